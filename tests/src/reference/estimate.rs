//! The base station's estimate of unreported battery levels in the reference: whether a device can pay for a report.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_common::scenario::EnergyModel;

/// Joint probability from which on missing reports mean an empty battery, as in the emulator.
const EMPTY_PROBABILITY: f64 = 0.02;

/// Estimate of one battery, micro-units.
#[derive(Clone, Debug)]
pub(super) struct ReferenceEstimate {
    costs: EnergyModel,
    /// Mean harvest in each TTI of a day; a single entry if all TTIs are alike.
    mean: Vec<u64>,
    /// Whether the sun is up in each TTI of a day.
    is_day: Vec<bool>,
    /// Last known level.
    level: u64,
    /// First TTI after the last known level.
    from: u64,
    /// First TTI since the last report in which the device was silent although, by the estimate, its battery could pay
    /// for a report and radio losses hardly explain the silence.
    silent_since: Option<u64>,
    /// TTIs from the first unexpected silence to the latest.
    silence_span: u64,
    /// Probability that radio losses alone explain the missing reports.
    loss_probability: f64,
}

impl ReferenceEstimate {
    /// Creates the estimate for a battery with these costs, and mean harvest and daylight by TTI of a day.
    pub(super) fn new(costs: EnergyModel, mean: Vec<u64>, is_day: Vec<bool>) -> Self {
        Self {
            level: costs.initial.micro(),
            costs,
            mean,
            is_day,
            from: 0,
            silent_since: None,
            silence_span: 0,
            loss_probability: 1.0,
        }
    }

    /// Returns the level at the end of TTI `k`, for a device that senses in the TTIs for which `senses` holds.
    fn level(&self, k: u64, senses: impl Fn(u64) -> bool) -> u64 {
        if k < self.from {
            return self.level;
        }
        let cost = |k: u64| {
            if senses(k) {
                self.costs.e_idle.micro()
            } else {
                self.costs.e_wur.micro()
            }
        };
        let is_up = |k: u64| self.is_day[k as usize % self.is_day.len()];
        let (mut level, mut first) = (self.level, self.from);
        // Sums over one day or one night at a time.
        while first <= k {
            let (mut income, mut spent, mut last) = (0, 0, first);
            loop {
                income += self.mean[last as usize % self.mean.len()];
                spent += cost(last);
                if last == k || is_up(last) != is_up(last + 1) {
                    break;
                }
                last += 1;
            }
            level = if income <= spent {
                level.saturating_sub(spent - income)
            } else {
                // In its silence the device gained less than `needed`, which limits the gain per TTI.
                let needed = self.costs.e_tx.micro() + self.costs.e_idle.micro();
                let max_gain = (needed * (last + 1 - first)).checked_div(self.silence_span);
                level + (income - spent).min(max_gain.unwrap_or(u64::MAX))
            };
            level = level.min(self.costs.e_max.micro().saturating_sub(cost(last)));
            first = last + 1;
        }
        level
    }

    /// Whether the device can pay for a report at the end of TTI `k`.
    pub(super) fn can_report(&self, k: u64, senses: impl Fn(u64) -> bool) -> bool {
        self.level(k, senses) >= self.costs.e_tx.micro()
    }

    /// Records that the device reported `level` in TTI `k`.
    pub(super) fn record_report(&mut self, k: u64, level: u64) {
        (self.level, self.from, self.silent_since, self.silence_span) = (level, k + 1, None, 0);
        self.loss_probability = 1.0;
    }

    /// Records a missing report in TTI `k`, in which a powered device must have reported. The radio alone loses it with
    /// probability `report_loss`. Once the joint probability is at most [`EMPTY_PROBABILITY`], the battery counts as
    /// empty.
    pub(super) fn record_silence(&mut self, k: u64, report_loss: f64, senses: impl Fn(u64) -> bool) {
        self.loss_probability *= report_loss;
        if self.loss_probability > EMPTY_PROBABILITY {
            return;
        }
        self.loss_probability = 1.0;
        let level = self.level(k, senses);
        if level > 0 && level >= self.costs.e_tx.micro() {
            self.silence_span = k - *self.silent_since.get_or_insert(k);
        }
        (self.level, self.from) = (0, k + 1);
    }
}
