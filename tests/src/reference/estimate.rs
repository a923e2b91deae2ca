//! The base station's estimate of unreported battery levels in the reference: whether a device can pay for a report.
//! It matches the emulator for policies that do not read all levels, such as `knn` and `adjusted`. For the others, with
//! `bs.battery_knowledge = reported`, the emulator has a further rule for long silences, which is missing here.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_common::scenario::EnergyModel;

/// Joint probability from which on missing reports mean an empty battery; `MIN_SILENCE_LIKELIHOOD` in
/// `bs/src/battery_estimator/mod.rs`.
const EMPTY_PROBABILITY: f64 = 0.02;

/// Estimate of one battery, micro-units.
#[derive(Clone, Debug)]
pub(super) struct ReferenceEstimate {
    costs: EnergyModel,
    /// Mean harvest in each TTI of a day; a single entry if all TTIs are alike.
    expected_harvest: Vec<u64>,
    /// Whether the sun is up in each TTI of a day; a single entry if all TTIs are alike.
    is_daylight: Vec<bool>,
    /// Last known level.
    known_level: u64,
    /// First TTI after the last known level.
    first_estimated_tti: u64,
    /// First TTI since the last report in which the device was silent although, by the estimate, its battery could pay
    /// for a report and radio losses hardly explain the silence.
    silent_since: Option<u64>,
    /// TTIs from the first unexpected silence to the latest; 0 if there was at most one.
    silence_span: u64,
    /// Probability that radio losses alone explain the missing reports since the last known level.
    silence_likelihood: f64,
}

impl ReferenceEstimate {
    /// Creates the estimate for a battery with these costs, and mean harvest and daylight by TTI of a day. Neither list
    /// is empty.
    pub(super) fn new(costs: EnergyModel, expected_harvest: Vec<u64>, is_daylight: Vec<bool>) -> Self {
        Self {
            known_level: costs.initial.micro(),
            costs,
            expected_harvest,
            is_daylight,
            first_estimated_tti: 0,
            silent_since: None,
            silence_span: 0,
            silence_likelihood: 1.0,
        }
    }

    /// Returns the level at the end of TTI `k`, for a device that senses in the TTIs for which `senses` holds.
    fn level_at_end(&self, k: u64, senses: impl Fn(u64) -> bool) -> u64 {
        if k < self.first_estimated_tti {
            return self.known_level;
        }
        let cost = |tti: u64| {
            if senses(tti) {
                self.costs.e_idle.micro()
            } else {
                self.costs.e_wur.micro()
            }
        };
        let is_up = |tti: u64| self.is_daylight[tti as usize % self.is_daylight.len()];
        let (mut level, mut first) = (self.known_level, self.first_estimated_tti);
        // Sums over one day or one night at a time.
        while first <= k {
            let (mut income, mut spent, mut last) = (0, 0, first);
            loop {
                income += self.expected_harvest[last as usize % self.expected_harvest.len()];
                spent += cost(last);
                if last == k || is_up(last) != is_up(last + 1) {
                    break;
                }
                last += 1;
            }
            level = if income <= spent {
                level.saturating_sub(spent - income)
            } else {
                // In its silence the device gained less than `report_cost`, which limits the gain per TTI.
                let report_cost = self.costs.e_tx.micro() + self.costs.e_idle.micro();
                let max_gain = (report_cost * (last + 1 - first)).checked_div(self.silence_span);
                level + (income - spent).min(max_gain.unwrap_or(u64::MAX))
            };
            level = level.min(self.costs.e_max.micro().saturating_sub(cost(last)));
            first = last + 1;
        }
        level
    }

    /// Whether the device can pay for a report at the end of TTI `k`, if it senses in the TTIs for which `senses`
    /// holds.
    pub(super) fn can_report(&self, k: u64, senses: impl Fn(u64) -> bool) -> bool {
        self.level_at_end(k, senses) >= self.costs.e_tx.micro()
    }

    /// Records that the device reported `level` in TTI `k`.
    pub(super) fn record_report(&mut self, k: u64, level: u64) {
        (self.known_level, self.first_estimated_tti) = (level, k + 1);
        (self.silent_since, self.silence_span) = (None, 0);
        self.silence_likelihood = 1.0;
    }

    /// Records a missing report in TTI `k`, in which a powered device must have reported. The radio alone loses it with
    /// probability `loss_probability`. Once the joint probability is at most [`EMPTY_PROBABILITY`], the battery counts
    /// as empty. Call at most once for a TTI.
    pub(super) fn record_silence(&mut self, k: u64, loss_probability: f64, senses: impl Fn(u64) -> bool) {
        self.silence_likelihood *= loss_probability;
        if self.silence_likelihood > EMPTY_PROBABILITY {
            return;
        }
        self.silence_likelihood = 1.0;
        let level = self.level_at_end(k, senses);
        if level > 0 && level >= self.costs.e_tx.micro() {
            self.silence_span = k - *self.silent_since.get_or_insert(k);
        }
        (self.known_level, self.first_estimated_tti) = (0, k + 1);
    }
}
