//! Events: their starts, epicentres and ends (paper Sec. II). [`crate::world`] drives the [`EventProcess`].
//!
//! Event i starts some TTIs after event i − 1 has ended. Its gap, epicentre and duration have their own random streams.
//! So the i-th event of a scenario has the same epicentre under every policy. Its TTI depends on the durations of
//! earlier events, and so on the devices that reported them. Digests depend on every draw, and
//! `tests/src/reference/events.rs` computes the same. [`Stimulus`] and [`ActiveEvent`] are part of the wire format.

mod aftershocks;
mod bursts;
mod duration;
pub mod event_settings;
mod hot_spots;
mod process;
mod record;
mod uniform;

use std::fmt;

use serde::{Deserialize, Serialize};

pub use self::aftershocks::Aftershocks;
pub use self::bursts::EventBursts;
pub use self::duration::DurationKind;
pub use self::hot_spots::HotSpots;
pub use self::process::{ProcessKind, ProcessSettings};
pub use self::record::EventRecord;

use self::event_settings::EventSettings;
use self::process::{Epicentres, Starts};
use crate::geometry::{Area, Point};
use crate::ids::{EventId, Tti};

/// The signal that devices can sense in a TTI: an event at its epicentre.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stimulus {
    /// The event.
    pub event: EventId,
    /// Its epicentre.
    pub epicentre: Point,
}

impl fmt::Display for Stimulus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { event, epicentre } = self;
        write!(f, "event {} at ({:.2}, {:.2}) m", event.0, epicentre.x, epicentre.y)
    }
}

/// An event that has started and not yet ended.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ActiveEvent {
    /// The signal that devices can sense.
    pub stimulus: Stimulus,
    /// Its first TTI.
    pub start: Tti,
    /// Its last TTI if no report ends it earlier.
    pub last: Tti,
}

/// An event with a given start, for tests.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScriptedEvent {
    /// Its first TTI, after the last TTI of the previous event.
    pub start: Tti,
    /// Duration in TTIs unless a report ends it, ≥ 1.
    pub duration: u64,
    /// Its epicentre.
    pub epicentre: Point,
}

/// The origin of starts, epicentres and durations.
#[derive(Clone, Debug)]
enum EventSource {
    Drawn(Box<RandomEvents>),
    Script(Vec<ScriptedEvent>),
}

#[derive(Clone, Debug)]
struct RandomEvents {
    seed: u64,
    settings: EventSettings,
    starts: Starts,
    epicentres: Epicentres,
}

impl RandomEvents {
    /// Draws the epicentre and the duration in TTIs of `event`, which starts now.
    fn draw_event(&mut self, event: EventId) -> (Point, u64) {
        let EventSettings {
            duration,
            duration_kind,
            ..
        } = self.settings;
        (
            self.epicentres.draw(event),
            duration_kind.draw(duration, self.seed, event),
        )
    }
}

/// The event process: at most one event is active at a time.
#[derive(Clone, Debug)]
pub struct EventProcess {
    source: EventSource,
    next_event: EventId,
    next_start: Tti,
    /// The first TTI in which the next event can start.
    gap_start: Tti,
    active: Option<ActiveEvent>,
}

impl EventProcess {
    /// Creates the process of a scenario with `settings`, `seed` and `area`, before TTI 0, for a run of the TTIs before
    /// `end`. Events that would start later may be left out.
    pub fn new(seed: u64, area: Area, settings: &EventSettings, end: Tti) -> Self {
        Self::from_source(EventSource::Drawn(Box::new(RandomEvents {
            seed,
            settings: *settings,
            starts: settings.process.starts(seed, settings.alpha, end),
            epicentres: settings.process.epicentres(seed, area),
        })))
    }

    /// Creates a process of the given events, in order. Reports end them early, but do not move their starts.
    pub fn scripted(events: Vec<ScriptedEvent>) -> Self {
        Self::from_source(EventSource::Script(events))
    }

    fn from_source(source: EventSource) -> Self {
        let mut process = Self {
            source,
            next_event: EventId(0),
            next_start: Tti::ZERO,
            gap_start: Tti::ZERO,
            active: None,
        };
        process.schedule_next(Tti::ZERO);
        process
    }

    /// The TTI in which the next event starts; [`Tti::NEVER`] while an event is active, since it is not yet known.
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
    /// While an event is active, or if no scripted event is left.
    pub fn start(&mut self) -> ActiveEvent {
        assert!(self.active.is_none(), "one event at a time");
        let event = self.next_event;
        let (epicentre, duration) = match &mut self.source {
            EventSource::Drawn(drawn) => drawn.draw_event(event),
            EventSource::Script(events) => {
                // In range: after the last scripted event `next_start` is NEVER, and no event is due.
                let ScriptedEvent {
                    epicentre, duration, ..
                } = events[event.0 as usize];
                (epicentre, duration)
            }
        };
        let start = self.next_start;
        self.next_event = EventId(event.0 + 1);
        *self.active.insert(ActiveEvent {
            stimulus: Stimulus { event, epicentre },
            start,
            // Every duration is at least 1.
            last: start.saturating_add(duration - 1),
        })
    }

    /// Ends the active event; `last` is its last TTI. The next may start one TTI later. Call it after [`Self::start`],
    /// and with [`ActiveEvent::last`] if no report ends the event earlier: the process does not check this.
    pub fn end(&mut self, last: Tti) {
        self.active = None;
        self.schedule_next(last + 1);
    }

    /// Changes α from TTI `from` on, before any event of that TTI has started. Scripted events stay as they are. The
    /// process must have a constant α (`bs/src/actions.rs` refuses others): the next start is drawn again.
    ///
    /// # Panics
    /// If `alpha` is not a probability.
    pub fn set_alpha(&mut self, from: Tti, alpha: f64) {
        if let EventSource::Drawn(drawn) = &mut self.source {
            drawn.starts.set_alpha(from, alpha);
        }
        if self.active.is_none() {
            self.schedule_next(self.gap_start);
        }
    }

    /// Determines the start of the next event, in or after TTI `earliest`.
    fn schedule_next(&mut self, earliest: Tti) {
        self.gap_start = earliest;
        let next = self.next_event;
        self.next_start = match &mut self.source {
            // The gap has a stream keyed by the event, so its draw does not depend on the end of the previous event.
            EventSource::Drawn(drawn) => drawn.starts.draw_start(next, earliest),
            EventSource::Script(events) => events.get(next.0 as usize).map_or(Tti::NEVER, |event| event.start),
        };
    }
}
