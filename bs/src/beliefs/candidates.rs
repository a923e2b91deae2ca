//! Whom a policy may wake, best first, by either ranking.

use reveille_common::geometry::Point;
use reveille_common::ids::DeviceId;
use reveille_common::message::Report;
use reveille_common::scenario::WakeUpRanking;

use crate::beliefs::posterior::{Belief, evenly};
use crate::beliefs::ranking::{Correlation, Ranking};
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The least information that a wake-up must be expected to bring, as a share of Ψ. Between a hundredth and three
/// hundredths it makes no difference to what is gathered for the energy; below, hopeless devices are woken.
pub const LEAST_GAIN: f64 = 0.02;

/// The wake-up candidates of one event after another, by `bs.ranking` of the scenario.
#[derive(Clone, Debug)]
pub struct Candidates(Order);

#[derive(Clone, Debug)]
enum Order {
    P42(Ranking),
    Posterior(Belief),
}

impl Candidates {
    /// Candidates among the devices in `known`, ordered as its settings say.
    pub fn new(known: &Knowledge) -> Self {
        Self::by(known.bs.ranking, known)
    }

    /// Candidates among the devices in `known`, by `ranking`.
    pub fn by(ranking: WakeUpRanking, known: &Knowledge) -> Self {
        let (positions, area, sensing) = (known.positions(), known.area, &known.sensing);
        Self(match ranking {
            WakeUpRanking::P42 => {
                let correlation = Correlation::new(sensing, &known.grids);
                Order::P42(Ranking::new(&positions, area, correlation))
            }
            WakeUpRanking::Posterior => {
                Order::Posterior(Belief::new(&positions, area, sensing).losing(known.radio.silence()))
            }
        })
    }

    /// As before, where a wake-up in vain counts as a loss of `in_vain`, ≥ 0, information when devices are compared;
    /// scores are still the expected gains. The ranking by `P_4,2` does not ask.
    #[must_use]
    pub fn charging(self, in_vain: f64) -> Self {
        Self(match self.0 {
            Order::P42(ranking) => Order::P42(ranking),
            Order::Posterior(belief) => Order::Posterior(belief.charging(in_vain)),
        })
    }

    /// Begins an event with its first reports. The ranking by the belief also learns from the devices that could have
    /// reported and did not.
    pub fn start(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        self.start_with(seen, reports, evenly);
    }

    /// As [`Self::start`], for an event that was more likely at some places than at others before anything was heard of
    /// it: `prior` tells how likely, up to a factor > 0. The ranking by `P_4,2` does not ask.
    pub fn start_with(&mut self, seen: &Observation<'_>, reports: &[Report], prior: impl Fn(Point) -> f64) {
        self.clear();
        for report in reports {
            self.add_with(seen, report, &prior);
        }
        if let Order::Posterior(belief) = &mut self.0 {
            // One that has nothing to report with is silent wherever the event is.
            belief.hear_silence(|device| !seen.is_asleep(device) && seen.can_report(device), prior);
        }
    }

    /// Begins an event of which nothing is known.
    pub fn clear(&mut self) {
        match &mut self.0 {
            Order::P42(ranking) => ranking.start(),
            Order::Posterior(belief) => belief.start(),
        }
    }

    /// Takes in one more report.
    pub fn add(&mut self, seen: &Observation<'_>, report: &Report) {
        self.add_with(seen, report, evenly);
    }

    /// As [`Self::add`], with the prior that the event began with.
    pub fn add_with(&mut self, seen: &Observation<'_>, report: &Report, prior: impl Fn(Point) -> f64) {
        if let Order::P42(ranking) = &mut self.0 {
            // It is awake, perhaps by an old plan as it has missed the one by which it sleeps.
            ranking.take_out(report.device);
        }
        let distance = seen.known.sensing.distance(report.information);
        match (&mut self.0, distance) {
            (Order::P42(ranking), Some(d)) => ranking.add_reporter(report.device, d),
            (Order::Posterior(belief), Some(d)) => belief.add_reporter(report.device, d, prior),
            (Order::Posterior(belief), None) => belief.add_far(report.device),
            (Order::P42(_), None) => {}
        }
    }

    /// The belief over the epicentre, where the ranking goes by one.
    pub const fn belief(&self) -> Option<&Belief> {
        match &self.0 {
            Order::P42(_) => None,
            Order::Posterior(belief) => Some(belief),
        }
    }

    /// The best sleeping device for which `may_wake` holds, that can pay for a report as far as is known (Sec. IV),
    /// and that was not given out for this event, with its score: `P_4,2` times Ψ, or the expected gain of
    /// information; both `[0, Ψ]`.
    pub fn next(&mut self, seen: &Observation<'_>, may_wake: impl Fn(DeviceId) -> bool) -> Option<(DeviceId, f64)> {
        let is_candidate = |device| seen.is_asleep(device) && may_wake(device) && seen.can_report(device);
        match &mut self.0 {
            Order::P42(ranking) => {
                let (device, probability) = ranking.next(is_candidate)?;
                Some((device, probability * seen.known.sensing.psi))
            }
            Order::Posterior(belief) => belief.next(seen.information, is_candidate),
        }
    }
}
