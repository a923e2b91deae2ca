//! The policy `knn` (Sec. V-A, Algorithm 1): devices are clustered by location, and one member of each cluster is in S1
//! in turn. After a report the members of the reporters' clusters are woken, most correlated first, until Î ≥ I_min.
//! Digests depend on the clusters and on the turns of their members; names of facts are part of `summary.json`.
//! `tests/src/reference/policy.rs` repeats the policy.

use reveille_common::declare;
use reveille_common::declare::{switch, whole};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::rng::PolicyPurpose;
use reveille_common::scenario::MAX_DEVICES;

use super::factory::{PolicyEntry, PolicyFactory};
use super::interface::Policy;
use crate::beliefs::clusters::{ClusterSettings, Clusters};
use crate::beliefs::information_target::InformationTarget;
use crate::beliefs::posterior::EpicentreBelief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `knn` policy.
pub struct Knn {
    clusters: Clusters,
    information_target: InformationTarget,
    /// Clusters of this event's first reporters; every device woken later belongs to one of them.
    reporter_clusters: Vec<u32>,
}

impl Knn {
    /// Clusters the devices in `known` and finds I_min of the deployment.
    pub fn new(known: &Knowledge, settings: &KnnSettings) -> Self {
        let (positions, d_max) = (known.positions(), known.sensing.d_max);
        let stream = known.streams.stream(PolicyPurpose::Clusters, 0);
        Self {
            clusters: Clusters::form(&positions, known.area, d_max, settings.cluster_settings(), stream),
            information_target: InformationTarget::new(known),
            reporter_clusters: Vec::new(),
        }
    }
}

impl Policy for Knn {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        let mut cycles = vec![DutyCycle::ASLEEP; seen.known.n()];
        for members in &self.clusters.members {
            let t_drx = members.len() as u32;
            for (turn, device) in (0..).zip(members) {
                // In the TTIs k of this member's turn (k + offset) mod t_DRX is 0, so exactly one member senses in each
                // TTI.
                cycles[device.index()] = DutyCycle {
                    t_on: 1,
                    t_drx,
                    offset: (t_drx - turn) % t_drx,
                };
            }
        }
        Plan::Periodic(cycles)
    }

    fn device_groups(&self) -> Option<&[u32]> {
        Some(&self.clusters.cluster_of)
    }

    fn next_decision(&self, _now: Tti) -> Tti {
        Tti::NEVER
    }

    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        if !self.information_target.start_event(seen, reports) {
            // The target is reached: `next_device` names none, so the clusters of an earlier event do no harm.
            return;
        }
        self.reporter_clusters.clear();
        for report in reports {
            let cluster = self.clusters.cluster_of[report.device.index()];
            if !self.reporter_clusters.contains(&cluster) {
                self.reporter_clusters.push(cluster);
            }
        }
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let Self {
            clusters,
            information_target,
            reporter_clusters,
        } = self;
        information_target.next_device(seen, |device| {
            reporter_clusters.contains(&clusters.cluster_of[device.index()])
        })
    }

    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        vec![
            ("clusters_formed", self.clusters.formed_count as f64),
            ("clusters_after_splitting", self.clusters.members.len() as f64),
            ("i_min", self.information_target.i_min()),
        ]
    }

    fn epicentre_belief(&self) -> Option<&EpicentreBelief> {
        self.information_target.belief()
    }

    fn take_wake_up_answer(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        self.information_target.add_wake_up_answer(seen, report);
    }
}

/// The policy `knn`. The text is part of docs/scenario.md.
pub const KNN: PolicyEntry = PolicyEntry {
    about: "Clusters devices by location; one member of each cluster senses in turn. Wakes members of the reporters' \
            clusters (Algorithm 1).",
    heeds_ranking: true,
    runtime: "O(N(N-1)/2)",
    ..PolicyEntry::for_settings::<KnnSettings>()
};

impl PolicyFactory for KnnSettings {
    fn build(&self, known: &Knowledge) -> Box<dyn Policy> {
        Box::new(Knn::new(known, self))
    }
}

// The fields, in this order, are part of scenario files, their hashes and docs/scenario.md.
declare! {
    /// Settings of the policy `knn` (Sec. V-A, Algorithm 1).
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct KnnSettings in "policy.knn" {
        /// Neighbours K that vote on a device's cluster.
        pub neighbours: u32 = whole(1, MAX_DEVICES as u64, 5).source("Algorithm 1"),
        /// Whether a cluster with a member farther than `d_max` from its centroid is split.
        pub limit_radius: bool = switch(true),
    }
}

impl KnnSettings {
    /// Returns the settings for forming the clusters.
    pub const fn cluster_settings(&self) -> ClusterSettings {
        ClusterSettings {
            neighbours: self.neighbours,
            limit_radius: self.limit_radius,
        }
    }
}
