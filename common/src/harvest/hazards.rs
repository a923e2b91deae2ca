//! Gaps between arrivals whose probability changes with the time of the day.

use crate::ids::Tti;

/// How hazardous a day is: the integral of −ln(1 − p) from its first TTI on, p the probability of an arrival.
#[derive(Clone, Debug)]
pub(super) struct Hazards {
    /// Up to and with each TTI of the day.
    ends: Vec<f64>,
}

impl Hazards {
    /// Those of a `day` of TTIs with these probabilities of an arrival, each below 1.
    pub(super) fn new(day: impl Iterator<Item = f64>) -> Self {
        let mut sum = 0.0;
        let ends = day.map(|p| {
            sum -= libm::log1p(-p);
            sum
        });
        Self { ends: ends.collect() }
    }

    /// The first TTI from `from` on by whose end the hazard has grown by more than `asked`, ≥ 0.
    ///
    /// No arrival comes in TTIs of which the hazards add up to h with the probability exp(-h), so an exponential draw
    /// gives the TTI of the next arrival, as independent trials in all of them would.
    pub(super) fn passed(&self, from: Tti, asked: f64) -> Tti {
        let ttis = self.ends.len() as u64;
        let whole = self.ends.last().copied().unwrap_or(0.0);
        if whole <= 0.0 {
            return Tti::NEVER;
        }
        let (day, slot) = (from.0 / ttis, (from.0 % ttis) as usize);
        let before = slot.checked_sub(1).map_or(0.0, |last| self.ends[last]);
        let goal = before + asked;
        let days = (goal / whole).floor();
        let rest = (goal - days * whole).max(0.0);
        let mut day = day.saturating_add(days as u64);
        let mut slot = self.ends.partition_point(|&end| end <= rest);
        if slot == self.ends.len() {
            // By rounding alone: it is the first of the next day.
            day = day.saturating_add(1);
            slot = self.ends.partition_point(|&end| end <= 0.0);
        }
        Tti(day.saturating_mul(ttis).saturating_add(slot as u64))
    }
}
