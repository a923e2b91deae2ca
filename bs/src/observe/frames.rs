//! What happens in a run as messages: those on the air, and the truth that nobody sends.
//!
//! Over the bus and in memory these are the same, byte for byte: what the score counts on the air, once each.

use reveille_common::ids::Tti;
use reveille_common::message::{
    Belief, EventNews, FailedReport, Frame, LostReport, Report, States, WakeOutcome, WakeUp, Woken, World,
};

use super::{Happening, Observer};

/// Makes frames of what happens. TTIs rise from frame to frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct Frames {
    /// The first TTI of the last grant.
    first: Tti,
    /// The last TTI of the last grant.
    last: Tti,
    /// The TTI that is granted next.
    next: Tti,
}

impl Frames {
    /// Hands to `take` what `happening` is in messages.
    pub fn of(&mut self, happening: &Happening<'_>, mut take: impl FnMut(Frame)) {
        match *happening {
            Happening::Plan { update, .. } => take(Frame::of(update.from, (), update)),
            Happening::Granted(grant) => {
                (self.first, self.last, self.next) = (grant.first, grant.last, grant.last + 1);
                let world = World {
                    first: grant.first,
                    last: grant.last,
                    stimulus: grant.stimulus,
                    until: grant.until,
                };
                take(Frame::of(grant.first, (), &world));
            }
            Happening::EventStarted(event) => take(Frame::of(event.start, (), &EventNews::Started(*event))),
            Happening::Reported(report) => take(Frame::of(report.tti, report.device, report)),
            Happening::Lost(report) => take(Frame::of(report.tti, report.device, &LostReport { report: *report })),
            Happening::Failed { tti, failure } => {
                take(Frame::of(tti, failure.device, &FailedReport { failure: *failure }));
            }
            Happening::WakeUp { tti, device, sent } => take(Frame::of(tti, device, &WakeUp { tti: sent })),
            Happening::Woken { tti, device, outcome } => {
                if let WakeOutcome::Reported(report) = outcome {
                    take(Frame::of::<Report>(tti, device, report));
                }
                take(Frame::of(tti, device, &Woken { outcome: *outcome }));
            }
            Happening::Believed { tti, places } => {
                let places = places.to_vec();
                take(Frame::of(tti, (), &Belief { places }));
            }
            Happening::EventEnded(record) => take(Frame::of(record.last, (), &EventNews::Ended(*record))),
            Happening::Gone(outage) => take(Frame::of(outage.tti, (), outage)),
            Happening::Closed(_) => {}
            Happening::States(views) => {
                let states = States { views: views.to_vec() };
                take(Frame::of(self.last, (), &states));
            }
        }
    }
}

/// An observer that hands on what it sees as frames.
#[derive(Clone, Copy, Debug)]
pub struct Framed<F> {
    frames: Frames,
    take: F,
    /// The TTIs between two that the states of the devices are wanted of; 0 for never.
    states_every: u64,
    /// The TTI from which on they are wanted next.
    states_due: Tti,
}

impl<F: FnMut(Frame)> Framed<F> {
    /// Hands frames to `take`, with the states of the devices at the end of the grants that begin `states_every` TTIs
    /// after one another, or a little later where a grant is longer; 0 for none.
    pub fn new(states_every: u64, take: F) -> Self {
        Self {
            frames: Frames::default(),
            take,
            states_every,
            states_due: Tti::ZERO,
        }
    }
}

impl<F: FnMut(Frame)> Observer for Framed<F> {
    fn see(&mut self, happening: &Happening<'_>) {
        if matches!(happening, Happening::States(_)) {
            let is_own = self.states_every > 0 && self.frames.first >= self.states_due;
            if !is_own {
                // Another observer has asked for them.
                return;
            }
            self.states_due = self.frames.last + self.states_every;
        }
        self.frames.of(happening, &mut self.take);
    }

    fn wants_states(&self) -> bool {
        self.states_every > 0 && self.frames.next >= self.states_due
    }

    fn wants_beliefs(&self) -> bool {
        true
    }
}
