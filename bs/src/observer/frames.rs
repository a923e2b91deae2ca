//! Encodes a run as frames: the messages on the air, and the ground truth that is never sent.
//!
//! The frames are byte-identical over the bus and in memory. Each message that the score counts on the air appears
//! once.

use reveille_common::ids::Tti;
use reveille_common::message::{
    BeliefUpdate, DeviceStates, EventUpdate, FailedReport, Frame, LostReport, Report, WakeOutcome, WakeUp,
    WakeUpResult, WorldUpdate,
};

use super::{Notification, Observer};

/// Encodes notifications as frames, in the order of their TTIs.
#[derive(Clone, Copy, Debug, Default)]
pub struct Frames {
    /// The first TTI of the last grant.
    first: Tti,
    /// The last TTI of the last grant.
    last: Tti,
    /// The next TTI to be granted.
    next: Tti,
}

impl Frames {
    /// Passes the frames of `happening` to `take`.
    pub fn encode(&mut self, happening: &Notification<'_>, mut take: impl FnMut(Frame)) {
        match *happening {
            Notification::Plan { update, .. } => take(Frame::of(update.from, (), update)),
            Notification::Granted(grant) => {
                (self.first, self.last, self.next) = (grant.first, grant.last, grant.last + 1);
                let world = WorldUpdate {
                    first: grant.first,
                    last: grant.last,
                    stimulus: grant.stimulus,
                    until: grant.until,
                };
                take(Frame::of(grant.first, (), &world));
            }
            Notification::EventStarted(event) => take(Frame::of(event.start, (), &EventUpdate::Started(*event))),
            Notification::Reported(report) => take(Frame::of(report.tti, report.device, report)),
            Notification::Lost(report) => take(Frame::of(report.tti, report.device, &LostReport { report: *report })),
            Notification::Failed { tti, failure } => {
                take(Frame::of(tti, failure.device, &FailedReport { failure: *failure }));
            }
            Notification::WakeUp { tti, device, sent } => take(Frame::of(tti, device, &WakeUp { tti: sent })),
            Notification::Woken { tti, device, outcome } => {
                // The report was on the air before its outcome was known, so its frame comes first.
                if let WakeOutcome::Reported(report) = outcome {
                    take(Frame::of::<Report>(tti, device, report));
                }
                take(Frame::of(tti, device, &WakeUpResult { outcome: *outcome }));
            }
            Notification::Believed { tti, places } => {
                let places = places.to_vec();
                take(Frame::of(tti, (), &BeliefUpdate { places }));
            }
            Notification::EventEnded(record) => take(Frame::of(record.last, (), &EventUpdate::Ended(*record))),
            Notification::Gone(outage) => take(Frame::of(outage.tti, (), outage)),
            Notification::Closed(_) => {}
            Notification::States(views) => {
                let states = DeviceStates { views: views.to_vec() };
                take(Frame::of(self.last, (), &states));
            }
        }
    }
}

/// An observer that encodes notifications as frames.
#[derive(Clone, Copy, Debug)]
pub struct FrameObserver<F> {
    frames: Frames,
    take: F,
    /// Interval between device states, TTIs; 0 for never.
    states_every: u64,
    /// First TTI at which states are due again.
    states_due: Tti,
}

impl<F: FnMut(Frame)> FrameObserver<F> {
    /// Creates an observer that passes frames to `take`. It also passes the device states at the end of a grant, every
    /// `states_every` TTIs or a little later if a grant is longer; 0 for never.
    pub fn new(states_every: u64, take: F) -> Self {
        Self {
            frames: Frames::default(),
            take,
            states_every,
            states_due: Tti::ZERO,
        }
    }
}

impl<F: FnMut(Frame)> Observer for FrameObserver<F> {
    fn notify(&mut self, happening: &Notification<'_>) {
        if matches!(happening, Notification::States(_)) {
            let is_own = self.states_every > 0 && self.frames.first >= self.states_due;
            if !is_own {
                // Another observer has requested these states.
                return;
            }
            self.states_due = self.frames.last + self.states_every;
        }
        self.frames.encode(happening, &mut self.take);
    }

    fn wants_states(&self) -> bool {
        self.states_every > 0 && self.frames.next >= self.states_due
    }

    fn wants_beliefs(&self) -> bool {
        true
    }
}
