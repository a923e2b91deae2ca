//! The measured result of a pair of weights.

use super::ranges::Pair;

/// The measured result of a pair of weights, means over the evaluation runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Evaluation {
    /// The objective.
    pub objective: f64,
    /// Half the width of its 95 % interval; NaN for a single run.
    pub objective_half: f64,
    /// Information, the objective of P1.
    pub information: f64,
    /// Half the width of its 95 % interval; NaN for a single run.
    pub information_half: f64,
    /// Events without a report, % of events.
    pub misdetection_pct: f64,
    /// Units spent per device and TTI.
    pub energy: f64,
    /// Wake-ups per event.
    pub wake_ups: f64,
}

impl Evaluation {
    /// What [`Self::values`] are called in files, in their order.
    pub const NAMES: [&str; 7] = [
        "objective",
        "objective_half_width",
        "info_p1",
        "info_half_width",
        "misdetection_pct",
        "energy_per_device_tti",
        "wake_ups_per_event",
    ];

    /// The fields.
    pub const fn values(&self) -> [f64; 7] {
        [
            self.objective,
            self.objective_half,
            self.information,
            self.information_half,
            self.misdetection_pct,
            self.energy,
            self.wake_ups,
        ]
    }

    /// The evaluation with these [`Self::values`].
    pub const fn of(values: [f64; 7]) -> Self {
        let [
            objective,
            objective_half,
            information,
            information_half,
            misdetection_pct,
            energy,
            wake_ups,
        ] = values;
        Self {
            objective,
            objective_half,
            information,
            information_half,
            misdetection_pct,
            energy,
            wake_ups,
        }
    }
}

/// A pair of weights and its measured result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// The pair.
    pub weights: Pair,
    /// Its measured result.
    pub evaluation: Evaluation,
}
