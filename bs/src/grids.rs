//! Upper bounds of wake-up correlations on a grid of distances, made once for a sensing model and shared between runs.

use std::sync::{Arc, Mutex, PoisonError};

/// Upper bounds of `P_4,2` on a grid of distances, each good for all pairs (d, γ) that are nearest to its grid point.
#[derive(Debug, Default)]
pub(crate) struct Bounds {
    /// Grid points per metre.
    pub(crate) scale: f64,
    /// Grid points along γ, from 0 to twice the sensing range.
    pub(crate) columns: usize,
    /// For each row of d the bands of γ with a bound of at least p(d_max), by falling bound.
    pub(crate) bands: Vec<Vec<Band>>,
}

/// All γ that are nearest to one grid point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Band {
    /// The number of the grid point.
    pub(crate) column: usize,
    /// No less than `P_4,2` of any pair with this γ.
    pub(crate) bound: f64,
}

/// Grids that are kept.
const KEPT: usize = 32;

/// The bits of η and d_max, which make the grid of a sensing model.
type Key = (u64, u64);

/// Grids of bounds by η and d_max, to be shared between runs: what is in it changes no result.
#[derive(Debug, Default)]
pub struct Grids(Mutex<Vec<(Key, Arc<Bounds>)>>);

impl Grids {
    /// The grid of `key`, which `make` makes unless it is known.
    pub(crate) fn get_or_make(&self, key: Key, make: impl FnOnce() -> Bounds) -> Arc<Bounds> {
        let lock = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, known)) = lock().iter().find(|(other, _)| *other == key) {
            return Arc::clone(known);
        }
        let made = Arc::new(make());
        let mut grids = lock();
        if grids.len() >= KEPT {
            grids.remove(0);
        }
        grids.push((key, Arc::clone(&made)));
        made
    }
}
