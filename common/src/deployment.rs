//! A scenario put on the ground: which device stands where and carries what.

use std::sync::Arc;

use crate::geometry::{Point, place};
use crate::ids::DeviceId;
use crate::message::{Assignment, DeviceSetup, Membership};
use crate::scenario::{Scenario, assign_classes};
use crate::units::Energy;

/// The devices of a run. The same scenario and seed always give the same deployment.
#[derive(Clone, Debug)]
pub struct Deployment {
    /// The devices, in the order of ids.
    pub devices: Vec<DeviceSetup>,
    /// The class of each device, an index into [`Scenario::classes`].
    pub classes: Vec<u16>,
    /// Recorded energy per TTI by row, that the devices' sources refer to.
    pub traces: Vec<Arc<Vec<Energy>>>,
}

impl Deployment {
    /// The deployment of `scenario`.
    pub fn new(scenario: &Scenario) -> Self {
        let (traces, first_trace) = collect_traces(scenario);
        let positions = place(&scenario.layout, scenario.area, scenario.devices, scenario.seed);
        let mut of_class = vec![0u32; scenario.classes.len()];
        let classes = assign_classes(scenario);
        let devices = positions
            .into_iter()
            .zip(&classes)
            .zip(0..)
            .map(|((position, &class), id)| {
                let class = usize::from(class);
                let kind = &scenario.classes[class];
                let trace = first_trace[class] + kind.harvest.column_of(of_class[class]);
                of_class[class] += 1;
                let harvest = kind.harvest.setup(scenario.tau, trace);
                DeviceSetup {
                    id: DeviceId(id),
                    position,
                    energy: kind.energy,
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

    /// The positions, in the order of ids.
    pub fn positions(&self) -> Vec<Point> {
        self.devices.iter().map(|d| d.position).collect()
    }

    /// What the host of `membership` needs to carry the devices `first .. first + count` from TTI 0 on.
    pub fn assignment(&self, scenario: &Scenario, membership: Membership, first: u32, count: u32) -> Assignment {
        let devices = self.devices[first as usize..(first + count) as usize].to_vec();
        let traces = if devices.iter().any(|d| d.harvest.reads_a_trace()) {
            self.traces.clone()
        } else {
            Vec::new()
        };
        Assignment {
            membership,
            resumption: None,
            seed: scenario.seed,
            ttis: scenario.ttis,
            measured_from: scenario.warm_up_end(),
            sensing: scenario.sensing.clone(),
            radio: scenario.radio,
            devices,
            traces,
        }
    }
}

/// All columns of all classes, and for each class the index of its first.
fn collect_traces(scenario: &Scenario) -> (Vec<Arc<Vec<Energy>>>, Vec<u32>) {
    let mut traces = Vec::new();
    let first = scenario
        .classes
        .iter()
        .map(|class| {
            let first = traces.len() as u32;
            traces.extend(class.harvest.columns().iter().cloned().map(Arc::new));
            first
        })
        .collect();
    (traces, first)
}
