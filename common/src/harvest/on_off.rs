//! The source `mpp` (the paper's modulated Poisson process): an on/off Markov chain in model time, the time in which λ
//! and τ are given. It is sampled once per TTI and delivers E_B in each TTI at whose beginning it is on.
//!
//! Digests depend on the order of draws: whether it starts on, then the periods in turn;
//! `tests/src/reference/harvest.rs` repeats it. The order of fields in `visit` is part of the scenario hash, the help
//! texts are part of `docs/scenario.md`. [`OnOffSetup`] goes to hosts in the wire format (`WIRE_VERSION`); no file
//! stores it.

use serde::{Deserialize, Serialize};

use super::arrivals::{Arrivals, eq5_probability};
use super::shared_tables::expected_energy;
use crate::declare::{FieldReader, FieldSink, Range, ScenarioError, Section, Visit, number};
use crate::ids::Tti;
use crate::rng::{Geometric, Stream};
use crate::units::Energy;

/// Allowed mean off-durations, in units of model time.
const OFF_MEAN_RANGE: Range = Range::above(0.0, 1e15);

crate::declare! {
    /// On/off source with exponential durations. It delivers `e_b` in each TTI that begins while it is on.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct OffTimeFields in "harvest" only with "harvest.kind" = &["mpp"]; {
        /// Mean off-duration.
        off_mean: Option<f64> = number(OFF_MEAN_RANGE, 1.0)
            .unit("units of model time")
            .derived("such that the source is on for the share λτ·exp(-λτ) of the time")
            .source("Eq. (5)"),
    }
}

/// An on/off source with exponential durations and energy `E_B` in each TTI that begins while it is on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OnOff {
    /// Rate λ at which it turns off, per unit of model time, > 0: on-durations have the mean 1/λ.
    pub lambda: f64,
    /// `E_B`.
    pub e_b: Energy,
    /// Mean off-duration in units of model time, > 0. By default the source is on for the share λτ·exp(-λτ) of the
    /// time, as the paper reads Eq. (5).
    pub off_mean: f64,
}

impl OnOff {
    /// The fields of this kind only.
    pub const SECTION: &'static Section = OffTimeFields::SECTION;

    /// Builds the settings in `reader`, for TTIs of duration `tau`.
    pub(super) fn from_fields(reader: &FieldReader<'_>, tau: f64) -> Result<Self, ScenarioError> {
        let Arrivals { lambda, e_b } = Arrivals::read(reader)?;
        if lambda == 0.0 {
            let complaint = "must be greater than 0 for harvest.kind = \"mpp\" (on-durations have the mean 1/lambda)";
            return Err(reader.invalid_value("harvest.lambda", lambda, complaint));
        }
        let off_mean = match OffTimeFields::read(reader)?.off_mean {
            Some(off_mean) => off_mean,
            None => default_off_mean(reader, lambda, tau)?,
        };
        Ok(Self { lambda, e_b, off_mean })
    }

    pub(super) fn visit(&self, sink: &mut dyn FieldSink) {
        let Self { lambda, e_b, off_mean } = *self;
        Arrivals { lambda, e_b }.visit(sink);
        OffTimeFields {
            off_mean: Some(off_mean),
        }
        .visit(sink);
    }

    /// The setup for TTIs of duration `tau`: the continuous-time chain on → off at rate λ, off → on at rate 1/off_mean,
    /// sampled every τ.
    pub(super) fn setup(&self, tau: f64) -> OnOffSetup {
        let (leave_on, leave_off) = (self.lambda, 1.0 / self.off_mean);
        let on_share = leave_off / (leave_on + leave_off);
        // 1 − exp(−x) by `expm1`, which stays precise if τ is short against both means.
        let decay = -libm::expm1(-(leave_on + leave_off) * tau);
        OnOffSetup {
            on_share,
            turn_off_probability: (1.0 - on_share) * decay,
            turn_on_probability: on_share * decay,
            e_b: self.e_b,
        }
    }
}

/// The mean off-duration of a source with mean on-duration 1/λ that is on for the share λτ·exp(-λτ) of the time.
fn default_off_mean(reader: &FieldReader<'_>, lambda: f64, tau: f64) -> Result<f64, ScenarioError> {
    let on_share = eq5_probability(lambda, tau);
    // The share is at most 1/e. For a very large λ it underflows to 0; the result is then infinite, which is rejected
    // below.
    let off_mean = (1.0 - on_share) / (lambda * on_share);
    if OFF_MEAN_RANGE.contains(off_mean) {
        return Ok(off_mean);
    }
    let complaint = "gives too small an on share for a default off-duration; set harvest.off_mean";
    Err(reader.invalid_value("harvest.lambda", lambda, complaint))
}

/// The setup of an on/off source on a device: an arrival in each TTI that begins while it is on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct OnOffSetup {
    /// Probability that it is on in TTI 0, `[0, 1]`.
    pub on_share: f64,
    /// Probability that it is off one TTI after it was on, `[0, 1]`.
    #[serde(rename = "p_off")]
    pub turn_off_probability: f64,
    /// Probability that it is on one TTI after it was off, `[0, 1]`.
    #[serde(rename = "p_on")]
    pub turn_on_probability: f64,
    /// Energy E_B of an arrival.
    pub e_b: Energy,
}

impl OnOffSetup {
    pub(super) fn is_valid(&self) -> bool {
        let Self {
            on_share,
            turn_off_probability,
            turn_on_probability,
            e_b: _,
        } = *self;
        let probabilities = [on_share, turn_off_probability, turn_on_probability];
        probabilities.iter().all(|p| (0.0..=1.0).contains(p))
    }

    /// The mean harvest per TTI.
    pub(super) fn mean(&self) -> Energy {
        expected_energy(self.on_share, self.e_b)
    }

    /// The expected harvest per TTI, micro-units; the same in every TTI, since the source starts in its stationary
    /// state.
    pub(super) fn expected_micro(&self) -> f64 {
        self.on_share * self.e_b.micro() as f64
    }

    /// Creates the source. Also returns the TTI of its first arrival.
    pub(super) fn source(&self, mut stream: Stream) -> (OnOffSource, Tti) {
        let on_duration = Geometric::new(self.turn_off_probability);
        let off_duration = Geometric::new(self.turn_on_probability);
        let is_on = stream.unit() < self.on_share;
        let next = if is_on {
            Tti::ZERO
        } else {
            // An off-period of n TTIs from TTI 0 on ends before TTI n.
            Tti(off_duration.draw(&mut stream))
        };
        let last_on = draw_last_on(next, on_duration, &mut stream);
        let source = OnOffSource {
            on_duration,
            off_duration,
            last_on,
            stream,
            e_b: self.e_b,
        };
        (source, next)
    }
}

#[derive(Clone, Debug)]
pub(super) struct OnOffSource {
    /// The distribution of the length of an on-period in TTIs.
    on_duration: Geometric,
    /// The distribution of the length of an off-period in TTIs.
    off_duration: Geometric,
    /// The last TTI of the current on-period.
    last_on: Tti,
    stream: Stream,
    e_b: Energy,
}

impl OnOffSource {
    /// Returns the arrival in `now` and the TTI of the next one.
    #[inline]
    pub(super) fn take(&mut self, now: Tti) -> (Energy, Tti) {
        if now < self.last_on {
            return (self.e_b, now + 1);
        }
        // The off-period begins at `now` + 1, so its length is counted from there.
        let next = now
            .saturating_add(self.off_duration.draw(&mut self.stream))
            .saturating_add(1);
        self.last_on = draw_last_on(next, self.on_duration, &mut self.stream);
        (self.e_b, next)
    }
}

/// The last TTI of an on-period that starts at `first`.
fn draw_last_on(first: Tti, on_duration: Geometric, stream: &mut Stream) -> Tti {
    first.saturating_add(on_duration.draw(stream)).previous()
}
