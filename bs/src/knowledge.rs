//! The base station's knowledge before the first TTI, which a policy receives.
//!
//! [`Knowledge`] separates policies from ground truth: it contains neither scenario and seed, nor times, places and
//! durations of events, nor future harvests. During the run a policy receives [`crate::observation::Observation`]. The
//! `compile_fail` examples below test this.

use std::sync::Arc;

use reveille_common::deployment::Deployment;
use reveille_common::geometry::{Area, Point};
use reveille_common::harvest::DayProfile;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::radio::RadioLossRates;
use reveille_common::rng::PolicyStreams;
use reveille_common::scenario::{BsSettings, EnergyModel, Scenario};
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

use crate::bounds_cache::BoundsCache;

/// Knowledge of one device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceKnowledge {
    /// Position.
    pub position: Point,
    /// Class, an index into [`Knowledge::classes`].
    pub class: u16,
    /// Battery parameters and energy costs.
    pub energy: EnergyModel,
    /// Mean harvest per TTI; the mean over a day if the harvest varies with the time of day.
    pub mean_harvest: Energy,
}

/// Knowledge of the deployment and of the model, the same for all policies.
///
/// A policy cannot use the seed, though it may draw random numbers:
/// ```compile_fail
/// fn peek(known: &reveille_bs::knowledge::Knowledge) -> u64 {
///     known.streams.seed
/// }
/// ```
/// It cannot use the duration of events, their process beyond α, or the future harvest of a device:
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
/// fn peek(known: &reveille_bs::knowledge::Knowledge) {
///     let _ = &known.devices[0].harvest;
/// }
/// ```
/// These examples only show that no field has such a name. The guard is the complete list of fields, so that a new
/// field also needs a change here:
/// ```
/// use reveille_bs::knowledge::Knowledge;
///
/// fn all(known: Knowledge) {
///     let Knowledge {
///         area: _, sensing: _, radio: _, alpha: _, tau: _, ttis: _, bs: _, classes: _, day_profiles: _,
///         devices: _, streams: _, correlation_bounds: _,
///     } = known;
/// }
/// ```
/// A policy can use them as follows:
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
    /// The sensing model, with p known and invertible.
    pub sensing: Sensing,
    /// Long-run loss rates of the radio.
    pub radio: RadioLossRates,
    /// Probability α that an event starts in a TTI in which none is active, `(0, 1]`; its long-run mean where it
    /// changes with time. An operator who changes the rate during a run does not change it here.
    pub alpha: f64,
    /// Duration τ of a TTI in units of model time, > 0.
    pub tau: f64,
    /// Length of the run K in TTIs.
    pub ttis: u64,
    /// The settings of the base station.
    pub bs: BsSettings,
    /// Names of the device classes.
    pub classes: Vec<String>,
    /// Expected harvest by time of day, for each class; `None` if it is constant or unknown.
    pub day_profiles: Vec<Option<Arc<DayProfile>>>,
    /// The devices, in the order of ids.
    pub devices: Vec<DeviceKnowledge>,
    /// The random draws that a policy may make.
    pub streams: PolicyStreams,
    /// Cache of upper bounds of `P_4,2`. Runs share it, and it changes no result.
    pub correlation_bounds: Arc<BoundsCache>,
}

impl Knowledge {
    /// Returns the base station's knowledge of `scenario` with the devices of `deployment`. `correlation_bounds` may be
    /// shared with other runs.
    pub fn from_scenario<P>(
        scenario: &Scenario<P>,
        deployment: &Deployment,
        correlation_bounds: Arc<BoundsCache>,
    ) -> Self {
        let devices = deployment.devices.iter().zip(&deployment.classes);
        Self {
            area: scenario.area,
            sensing: scenario.sensing.clone(),
            radio: scenario.radio.loss_rates(),
            alpha: scenario.events.alpha,
            tau: scenario.run.tau,
            ttis: scenario.run.ttis,
            bs: scenario.bs,
            classes: scenario.classes.iter().map(|class| class.name.clone()).collect(),
            day_profiles: scenario
                .classes
                .iter()
                // Only a source by the time of day has a day profile, so the index of the trace does not matter.
                .map(|class| class.harvest.setup(scenario.run.tau, 0).day_profile().map(Arc::new))
                .collect(),
            devices: devices
                .map(|(device, &class)| DeviceKnowledge {
                    position: device.position,
                    class,
                    energy: device.energy,
                    mean_harvest: device.harvest.mean(&deployment.traces),
                })
                .collect(),
            streams: PolicyStreams::new(scenario.run.seed),
            correlation_bounds,
        }
    }

    /// Number of devices N.
    pub const fn n(&self) -> usize {
        self.devices.len()
    }

    /// Expected harvest of `device` in the TTIs from `from` to before `end`. It follows the day profile of its class if
    /// known, and the mean otherwise. It uses no random draw.
    pub fn expected_harvest(&self, device: DeviceId, from: Tti, end: Tti) -> Energy {
        let device_knowledge = &self.devices[device.index()];
        match &self.day_profiles[usize::from(device_knowledge.class)] {
            Some(profile) => profile.energy_between(from, end),
            None => device_knowledge.mean_harvest.times(end.0.saturating_sub(from.0)),
        }
    }

    /// The positions, in the order of ids.
    pub fn positions(&self) -> Vec<Point> {
        self.devices.iter().map(|device| device.position).collect()
    }
}
