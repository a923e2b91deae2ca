//! The patrol: devices sense in turn, and a report wakes the reporter's nearest neighbours.
//!
//! The page docs/writing-a-policy.md explains this file and shows a copy; `tests/tests/tutorial.rs` compares them.

use reveille_bs::policy::prelude::*;

declare! {
    /// Devices sense in turn; a report wakes the reporter's nearest neighbours.
    #[derive(Clone, Copy, Debug)]
    pub struct PatrolSettings in "policy.patrol" {
        /// Length of a device's duty cycle, of which it senses in one TTI.
        pub every: u32 = declare::whole(1, 1000, 8).unit("TTIs"),
        /// Number of devices to wake after a report, the nearest ones to the first reporter.
        pub helpers: u32 = declare::whole(0, 100, 2),
    }
}

/// The policy `patrol`.
pub const PATROL: PolicyEntry = PolicyEntry::for_settings::<PatrolSettings>();

impl PolicyFactory for PatrolSettings {
    fn build(&self, _: &Knowledge) -> Box<dyn Policy> {
        Box::new(Patrol {
            settings: *self,
            to_wake: Vec::new(),
        })
    }
}

/// A patrol during a run.
struct Patrol {
    settings: PatrolSettings,
    /// The devices to wake after the last report, the next at the end.
    to_wake: Vec<DeviceId>,
}

impl Policy for Patrol {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        let t_drx = self.settings.every;
        let cycle = |j: u32| DutyCycle {
            t_on: 1,
            t_drx,
            offset: j % t_drx,
        };
        Plan::Periodic((0..seen.known.n() as u32).map(cycle).collect())
    }

    /// The first plan holds for good.
    fn next_decision(&self, _: Tti) -> Tti {
        Tti::NEVER
    }

    /// There is at least one report, and the first is the one of the lowest device id.
    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        let devices = &seen.known.devices;
        let reporter = devices[reports[0].device.index()].position;
        let distance = |j: &DeviceId| devices[j.index()].position.distance(reporter);
        let asleep = (0..devices.len() as u32).map(DeviceId).filter(|&j| seen.is_asleep(j));
        self.to_wake = asleep.collect();
        // The farthest come first: devices are taken from the end.
        self.to_wake
            .sort_by(|a, b| distance(b).total_cmp(&distance(a)).then(b.cmp(a)));
        let surplus = self.to_wake.len().saturating_sub(self.settings.helpers as usize);
        self.to_wake.drain(..surplus);
    }

    fn next_wake_up(&mut self, _: &Observation<'_>) -> Option<DeviceId> {
        self.to_wake.pop()
    }

    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        vec![("sensing_share", 1.0 / f64::from(self.settings.every))]
    }
}
