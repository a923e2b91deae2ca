//! What a host is told about the devices that it carries.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::energy::EnergyModel;
use crate::geometry::Point;
use crate::harvest::HarvestSetup;
use crate::ids::{DeviceId, HostId, Tti};
use crate::radio::Radio;
use crate::sensing::Sensing;
use crate::units::Energy;

/// What a host needs to carry its devices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Assignment {
    /// The host's number.
    pub host: HostId,
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
