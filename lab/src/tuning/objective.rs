//! The objective of a tuning: the number that a run's metrics give, larger is better. Its name and its text are in the
//! header of the history file, so after a change of either, older tunings cannot be resumed. `figures tuning` shows
//! both.

use std::fmt;

use reveille_common::score::Metrics;

/// The objective that a tuning maximises. Information is `info_p1`, the objective of P1: Σ I_i / (αK). Information per
/// event would favour policies that rarely look, because it ignores events that they miss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TuningObjective {
    /// Information (P1) − `energy_weight` · (units spent per device and TTI) − `miss_weight` · (share of events
    /// misdetected).
    Balance {
        /// Value of one unit per device and TTI in information (P1), ≥ 0.
        energy_weight: f64,
        /// Cost of misdetecting all events in information (P1), beyond the information lost, ≥ 0.
        miss_weight: f64,
    },
    /// Information (P1), with a mean in `[0, Ψ]`.
    Information,
    /// Information per unit spent: Σ I_i / energy of all devices, over the measured TTIs.
    Efficiency,
}

impl TuningObjective {
    /// Returns the value of a run with these metrics. It is NaN if the run has no event, or spends no energy with
    /// [`Self::Efficiency`].
    ///
    /// `alpha` is α, events per TTI; `devices` is N. Σ I_i / Σ energy = `info_p1` · α / (N · energy per device and
    /// TTI).
    pub fn value_of(self, metrics: &Metrics, alpha: f64, devices: u32) -> f64 {
        let Metrics {
            info_p1,
            misdetection_pct,
            energy_per_device_tti,
            events,
            ..
        } = *metrics;
        if events == 0 {
            return f64::NAN;
        }
        match self {
            Self::Balance {
                energy_weight,
                miss_weight,
            } => info_p1 - energy_weight * energy_per_device_tti - miss_weight * misdetection_pct / 100.0,
            Self::Information => info_p1,
            Self::Efficiency if energy_per_device_tti <= 0.0 => f64::NAN,
            Self::Efficiency => info_p1 * alpha / (energy_per_device_tti * f64::from(devices)),
        }
    }

    /// The name on the command line and in histories.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Balance { .. } => "balance",
            Self::Information => "information",
            Self::Efficiency => "efficiency",
        }
    }
}

impl fmt::Display for TuningObjective {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Balance {
                energy_weight,
                miss_weight,
            } => {
                write!(
                    f,
                    "information (P1) − {energy_weight} × energy − {miss_weight} × share missed"
                )
            }
            Self::Information => f.write_str("information (P1)"),
            Self::Efficiency => f.write_str("information per unit spent"),
        }
    }
}
