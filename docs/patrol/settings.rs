//! Settings of the `patrol` policy.

use reveille_common::declare;
use reveille_common::declare::{Sink, whole};
use reveille_common::scenario::PolicySettings;

declare! {
    /// Settings of the policy `patrol`.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct PatrolSettings in "policy.patrol" {
        /// Length of a device's duty cycle, of which it senses in one TTI.
        pub every: u32 = whole(1, 1000, 8).unit("TTIs"),
        /// Devices to wake after a report: those nearest to the first reporter.
        pub helpers: u32 = whole(0, 100, 2),
    }
}

impl PolicySettings for PatrolSettings {
    fn visit(&self, sink: &mut dyn Sink) {
        Self::visit(self, sink);
    }
}
