//! The sensing of events by devices and the information in their reports (paper Sec. II-A). Digests hold the
//! information bit for bit, so no operation may change; `tests/src/reference/detection.rs` repeats the detection. Names
//! are part of scenario files, the scenario hash and learned tables. The doc comments of the fields are rows of
//! `docs/scenario.md`. A change of the fields of [`Sensing`] or of their order raises `WIRE_VERSION`.

use serde::{Deserialize, Serialize};

use crate::declare;
use crate::declare::{FieldReader, POSITIVE, ScenarioError, choice, choices, number};
use crate::geometry::Area;
use crate::ids::{DeviceId, EventId};
use crate::rng::{Purpose, unit_for_pair};

/// Maximum value of η · `d_max`: `p(d_max)` is still above 0 in double precision. The doc comment of `eta` repeats it.
const MAX_DECAY: f64 = 700.0;

choices! {
    /// Rule by which a device in S1 detects the active event.
    #[derive(Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum DetectionKind {
        /// Every device in S1 within `d_max` of the epicentre detects the event.
        Range = "range",
        /// A device in S1 within `d_max` detects the event with probability p(d): the literal reading of P_1,2 = α p(d)
        /// in Sec. IV.
        Probabilistic = "probabilistic",
    }
}

choices! {
    /// Function g that combines the reports of one event (Eq. (2)).
    #[derive(Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum Fusion {
        /// The largest report counts.
        Max = "max",
        /// The sum of all reports counts, up to Ψ, Eq. (3).
        SumSaturation = "sum-saturation",
    }
}

declare! {
    /// Sensing model and information of a report, shared by all devices (paper Sec. II-A).
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    pub struct Sensing in "sensing" {
        /// Rule by which a device in S1 detects the active event.
        pub kind: DetectionKind = choice::<DetectionKind>("range").source("Sec. II-A, Sec. IV"),
        /// Sensing range d_max. At most the area's diagonal.
        pub d_max: f64 = number(POSITIVE, 4.0).unit("metres").source("Table II"),
        /// Decay η of the sensing function p(d) = exp(-η d); η · d_max is at most 700.
        pub eta: f64 = number(POSITIVE, 1.0).unit("per metre").source("Table II"),
        /// Largest information Ψ of one report, reached at distance 0.
        pub psi: f64 = number(POSITIVE, 1.0).unit("information").source("Table II"),
        /// Function g that combines the reports of one event.
        pub g: Fusion = choice::<Fusion>("max").source("Eq. (2), Eq. (3)"),
    }
}

impl Sensing {
    /// Reads the settings from `reader`, for devices on `area`.
    ///
    /// # Errors
    /// If a value is not allowed.
    pub fn from_fields(reader: &FieldReader<'_>, area: Area) -> Result<Self, ScenarioError> {
        let sensing = Self::read(reader)?;
        let Self { d_max, eta, .. } = sensing;
        if d_max > area.diagonal() {
            let allowed = format!(
                "must be greater than 0 and at most {:.2} (the area's diagonal in metres)",
                area.diagonal()
            );
            return Err(reader.invalid_value("sensing.d_max", d_max, allowed));
        }
        if eta * d_max > MAX_DECAY {
            let allowed = format!(
                "must be at most {} ({MAX_DECAY} / d_max), or p(d_max) is too small to count",
                MAX_DECAY / d_max
            );
            return Err(reader.invalid_value("sensing.eta", eta, allowed));
        }
        Ok(sensing)
    }
}

impl Sensing {
    /// Returns the sensing function p(d) = exp(-η d), `(0, 1]`, of a distance `d` ≥ 0 in metres.
    pub fn p(&self, d: f64) -> f64 {
        libm::exp(-self.eta * d)
    }

    /// Returns the information I_ij = Ψ p(d) of a report from distance `d` in metres (Eq. (1)); 0 beyond `d_max`.
    pub fn information(&self, d: f64) -> f64 {
        if d <= self.d_max { self.psi * self.p(d) } else { 0.0 }
    }

    /// Returns the distance in metres that corresponds to a report of information `i`: the inverse of Eq. (1). `None`
    /// for a report without information, which only shows that the event is farther than `d_max`.
    pub fn distance(&self, i: f64) -> Option<f64> {
        // Rounding, or a false report above Ψ, must not give a negative distance.
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

    /// Returns the information Î at the BS after another report of information `report` (Eq. (2)).
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

    fn paper_sensing() -> Sensing {
        Sensing {
            kind: DetectionKind::Range,
            d_max: 4.0,
            eta: 1.0,
            psi: 1.0,
            g: Fusion::Max,
        }
    }

    #[test]
    fn p_at_d_max_is_0_018_as_in_the_paper() {
        assert!((paper_sensing().p(4.0) - 0.018_315_638_888_734_18).abs() < 1e-16);
    }

    #[test]
    fn the_distance_is_recovered_from_the_information() {
        for d in [0.0, 0.3, 1.7, 3.999, 4.0] {
            let distance = paper_sensing()
                .distance(paper_sensing().information(d))
                .expect("within range");
            assert!((distance - d).abs() < 1e-12, "{distance} m, not {d}");
        }
        assert_eq!(paper_sensing().distance(paper_sensing().information(4.1)), None);
    }

    #[test]
    fn detections_have_the_probability_p() {
        let sensing = Sensing {
            kind: DetectionKind::Probabilistic,
            ..paper_sensing()
        };
        let n = 100_000;
        let share = (0..n)
            .filter(|&i| sensing.detects(3, EventId(i), DeviceId(4), 1.0))
            .count() as f64
            / n as f64;
        let p = sensing.p(1.0);
        assert!(
            (share - p).abs() < 4.0 * (p * (1.0 - p) / n as f64).sqrt(),
            "a share of {share} is detected, not {p}"
        );
        assert!((0..n).all(|i| !sensing.detects(3, EventId(i), DeviceId(4), 4.01)));
    }

    #[test]
    fn fusion_takes_the_maximum_or_a_capped_sum() {
        let saturating = Sensing {
            g: Fusion::SumSaturation,
            ..paper_sensing()
        };
        assert!((paper_sensing().fuse(0.4, 0.3) - 0.4).abs() < f64::EPSILON);
        assert!((saturating.fuse(0.4, 0.3) - 0.7).abs() < 1e-15);
        assert!((saturating.fuse(0.8, 0.3) - 1.0).abs() < f64::EPSILON);
    }
}
