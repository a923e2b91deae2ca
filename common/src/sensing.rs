//! What a device senses of an event and what its report is worth (paper Sec. II-A).

use serde::{Deserialize, Serialize};

use crate::ids::{DeviceId, EventId};
use crate::rng::{Purpose, unit_for_pair};

/// How a device in S1 comes to detect the active event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DetectionKind {
    /// Every S1 device within `d_max` of the epicentre detects it.
    Range,
    /// An S1 device within `d_max` detects with probability p(d): the literal P_1,2 = α p(d) of Sec. IV.
    Probabilistic,
}

impl DetectionKind {
    /// Its name, as in `sensing.kind` of a scenario.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Range => "range",
            Self::Probabilistic => "probabilistic",
        }
    }
}

/// The function g that joins the reports of one event (Eq. (2)).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fusion {
    /// The largest report counts.
    Max,
    /// Reports add up to at most Ψ, Eq. (3).
    SumSaturation,
}

impl Fusion {
    /// Its name, as in `sensing.g` of a scenario.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Max => "max",
            Self::SumSaturation => "sum-saturation",
        }
    }
}

/// The sensing model that all devices share.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sensing {
    /// Detection in S1.
    pub kind: DetectionKind,
    /// Sensing range d_max, metres, > 0 (Table II: 4).
    pub d_max: f64,
    /// Decay η of the sensing function, per metre, > 0 (Table II: 1).
    pub eta: f64,
    /// Largest information Ψ of one report, > 0 (Table II: 1).
    pub psi: f64,
    /// The function g of Eq. (2).
    pub g: Fusion,
}

impl Sensing {
    /// The sensing function p(d) = exp(-η d), `(0, 1]`, of a distance `d` ≥ 0 in metres.
    pub fn p(&self, d: f64) -> f64 {
        libm::exp(-self.eta * d)
    }

    /// The information I_ij = Ψ p(d) of a report from distance `d` in metres (Eq. (1)); 0 beyond `d_max`.
    pub fn information(&self, d: f64) -> f64 {
        if d <= self.d_max { self.psi * self.p(d) } else { 0.0 }
    }

    /// The distance in metres that a report of information `i` tells of: the inverse of Eq. (1). `None` for a report
    /// without information, which only says that the event is farther than `d_max`.
    pub fn distance(&self, i: f64) -> Option<f64> {
        (i > 0.0).then(|| (-libm::log(i / self.psi) / self.eta).max(0.0))
    }

    /// Whether `device`, in S1 at distance `d` metres, detects `event`. One draw per event and device.
    pub fn detects(&self, seed: u64, event: EventId, device: DeviceId, d: f64) -> bool {
        d <= self.d_max
            && match self.kind {
                DetectionKind::Range => true,
                DetectionKind::Probabilistic => {
                    unit_for_pair(seed, Purpose::Detection, event.0, u64::from(device.0)) < self.p(d)
                }
            }
    }

    /// The information Î at the BS after one more report of information `report` (Eq. (2)).
    pub fn fuse(&self, so_far: f64, report: f64) -> f64 {
        match self.g {
            Fusion::Max => so_far.max(report),
            Fusion::SumSaturation => (so_far + report).min(self.psi),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paper() -> Sensing {
        Sensing {
            kind: DetectionKind::Range,
            d_max: 4.0,
            eta: 1.0,
            psi: 1.0,
            g: Fusion::Max,
        }
    }

    #[test]
    fn p_at_d_max_is_the_papers_0_018() {
        assert!((paper().p(4.0) - 0.018_315_638_888_734_18).abs() < 1e-16);
    }

    #[test]
    fn a_report_tells_its_distance() {
        for d in [0.0, 0.3, 1.7, 3.999, 4.0] {
            let back = paper().distance(paper().information(d)).expect("within range");
            assert!((back - d).abs() < 1e-12, "{d} came back as {back}");
        }
        assert_eq!(paper().distance(paper().information(4.1)), None);
    }

    #[test]
    fn probabilistic_detection_follows_p() {
        let sensing = Sensing {
            kind: DetectionKind::Probabilistic,
            ..paper()
        };
        let n = 100_000;
        let hits = (0..n)
            .filter(|&i| sensing.detects(3, EventId(i), DeviceId(4), 1.0))
            .count() as f64
            / n as f64;
        let p = sensing.p(1.0);
        assert!(
            (hits - p).abs() < 4.0 * (p * (1.0 - p) / n as f64).sqrt(),
            "{hits} against {p}"
        );
        assert!((0..n).all(|i| !sensing.detects(3, EventId(i), DeviceId(4), 4.01)));
    }

    #[test]
    fn fusion_takes_the_maximum_or_a_capped_sum() {
        let sum = Sensing {
            g: Fusion::SumSaturation,
            ..paper()
        };
        assert!((paper().fuse(0.4, 0.3) - 0.4).abs() < f64::EPSILON);
        assert!((sum.fuse(0.4, 0.3) - 0.7).abs() < 1e-15);
        assert!((sum.fuse(0.8, 0.3) - 1.0).abs() < f64::EPSILON);
    }
}
