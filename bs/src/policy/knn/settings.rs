//! Settings of the `knn` policy (Sec. V-A, Algorithm 1).

use reveille_common::declare;
use reveille_common::declare::{Sink, switch, whole};
use reveille_common::scenario::{MAX_DEVICES, PolicySettings};

use crate::beliefs::clusters::Voting;

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
    /// How clusters are formed.
    pub const fn voting(&self) -> Voting {
        Voting {
            neighbours: self.neighbours,
            limit_radius: self.limit_radius,
        }
    }
}

impl PolicySettings for KnnSettings {
    fn visit(&self, sink: &mut dyn Sink) {
        Self::visit(self, sink);
    }
}
