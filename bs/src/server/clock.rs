//! The virtual clock, with its commands (pause, step, run to a TTI, resume) and its pace. It reads no time: `run_loop`
//! waits for due TTIs and records their [`Lateness`]. The clock changes no result of a run.

use std::time::Duration;

use reveille_common::ids::Tti;
use reveille_common::message::{ClockCommand, Pace};

/// Longest time between two TTIs, in microseconds: one day.
const MAX_MICROS_PER_TTI: u64 = 86_400_000_000;

/// The virtual clock: the TTI at which it must stop, and its pace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VirtualClock {
    /// The first TTI that must not be granted yet; [`Tti::NEVER`] while no command stops the clock.
    until: Tti,
    /// The TTI before which the run ends.
    end: Tti,
    pace: Pace,
}

impl VirtualClock {
    /// Creates a clock that runs to `end` at `pace`. The caller bounds the pace: an `Instant` must hold every due time.
    pub const fn new(end: Tti, pace: Pace) -> Self {
        Self {
            until: Tti::NEVER,
            end,
            pace,
        }
    }

    /// Applies `command`, with `next` as the next TTI to grant, at which a pause or step begins. A `RunTo` with a past
    /// TTI, or one after the end, has no effect. A pace slower than one day per TTI becomes one day per TTI.
    pub fn apply(&mut self, command: ClockCommand, next: Tti) {
        match command {
            ClockCommand::Pause => self.until = next,
            // A step before the previous one has ended extends it. The number comes from an operator and may be any
            // `u64`.
            ClockCommand::Step(n) => {
                let stop = if self.until == Tti::NEVER {
                    next
                } else {
                    self.until.max(next)
                };
                self.until = stop.saturating_add(n);
            }
            ClockCommand::RunTo(k) if k >= next && k <= self.end => self.until = k,
            ClockCommand::Resume => self.until = Tti::NEVER,
            // An operator may send any `u64`; an unbounded pace could overflow the `Instant` at which a TTI is due.
            ClockCommand::Pace(Pace::RealTime(micros)) => self.pace = Pace::RealTime(micros.min(MAX_MICROS_PER_TTI)),
            ClockCommand::Pace(Pace::Max) => self.pace = Pace::Max,
            ClockCommand::RunTo(_) | ClockCommand::Status => {}
        }
    }

    /// The pace at which TTIs follow each other.
    pub const fn pace(&self) -> Pace {
        self.pace
    }

    /// The first TTI that must not be granted yet.
    pub const fn until(&self) -> Tti {
        self.until
    }

    /// The TTI before which the run ends.
    pub const fn end(&self) -> Tti {
        self.end
    }
}

/// Delays of TTIs under a real-time pace.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lateness {
    /// TTIs that began later than they were due.
    pub late_ttis: u64,
    /// The largest delay.
    pub max_delay: Duration,
    /// The sum of delays.
    pub total_delay: Duration,
}

impl Lateness {
    /// Counts a TTI that began `delay` after it was due.
    pub fn record_delay(&mut self, delay: Duration) {
        self.late_ttis += 1;
        self.max_delay = self.max_delay.max(delay);
        self.total_delay += delay;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_set_the_stop_and_the_pace() {
        let mut clock = VirtualClock::new(Tti(100), Pace::Max);
        assert_eq!((clock.until(), clock.end()), (Tti::NEVER, Tti(100)));
        clock.apply(ClockCommand::Pause, Tti(7));
        assert_eq!(clock.until(), Tti(7));
        clock.apply(ClockCommand::Step(3), Tti(7));
        assert_eq!(clock.until(), Tti(10));
        clock.apply(ClockCommand::Step(5), Tti(9));
        assert_eq!(clock.until(), Tti(15), "a second step adds to the first");
        clock.apply(ClockCommand::RunTo(Tti(50)), Tti(10));
        clock.apply(ClockCommand::Status, Tti(20));
        assert_eq!(clock.until(), Tti(50));
        for outside in [Tti(19), Tti(101)] {
            clock.apply(ClockCommand::RunTo(outside), Tti(20));
            assert_eq!(clock.until(), Tti(50), "run to {outside}");
        }
        clock.apply(ClockCommand::Resume, Tti(50));
        assert_eq!((clock.until(), clock.pace()), (Tti::NEVER, Pace::Max));
        for (micros, kept) in [(2, 2), (u64::MAX, MAX_MICROS_PER_TTI)] {
            clock.apply(ClockCommand::Pace(Pace::RealTime(micros)), Tti(50));
            assert_eq!(clock.pace(), Pace::RealTime(kept));
        }
        assert_eq!(clock.until(), Tti::NEVER);
    }
}
