//! Encodes a run as frames: the messages on the air, and the ground truth that is never sent.
//!
//! The frames are byte-identical over the bus and in memory, since an audit compares the frames of a run with its
//! replay. Each message that the score counts on the air appears once. Recordings and the tap of the bus carry them;
//! `view/` reconstructs states, metrics and digest from the frames and their order.

use reveille_common::ids::Tti;
use reveille_common::message::{
    BeliefUpdate, DeviceStates, EventUpdate, FailedReport, Frame, LostReport, Report, WakeOutcome, WakeUp,
    WakeUpResult, WorldUpdate,
};

use super::{Notification, Observer};

/// Encodes notifications as frames. It keeps the order of notifications and remembers the last grant.
#[derive(Clone, Copy, Debug, Default)]
pub struct FrameEncoder {
    /// The last TTI of the last grant.
    grant_last: Tti,
}

impl FrameEncoder {
    /// Passes the frames of `notification` to `emit`.
    pub fn encode(&mut self, notification: &Notification<'_>, mut emit: impl FnMut(Frame)) {
        match *notification {
            Notification::PlanSent { update, .. } => emit(Frame::new(update.from, (), update)),
            Notification::TtisGranted(grant) => {
                self.grant_last = grant.last;
                let world = WorldUpdate {
                    first: grant.first,
                    last: grant.last,
                    stimulus: grant.stimulus,
                    stimulus_last: grant.event_last_tti,
                };
                emit(Frame::new(grant.first, (), &world));
            }
            Notification::EventStarted(event) => emit(Frame::new(event.start, (), &EventUpdate::Started(*event))),
            Notification::ReportReceived(report) => emit(Frame::new(report.tti, report.device, report)),
            Notification::ReportLost(report) => {
                emit(Frame::new(report.tti, report.device, &LostReport { report: *report }));
            }
            Notification::ReportFailed { tti, failure } => {
                emit(Frame::new(tti, failure.device, &FailedReport { failure: *failure }));
            }
            Notification::WakeUpSent { tti, device, sent } => emit(Frame::new(tti, device, &WakeUp { tti: sent })),
            Notification::WakeUpCompleted { tti, device, outcome } => {
                // The report was on the air before its outcome was known, so its frame comes first.
                if let WakeOutcome::Reported(report) = outcome {
                    emit(Frame::new::<Report>(tti, device, report));
                }
                emit(Frame::new(tti, device, &WakeUpResult { outcome: *outcome }));
            }
            Notification::BeliefUpdated { tti, places } => {
                let places = places.to_vec();
                emit(Frame::new(tti, (), &BeliefUpdate { places }));
            }
            Notification::EventEnded(record) => emit(Frame::new(record.last, (), &EventUpdate::Ended(*record))),
            Notification::DevicesRemoved(removal) => emit(Frame::new(removal.tti, (), removal)),
            Notification::ActionTaken(action) => emit(Frame::new(action.tti, (), action)),
            Notification::TtiClosed(_) => {}
            Notification::DeviceStates(views) => {
                let states = DeviceStates { views: views.to_vec() };
                emit(Frame::new(self.grant_last, (), &states));
            }
        }
    }
}

/// An observer that encodes notifications as frames.
#[derive(Clone, Copy, Debug)]
pub struct FrameObserver<F> {
    encoder: FrameEncoder,
    emit: F,
    /// Interval between device states, TTIs; 0 for never.
    state_interval: u64,
    /// First TTI at which states are due again.
    states_due: Tti,
}

impl<F: FnMut(Frame)> FrameObserver<F> {
    /// Creates an observer that passes frames to `emit`, also the device states at the end of TTI 0 and of every
    /// `state_interval` TTIs after it; 0 for never.
    pub fn new(state_interval: u64, emit: F) -> Self {
        Self {
            encoder: FrameEncoder::default(),
            emit,
            state_interval,
            states_due: Tti::ZERO,
        }
    }
}

impl<F: FnMut(Frame)> Observer for FrameObserver<F> {
    fn notify(&mut self, notification: &Notification<'_>) {
        if matches!(notification, Notification::DeviceStates(_)) {
            let last = self.encoder.grant_last;
            if last < self.states_due() {
                // Another observer has requested these states.
                return;
            }
            self.states_due = Tti((last.0 / self.state_interval + 1) * self.state_interval);
        }
        self.encoder.encode(notification, &mut self.emit);
    }

    fn states_due(&self) -> Tti {
        if self.state_interval == 0 {
            Tti::NEVER
        } else {
            self.states_due
        }
    }

    fn wants_beliefs(&self) -> bool {
        true
    }
}
