//! Adjusted duty cycling (Sec. V-A, first approach): one (t_on, t_DRX) for all devices, with staggered offsets, found by
//! exhaustive search for the deployment; after a report any sleeping device may be woken, most correlated first, until
//! Î ≥ I_min.
//!
//! The search itself runs the devices too, and so lives with whoever drives both sides (`reveille_lab::adjusted`).

use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::scenario::{AdjustedSettings, DutyChoice, Scenario};

use super::Policy;
use crate::candidates::Candidates;
use crate::observation::Observation;
use crate::wakeup::i_min;

/// The `adjusted` policy.
pub struct Adjusted {
    choice: DutyChoice,
    i_min: f64,
    candidates: Candidates,
}

impl Adjusted {
    /// The policy with the duty cycle that the search has found.
    ///
    /// # Panics
    /// If no search was made.
    pub fn new(scenario: &Scenario, settings: &AdjustedSettings, positions: &[Point]) -> Self {
        let sensing = &scenario.sensing;
        Self {
            choice: settings.found.expect("the duty cycle is searched before a run"),
            i_min: i_min(positions, scenario.area, sensing),
            candidates: Candidates::new(scenario, positions),
        }
    }
}

impl Policy for Adjusted {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        let DutyChoice { t_on, t_drx, .. } = self.choice;
        let cycle = |j: u32| DutyCycle {
            t_on,
            t_drx,
            offset: j % t_drx,
        };
        Plan::Periodic((0..seen.positions.len() as u32).map(cycle).collect())
    }

    fn next_decision(&self, _: Tti) -> Tti {
        Tti::NEVER
    }

    fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        if seen.information < self.i_min {
            self.candidates.start(seen, reports);
        }
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        if seen.information >= self.i_min {
            None
        } else {
            self.candidates.next(seen, |_| true).map(|(device, _)| device)
        }
    }

    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        if let Some(report) = report.filter(|_| seen.information < self.i_min) {
            self.candidates.add(seen, report);
        }
    }

    fn facts(&self) -> Vec<(&'static str, f64)> {
        let DutyChoice {
            t_on,
            t_drx,
            reaches_i_min,
            pairs,
            device_ttis,
        } = self.choice;
        vec![
            ("t_on", f64::from(t_on)),
            ("t_drx", f64::from(t_drx)),
            ("i_min", self.i_min),
            ("reaches_i_min", f64::from(u8::from(reaches_i_min))),
            ("searched_pairs", f64::from(pairs)),
            ("searched_device_ttis", device_ttis as f64),
        ]
    }
}
