//! What a host is told about the devices that it carries.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::energy::EnergyModel;
use crate::geometry::Point;
use crate::harvest::HarvestSetup;
use crate::ids::{DeviceId, Tti};
use crate::radio::Radio;
use crate::secret::{HostPass, Secret};
use crate::sensing::Sensing;
use crate::units::Energy;

/// What the BS tells a host of the bus, and nobody else.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Membership {
    /// The host's number, and its own token.
    pub pass: HostPass,
    /// What the keys of all members begin with.
    pub secret: Secret,
}

/// A device in the middle of a run, as its machine has it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Checkpoint(pub Vec<u8>);

/// Where a host takes up devices in the middle of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Resumption {
    /// The first TTI that they have not been granted.
    pub next: Tti,
    /// The TTI from which the plan holds that they have; `None` if there was none yet.
    pub plan: Option<Tti>,
    /// The devices, in the order of ids.
    pub devices: Vec<Checkpoint>,
}

/// What a host needs to carry its devices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Assignment {
    /// How the host is known on the bus.
    pub membership: Membership,
    /// Where its devices stand, if not before TTI 0.
    pub resumption: Option<Resumption>,
    /// Seed of the run's streams.
    pub seed: u64,
    /// Length K of the run in TTIs.
    pub ttis: u64,
    /// The first measured TTI: what happens before it is warm-up.
    pub measured_from: Tti,
    /// The sensing model.
    pub sensing: Sensing,
    /// How the radio fails.
    pub radio: Radio,
    /// Its devices, numbered one after another.
    pub devices: Vec<DeviceSetup>,
    /// Recorded energy per TTI by row, that the devices' sources refer to.
    pub traces: Vec<Arc<Vec<Energy>>>,
}

impl Assignment {
    /// Checks what a device would otherwise trip over.
    ///
    /// # Errors
    /// What is wrong, in words.
    pub fn check(&self) -> Result<(), String> {
        let Some(first) = self.devices.first() else {
            return Err("it names no device".to_owned());
        };
        if !self.radio.is_sound() {
            return Err("it has an impossible radio".to_owned());
        }
        for (setup, expected) in self.devices.iter().zip(first.id.0..) {
            let device = setup.id;
            if device.0 != expected {
                return Err(format!("device {device} stands where {expected} belongs"));
            }
            if setup.energy.initial > setup.energy.e_max {
                return Err(format!("device {device} starts with more than its battery holds"));
            }
            if !setup.harvest.is_sound(&self.traces) {
                return Err(format!("device {device} has an impossible energy source"));
            }
        }
        if self
            .resumption
            .as_ref()
            .is_some_and(|r| r.devices.len() != self.devices.len())
        {
            return Err("it has more or fewer checkpoints than devices".to_owned());
        }
        Ok(())
    }
}

/// One device as it is at the start of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeviceSetup {
    /// Its number.
    pub id: DeviceId,
    /// Where it stands.
    pub position: Point,
    /// Battery and costs.
    pub energy: EnergyModel,
    /// Its energy source.
    pub harvest: HarvestSetup,
}
