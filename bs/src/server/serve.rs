//! Entry points of a run over the bus: [`serve`] runs it from the first join to the last ledger, [`dismiss_hosts`] ends
//! it for the hosts once the results are written. `deploy/src/commands/bs.rs` calls both, the second also after an
//! error, since hosts wait for it.

use std::sync::Arc;
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{ClockMessage, Frame, HostCheckpoint};
use reveille_common::score::WindowRecord;

use super::config::{DecisionTimeout, RunProgress, ServerConfig, ServerOutcome};
use super::error::BsError;
use super::failover::ReplaySource;
use super::policy_port::PolicyPort;
use super::run_loop::LoopContext;
use super::state::{SharedState, now};
use super::{join, run_loop, subscriptions};
use crate::cycle::PreparedRun;
use crate::observer::frames::FrameObserver;
use crate::observer::{Notification, Observer};
use crate::session::Session;

/// Longest wait for dismissed hosts to leave: a frozen one never does.
const DISMISSAL_PATIENCE: Duration = Duration::from_secs(2);
/// Interval between checks of whether they have left.
const LEAVE_CHECK_INTERVAL: Duration = Duration::from_millis(10);

/// A run to serve.
pub struct RunSpec<'a> {
    /// The scenario with its deployment and policy.
    pub prepared: &'a PreparedRun,
    /// The run, before TTI 0 or resumed.
    pub session: Session,
    /// Checkpoint of all devices of a resumed run before the next TTI of `session`, for its first hosts.
    pub checkpoint: Option<Arc<HostCheckpoint>>,
    /// Replay that restores the devices of lost hosts and stores external inputs. Without it no other host can take
    /// over these devices, and their removal ends the run.
    pub replay: Option<Arc<dyn ReplaySource>>,
    /// Time to wait for a decision at the policy port; `None` if no policy process decides.
    pub decision_timeout: Option<DecisionTimeout>,
}

/// Runs `spec` over `bus`: waits until every device has a host, runs every TTI and collects the ledgers.
///
/// # Errors
/// If the bus fails, too few devices join, a host is lost for good, no decision arrives in time, external inputs cannot
/// be stored or repeated, or the run is interrupted without a replay.
pub async fn serve(
    bus: &Bus,
    spec: RunSpec<'_>,
    settings: &ServerConfig,
    progress: &Arc<RunProgress>,
    observer: &mut impl Observer,
) -> Result<ServerOutcome, BsError> {
    let RunSpec {
        prepared,
        session,
        checkpoint,
        replay,
        decision_timeout,
    } = spec;
    let PreparedRun {
        scenario, deployment, ..
    } = prepared;
    let shared = SharedState::new(scenario, deployment, settings, session.next_tti());
    let all_devices = (0..scenario.run.devices).map(DeviceId);
    let removed_devices = all_devices.filter(|&device| session.cycle().is_removed(device));
    shared.lock().removed_devices.extend(removed_devices);
    // Kept until the end of the run: dropping a subscription undeclares it.
    let _guards = subscriptions::declare(bus, scenario, deployment, settings, checkpoint, replay.clone(), &shared)?;
    let joining_started = now();
    join::wait_for_all_devices(&shared, scenario, settings, progress).await?;
    let joining_time = joining_started.elapsed();
    let gauge = BatteryGauge {
        progress,
        devices: scenario.run.devices,
    };
    let mut observers = (observer, (BusObserver::new(bus, settings.state_interval_ttis), gauge));
    let context = LoopContext {
        bus,
        settings,
        progress,
        shared: &shared,
        replay,
        port: PolicyPort::new(bus, settings.run_key, decision_timeout),
    };
    run_loop::run(context, session, &mut observers, joining_time).await
}

/// Sends frames to observers on the bus, while there are any.
struct BusObserver<'a> {
    bus: &'a Bus,
    frame_observer: FrameObserver<Box<dyn FnMut(Frame) + Send + 'a>>,
}

impl<'a> BusObserver<'a> {
    /// Sends the states of all devices every `state_interval_ttis` TTIs; 0 for never.
    fn new(bus: &'a Bus, state_interval_ttis: u64) -> Self {
        Self {
            bus,
            frame_observer: FrameObserver::new(state_interval_ttis, Box::new(|frame| bus.publish_frame(frame))),
        }
    }
}

impl Observer for BusObserver<'_> {
    fn notify(&mut self, notification: &Notification<'_>) {
        // Frames are encoded copies, whose cost a run without observers should not pay.
        if self.bus.is_observed() {
            self.frame_observer.notify(notification);
        }
    }

    fn states_due(&self) -> Tti {
        if self.bus.is_observed() {
            self.frame_observer.states_due()
        } else {
            Tti::NEVER
        }
    }

    fn wants_beliefs(&self) -> bool {
        self.bus.is_observed()
    }
}

/// Writes the mean battery of each window to the progress.
struct BatteryGauge<'a> {
    progress: &'a RunProgress,
    devices: u32,
}

impl Observer for BatteryGauge<'_> {
    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        self.progress.set_mean_battery(self.devices, window);
        true
    }
}

/// Dismisses all hosts: the run has ended and its results are written, or it has failed for the given reason. Returns
/// once they have left, or after `DISMISSAL_PATIENCE`.
///
/// # Errors
/// If the bus fails.
pub async fn dismiss_hosts(bus: &Bus, failure: Option<String>) -> Result<(), BsError> {
    let message = failure.map_or(ClockMessage::Dismiss, ClockMessage::RunFailed);
    bus.publisher::<ClockMessage>()?.publish(&message)?;
    // The message can still be on a slow link, and the end of this session would overtake it at a router.
    let deadline = now() + DISMISSAL_PATIENCE;
    // The results are complete, so a failed query only ends the wait.
    while let Ok(1..) = bus.count_alive_hosts(deadline.saturating_duration_since(now())).await
        && now() < deadline
    {
        tokio::time::sleep(LEAVE_CHECK_INTERVAL).await;
    }
    Ok(())
}
