//! A patrol: devices sense in turn, and a report wakes the reporter's nearest neighbours.

pub mod settings;

use std::sync::Arc;

use reveille_bs::knowledge::Knowledge;
use reveille_bs::observation::Observation;
use reveille_bs::policy::contract::{Opaque, Policy};
use reveille_bs::policy::kind::{Profile, Registered, own};
use reveille_bs::policy::mind::Mind;
use reveille_common::declare::{Reader, ScenarioError, Section};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::scenario::{PolicyChoice, PolicyKind, PolicySettings, Site};

use self::settings::PatrolSettings;

/// The `patrol` policy.
pub struct Patrol {
    settings: PatrolSettings,
    /// Whom to wake for this event, the next at the end.
    helpers: Vec<DeviceId>,
}

impl Patrol {
    /// A patrol with these settings.
    pub const fn new(settings: PatrolSettings) -> Self {
        Self {
            settings,
            helpers: Vec::new(),
        }
    }
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

    fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        let devices = &seen.known.devices;
        let reporter = devices[reports[0].device.index()].position;
        let asleep = (0..devices.len() as u32).map(DeviceId).filter(|&j| seen.is_asleep(j));
        let mut near: Vec<DeviceId> = asleep.collect();
        near.sort_by(|a, b| {
            let distance = |j: &DeviceId| devices[j.index()].position.distance(reporter);
            distance(a).total_cmp(&distance(b)).then(a.cmp(b))
        });
        near.truncate(self.settings.helpers as usize);
        near.reverse();
        self.helpers = near;
    }

    fn next_wake_up(&mut self, _: &Observation<'_>) -> Option<DeviceId> {
        self.helpers.pop()
    }

    fn answered(&mut self, _: &Observation<'_>, _: Option<&Report>) {}

    fn facts(&self) -> Vec<(&'static str, f64)> {
        vec![("sensing_share", 1.0 / f64::from(self.settings.every))]
    }
}

/// What the policy `patrol` tells of itself.
#[derive(Clone, Copy, Debug)]
pub struct PatrolKind;

impl PolicyKind for PatrolKind {
    fn name(&self) -> &'static str {
        "patrol"
    }

    fn about(&self) -> &'static str {
        "Devices sense in turn; a report wakes the reporter's nearest neighbours."
    }

    fn section(&self) -> Option<&'static Section> {
        Some(PatrolSettings::SECTION)
    }

    fn settle(&self, reader: &Reader<'_>, _: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(PatrolSettings::read(reader)?))
    }
}

impl Registered for PatrolKind {
    fn profile(&self) -> Profile {
        Profile {
            wakes: true,
            ..Profile::plain(7)
        }
    }

    fn build(&self, choice: &PolicyChoice, _: &Knowledge, _: Option<&Opaque>) -> Mind {
        Mind::of(Patrol::new(*own(choice)))
    }
}
