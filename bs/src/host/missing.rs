//! Hosts that are lost, or say nothing: what becomes of the run.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use reveille_common::message::Resumption;

use super::drive::OnLoss;
use super::error::BsError;
use super::losses::Point;
use super::running::{Loop, MUTE, SILENT};
use super::shared::BsState;

impl Loop<'_> {
    /// Says whom the run waits for.
    pub(super) fn name_silent(&self) {
        let state = self.crew.shared.lock();
        for host in state.barrier.waiting() {
            let (tti, name) = (self.cycle.next_tti(), state.admission.name(host));
            tracing::warn!(%host, %tti, "waiting for the answer of {name} for {} s now", SILENT.as_secs());
        }
    }

    /// Hosts that have not answered for long do not carry their devices any more.
    pub(super) fn give_up_silent(&self) {
        let mut state = self.crew.shared.lock();
        for host in state.barrier.waiting() {
            let name = state.admission.name(host);
            tracing::warn!(%host, "{name} has not answered for {} s: it counts as lost", MUTE.as_secs());
            state.lose(host);
        }
    }

    /// Whether the run can go on, with those who are lost and without; what is needed for that is begun.
    pub(super) fn check(&self, state: &mut BsState) -> Result<(), BsError> {
        if let Some(why) = state.failure.take() {
            return Err(BsError::CannotGoOn(why));
        }
        let lost: Vec<_> = state.losses.places().collect();
        let Some(places) = lost.first() else { return Ok(()) };
        let (tti, host, first, last) = (self.cycle.next_tti(), places.host, places.first.0, places.last().0);
        match self.crew.settings.on_loss {
            OnLoss::End => return Err(BsError::HostLost { host, first, last, tti }),
            OnLoss::Wait if self.crew.progress.stop.load(Ordering::Relaxed) => {
                return Err(BsError::InterruptedWaiting { host, first, last, tti });
            }
            OnLoss::Wait => {}
            OnLoss::Continue => {
                for places in lost {
                    let (host, first, last) = (places.host, places.first.0, places.last().0);
                    let name = state.admission.name(host);
                    tracing::warn!(%host, first, last, %tti, "lost {name}; the run goes on without its devices");
                    state.go_on_without(places);
                }
                return Ok(());
            }
        }
        for places in lost {
            if state.reported.insert(places.host) {
                let (host, first, last) = (places.host, places.first.0, places.last().0);
                let name = state.admission.name(host);
                let held = "the clock is held until its devices are carried again";
                tracing::warn!(%host, first, last, %tti, "lost {name}; {held}");
            }
        }
        for host in state.late() {
            state.lose(host);
        }
        self.restore(state);
        Ok(())
    }

    /// Has a replay find the devices of lost hosts, where none was asked for them yet.
    fn restore(&self, state: &mut BsState) {
        let Some(replay) = &self.crew.replay else { return };
        let Point { next, plan } = self.point;
        for places in state.losses.unasked(next) {
            let (replay, shared) = (Arc::clone(replay), Arc::clone(self.crew.shared));
            tokio::task::spawn_blocking(move || {
                let found = replay.devices(next, places.first, places.count);
                let mut state = shared.lock();
                match found {
                    Ok(devices) => state.losses.found(places.host, Resumption { next, plan, devices }),
                    Err(why) => state.failure = Some(why),
                }
                drop(state);
                shared.ring();
            });
        }
    }
}
