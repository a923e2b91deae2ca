//! Events: when they start, where, and when they end (paper Sec. II).
//!
//! Event i starts a geometric gap after event i − 1 has ended. Its gap and its epicentre are drawn from streams of its
//! own, so the i-th event of a scenario has the same epicentre under every policy; its TTI depends on how long the events
//! before it lasted, which depends on who reported them.

use serde::{Deserialize, Serialize};

use crate::geometry::{Area, Point};
use crate::ids::{EventId, Tti};
use crate::rng::{Geometric, Purpose, Stream};
use crate::scenario::Scenario;

/// What the physical world shows the devices in a TTI: an event at its epicentre.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stimulus {
    /// The event.
    pub event: EventId,
    /// Where it is.
    pub epicentre: Point,
}

/// An event that has started and not yet ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActiveEvent {
    /// What it shows.
    pub stimulus: Stimulus,
    /// Its first TTI.
    pub start: Tti,
    /// Its last TTI if no report ends it earlier.
    pub last: Tti,
}

/// The event process: at most one event is active at a time.
#[derive(Clone, Debug)]
pub struct EventProcess {
    seed: u64,
    area: Area,
    gap: Geometric,
    duration: u64,
    next_event: EventId,
    next_start: Tti,
    active: Option<ActiveEvent>,
}

impl EventProcess {
    /// The process of `scenario`, before TTI 0.
    pub fn new(scenario: &Scenario) -> Self {
        let mut process = Self {
            seed: scenario.seed,
            area: scenario.area,
            gap: Geometric::new(scenario.events.alpha),
            duration: scenario.events.duration,
            next_event: EventId(0),
            next_start: Tti::ZERO,
            active: None,
        };
        process.schedule(Tti::ZERO);
        process
    }

    /// The TTI in which the next event starts. While one is active it is not yet known: [`Tti::NEVER`].
    pub const fn next_start(&self) -> Tti {
        if self.active.is_some() {
            Tti::NEVER
        } else {
            self.next_start
        }
    }

    /// Starts the event that is due at [`Self::next_start`].
    ///
    /// # Panics
    /// While an event is active.
    pub fn start(&mut self) -> ActiveEvent {
        assert!(self.active.is_none(), "one event at a time");
        let event = self.next_event;
        let mut stream = Stream::new(self.seed, Purpose::Epicentre, event.0);
        let epicentre = Point::new(stream.unit() * self.area.width, stream.unit() * self.area.height);
        let start = self.next_start;
        let last = start.saturating_add(self.duration - 1);
        self.next_event = EventId(event.0 + 1);
        *self.active.insert(ActiveEvent {
            stimulus: Stimulus { event, epicentre },
            start,
            last,
        })
    }

    /// Ends the active event; `last` is its last TTI. The next may start one TTI later.
    pub fn end(&mut self, last: Tti) {
        self.active = None;
        self.schedule(last + 1);
    }

    fn schedule(&mut self, earliest: Tti) {
        let gap = self
            .gap
            .draw(&mut Stream::new(self.seed, Purpose::EventGap, self.next_event.0));
        self.next_start = earliest.saturating_add(gap - 1);
    }
}
