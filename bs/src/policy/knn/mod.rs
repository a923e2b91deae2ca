//! KNN-based duty cycling and wake-up (Sec. V-A, Algorithm 1): clusters by location, one member of each in S1 in turn,
//! and after a report the members of the reporters' clusters, most correlated first, until Î ≥ I_min.

pub mod settings;

use std::sync::Arc;

use reveille_common::declare::{Reader, ScenarioError, Section};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::rng::PolicyPurpose;
use reveille_common::scenario::{PolicyChoice, PolicyKind, PolicySettings, Site};

use self::settings::KnnSettings;
use super::contract::{Opaque, Policy};
use super::kind::{Profile, Registered, own};
use super::mind::Mind;
use crate::beliefs::aim::Aim;
use crate::beliefs::clusters::Clusters;
use crate::beliefs::posterior::Belief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `knn` policy.
pub struct Knn {
    clusters: Clusters,
    aim: Aim,
    /// The clusters of this event's first reporters; whoever is woken later belongs to one of them.
    asked: Vec<u32>,
}

impl Knn {
    /// Clusters the devices in `known` and finds I_min of the deployment.
    pub fn new(known: &Knowledge, settings: &KnnSettings) -> Self {
        let (positions, d_max) = (known.positions(), known.sensing.d_max);
        let start = known.streams.stream(PolicyPurpose::Clusters, 0);
        Self {
            clusters: Clusters::form(&positions, known.area, d_max, settings.voting(), start),
            aim: Aim::new(known),
            asked: Vec::new(),
        }
    }
}

impl Policy for Knn {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        let mut cycles = vec![DutyCycle::ASLEEP; seen.known.n()];
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

    fn groups(&self) -> Option<&[u32]> {
        Some(&self.clusters.of)
    }

    fn next_decision(&self, _: Tti) -> Tti {
        Tti::NEVER
    }

    fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        if !self.aim.start(seen, reports) {
            return;
        }
        self.asked.clear();
        for report in reports {
            let cluster = self.clusters.of[report.device.index()];
            if !self.asked.contains(&cluster) {
                self.asked.push(cluster);
            }
        }
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let Self { clusters, aim, asked } = self;
        aim.next(seen, |device| asked.contains(&clusters.of[device.index()]))
    }

    fn facts(&self) -> Vec<(&'static str, f64)> {
        vec![
            ("clusters_formed", self.clusters.formed as f64),
            ("clusters_after_splitting", self.clusters.members.len() as f64),
            ("i_min", self.aim.i_min()),
        ]
    }

    fn belief(&self) -> Option<&Belief> {
        self.aim.belief()
    }

    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        self.aim.answered(seen, report);
    }
}

/// The policy `knn`.
#[derive(Clone, Copy, Debug)]
pub struct KnnKind;

impl PolicyKind for KnnKind {
    fn name(&self) -> &'static str {
        "knn"
    }

    fn about(&self) -> &'static str {
        "Clusters by location, one member of each sensing in turn; wakes members of the reporters' \
         clusters (Algorithm 1)."
    }

    fn section(&self) -> Option<&'static Section> {
        Some(KnnSettings::SECTION)
    }

    fn settle(&self, reader: &Reader<'_>, _: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(KnnSettings::read(reader)?))
    }
}

impl Registered for KnnKind {
    fn profile(&self) -> Profile {
        Profile {
            runtime: "O(N(N-1)/2)",
            wakes: true,
            heeds_ranking: true,
            ..Profile::plain(0)
        }
    }

    fn build(&self, choice: &PolicyChoice, known: &Knowledge, _: Option<&Opaque>) -> Mind {
        Mind::of(Knn::new(known, own(choice)))
    }
}
