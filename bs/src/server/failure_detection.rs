//! Detection of unresponsive and lost hosts in the run loop, and the reaction that [`OnLoss`] selects. `failover`
//! records the lost hosts, and `run_loop` declares the time limits.

use std::sync::Arc;

use reveille_common::message::HostCheckpoint;

use super::config::OnLoss;
use super::error::BsError;
use super::run_loop::{LOST_AFTER, RunLoop, UNRESPONSIVE_AFTER};
use super::state::{ServerState, now};

impl RunLoop<'_> {
    /// Logs a warning for each host that has not answered; the caller measures the time.
    pub(super) fn warn_of_unresponsive_hosts(&self) {
        let state = self.context.shared.lock();
        for host in state.barrier.missing_hosts() {
            let (tti, name) = (self.session.next_tti(), state.admission.host_name(host));
            let seconds = UNRESPONSIVE_AFTER.as_secs();
            tracing::warn!(%host, %tti, "{name} has not answered for {seconds} s; still waiting");
        }
    }

    /// Marks the hosts that have not answered for [`LOST_AFTER`] as lost; the caller measures the time.
    pub(super) fn mark_unresponsive_hosts_lost(&self) {
        let mut state = self.context.shared.lock();
        for host in state.barrier.missing_hosts() {
            let name = state.admission.host_name(host);
            tracing::warn!(%host, "{name} has not answered for {} s; it counts as lost", LOST_AFTER.as_secs());
            state.mark_lost(host);
        }
    }

    /// Checks whether the run can continue after host losses, and starts the removals or replays that it needs. Every
    /// wait of the run loop calls it at each check, under the lock.
    pub(super) fn handle_lost_hosts(&self, state: &mut ServerState) -> Result<(), BsError> {
        if let Some(why) = state.failure.take() {
            return Err(BsError::CannotContinue(why));
        }
        let lost: Vec<_> = state.lost_hosts.assignments().collect();
        let Some(&first_lost) = lost.first() else { return Ok(()) };
        let (tti, now) = (self.session.next_tti(), now());
        let settings = self.context.settings;
        match settings.on_loss {
            OnLoss::End => {
                let lost = state.describe_host(first_lost);
                return Err(BsError::HostLost { lost, tti });
            }
            // No host can return the ledgers of the lost devices, so an interrupted run takes its outcome from the
            // replay.
            OnLoss::Wait if self.context.progress.is_stop_requested() => {
                let lost = state.describe_host(first_lost);
                return Err(BsError::InterruptedAwaitingHost { lost, tti });
            }
            OnLoss::Wait => {
                if let Some(limit) = settings.loss_timeout
                    && let Some(overdue) = state.lost_hosts.find_lost_for(limit, now)
                {
                    let lost = state.describe_host(overdue);
                    return Err(BsError::LossTimeout { lost, tti, limit });
                }
            }
            OnLoss::Continue => {
                for assignment in lost {
                    let (host, first, last) = (assignment.host, assignment.first.0, assignment.last().0);
                    let name = state.admission.host_name(host);
                    tracing::warn!(%host, first, last, %tti, "lost {name}; the run continues without its devices");
                    // This closes the loss, so the next check does not find it again.
                    state.remove_host(assignment);
                }
                return Ok(());
            }
        }
        // `publish_progress` is not called while the run waits.
        self.publish_active_hosts(state);
        for (assignment, duration) in state.lost_hosts.take_due_warnings(now) {
            let (host, first, last) = (assignment.host, assignment.first.0, assignment.last().0);
            let name = state.admission.host_name(host);
            if let Some(duration) = duration {
                let seconds = duration.as_secs();
                let advice =
                    "start another `reveille device`, or end the run with Ctrl-C and continue it with --resume";
                tracing::warn!(%host, first, last, %tti, "still waiting for {name}, lost for {seconds} s; {advice}");
            } else {
                let status = "the run is waiting until a host runs its devices again";
                tracing::warn!(%host, first, last, %tti, "lost {name}; {status}");
            }
        }
        // A new host that takes over and never becomes ready would hold the clock for ever.
        for host in state.overdue_hosts() {
            state.mark_lost(host);
        }
        self.start_replays(state);
        Ok(())
    }

    /// Starts a replay for the devices of each lost host, unless one was requested before.
    fn start_replays(&self, state: &mut ServerState) {
        let Some(replay) = &self.context.replay else { return };
        let resume_point = self.session.resume_point();
        for assignment in state.lost_hosts.request_replays(resume_point.next) {
            let (replay, shared) = (Arc::clone(replay), Arc::clone(self.context.shared));
            // The replay may take as long as a run in memory, and this loop must still notice returns and commands.
            tokio::task::spawn_blocking(move || {
                let checkpoints = replay.device_checkpoints(resume_point.next, assignment.first, assignment.count);
                let mut state = shared.lock();
                match checkpoints {
                    Ok(devices) => {
                        let at = resume_point;
                        state
                            .lost_hosts
                            .set_checkpoint(assignment.host, HostCheckpoint { at, devices });
                    }
                    Err(why) => state.failure = Some(why),
                }
                // Unlock before the notification: the loop that it wakes takes this lock first.
                drop(state);
                shared.notify_run_loop();
            });
        }
    }
}
