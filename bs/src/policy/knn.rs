//! KNN-based duty cycling and wake-up (Sec. V-A, Algorithm 1): clusters by location, one member of each in S1 in turn, and
//! after a report the members of the reporters' clusters, most correlated first, until Î ≥ I_min.

use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::scenario::{KnnSettings, Scenario};

use super::Policy;
use crate::candidates::Candidates;
use crate::clusters::Clusters;
use crate::observation::Observation;
use crate::wakeup::i_min;

/// The `knn` policy.
pub struct Knn {
    clusters: Clusters,
    /// The information I_min that wake-ups aim for (Sec. V-A, Eq. (E_Info3)).
    i_min: f64,
    candidates: Candidates,
    /// The clusters of this event's first reporters; whoever is woken later belongs to one of them.
    asked: Vec<u32>,
}

impl Knn {
    /// Clusters devices at `positions` and finds I_min of the deployment.
    pub fn new(scenario: &Scenario, settings: &KnnSettings, positions: &[Point]) -> Self {
        let sensing = &scenario.sensing;
        Self {
            clusters: Clusters::form(positions, scenario.area, sensing.d_max, settings, scenario.seed),
            i_min: i_min(positions, scenario.area, sensing),
            candidates: Candidates::new(scenario, positions),
            asked: Vec::new(),
        }
    }
}

impl Policy for Knn {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        let mut cycles = vec![DutyCycle::ASLEEP; seen.positions.len()];
        for members in &self.clusters.members {
            let t_drx = members.len() as u32;
            for (turn, device) in (0..).zip(members) {
                cycles[device.index()] = DutyCycle {
                    t_on: 1,
                    t_drx,
                    offset: (t_drx - turn) % t_drx,
                };
            }
        }
        Plan::Periodic(cycles)
    }

    fn next_decision(&self, _: Tti) -> Tti {
        Tti::NEVER
    }

    fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        if seen.information >= self.i_min {
            return;
        }
        self.asked.clear();
        for report in reports {
            let cluster = self.clusters.of[report.device.index()];
            if !self.asked.contains(&cluster) {
                self.asked.push(cluster);
            }
        }
        self.candidates.start(seen, reports);
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        if seen.information >= self.i_min {
            None
        } else {
            let Self {
                clusters,
                candidates,
                asked,
                ..
            } = self;
            let is_asked = |device: DeviceId| asked.contains(&clusters.of[device.index()]);
            candidates.next(seen, is_asked).map(|(device, _)| device)
        }
    }

    fn facts(&self) -> Vec<(&'static str, f64)> {
        vec![
            ("clusters_formed", self.clusters.formed as f64),
            ("clusters_after_splitting", self.clusters.members.len() as f64),
            ("i_min", self.i_min),
        ]
    }

    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        if let Some(report) = report.filter(|_| seen.information < self.i_min) {
            self.candidates.add(seen, report);
        }
    }
}
