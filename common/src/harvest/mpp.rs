//! An on/off source.

use serde::{Deserialize, Serialize};

use super::arrivals::Arrivals;
use super::sources::expected;
use crate::declare::{Range, Reader, ScenarioError, Section, Sink, number};
use crate::ids::Tti;
use crate::rng::{Geometric, Stream};
use crate::units::Energy;

/// Mean off-durations.
const DURATION: Range = Range::above(0.0, 1e15);

crate::declare! {
    /// A source that is on or off, both for exponential durations, and brings `e_b` in each TTI that begins while it is
    /// on.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Off in "harvest" only with "harvest.kind" = &["mpp"]; {
        /// Mean off-duration.
        off_mean: Option<f64> = number(DURATION, 1.0)
            .unit("units of model time")
            .derived("such that the source is on for the share λτ·exp(-λτ) of the time")
            .source("Eq. (5)"),
    }
}

/// An on/off source with exponential durations, `E_B` in each TTI that begins while it is on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mpp {
    /// λ, per unit of model time, > 0: on-durations have the mean 1/λ.
    pub lambda: f64,
    /// `E_B`.
    pub e_b: Energy,
    /// Mean off-duration in units of model time, > 0. By default such that the source is on for the share λτ·exp(-λτ)
    /// of the time, which is how the paper reads Eq. (5).
    pub off_mean: f64,
}

impl Mpp {
    /// The fields that are its own.
    pub const SECTION: &'static Section = Off::SECTION;

    /// The settings that `reader` has, for TTIs of duration `tau`.
    pub(super) fn settle(reader: &Reader<'_>, tau: f64) -> Result<Self, ScenarioError> {
        let Arrivals { lambda, e_b } = Arrivals::read(reader)?;
        if lambda == 0.0 {
            let allowed = "must be greater than 0 for harvest.kind = \"mpp\" (on-durations have the mean 1/lambda)";
            return Err(reader.refuse("harvest.lambda", lambda, allowed));
        }
        let off_mean = match Off::read(reader)?.off_mean {
            Some(off_mean) => off_mean,
            None => default_off_mean(reader, lambda, tau)?,
        };
        Ok(Self { lambda, e_b, off_mean })
    }

    /// Hands every field to `sink`.
    pub(super) fn visit(&self, sink: &mut dyn Sink) {
        let Self { lambda, e_b, off_mean } = *self;
        Arrivals { lambda, e_b }.visit(sink);
        Off {
            off_mean: Some(off_mean),
        }
        .visit(sink);
    }

    /// The source for TTIs of duration `tau`: the continuous-time chain on → off at rate λ, off → on at rate
    /// 1/off_mean, sampled every τ.
    pub(super) fn setup(&self, tau: f64) -> OnOffSetup {
        let (leave_on, leave_off) = (self.lambda, 1.0 / self.off_mean);
        let on_share = leave_off / (leave_on + leave_off);
        let forgotten = -libm::expm1(-(leave_on + leave_off) * tau);
        OnOffSetup {
            on_share,
            p_off: (1.0 - on_share) * forgotten,
            p_on: on_share * forgotten,
            e_b: self.e_b,
        }
    }
}

/// The mean off-duration for which a source with on-durations of mean 1/λ is on for the share λτ·exp(-λτ) of the time.
fn default_off_mean(reader: &Reader<'_>, lambda: f64, tau: f64) -> Result<f64, ScenarioError> {
    let on_share = lambda * tau * libm::exp(-lambda * tau);
    let off_mean = (1.0 - on_share) / (lambda * on_share);
    if DURATION.contains(off_mean) {
        return Ok(off_mean);
    }
    let allowed = "is on for so small a share of the time that harvest.off_mean has to be set";
    Err(reader.refuse("harvest.lambda", lambda, allowed))
}

/// An on/off source as a device needs it: an arrival in each TTI that begins while it is on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct OnOffSetup {
    /// Probability that it is on in TTI 0, `[0, 1]`.
    pub on_share: f64,
    /// Probability that it is off one TTI after it was on, `[0, 1]`.
    pub p_off: f64,
    /// Probability that it is on one TTI after it was off, `[0, 1]`.
    pub p_on: f64,
    /// Energy E_B of an arrival.
    pub e_b: Energy,
}

impl OnOffSetup {
    /// Whether a device can be given it.
    pub(super) fn is_sound(&self) -> bool {
        let Self {
            on_share, p_off, p_on, ..
        } = *self;
        [on_share, p_off, p_on].iter().all(|p| (0.0..=1.0).contains(p))
    }

    /// The mean harvest in a TTI.
    pub(super) fn mean(&self) -> Energy {
        expected(self.on_share, self.e_b)
    }

    /// The source, and the TTI of its first arrival.
    pub(super) fn source(&self, mut stream: Stream) -> (OnOffSource, Tti) {
        let (on_run, off_run) = (Geometric::new(self.p_off), Geometric::new(self.p_on));
        let on_now = stream.unit() < self.on_share;
        let next = if on_now {
            Tti::ZERO
        } else {
            Tti(off_run.draw(&mut stream))
        };
        let last_on = last_of_run(next, on_run, &mut stream);
        let source = OnOffSource {
            on_run,
            off_run,
            last_on,
            stream,
            e_b: self.e_b,
        };
        (source, next)
    }
}

/// An on/off source at one device.
#[derive(Clone, Debug)]
pub(super) struct OnOffSource {
    on_run: Geometric,
    off_run: Geometric,
    last_on: Tti,
    stream: Stream,
    e_b: Energy,
}

impl OnOffSource {
    /// The arrival in `now`, and the TTI of the next.
    #[inline]
    pub(super) fn take(&mut self, now: Tti) -> (Energy, Tti) {
        if now < self.last_on {
            return (self.e_b, now + 1);
        }
        let next = now
            .saturating_add(self.off_run.draw(&mut self.stream))
            .saturating_add(1);
        self.last_on = last_of_run(next, self.on_run, &mut self.stream);
        (self.e_b, next)
    }
}

/// The last TTI of a run of on-TTIs that starts at `first`.
fn last_of_run(first: Tti, on_run: Geometric, stream: &mut Stream) -> Tti {
    first.saturating_add(on_run.draw(stream)).saturating_sub_one()
}
