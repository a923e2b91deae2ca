//! The virtual clock: pause, step, run to a TTI, resume; and the pace.

use std::time::Duration;

use reveille_common::ids::Tti;
use reveille_common::message::ClockCommand;

/// How fast TTIs follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// As fast as the hosts answer.
    Max,
    /// One TTI in this time; being late is counted, never made up for by stretching.
    RealTime(Duration),
}

/// Where the clock must stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VirtualClock {
    until: Tti,
    end: Tti,
}

impl VirtualClock {
    /// A clock that runs to `end`.
    pub const fn new(end: Tti) -> Self {
        Self { until: Tti::NEVER, end }
    }

    /// Obeys `command` while the next TTI to be granted is `next`. A TTI that is past, or after the end, is not run to.
    pub fn obey(&mut self, command: ClockCommand, next: Tti) {
        self.until = match command {
            ClockCommand::Pause => next,
            ClockCommand::Step(n) => next.saturating_add(n),
            ClockCommand::RunTo(k) if k >= next && k <= self.end => k,
            ClockCommand::RunTo(_) | ClockCommand::Status => self.until,
            ClockCommand::Resume => Tti::NEVER,
        };
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
        let mut clock = VirtualClock::new(Tti(100));
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
        assert_eq!(clock.until(), Tti::NEVER);
    }
}
