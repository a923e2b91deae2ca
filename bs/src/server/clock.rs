//! The virtual clock, with its commands (pause, step, run to a TTI, resume) and its pace. It reads no time: `run_loop`
//! waits for due TTIs and records their [`Lateness`]. The clock changes no result of a run.

use std::time::{Duration, Instant};

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

/// Number of consecutive TTIs with growing delays before [`PaceWatch`] reports a pace. After a single long TTI the next
/// ones catch up.
const MIN_SLOW_TTIS: u64 = 20;
/// Smallest growth of the delay that [`PaceWatch`] reports. The largest step of a sequence does not count, since one
/// long TTI does not predict the others.
const MIN_REPORTED_GROWTH: Duration = Duration::from_millis(500);

/// Finds out whether TTIs take longer than the pace allows. Create a new one for each pace.
#[derive(Clone, Copy, Debug, Default)]
pub struct PaceWatch {
    slow_phase: Option<SlowPhase>,
    last_delay: Duration,
    has_reported: bool,
}

/// A sequence of TTIs with growing delays.
#[derive(Clone, Copy, Debug)]
struct SlowPhase {
    /// The first TTI.
    first: Tti,
    /// Time at which it began.
    start: Instant,
    /// Growth of the delay in the sequence.
    growth: Duration,
    /// The largest part of `growth` in one TTI.
    largest_step: Duration,
}

impl PaceWatch {
    /// Records that `tti` begins at `now`, `delay` after it was due. Returns the mean duration of the last TTIs if they
    /// are too slow for the pace. It does so at most once.
    pub fn record(&mut self, tti: Tti, delay: Duration, now: Instant) -> Option<Duration> {
        let step = delay.saturating_sub(self.last_delay);
        self.last_delay = delay;
        if step.is_zero() {
            self.slow_phase = None;
            return None;
        }
        let phase = self.slow_phase.get_or_insert(SlowPhase {
            first: tti,
            start: now,
            growth: Duration::ZERO,
            largest_step: Duration::ZERO,
        });
        phase.growth += step;
        phase.largest_step = phase.largest_step.max(step);
        let slow_ttis = tti - phase.first;
        let steady_growth = phase.growth.saturating_sub(phase.largest_step);
        if self.has_reported || slow_ttis < MIN_SLOW_TTIS || steady_growth < MIN_REPORTED_GROWTH {
            return None;
        }
        self.has_reported = true;
        Some(now.saturating_duration_since(phase.start) / u32::try_from(slow_ttis).unwrap_or(u32::MAX))
    }
}

#[cfg(test)]
#[expect(clippy::disallowed_methods, reason = "the tests need an instant")]
mod tests {
    use super::*;

    /// Begins a TTI whenever the one before is over and the pace of 10 ms allows it; TTI k takes `durations[k]` ms.
    /// Returns the TTI before which the pace was reported as too fast, and the mean duration in ms.
    fn watch(durations: &[u64]) -> Option<(usize, u128)> {
        let (mut watch, start) = (PaceWatch::default(), Instant::now());
        let mut time = 0;
        for (k, duration) in durations.iter().enumerate() {
            let due = 10 * k as u64;
            let begin = due.max(time);
            let delay = Duration::from_millis(begin - due);
            if let Some(mean) = watch.record(Tti(k as u64), delay, start + Duration::from_millis(begin)) {
                return Some((k, mean.as_millis()));
            }
            time = begin + duration;
        }
        None
    }

    #[test]
    fn a_pace_is_too_fast_only_if_ttis_fall_behind_one_after_another() {
        assert_eq!(watch(&[40; 100]), Some((21, 40)), "20 TTIs after the first late one");
        assert_eq!(
            watch(&[12; 1000]),
            Some((251, 12)),
            "500 ms behind, the largest step left out"
        );
        let mut frozen = vec![9; 3000];
        frozen[50] = 5000;
        assert_eq!(watch(&frozen), None, "after a long TTI the others catch up");
        let mut slow_for_a_while = [vec![11; 60], vec![9; 3000]].concat();
        slow_for_a_while[30] = 600;
        assert_eq!(
            watch(&slow_for_a_while),
            None,
            "one long TTI among some that are a little slow"
        );
    }

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
