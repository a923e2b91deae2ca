//! What ages are worth.

/// The largest age that is told from larger ones, TTIs.
pub const OLDEST: usize = u8::MAX as usize;

/// What looking at a cell of each age is worth, from age 0 to [`OLDEST`]; at most 255, and never less for a larger age.
pub type Worths = [u8; OLDEST + 1];
