//! The measured result of a pair of weights. [`Evaluation::NAMES`] and the order of the values are the format of
//! history files; `reveille tune --json` uses the names as keys. A change needs another first line in `history`.

use super::ranges::WeightPair;

/// The measured result of a pair of weights: means over the evaluation runs in which the value is defined.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Evaluation {
    /// The objective.
    pub objective: f64,
    /// Half the width of its 95 % interval; NaN for a single run.
    pub objective_half_width: f64,
    /// Information, the objective of P1.
    pub information: f64,
    /// Half the width of its 95 % interval; NaN for a single run.
    pub information_half_width: f64,
    /// The share of events without a report, %.
    pub misdetection_pct: f64,
    /// The energy spent per device and TTI, units.
    pub energy: f64,
    /// The number of wake-ups per event.
    pub wake_ups: f64,
}

impl Evaluation {
    /// The names of [`Self::values`] in files, in their order.
    pub const NAMES: [&str; 7] = [
        "objective",
        "objective_half_width",
        "info_p1",
        "info_half_width",
        "misdetection_pct",
        "energy_per_device_tti",
        "wake_ups_per_event",
    ];

    /// The fields in the order of [`Self::NAMES`].
    pub const fn values(&self) -> [f64; 7] {
        [
            self.objective,
            self.objective_half_width,
            self.information,
            self.information_half_width,
            self.misdetection_pct,
            self.energy,
            self.wake_ups,
        ]
    }

    /// Creates an evaluation from [`Self::values`].
    pub const fn from_values(values: [f64; 7]) -> Self {
        let [
            objective,
            objective_half_width,
            information,
            information_half_width,
            misdetection_pct,
            energy,
            wake_ups,
        ] = values;
        Self {
            objective,
            objective_half_width,
            information,
            information_half_width,
            misdetection_pct,
            energy,
            wake_ups,
        }
    }
}

/// A pair of weights and its measured result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TuningPoint {
    /// The pair.
    pub weights: WeightPair,
    /// The measured result.
    pub evaluation: Evaluation,
}
