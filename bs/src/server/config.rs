//! Settings, progress and outcome of a run over the bus. `deploy/src/commands/bs.rs` sets the settings and reads the
//! outcome; displays and supervisors in other threads share [`RunProgress`]. Nothing here is serialised as it is: that
//! file copies fields into `summary.json`.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Pace;
use reveille_common::score::WindowRecord;
use reveille_common::secret::Secret;

use super::admission::Assignment;
use super::clock::Lateness;
use crate::cycle::RunOutcome;

/// Action when a host is lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnLoss {
    /// End the run with an error.
    End,
    /// Continue without its devices, which are removed.
    Continue,
    /// Hold the clock until the host returns, or another host takes over its devices in their last state.
    Wait,
}

/// Time limit for a decision, and the action after it.
#[derive(Clone, Copy, Debug, Default)]
pub struct DecisionTimeout {
    /// Time limit; `None` for no limit.
    pub limit: Option<Duration>,
    /// Action when the time is up.
    pub on_timeout: OnUndecided,
}

/// Action when no valid decision arrives in time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OnUndecided {
    /// End the run with an error.
    #[default]
    End,
    /// Keep the current plan, and wake no device.
    Hold,
}

/// Counts of decision requests with and without a decision of a policy process, and of the answers that do not count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DecisionCounts {
    /// Decisions of policy processes.
    pub decided: u64,
    /// Answers that were invalid, or came after the one that counted.
    pub refused_answers: u64,
    /// Requests without a decision: the current plan was kept, or no device was woken.
    pub held: u64,
}

/// Settings of a base station on the bus. They do not change the outcome of a completed run, except that
/// [`OnLoss::Continue`] removes the devices of lost hosts.
#[derive(Clone, Copy, Debug)]
pub struct ServerConfig {
    /// The identity of the run, which a resumed run keeps.
    pub run_id: u64,
    /// Grant as many TTIs at a time as possible, or one.
    pub lookahead: bool,
    /// The pace; a real-time pace grants one TTI at a time.
    pub pace: Pace,
    /// Action when a host is lost.
    pub on_loss: OnLoss,
    /// Time limit for each loss under [`OnLoss::Wait`]; `None` for no limit.
    pub loss_timeout: Option<Duration>,
    /// TTIs in a window of the per-window series, ≥ 1. `serve` does not read it: its caller makes the session with it.
    pub window_ttis: u64,
    /// Time to wait for all devices to join; `None` for no limit.
    pub join_timeout: Option<Duration>,
    /// Start with the clock paused.
    pub starts_paused: bool,
    /// TTIs between two frames with the states of all devices; 0 for none.
    pub state_interval_ttis: u64,
    /// The run's key, which operators and policy processes must show; `None` if any client may act as one.
    pub run_key: Option<Secret>,
    /// Whether hosts must show the run's key as well.
    pub join_needs_key: bool,
}

/// Progress of a run, for a display in another thread. `join` and the run loop write it; supervisors request a stop.
#[derive(Debug, Default)]
pub struct RunProgress {
    /// Devices that have joined.
    pub joined_devices: AtomicU64,
    /// Whether all devices have joined, so that the run has begun.
    pub has_begun: AtomicBool,
    /// The next TTI to be granted.
    pub next_tti: AtomicU64,
    /// Counted events that have ended.
    pub events: AtomicU64,
    /// Counted events that have ended without a report.
    pub misdetected: AtomicU64,
    /// Mean battery of a device over the last window, micro-units.
    pub mean_battery_micro: AtomicU64,
    /// Whether the clock is paused.
    pub is_paused: AtomicBool,
    /// Hosts that run devices and are not lost.
    pub active_host_count: AtomicU64,
    /// TTIs that began late under a real-time pace.
    pub late_ttis: AtomicU64,
    /// The largest delay of a TTI, nanoseconds.
    pub max_late_ns: AtomicU64,
    /// The assignments and names of all hosts that are not removed; replaced at each retransmission and removal.
    pub owners: Mutex<Vec<(Assignment, String)>>,
    /// Reason why the run cannot continue, if a thread other than the run loop has found one.
    stop_cause: OnceLock<String>,
    stop_requested: AtomicBool,
}

impl RunProgress {
    /// Requests the end of the run at the next TTI.
    pub fn request_stop(&self) {
        // A thread that sees the request also sees the cause, which is set before it.
        self.stop_requested.store(true, Ordering::Release);
    }

    /// Requests the end of the run because of `why`. Only the first cause counts.
    pub fn request_stop_because(&self, why: String) {
        let _has_earlier_cause = self.stop_cause.set(why).is_err();
        self.request_stop();
    }

    /// Whether the run is to end at the next TTI.
    pub fn is_stop_requested(&self) -> bool {
        self.stop_requested.load(Ordering::Acquire)
    }

    /// The reason why the run cannot continue; `None` while it can.
    pub fn stop_cause(&self) -> Option<&str> {
        self.stop_cause.get().map(String::as_str)
    }

    /// Sets the mean battery from `window`, averaged over `devices` devices.
    pub fn set_mean_battery(&self, devices: u32, window: &WindowRecord) {
        let device_ttis = u128::from(window.end - window.first) * u128::from(devices);
        let mean = window.energy.battery_sum / device_ttis.max(1);
        self.mean_battery_micro.store(mean as u64, Ordering::Relaxed);
    }

    /// Describes the owner of `device`.
    pub fn owner_of(&self, device: DeviceId) -> Option<String> {
        let owners = self.owners.lock().unwrap_or_else(PoisonError::into_inner);
        let has_device = |assignment: &Assignment| (assignment.first..=assignment.last()).contains(&device);
        let (assignment, name) = owners.iter().find(|(assignment, _)| has_device(assignment))?;
        Some(format!("host {} ({name})", assignment.host))
    }
}

/// Result of a run over the bus.
#[derive(Clone, Debug)]
pub struct ServerOutcome {
    /// The outcome, whole or partial.
    pub outcome: RunOutcome,
    /// The first TTI over the bus; a resumed run has replayed the TTIs before it.
    pub first_tti: Tti,
    /// The time from the call until all devices had joined.
    pub joining_time: Duration,
    /// The time from the end of joining to the last answer.
    pub running_time: Duration,
    /// Number of processes with which the run began; a takeover does not add one.
    pub process_count: usize,
    /// Grants made: barriers over all hosts.
    pub grant_count: u64,
    /// Delays under a real-time pace.
    pub lateness: Lateness,
    /// Payloads that were dropped because they were not messages.
    pub malformed_payloads: u64,
    /// Messages that were dropped because they were unexpected or impossible.
    pub unexpected_messages: u64,
    /// Duration of each loss of a process, until all its devices had hosts again.
    pub loss_durations: Vec<Duration>,
    /// Decisions of policy processes.
    pub decisions: DecisionCounts,
    /// Queued decisions that the run did not need.
    pub unused_decisions: usize,
}
