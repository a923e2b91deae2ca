//! What the sources of a run have in common.

use std::sync::Arc;

use super::hazards::Hazards;
use super::sun::Sun;
use crate::rng::{GapTable, Geometric};
use crate::units::Energy;

/// The mean of `e_b` with probability `p`, to the nearest micro-unit.
pub(super) fn expected(p: f64, e_b: Energy) -> Energy {
    Energy::from_micro((p * e_b.micro() as f64).round() as u64)
}

/// What the sources of a run share: recorded energy, the tables that gaps are drawn from, and those of a day.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    pub(super) traces: Vec<Arc<Vec<Energy>>>,
    /// The tables, by the bits of the probability of an arrival.
    tables: Vec<(u64, Arc<GapTable>)>,
    /// The days of places, by the probability of an arrival under a sun in the zenith.
    days: Vec<(Sun, f64, Arc<Hazards>)>,
}

impl Sources {
    /// What sources need that read `traces`, the run's, energy per TTI by row.
    pub(super) fn with_traces(traces: Vec<Arc<Vec<Energy>>>) -> Self {
        Self {
            traces,
            ..Self::default()
        }
    }

    /// Adds the gaps between arrivals of probability `p`.
    pub(super) fn add_gaps(&mut self, p: f64) {
        if self.tables.iter().all(|&(known, _)| known != p.to_bits()) {
            self.tables
                .push((p.to_bits(), Arc::new(GapTable::new(Geometric::new(p)))));
        }
    }

    /// Adds the days under `sun` where an arrival has the probability `zenith` for an irradiance of 1.
    pub(super) fn add_hazards(&mut self, sun: &Sun, zenith: f64) {
        if self.known_day(sun, zenith).is_none() {
            self.days
                .push((*sun, zenith, Arc::new(Hazards::new(sun.times(zenith)))));
        }
    }

    /// The gaps between arrivals of probability `p`, from a table shared with other devices if there is one.
    pub(super) fn gaps(&self, p: f64) -> Arc<GapTable> {
        let known = self.tables.iter().find(|(bits, _)| *bits == p.to_bits());
        known.map_or_else(
            || Arc::new(GapTable::new(Geometric::new(p))),
            |(_, table)| Arc::clone(table),
        )
    }

    /// The same days, shared with other devices if they are there.
    pub(super) fn hazards(&self, sun: &Sun, zenith: f64) -> Arc<Hazards> {
        let known = self.known_day(sun, zenith);
        known.map_or_else(|| Arc::new(Hazards::new(sun.times(zenith))), Arc::clone)
    }

    fn known_day(&self, sun: &Sun, zenith: f64) -> Option<&Arc<Hazards>> {
        let is_it = |(known, at, _): &&(Sun, f64, Arc<Hazards>)| known == sun && at.to_bits() == zenith.to_bits();
        self.days.iter().find(is_it).map(|(_, _, hazards)| hazards)
    }
}
