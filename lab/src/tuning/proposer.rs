//! Who chooses the next pair of weights.

use super::error::TuningError;
use super::ranges::{Pair, Ranges};

/// Chooses the next pair of weights.
pub trait Proposer {
    /// The pair to try next, in `ranges`, after `points`: pairs with the objective of each, at least
    /// [`super::LEAST_DESIGN`].
    ///
    /// # Errors
    /// If none can be found.
    fn propose(&self, ranges: &Ranges, points: &[(Pair, f64)]) -> Result<Pair, TuningError>;
}

/// Values over ranges of weights.
#[derive(Clone, Debug, PartialEq)]
pub struct Surface {
    /// At the middles of equal cells of the logarithms, by rising μ2, each row by rising μ1.
    pub rows: Vec<Vec<f64>>,
}
