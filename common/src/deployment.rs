//! The deployment of a scenario: the position and the setup of each device, and the setup of each host.
//!
//! Base station, reconstruction and figures derive it from the scenario, so a scenario must give the same deployment in
//! every process.

use std::sync::Arc;

use crate::geometry::{Point, place_devices};
use crate::ids::DeviceId;
use crate::message::{BusCredentials, DeviceSetup, HostSetup};
use crate::scenario::{Scenario, assign_classes};
use crate::units::Energy;

/// The devices of a run. The same scenario always leads to the same deployment; its seed draws positions and classes.
#[derive(Clone, Debug)]
pub struct Deployment {
    /// The devices, in the order of ids.
    pub devices: Vec<DeviceSetup>,
    /// The class of each device, an index into [`Scenario::classes`].
    pub classes: Vec<u16>,
    /// The traces of recorded energy per TTI; a device's source refers to one by its index.
    pub traces: Vec<Arc<Vec<Energy>>>,
}

impl Deployment {
    /// Deploys the devices of `scenario`.
    ///
    /// # Panics
    /// If a device has no class, which loading a scenario rules out.
    pub fn new<P>(scenario: &Scenario<P>) -> Self {
        let (traces, first_traces) = collect_traces(scenario);
        let positions = place_devices(&scenario.layout, scenario.area, scenario.run.devices, scenario.run.seed);
        // The number of devices of each class so far: the next device of a class reads the column of this number.
        let mut devices_by_class = vec![0u32; scenario.classes.len()];
        let classes = assign_classes(scenario);
        let devices = positions
            .into_iter()
            .zip(&classes)
            .zip(0..)
            .map(|((position, &class), id)| {
                let class_index = usize::from(class);
                let class = &scenario.classes[class_index];
                let nth_of_class = devices_by_class[class_index];
                let trace_index = first_traces[class_index] + class.harvest.column_index(nth_of_class);
                devices_by_class[class_index] += 1;
                let harvest = class.harvest.setup(scenario.run.tau, trace_index);
                DeviceSetup {
                    id: DeviceId(id),
                    position,
                    energy: class.energy,
                    harvest,
                }
            })
            .collect();
        Self {
            devices,
            classes,
            traces,
        }
    }

    /// Returns the positions of the devices, in the order of ids.
    pub fn positions(&self) -> Vec<Point> {
        self.devices.iter().map(|d| d.position).collect()
    }

    /// Returns the setup of a host with `credentials` for the devices `first .. first + count` from TTI 0 on.
    /// `scenario` must be the scenario of this deployment.
    ///
    /// # Panics
    /// If these devices are not all among the deployed ones.
    pub fn host_setup<P>(
        &self,
        scenario: &Scenario<P>,
        credentials: BusCredentials,
        first: u32,
        count: u32,
    ) -> HostSetup {
        let devices = self.devices[first as usize..(first + count) as usize].to_vec();
        // Traces can be long, so a host that reads none does not receive them. Otherwise it receives all: devices refer
        // to them by index.
        let traces = if devices.iter().any(|d| d.harvest.reads_trace()) {
            self.traces.clone()
        } else {
            Vec::new()
        };
        HostSetup {
            credentials,
            checkpoint: None,
            seed: scenario.run.seed,
            ttis: scenario.run.ttis,
            measured_from: scenario.warm_up_end(),
            sensing: scenario.sensing.clone(),
            radio: scenario.radio,
            devices,
            traces,
        }
    }
}

/// Collects all trace columns of all classes, and the index of the first column of each class.
fn collect_traces<P>(scenario: &Scenario<P>) -> (Vec<Arc<Vec<Energy>>>, Vec<u32>) {
    let mut traces = Vec::new();
    let first_traces = scenario
        .classes
        .iter()
        .map(|class| {
            let first_trace = traces.len() as u32;
            traces.extend(class.harvest.trace_columns().iter().cloned().map(Arc::new));
            first_trace
        })
        .collect();
    (traces, first_traces)
}
