//! Whom a policy may wake, best first, by either ranking.

use reveille_common::geometry::Point;
use reveille_common::ids::DeviceId;
use reveille_common::message::Report;
use reveille_common::scenario::{Scenario, WakeUpRanking};

use crate::learn::belief::Belief;
use crate::observation::Observation;
use crate::wakeup::{Correlation, Ranking};

/// The wake-up candidates of one event after another, by `bs.ranking` of the scenario.
#[derive(Clone, Debug)]
pub struct Candidates(Kind);

#[derive(Clone, Debug)]
enum Kind {
    P42(Ranking),
    Posterior(Belief),
}

impl Candidates {
    /// Candidates among the devices at `positions`.
    pub fn new(scenario: &Scenario, positions: &[Point]) -> Self {
        let (area, sensing) = (scenario.area, &scenario.sensing);
        Self(match scenario.bs.ranking {
            WakeUpRanking::P42 => Kind::P42(Ranking::new(positions, area, Correlation::new(sensing))),
            WakeUpRanking::Posterior => Kind::Posterior(Belief::new(positions, area, sensing)),
        })
    }

    /// Begins an event with its first reports. Those who could have reported and did not count where a ranking makes
    /// something of it.
    pub fn start(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        self.clear();
        for report in reports {
            self.add(seen, report);
        }
        if let Kind::Posterior(belief) = &mut self.0 {
            belief.hear_silence(|device| !seen.is_asleep(device));
        }
    }

    /// Begins an event of which nothing is known.
    pub fn clear(&mut self) {
        match &mut self.0 {
            Kind::P42(ranking) => ranking.start(),
            Kind::Posterior(belief) => belief.start(),
        }
    }

    /// Takes in one more report.
    pub fn add(&mut self, seen: &Observation<'_>, report: &Report) {
        let distance = seen.sensing.distance(report.information);
        match (&mut self.0, distance) {
            (Kind::P42(ranking), Some(d)) => ranking.add_reporter(report.device, d),
            (Kind::Posterior(belief), Some(d)) => belief.add_reporter(report.device, d),
            (Kind::Posterior(belief), None) => belief.add_far(report.device),
            (Kind::P42(_), None) => {}
        }
    }

    /// The best sleeping device for which `may_wake` holds and that was not given out for this event, with its score:
    /// `P_4,2` times Ψ, or the expected gain of information; both `[0, Ψ]`.
    pub fn next(&mut self, seen: &Observation<'_>, may_wake: impl Fn(DeviceId) -> bool) -> Option<(DeviceId, f64)> {
        let is_candidate = |device| seen.is_asleep(device) && may_wake(device);
        match &mut self.0 {
            Kind::P42(ranking) => {
                let (device, probability) = ranking.next(is_candidate)?;
                Some((device, probability * seen.sensing.psi))
            }
            Kind::Posterior(belief) => belief.next(seen.information, is_candidate),
        }
    }
}
