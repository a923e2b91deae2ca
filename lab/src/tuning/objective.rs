//! What is to be made large.

use std::fmt;

use reveille_common::score::Metrics;

/// What a run is worth. Information is `info_p1`, the objective of P1: Σ I_i / (αK). Information per event would favour
/// policies that look seldom, as what they miss by coming late does not count there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Objective {
    /// Information (P1) − `energy` · (units spent per device and TTI) − `miss` · (share of events misdetected).
    Balance {
        /// Information (P1) that one unit per device and TTI is worth, ≥ 0.
        energy: f64,
        /// Information (P1) that all events misdetected would cost, beyond the information that they lack, ≥ 0.
        miss: f64,
    },
    /// Information (P1), `[0, Ψ]` on the mean.
    Information,
    /// Information per unit spent: Σ I_i / energy of all devices, over the measured TTIs.
    Efficiency,
}

impl Objective {
    /// Its value for a run with these metrics; NaN if it has no event or spends nothing where that counts.
    ///
    /// `alpha` is α, events per TTI and `devices` is N: Σ I_i / Σ energy = `info_p1` · α / (N · energy per device and
    /// TTI).
    pub fn of(self, metrics: &Metrics, alpha: f64, devices: u32) -> f64 {
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
            Self::Balance { energy, miss } => {
                info_p1 - energy * energy_per_device_tti - miss * misdetection_pct / 100.0
            }
            Self::Information => info_p1,
            Self::Efficiency if energy_per_device_tti <= 0.0 => f64::NAN,
            Self::Efficiency => info_p1 * alpha / (energy_per_device_tti * f64::from(devices)),
        }
    }

    /// Its name, as on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Balance { .. } => "balance",
            Self::Information => "information",
            Self::Efficiency => "efficiency",
        }
    }
}

impl fmt::Display for Objective {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Balance { energy, miss } => {
                write!(f, "information (P1) − {energy} × energy − {miss} × share missed")
            }
            Self::Information => f.write_str("information (P1)"),
            Self::Efficiency => f.write_str("information per unit spent"),
        }
    }
}
