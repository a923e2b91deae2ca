//! Upper bounds of wake-up correlations on a grid of distances, cached per sensing model and shared between runs.
//!
//! [`Correlation`](crate::beliefs::correlation::Correlation) computes and reads them. Runs share the cache through
//! [`Knowledge::correlation_bounds`](crate::knowledge::Knowledge::correlation_bounds), so a grid must depend on its key
//! alone.

use std::sync::{Arc, Mutex, PoisonError};

/// Upper bounds of `P_4,2` on a grid of distances, each valid for all pairs (d, γ) that are nearest to its grid point:
/// d from the event to the reporter, γ from the reporter to a candidate. Rows are along d, columns along γ.
#[derive(Debug, Default)]
pub(crate) struct CorrelationBounds {
    /// Grid points per metre.
    pub(crate) points_per_metre: f64,
    /// Grid points along γ, from 0 to at least twice the sensing range.
    pub(crate) columns: usize,
    /// Bands of γ with a bound of at least p(d_max), one list per row of d, in descending order of the bound.
    pub(crate) bands: Vec<Vec<Band>>,
}

/// All γ nearest to one grid point of a row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Band {
    /// Index of the grid point along γ.
    pub(crate) column: usize,
    /// Upper bound of `P_4,2` over all pairs nearest to this grid point.
    pub(crate) bound: f64,
}

/// Largest number of sensing models with cached bounds; the oldest makes room for a new one.
const MAX_MODELS: usize = 32;

/// The bits of η and d_max, which determine the bounds of a sensing model.
type ModelKey = (u64, u64);

/// Cache of bounds by η and d_max, for several runs. Its contents do not change any result.
#[derive(Debug, Default)]
pub struct BoundsCache(Mutex<Vec<(ModelKey, Arc<CorrelationBounds>)>>);

impl BoundsCache {
    /// Returns the bounds of `key`, and calls `make` if they are not cached.
    pub(crate) fn get_or_make(
        &self,
        key: ModelKey,
        make: impl FnOnce() -> CorrelationBounds,
    ) -> Arc<CorrelationBounds> {
        // A panic in another thread leaves the list whole, since entries change only by one `remove` and one `push`.
        let lock = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, cached)) = lock().iter().find(|(other, _)| *other == key) {
            return Arc::clone(cached);
        }
        // The lock is free while `make` runs. Two runs may make the same bounds twice; both copies are equal.
        let bounds = Arc::new(make());
        let mut entries = lock();
        if entries.len() >= MAX_MODELS {
            entries.remove(0);
        }
        entries.push((key, Arc::clone(&bounds)));
        bounds
    }
}
