//! Detection of unresponsive and lost hosts, and the reaction of the run.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use reveille_common::message::HostCheckpoint;

use super::config::OnLoss;
use super::error::BsError;
use super::run_loop::{MUTE, RunLoop, SILENT};
use super::state::ServerState;

impl RunLoop<'_> {
    /// Logs a warning for each unresponsive host.
    pub(super) fn report_silent_hosts(&self) {
        let state = self.crew.shared.lock();
        for host in state.barrier.missing_hosts() {
            let (tti, name) = (self.session.next_tti(), state.admission.name(host));
            tracing::warn!(%host, %tti, "{name} has not answered for {} s; still waiting", SILENT.as_secs());
        }
    }

    /// Marks hosts as lost that have not answered for 30 s.
    pub(super) fn time_out_silent_hosts(&self) {
        let mut state = self.crew.shared.lock();
        for host in state.barrier.missing_hosts() {
            let name = state.admission.name(host);
            tracing::warn!(%host, "{name} has not answered for {} s; it counts as lost", MUTE.as_secs());
            state.mark_lost(host);
        }
    }

    /// Checks whether the run can continue after host losses, and starts the removals or replays that it needs.
    pub(super) fn check_hosts(&self, state: &mut ServerState) -> Result<(), BsError> {
        if let Some(why) = state.failure.take() {
            return Err(BsError::CannotContinue(why));
        }
        let lost: Vec<_> = state.losses.assignments().collect();
        let Some(places) = lost.first() else { return Ok(()) };
        let (tti, host, first, last) = (self.session.next_tti(), places.host, places.first.0, places.last().0);
        match self.crew.settings.on_loss {
            OnLoss::End => return Err(BsError::HostLost { host, first, last, tti }),
            // No host can return the ledgers of the lost devices, so an interrupted run takes its outcome from the
            // replay.
            OnLoss::Wait if self.crew.progress.stop.load(Ordering::Relaxed) => {
                return Err(BsError::InterruptedAwaitingHost { host, first, last, tti });
            }
            OnLoss::Wait => {}
            OnLoss::Continue => {
                for places in lost {
                    let (host, first, last) = (places.host, places.first.0, places.last().0);
                    let name = state.admission.name(host);
                    tracing::warn!(%host, first, last, %tti, "lost {name}; the run continues without its devices");
                    // This closes the loss, so the next check does not find it again.
                    state.remove_host(places);
                }
                return Ok(());
            }
        }
        for places in lost {
            // The check runs many times a second while the run is waiting; each loss is reported once.
            if state.reported.insert(places.host) {
                let (host, first, last) = (places.host, places.first.0, places.last().0);
                let name = state.admission.name(host);
                let held = "the run is waiting until a host runs its devices again";
                tracing::warn!(%host, first, last, %tti, "lost {name}; {held}");
            }
        }
        // A new host that takes over and never becomes ready would hold the clock for ever.
        for host in state.overdue_hosts() {
            state.mark_lost(host);
        }
        self.restore(state);
        Ok(())
    }

    /// Starts a replay for the devices of each lost host, unless one was requested before.
    fn restore(&self, state: &mut ServerState) {
        let Some(replay) = &self.crew.replay else { return };
        let at = self.session.resume_point();
        for places in state.losses.needing_replay(at.next) {
            let (replay, shared) = (Arc::clone(replay), Arc::clone(self.crew.shared));
            // The replay may take as long as a run in memory, and this loop must still notice returns and commands.
            tokio::task::spawn_blocking(move || {
                let found = replay.devices(at.next, places.first, places.count);
                let mut state = shared.lock();
                match found {
                    Ok(devices) => state.losses.set_checkpoint(places.host, HostCheckpoint { at, devices }),
                    Err(why) => state.failure = Some(why),
                }
                // Unlock before the notification: the loop that it wakes takes this lock first.
                drop(state);
                shared.notify();
            });
        }
    }
}
