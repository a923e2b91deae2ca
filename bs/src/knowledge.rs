//! What a base station knows before the first TTI, and what a policy is handed of a run.
//!
//! This is the wall between a policy and ground truth: the scenario, its seed, when and where events come, how long
//! they last and what will be harvested do not pass it. What comes later, a policy hears by
//! [`crate::observation::Observation`].

use std::sync::Arc;

use reveille_common::deployment::Deployment;
use reveille_common::geometry::{Area, Point};
use reveille_common::harvest::Course;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::radio::Link;
use reveille_common::rng::PolicyStreams;
use reveille_common::scenario::{BsSettings, EnergyModel, Scenario};
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

use crate::grids::Grids;

/// What is known of one device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceKnowledge {
    /// Where it stands.
    pub position: Point,
    /// Its class, an index into [`Knowledge::classes`].
    pub class: u16,
    /// Battery and costs.
    pub energy: EnergyModel,
    /// Its mean harvest in a TTI; over a day where that differs with the time of the day.
    pub mean_harvest: Energy,
}

/// What a base station knows of its deployment and of the model, the same for all policies.
///
/// No policy can be built from the seed, though it may draw,
/// ```compile_fail
/// fn peek(known: &reveille_bs::knowledge::Knowledge) -> u64 {
///     known.streams.seed
/// }
/// ```
/// or from how long events last and from their process beyond α, or from what a device will harvest:
/// ```compile_fail
/// fn peek(known: &reveille_bs::knowledge::Knowledge) -> u64 {
///     known.events.duration
/// }
/// ```
/// ```compile_fail
/// fn peek(known: &reveille_bs::knowledge::Knowledge) -> reveille_common::event::DurationKind {
///     known.events.duration_kind
/// }
/// ```
/// ```compile_fail
/// fn peek(known: &reveille_bs::knowledge::Knowledge) -> reveille_common::event::Process {
///     known.events.process
/// }
/// ```
/// ```compile_fail
/// fn peek(known: &reveille_bs::knowledge::Knowledge) {
///     let _ = &known.devices[0].harvest;
/// }
/// ```
/// or from what the radio will lose:
/// ```compile_fail
/// fn peek(known: &mut reveille_bs::knowledge::Knowledge) {
///     known.radio.at(reveille_common::ids::Tti(5));
/// }
/// ```
/// This is all that there is, so that whoever adds to it passes by here,
/// ```
/// use reveille_bs::knowledge::Knowledge;
///
/// fn all(known: Knowledge) {
///     let Knowledge {
///         area: _, sensing: _, radio: _, alpha: _, tau: _, ttis: _, bs: _, classes: _, courses: _, devices: _,
///         streams: _, grids: _,
///     } = known;
/// }
/// ```
/// and what it can do:
/// ```
/// use reveille_common::rng::PolicyPurpose;
///
/// fn known(known: &reveille_bs::knowledge::Knowledge) -> f64 {
///     let draw = known.streams.unit_for_pair(PolicyPurpose::Exploration, 0, 0);
///     known.alpha + known.devices[0].mean_harvest.units() + draw
/// }
/// ```
#[derive(Clone, Debug)]
pub struct Knowledge {
    /// The served area ξ.
    pub area: Area,
    /// The sensing model, whose p is known and invertible.
    pub sensing: Sensing,
    /// How often the radio loses what, in the long run.
    pub radio: Link,
    /// Probability α that an event starts in a TTI in which none is active, `(0, 1]`; its long-run mean where it
    /// changes with time.
    pub alpha: f64,
    /// Duration τ of a TTI in units of model time, > 0.
    pub tau: f64,
    /// Length of the run K in TTIs.
    pub ttis: u64,
    /// The settings of the base station.
    pub bs: BsSettings,
    /// The names of the device classes.
    pub classes: Vec<String>,
    /// By class, what is to be expected of its energy source at which time of the day, where that differs and is known.
    pub courses: Vec<Option<Arc<Course>>>,
    /// The devices, in the order of ids.
    pub devices: Vec<DeviceKnowledge>,
    /// The random draws that a policy may make.
    pub streams: PolicyStreams,
    /// Grids of wake-up correlations that were computed before.
    pub grids: Arc<Grids>,
}

impl Knowledge {
    /// What a base station knows of `scenario` with its devices as in `deployment`. `grids` may be shared with other
    /// runs.
    pub fn of(scenario: &Scenario, deployment: &Deployment, grids: Arc<Grids>) -> Self {
        let devices = deployment.devices.iter().zip(&deployment.classes);
        Self {
            area: scenario.area,
            sensing: scenario.sensing.clone(),
            radio: scenario.radio.link(),
            alpha: scenario.events.alpha,
            tau: scenario.tau,
            ttis: scenario.ttis,
            bs: scenario.bs,
            classes: scenario.classes.iter().map(|class| class.name.clone()).collect(),
            courses: scenario
                .classes
                .iter()
                .map(|class| class.harvest.setup(scenario.tau, 0).course().map(Arc::new))
                .collect(),
            devices: devices
                .map(|(device, &class)| DeviceKnowledge {
                    position: device.position,
                    class,
                    energy: device.energy,
                    mean_harvest: device.harvest.mean(&deployment.traces),
                })
                .collect(),
            streams: PolicyStreams::new(scenario.seed),
            grids,
        }
    }

    /// Number of devices N.
    pub const fn n(&self) -> usize {
        self.devices.len()
    }

    /// What `device` is expected to harvest in the TTIs from `from` to before `end`: by the time of the day where its
    /// course is known, and else by the mean. No draw is in it.
    pub fn expected_harvest(&self, device: DeviceId, from: Tti, end: Tti) -> Energy {
        let known = &self.devices[device.index()];
        match &self.courses[usize::from(known.class)] {
            Some(course) => course.between(from, end),
            None => known.mean_harvest.times(end.0.saturating_sub(from.0)),
        }
    }

    /// The positions, in the order of ids.
    pub fn positions(&self) -> Vec<Point> {
        self.devices.iter().map(|device| device.position).collect()
    }
}
