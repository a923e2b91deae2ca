//! The emulation plane between base station and hosts: joining, grants and answers. Fields and variants are encoded by
//! position: a change raises `WIRE_VERSION`. Names in requests, [`ClockMessage`] and [`HostAnswer`] are part of
//! recordings (`view/src/schemas.rs`). [`HostSetup`] includes the settings of energy, harvest, radio and sensing.

use std::fmt;
use std::iter::Sum;
use std::ops::AddAssign;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{Change, Concerns, DeviceRange, FailedTransmission, WakeOutcome};
use crate::digits::count_noun;
use crate::energy::EnergyModel;
use crate::event::Stimulus;
use crate::geometry::Point;
use crate::harvest::HarvestSetup;
use crate::ids::{DeviceId, HostId, Tti};
use crate::radio::RadioSettings;
use crate::secret::{HostCredential, Secret};
use crate::sensing::Sensing;
use crate::state::DeviceView;
use crate::totals::{DeviceTotals, Ledger};
use crate::units::Energy;

/// Emulation, host → BS, a query: a request for an assignment.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JoinRequest {
    /// The host's version of Reveille.
    pub version: String,
    /// The devices that the host offers to run.
    pub offer: HostOffer,
    /// A random number drawn by this host process: a repeated request gets the same assignment.
    pub nonce: u64,
    /// The host's own name, for messages to the operator. The BS does not rely on it.
    pub name: String,
}

/// The devices that a host offers to run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum HostOffer {
    /// Free or lost devices, at most this number, ≥ 1.
    AtMost(u32),
    /// An equal share of the free devices, or any number of lost ones.
    Share,
    /// Any number of lost devices, and no others.
    Lost,
    /// No devices: a router, which only needs the run's secret.
    Nothing,
    /// Exactly these devices, free or lost.
    Exactly(DeviceRange),
}

impl HostOffer {
    /// Largest number of devices that the host takes over from a lost host.
    pub const fn max_devices(self) -> u32 {
        match self {
            Self::AtMost(count) | Self::Exactly(DeviceRange { count, .. }) => count,
            Self::Share | Self::Lost => u32::MAX,
            Self::Nothing => 0,
        }
    }
}

impl fmt::Display for HostOffer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::AtMost(count) => f.write_str(&count_noun(*count, "device")),
            Self::Share => f.write_str("a share of the devices"),
            Self::Lost => f.write_str("lost devices"),
            Self::Nothing => f.write_str("no devices, as a router"),
            Self::Exactly(range) => range.fmt(f),
        }
    }
}

/// Emulation, BS → host: the reply to a [`JoinRequest`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum JoinReply {
    /// The host's assignment.
    Welcome(Box<HostSetup>),
    /// The BS still waits for other hosts before it divides the devices; the host asks again.
    AwaitShare,
    /// No devices are free now; the host may ask again. Holds the reason.
    Retry(String),
    /// The BS refuses the host, for this reason.
    Refused(String),
    /// The run's secret, for a router ([`HostOffer::Nothing`]).
    Routes(Secret),
}

impl Concerns for JoinRequest {}

impl fmt::Display for JoinRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            version, offer, name, ..
        } = self;
        write!(f, "{name:?} offers to run {offer}, reveille {version}")
    }
}

/// A host's credential and the run's secret, which the BS sends only to members of the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BusCredentials {
    /// The host's number and token.
    pub credential: HostCredential,
    /// The secret part at the start of every member's keys.
    pub secret: Secret,
}

/// The saved state of a device during a run, as its state machine encodes it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct DeviceCheckpoint(pub Vec<u8>);

/// A point between two grants at which a run can be resumed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResumePoint {
    /// The first TTI that has not been granted.
    pub next: Tti,
    /// The first TTI of the current plan; `None` before the first plan.
    pub plan_from: Option<Tti>,
}

/// Saved states of devices during a run, for a host to resume.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HostCheckpoint {
    /// The point that the devices have reached.
    pub at: ResumePoint,
    /// The devices, in the order of ids.
    pub devices: Vec<DeviceCheckpoint>,
}

impl HostCheckpoint {
    /// Returns the checkpoint of `count` devices from position `first`.
    ///
    /// # Panics
    /// If there are fewer devices.
    #[must_use]
    pub fn slice(&self, first: usize, count: usize) -> Self {
        Self {
            at: self.at,
            devices: self.devices[first..][..count].to_vec(),
        }
    }
}

/// The complete setup of a host for its devices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HostSetup {
    /// The host's identity on the bus.
    pub credentials: BusCredentials,
    /// The progress of its devices; `None` if they start before TTI 0.
    pub checkpoint: Option<HostCheckpoint>,
    /// Seed of the run's streams.
    pub seed: u64,
    /// Length K of the run in TTIs.
    pub ttis: u64,
    /// The first measured TTI; earlier ones are warm-up.
    pub measured_from: Tti,
    /// The sensing model.
    pub sensing: Sensing,
    /// The failures of the radio.
    pub radio: RadioSettings,
    /// Its devices, with consecutive ids.
    pub devices: Vec<DeviceSetup>,
    /// The traces of recorded energy per TTI; a device's source refers to one by its index.
    pub traces: Vec<Arc<Vec<Energy>>>,
}

impl HostSetup {
    /// Checks the values with which a device would panic, or a host would mix up its devices. A host calls it before it
    /// uses a setup; a new precondition of a device belongs here.
    ///
    /// # Errors
    /// If a value is invalid; describes the first such value.
    pub fn validate(&self) -> Result<(), String> {
        let Some(first) = self.devices.first() else {
            return Err("it has no devices".to_owned());
        };
        // A probability outside [0, 1] would panic in `Geometric::new`.
        if !self.radio.is_valid() {
            return Err("its radio settings are invalid".to_owned());
        }
        for (setup, expected) in self.devices.iter().zip(first.id.0..) {
            let device = setup.id;
            // A host finds a device by its offset from the first id, so ids have to be consecutive.
            if device.0 != expected {
                return Err(format!("device {device} follows where device {expected} is due"));
            }
            // `Battery::new` would panic.
            if setup.energy.initial > setup.energy.e_max {
                return Err(format!("the initial level of device {device} exceeds its capacity"));
            }
            // An unknown trace or an impossible probability would panic in `HarvestSource::new`.
            if !setup.harvest.is_valid(&self.traces) {
                return Err(format!("the energy source of device {device} is invalid"));
            }
        }
        // The host zips devices with checkpoints, which would silently drop the rest of the longer list.
        if self
            .checkpoint
            .as_ref()
            .is_some_and(|checkpoint| checkpoint.devices.len() != self.devices.len())
        {
            return Err("its numbers of checkpoints and devices differ".to_owned());
        }
        Ok(())
    }
}

/// The setup of one device at the start of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeviceSetup {
    /// Its number.
    pub id: DeviceId,
    /// Its position.
    pub position: Point,
    /// Battery and costs.
    pub energy: EnergyModel,
    /// Its energy source.
    pub harvest: HarvestSetup,
}

/// Emulation, host → BS, a query: the host has all subscriptions and waits for the first TTI. The reply tells whether
/// its assignment is still valid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ready {
    /// The host.
    pub host: HostId,
}

impl Concerns for Ready {}

impl fmt::Display for Ready {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "host {} is ready", self.host)
    }
}

/// The grant of one or more TTIs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct GrantMessage {
    /// First granted TTI.
    pub first: Tti,
    /// Last granted TTI. Only in this TTI can devices have anything to report.
    pub last: Tti,
    /// The stimulus that devices can sense in `last`.
    pub stimulus: Option<Stimulus>,
    /// The last TTI of that stimulus. A device that wakes later senses nothing.
    #[serde(rename = "until")]
    pub stimulus_last: Tti,
    /// Whether the answer contains the sums of the TTIs before `first`.
    #[serde(rename = "account")]
    pub wants_totals: bool,
    /// Whether the answer contains the states and batteries after `last`.
    #[serde(rename = "views")]
    pub wants_views: bool,
    /// The first TTI of the plan that applies in `last`. A host that missed that plan does not answer, and receives it
    /// again.
    #[serde(rename = "plan")]
    pub plan_from: Tti,
    /// Number of plans that take effect within the grant. A host that lacks one of them does not answer either.
    #[serde(rename = "plans")]
    pub plan_count: u32,
    /// Number of changes that operators make at the start of `first`. A host that lacks them does not answer either.
    #[serde(rename = "changes")]
    pub change_count: u32,
}

/// Emulation, BS → all hosts: the messages of the virtual clock.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ClockMessage {
    /// TTIs are granted.
    Grant(GrantMessage),
    /// Operators change devices at the start of this TTI, the first of the next grant. The BS sends it before that
    /// grant, once per TTI.
    Act(Tti, Vec<Change>),
    /// The run has ended before this TTI: hosts answer with their devices' ledgers and leave.
    CollectLedgers(Tti),
    /// The BS has received everything: hosts leave.
    Dismiss,
    /// The run has failed, for the reason given: hosts leave.
    RunFailed(String),
}

impl Concerns for ClockMessage {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        let Self::Act(_, changes) = self else { return false };
        let mut ranges = changes.iter().filter_map(Change::devices);
        ranges.any(|devices| devices.contains(device))
    }
}

impl fmt::Display for ClockMessage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Grant(grant) => grant.fmt(f),
            Self::Act(_, changes) => {
                let changes: Vec<String> = changes.iter().map(ToString::to_string).collect();
                f.write_str(&changes.join(", "))
            }
            Self::CollectLedgers(end) => write!(f, "the run ends before TTI {end}"),
            Self::Dismiss => f.write_str("hosts may leave"),
            Self::RunFailed(why) => write!(f, "the run has failed: {why}"),
        }
    }
}

impl fmt::Display for GrantMessage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            first,
            last,
            stimulus,
            stimulus_last: _,
            wants_totals,
            wants_views,
            plan_from: _,
            plan_count: _,
            change_count: _,
        } = self;
        if first == last {
            write!(f, "TTI {first}")?;
        } else {
            write!(f, "TTIs {first} to {last}")?;
        }
        if let Some(stimulus) = stimulus {
            write!(f, ", {stimulus}")?;
        }
        f.write_str(if *wants_totals { ", sums requested" } else { "" })?;
        f.write_str(if *wants_views {
            ", states and batteries requested"
        } else {
            ""
        })
    }
}

/// Numbers of devices with δ = 1 that would have detected the event of a TTI, but could not sense.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct UnableDetectors {
    /// Devices that could not pay for sensing.
    pub unpowered: u32,
    /// Devices that an operator had failed.
    pub failed: u32,
}

impl UnableDetectors {
    /// One device that could not pay for sensing.
    pub const UNPOWERED: Self = Self {
        unpowered: 1,
        failed: 0,
    };
    /// One failed device.
    pub const FAILED: Self = Self {
        unpowered: 0,
        failed: 1,
    };

    /// Returns the number of devices.
    pub fn total(self) -> u64 {
        u64::from(self.unpowered) + u64::from(self.failed)
    }
}

impl AddAssign for UnableDetectors {
    fn add_assign(&mut self, other: Self) {
        self.unpowered += other.unpowered;
        self.failed += other.failed;
    }
}

impl Sum for UnableDetectors {
    fn sum<I: Iterator<Item = Self>>(parts: I) -> Self {
        let mut sum = Self::default();
        parts.for_each(|part| sum += part);
        sum
    }
}

/// Emulation, host → BS: the answer to a [`ClockMessage`] or to a wake-up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum HostAnswer {
    /// A host's devices have completed all TTIs up to `tti`.
    GrantDone {
        /// The host.
        host: HostId,
        /// The last TTI of the grant.
        tti: Tti,
        /// Number of reports that its devices sent on the air plane in this TTI.
        reports: u32,
        /// Devices that detected the event and could not transmit.
        failures: Vec<FailedTransmission>,
        /// Devices that would have detected the event, but could not sense.
        unable: UnableDetectors,
        /// Sums over the host's devices, if the grant asked for them.
        totals: Option<DeviceTotals>,
        /// States and batteries of its devices, in the order of ids, if the grant asked for them. Observers see both.
        /// A policy with `bs.battery_knowledge = "oracle"` receives the batteries, which no real BS knows.
        views: Option<Vec<DeviceView>>,
    },
    /// A wake-up without a report.
    #[serde(rename = "NotWoken")]
    NoReport {
        /// The device.
        device: DeviceId,
        /// The TTI.
        tti: Tti,
        /// The outcome.
        outcome: WakeOutcome,
    },
    /// The ledgers of a host's devices at the end of the run.
    Ledgers {
        /// The host.
        host: HostId,
        /// The ledger of each device.
        ledgers: Vec<(DeviceId, Ledger)>,
    },
}

impl Concerns for HostAnswer {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        match self {
            Self::NoReport { device: woken, .. } => *woken == device,
            Self::GrantDone { failures, .. } => failures.iter().any(|failure| failure.device == device),
            Self::Ledgers { ledgers, .. } => ledgers.iter().any(|(id, _)| *id == device),
        }
    }
}

impl fmt::Display for HostAnswer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::GrantDone {
                reports,
                failures,
                totals,
                ..
            } => {
                write!(f, "done, {}", count_noun(*reports, "report"))?;
                for failure in failures {
                    write!(f, ", device {} could not transmit", failure.device)?;
                }
                totals
                    .as_ref()
                    .map_or(Ok(()), |sums| write!(f, ", batteries hold {}", sums.battery))
            }
            Self::NoReport { device, outcome, .. } => write!(f, "device {device} {outcome}"),
            Self::Ledgers { ledgers, .. } => write!(f, "the ledgers of {}", count_noun(ledgers.len(), "device")),
        }
    }
}
