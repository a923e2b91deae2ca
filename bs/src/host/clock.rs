//! The virtual clock: pause, step, run to a TTI, resume; and the pace.

use std::time::Duration;

use reveille_common::ids::Tti;
use reveille_common::message::{ClockCommand, Pace};

/// The longest time from one TTI to the next, microseconds: a day.
const SLOWEST: u64 = 86_400_000_000;

/// Where the clock must stop, and how fast it goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VirtualClock {
    until: Tti,
    end: Tti,
    pace: Pace,
}

impl VirtualClock {
    /// A clock that runs to `end` at `pace`.
    pub const fn new(end: Tti, pace: Pace) -> Self {
        Self {
            until: Tti::NEVER,
            end,
            pace,
        }
    }

    /// Obeys `command` while the next TTI to be granted is `next`. A TTI that is past, or after the end, is not run to;
    /// a pace of more than a day to a TTI is a day.
    pub fn obey(&mut self, command: ClockCommand, next: Tti) {
        match command {
            ClockCommand::Pause => self.until = next,
            ClockCommand::Step(n) => self.until = next.saturating_add(n),
            ClockCommand::RunTo(k) if k >= next && k <= self.end => self.until = k,
            ClockCommand::Resume => self.until = Tti::NEVER,
            ClockCommand::Pace(Pace::RealTime(micros)) => self.pace = Pace::RealTime(micros.min(SLOWEST)),
            ClockCommand::Pace(Pace::Max) => self.pace = Pace::Max,
            ClockCommand::RunTo(_) | ClockCommand::Status => {}
        }
    }

    /// How fast TTIs follow each other.
    pub const fn pace(&self) -> Pace {
        self.pace
    }

    /// The TTI that must not be granted yet.
    pub const fn until(&self) -> Tti {
        self.until
    }

    /// The TTI before which the run ends.
    pub const fn end(&self) -> Tti {
        self.end
    }
}

/// How well a real-time pace was kept.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lateness {
    /// TTIs that began later than they were due.
    pub late: u64,
    /// The largest delay.
    pub max: Duration,
    /// The sum of delays.
    pub total: Duration,
}

impl Lateness {
    /// A TTI began `by` after it was due.
    pub fn count(&mut self, by: Duration) {
        self.late += 1;
        self.max = self.max.max(by);
        self.total += by;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_move_the_stop() {
        let mut clock = VirtualClock::new(Tti(100), Pace::Max);
        assert_eq!((clock.until(), clock.end()), (Tti::NEVER, Tti(100)));
        clock.obey(ClockCommand::Pause, Tti(7));
        assert_eq!(clock.until(), Tti(7));
        clock.obey(ClockCommand::Step(3), Tti(7));
        assert_eq!(clock.until(), Tti(10));
        clock.obey(ClockCommand::RunTo(Tti(50)), Tti(10));
        clock.obey(ClockCommand::Status, Tti(20));
        assert_eq!(clock.until(), Tti(50));
        for outside in [Tti(19), Tti(101)] {
            clock.obey(ClockCommand::RunTo(outside), Tti(20));
            assert_eq!(clock.until(), Tti(50), "{outside}");
        }
        clock.obey(ClockCommand::Resume, Tti(50));
        assert_eq!((clock.until(), clock.pace()), (Tti::NEVER, Pace::Max));
        for (micros, kept) in [(2, 2), (u64::MAX, SLOWEST)] {
            clock.obey(ClockCommand::Pace(Pace::RealTime(micros)), Tti(50));
            assert_eq!(clock.pace(), Pace::RealTime(kept));
        }
        assert_eq!(clock.until(), Tti::NEVER);
    }
}
