//! Ages of all places: the time since a device last covered each of them. [`selector`] chooses the sensing devices by
//! the worths of ages, for `age-index`, `dt` and `q-learning`; [`price`] sets the prices of the first two, for
//! `age-index` also by the battery levels that `foresight` predicts. `staleness` serves external policies.
//! `index_table` holds the worths, `check` the checks of scenarios, and `cells`, `certain` and `probabilistic` the ages
//! themselves.
//!
//! The age of a place is the number of TTIs in which an unnoticed event may have started there, including the coming
//! TTI. It is 1 before the first TTI. It is 1 again after a TTI in which a device in S1 covers the place. After a
//! reported event all ages are 1: that event is closed, no other was active, and the next starts in the next TTI at the
//! earliest. All other places age by one TTI, up to 255.
//!
//! If detection is certain within d_max, one look resets a place. If it is probabilistic, a look from distance d resets
//! the place with probability p(d), and the age is the mean over both outcomes. The same holds if the radio may lose
//! reports. Digests depend on every bit of a gain. docs/age-index.md states the rule, and
//! `tests/src/reference/age_index.rs` computes gains a second time.

mod cells;
mod certain;
mod check;
pub(crate) mod foresight;
mod index_table;
pub mod price;
mod probabilistic;
pub mod selector;
pub(crate) mod staleness;

use pulp::NullaryFnOnce;
use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::{DetectionKind, Sensing};

use self::cells::Cells;
use self::certain::CertainAges;
pub(crate) use self::check::check_cells;
pub use self::check::check_price;
pub use self::index_table::{MAX_WORTH, MIN_PRICE, effective_area};
use self::probabilistic::ProbabilisticAges;
use super::posterior::PlacePrior;
use crate::vector_width::VectorWidth;

/// Ages of the cells of an area, and the worth that the devices chosen for the coming TTI leave uncovered.
///
/// Devices are added or removed before each TTI. [`Ages::advance`] then passes the TTI, in which they sense.
#[derive(Clone, Debug)]
pub struct Ages {
    cells: Cells,
    model: AgeModel,
    vector_width: VectorWidth,
}

#[derive(Clone, Debug)]
enum AgeModel {
    Certain(CertainAges),
    Probabilistic(ProbabilisticAges),
}

/// A call of [`Ages::gain`]: a type, since a closure may not be inlined into [`VectorWidth::run`].
struct GainOf<'a> {
    ages: &'a Ages,
    j: usize,
}

impl NullaryFnOnce for GainOf<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        self.ages.inlined_gain(self.j)
    }
}

impl Ages {
    /// Creates the ages of `area` before the first TTI, for devices at `positions`, none of them chosen.
    pub fn new(positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        Self::with_loss(0.0, positions, area, sensing)
    }

    /// Creates ages like [`Self::new`], where a detection stays unreported with probability `loss_probability`,
    /// `[0, 1]`.
    pub(crate) fn with_loss(loss_probability: f64, positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let cells = Cells::new(area, sensing.d_max);
        let probabilistic = |detection_probability: &dyn Fn(f64) -> f64| {
            let report_probability = |d: f64| (1.0 - loss_probability) * detection_probability(d);
            AgeModel::Probabilistic(ProbabilisticAges::new(
                &cells,
                positions,
                sensing.d_max,
                report_probability,
            ))
        };
        let model = match sensing.kind {
            DetectionKind::Range if loss_probability <= 0.0 => {
                AgeModel::Certain(CertainAges::new(&cells, positions, sensing.d_max))
            }
            DetectionKind::Range => probabilistic(&|_| 1.0),
            DetectionKind::Probabilistic => probabilistic(&|d| sensing.p(d)),
        };
        Self {
            cells,
            model,
            vector_width: VectorWidth::fastest(),
        }
    }

    /// Returns the gain of adding the `j`-th device: the sum over its cells of the worths of their ages. With
    /// probabilistic detection each worth is weighted by the probability that only this device detects.
    pub fn gain(&self, j: usize) -> f64 {
        self.vector_width.run(GainOf { ages: self, j })
    }

    /// Sets `gains` to the [`Self::gain`] of each device, for callers inlined into [`VectorWidth::run`].
    #[inline(always)]
    pub(crate) fn fill_gains(&self, gains: &mut [f64]) {
        for (j, gain) in gains.iter_mut().enumerate() {
            *gain = self.inlined_gain(j);
        }
    }

    /// Returns [`Self::gain`], for callers inlined into [`VectorWidth::run`].
    #[inline(always)]
    fn inlined_gain(&self, j: usize) -> f64 {
        match &self.model {
            AgeModel::Certain(certain) => f64::from(certain.gain(j)),
            AgeModel::Probabilistic(probabilistic) => probabilistic.gain(j),
        }
    }

    /// Returns the worth that the chosen devices leave uncovered: the sum over all cells, in the unit of
    /// [`Self::gain`].
    pub fn uncovered_worth(&self) -> f64 {
        match &self.model {
            AgeModel::Certain(certain) => certain.uncovered_worth() as f64,
            AgeModel::Probabilistic(probabilistic) => probabilistic.uncovered_worth(),
        }
    }

    /// Returns the sum over all cells if no device was chosen.
    pub fn total_worth(&self) -> f64 {
        match &self.model {
            AgeModel::Certain(certain) => certain.total_worth() as f64,
            AgeModel::Probabilistic(probabilistic) => probabilistic.total_worth(),
        }
    }

    /// Adds the `j`-th device, which is not chosen, to the choice.
    #[inline(always)]
    pub fn add(&mut self, j: usize) {
        match &mut self.model {
            AgeModel::Certain(certain) => certain.add(j),
            AgeModel::Probabilistic(probabilistic) => probabilistic.add(j),
        }
    }

    /// Removes the `j`-th device, which is chosen, from the choice.
    #[inline(always)]
    pub fn remove(&mut self, j: usize) {
        match &mut self.model {
            AgeModel::Certain(certain) => certain.remove(j),
            AgeModel::Probabilistic(probabilistic) => probabilistic.remove(j),
        }
    }

    /// Removes all devices from the choice.
    pub fn clear(&mut self) {
        match &mut self.model {
            AgeModel::Certain(certain) => certain.clear(),
            AgeModel::Probabilistic(probabilistic) => probabilistic.clear(),
        }
    }

    /// Passes a TTI in which the chosen devices sense, and clears the choice. All ages are 1 again if
    /// `is_event_reported`.
    pub fn advance(&mut self, is_event_reported: bool) {
        match &mut self.model {
            AgeModel::Certain(certain) => certain.advance(is_event_reported),
            AgeModel::Probabilistic(probabilistic) => probabilistic.advance(is_event_reported),
        }
    }

    /// Returns the age of the place `point` in the coming TTI, TTIs, 1 ..= `MAX_AGE`. Outside of the area, it is the
    /// age of the nearest cell.
    pub fn age_at(&self, point: Point) -> f64 {
        let cell = self.cells.cell_at(point);
        match &self.model {
            AgeModel::Certain(certain) => f64::from(certain.age(cell)),
            AgeModel::Probabilistic(probabilistic) => probabilistic.age(cell),
        }
    }

    /// Area of a cell, m².
    pub(crate) fn cell_surface(&self) -> f64 {
        self.cells.surface()
    }
}

/// The relative density of the epicentre is the age of its place.
impl PlacePrior for Ages {
    fn density_at(&self, place: Point) -> f64 {
        self.age_at(place)
    }

    #[inline(always)]
    fn densities_at(&self, x: &[f64], y: &[f64], densities: &mut [f64]) {
        self.cells.write_cells(x, y, densities);
        for density in densities {
            // A whole number, see `Cells::write_cells`.
            let cell = *density as u32 as usize;
            *density = match &self.model {
                AgeModel::Certain(certain) => f64::from(certain.age(cell)),
                AgeModel::Probabilistic(probabilistic) => probabilistic.age(cell),
            };
        }
    }
}

/// Returns the number of cells of `area` for the sensing range `d_max`.
pub fn count_cells(area: Area, d_max: f64) -> f64 {
    Cells::count(area, d_max)
}

#[cfg(test)]
mod tests;
