//! Tables that the sources of a run share, so that a million devices do not each hold a copy. A table changes only the
//! speed: a source draws the same arrivals with and without it. Digests depend on the arithmetic of the hazards, by
//! which a diurnal source draws; `tests/src/reference/harvest.rs` finds the same arrivals TTI by TTI.

use std::sync::Arc;

use super::sun::Sun;
use crate::ids::Tti;
use crate::rng::{GapTable, Geometric};
use crate::units::Energy;

/// The mean of `e_b` with probability `p`, to the nearest micro-unit: the rounding that the sources have in common,
/// repeated in `tests/src/reference/harvest.rs`.
pub(super) fn expected_energy(p: f64, e_b: Energy) -> Energy {
    Energy::from_micro((p * e_b.micro() as f64).round() as u64)
}

/// Data shared by the energy sources of a run: recorded energy, tables to draw gaps from, and hazards of days.
#[derive(Clone, Debug, Default)]
pub struct SharedSourceData {
    /// The run's traces, energy per TTI by row.
    pub(super) traces: Vec<Arc<Vec<Energy>>>,
    gap_tables: Vec<SharedGapTable>,
    day_hazards: Vec<SharedDayHazards>,
}

/// A table to draw the gaps between arrivals from.
#[derive(Clone, Debug)]
struct SharedGapTable {
    /// The probability of an arrival in a TTI.
    arrival_probability: f64,
    table: Arc<GapTable>,
}

/// The hazards of a day.
#[derive(Clone, Debug)]
struct SharedDayHazards {
    sun: Sun,
    /// The probability of an arrival in a TTI with the sun in the zenith.
    zenith_probability: f64,
    hazards: Arc<CumulativeHazard>,
}

impl SharedSourceData {
    /// Creates the shared data with the run's `traces` only, energy per TTI by row.
    pub(super) fn with_traces(traces: Vec<Arc<Vec<Energy>>>) -> Self {
        Self {
            traces,
            ..Self::default()
        }
    }

    /// Adds the table of the gaps between arrivals of probability `p`, unless it exists.
    pub(super) fn add_gap_table(&mut self, p: f64) {
        // Shared by all devices with this probability, since a table costs thousands of logarithms.
        if self.find_gap_table(p).is_none() {
            self.gap_tables.push(SharedGapTable {
                arrival_probability: p,
                table: Arc::new(GapTable::new(Geometric::new(p))),
            });
        }
    }

    /// Adds the hazards of a day under `sun`, unless they exist; `zenith_probability` is the probability for an
    /// irradiance of 1.
    pub(super) fn add_day_hazards(&mut self, sun: &Sun, zenith_probability: f64) {
        if self.find_hazards(sun, zenith_probability).is_none() {
            self.day_hazards.push(SharedDayHazards {
                sun: *sun,
                zenith_probability,
                hazards: Arc::new(CumulativeHazard::new(sun.arrival_probabilities(zenith_probability))),
            });
        }
    }

    /// The gaps between arrivals of probability `p`, from a shared table if available.
    pub(super) fn gap_table(&self, p: f64) -> Arc<GapTable> {
        self.find_gap_table(p)
            .map_or_else(|| Arc::new(GapTable::new(Geometric::new(p))), Arc::clone)
    }

    /// The hazards of a day under `sun`, shared if available.
    pub(super) fn hazards(&self, sun: &Sun, zenith_probability: f64) -> Arc<CumulativeHazard> {
        let known = self.find_hazards(sun, zenith_probability);
        known.map_or_else(
            || Arc::new(CumulativeHazard::new(sun.arrival_probabilities(zenith_probability))),
            Arc::clone,
        )
    }

    fn find_gap_table(&self, p: f64) -> Option<&Arc<GapTable>> {
        let is_same = |known: &&SharedGapTable| known.arrival_probability.to_bits() == p.to_bits();
        self.gap_tables.iter().find(is_same).map(|known| &known.table)
    }

    fn find_hazards(&self, sun: &Sun, zenith_probability: f64) -> Option<&Arc<CumulativeHazard>> {
        let is_same = |known: &&SharedDayHazards| {
            known.sun == *sun && known.zenith_probability.to_bits() == zenith_probability.to_bits()
        };
        self.day_hazards.iter().find(is_same).map(|known| &known.hazards)
    }
}

/// Cumulative hazard of a day: the integral of −ln(1 − p) from its first TTI, where p is the probability of an arrival.
#[derive(Clone, Debug)]
pub(super) struct CumulativeHazard {
    /// The hazard up to and including each TTI of the day.
    cumulative: Vec<f64>,
}

impl CumulativeHazard {
    /// Creates the hazards of a `day` of TTIs with these arrival probabilities, each below 1: loading a scenario and
    /// [`DiurnalSetup::is_valid`](super::DiurnalSetup) ensure it.
    pub(super) fn new(day: impl Iterator<Item = f64>) -> Self {
        let mut sum = 0.0;
        let ends = day.map(|p| {
            sum -= libm::log1p(-p);
            sum
        });
        Self {
            cumulative: ends.collect(),
        }
    }

    /// The first TTI from `from` on by whose end the hazard has grown by more than `hazard`, ≥ 0.
    ///
    /// TTIs whose hazards add up to h bring no arrival with probability exp(-h). So one exponential draw finds the TTI
    /// of the next arrival with the same law as an independent trial in each TTI.
    pub(super) fn first_tti_beyond(&self, from: Tti, hazard: f64) -> Tti {
        let ttis = self.cumulative.len() as u64;
        let whole_day = self.cumulative.last().copied().unwrap_or(0.0);
        if whole_day <= 0.0 {
            return Tti::NEVER;
        }
        let (day, slot) = (from.0 / ttis, (from.0 % ttis) as usize);
        let hazard_before = slot.checked_sub(1).map_or(0.0, |last| self.cumulative[last]);
        let target = hazard_before + hazard;
        let days = (target / whole_day).floor();
        // Rounding can make the difference slightly negative.
        let hazard_in_day = (target - days * whole_day).max(0.0);
        let mut day = day.saturating_add(days as u64);
        // A dark TTI ends with the sum of the TTI before it, so it is never chosen.
        let mut slot = self.cumulative.partition_point(|&end| end <= hazard_in_day);
        if slot == self.cumulative.len() {
            // Only rounding leads here: the arrival is in the first lit TTI of the next day.
            day = day.saturating_add(1);
            slot = self.cumulative.partition_point(|&end| end <= 0.0);
        }
        Tti(day.saturating_mul(ttis).saturating_add(slot as u64))
    }
}
