//! The patrol: devices sense in turn, and a report wakes the reporter's nearest neighbours.

use reveille_bs::policy::prelude::*;

declare! {
    /// Devices sense in turn; a report wakes the reporter's nearest neighbours.
    #[derive(Clone, Copy, Debug)]
    pub struct PatrolSettings in "policy.patrol" {
        /// Length of a device's duty cycle, of which it senses in one TTI.
        pub every: u32 = declare::whole(1, 1000, 8).unit("TTIs"),
        /// Devices to wake after a report: those nearest to the first reporter.
        pub helpers: u32 = declare::whole(0, 100, 2),
    }
}

/// The policy `patrol`.
pub const PATROL: PolicyEntry = PolicyEntry::for_settings::<PatrolSettings>();

impl PolicyFactory for PatrolSettings {
    fn build(&self, _: &Knowledge) -> Box<dyn Policy> {
        Box::new(Patrol {
            settings: *self,
            helpers: Vec::new(),
        })
    }
}

/// A patrol during a run.
struct Patrol {
    settings: PatrolSettings,
    /// The devices to wake for this event, the next at the end.
    helpers: Vec<DeviceId>,
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

    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        let devices = &seen.known.devices;
        let reporter = devices[reports[0].device.index()].position;
        let distance = |j: &DeviceId| devices[j.index()].position.distance(reporter);
        let asleep = (0..devices.len() as u32).map(DeviceId).filter(|&j| seen.is_asleep(j));
        self.helpers = asleep.collect();
        // The farthest come first: helpers are taken from the end.
        self.helpers
            .sort_by(|a, b| distance(b).total_cmp(&distance(a)).then(b.cmp(a)));
        let surplus = self.helpers.len().saturating_sub(self.settings.helpers as usize);
        self.helpers.drain(..surplus);
    }

    fn next_wake_up(&mut self, _: &Observation<'_>) -> Option<DeviceId> {
        self.helpers.pop()
    }

    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        vec![("sensing_share", 1.0 / f64::from(self.settings.every))]
    }
}
