//! The transitions of the state machine.

/// The transitions (m, n) of Fig. 4, in the order of everything here.
pub const PAIRS: [(usize, usize); 10] = [
    (1, 1),
    (1, 2),
    (1, 4),
    (2, 3),
    (2, 4),
    (3, 1),
    (3, 4),
    (4, 1),
    (4, 2),
    (4, 4),
];
