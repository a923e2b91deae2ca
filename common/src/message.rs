//! What crosses the bus.
//!
//! Two planes: on the *air* plane travels what a real deployment would send over the radio, on the *emulation* plane what
//! only the emulation needs. [`crate::keys`] gives each message its key.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::event::Stimulus;
use crate::geometry::Point;
use crate::harvest::HarvestSetup;
use crate::ids::{DeviceId, HostId, Tti};
use crate::metrics::DeviceTotals;
use crate::plan::Plan;
use crate::scenario::EnergyModel;
use crate::sensing::Sensing;
use crate::units::Energy;

/// Air, BS → all devices: δ from a TTI on, when it changes and for synchronisation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlanUpdate {
    /// The first TTI it holds for.
    pub from: Tti,
    /// δ.
    pub plan: Plan,
}

/// Air, BS → one device's wake-up radio.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WakeUp {
    /// The TTI in which it is sent.
    pub tti: Tti,
}

/// Air, device → BS: what a device in S3 sends.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// The reporter.
    pub device: DeviceId,
    /// The TTI of the transmission.
    pub tti: Tti,
    /// I_ij = Ψ p(d_ij), 0 beyond d_max (Eq. (1)).
    pub information: f64,
    /// The reporter's battery after the transmission.
    pub battery: Energy,
}

/// A device that entered S2 and could not pay E_Tx.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// The device.
    pub device: DeviceId,
    /// What was left in its battery and is now lost.
    pub drained: Energy,
}

/// What came of a wake-up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum WakeOutcome {
    /// S4 → S2 → S3: it reported.
    Reported(Report),
    /// S4 → S2 → S4: it woke and could not pay E_Tx.
    Failed(Failure),
    /// Its wake-up radio had no power, or it was not asleep.
    Unheard,
}

/// Emulation, BS → all hosts: the grant of one or more TTIs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tick {
    /// First granted TTI.
    pub first: Tti,
    /// Last granted TTI. Only in this one can a device have anything to report.
    pub last: Tti,
    /// What the world shows in `last`.
    pub stimulus: Option<Stimulus>,
    /// Whether the answer carries the sums of the TTIs before `first`.
    pub account: bool,
    /// Whether the answer carries the battery levels after `last`.
    pub batteries: bool,
    /// The TTI from which the plan in force holds. A host that has missed that plan does not answer, and is sent it again.
    pub plan: Tti,
}

/// Emulation, BS → all hosts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Clock {
    /// TTIs are granted.
    Grant(Tick),
    /// The run has ended before this TTI: hosts answer with their devices' ledgers and leave.
    Finish(Tti),
    /// Everything has been received: hosts leave.
    Dismiss,
}

/// Emulation, host → BS: the answer to a [`Clock`] message or to a wake-up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Answer {
    /// A host's devices have done all TTIs up to `tti`.
    Done {
        /// The host.
        host: HostId,
        /// The last TTI of the grant.
        tti: Tti,
        /// Reports that its devices have put on the air plane in this TTI.
        reports: u32,
        /// Devices that detected the event and could not transmit.
        failures: Vec<Failure>,
        /// Sums over the host's devices, where the grant asked for them.
        totals: Option<DeviceTotals>,
        /// Battery levels of its devices, in the order of ids, where the grant asked for them: what a policy with
        /// `bs.battery_knowledge = "oracle"` is told, and no real BS is.
        batteries: Option<Vec<Energy>>,
    },
    /// A wake-up that brought no report.
    NotWoken {
        /// The device.
        device: DeviceId,
        /// The TTI.
        tti: Tti,
        /// What its battery lost, if it woke at all.
        failure: Option<Failure>,
    },
    /// The ledgers of a host's devices at the end of the run.
    Final {
        /// The host.
        host: HostId,
        /// One for each device.
        ledgers: Vec<(DeviceId, DeviceTotals)>,
    },
}

/// Emulation, host → BS, a query: places in the run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JoinRequest {
    /// The host's version of Reveille.
    pub version: String,
    /// How many devices it offers to carry, ≥ 1.
    pub count: u32,
    /// A number that this host process drew for itself: a repeated request gets the same places.
    pub nonce: u64,
}

/// Emulation, BS → host: the reply to a [`JoinRequest`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum JoinReply {
    /// The host's places.
    Welcome(Assignment),
    /// Why not, in words.
    Refused(String),
}

/// What a host needs to carry its devices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Assignment {
    /// The host's number.
    pub host: HostId,
    /// Seed of the run's streams.
    pub seed: u64,
    /// Length K of the run in TTIs.
    pub ttis: u64,
    /// The sensing model.
    pub sensing: Sensing,
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
        for (setup, expected) in self.devices.iter().zip(first.id.0..) {
            let device = setup.id;
            if device.0 != expected {
                return Err(format!("device {device} stands where {expected} belongs"));
            }
            if setup.energy.initial > setup.energy.e_max {
                return Err(format!("device {device} starts with more than its battery holds"));
            }
            let is_share = |p: f64| (0.0..=1.0).contains(&p);
            let is_sound = match setup.harvest {
                HarvestSetup::Arrivals { p, .. } => is_share(p),
                HarvestSetup::OnOff {
                    on_share, p_off, p_on, ..
                } => [on_share, p_off, p_on].into_iter().all(is_share),
                HarvestSetup::Trace {
                    trace, ttis_per_row, ..
                } => ttis_per_row > 0 && self.traces.get(trace as usize).is_some_and(|rows| !rows.is_empty()),
            };
            if !is_sound {
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

/// Emulation, host → BS, a query: the host is subscribed to everything and waits for the first TTI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ready {
    /// The host.
    pub host: HostId,
}

/// Emulation, anyone → BS, a query: commands to the virtual clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ClockCommand {
    /// Grant nothing more until told.
    Pause,
    /// Grant `n` TTIs, then pause.
    Step(u64),
    /// Grant TTIs up to but not including this one, then pause.
    RunTo(Tti),
    /// Grant to the end.
    Resume,
    /// Change nothing.
    Status,
}

/// The reply to a [`ClockCommand`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockStatus {
    /// The next TTI to be granted.
    pub tti: Tti,
    /// Length K of the run.
    pub ttis: u64,
    /// Whether the clock stands, or will when it reaches `until`.
    pub paused: bool,
    /// The TTI before which the clock will stop.
    pub until: Tti,
    /// Whether all devices have joined.
    pub begun: bool,
}

/// Emulation, BS → observers: copies of messages, in the order in which the BS sent or received them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TapBatch {
    /// The number of the first frame, counted since the run began. A gap to the batch before is what was left out.
    pub first: u64,
    /// The frames.
    pub frames: Vec<TapFrame>,
}

/// A copy of one message.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TapFrame {
    /// The TTI that the BS was in.
    pub tti: Tti,
    /// Its key.
    pub key: String,
    /// Its payload as sent.
    pub payload: Vec<u8>,
}
