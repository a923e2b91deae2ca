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

/// Longest delay that later TTIs catch up, in TTIs of the pace. After a longer one, such as the wait for a lost host,
/// the schedule starts again.
const MAX_CAUGHT_UP_TTIS: u32 = 5;
/// Delays up to this length are always caught up: a busy machine can delay a process by about as much.
const MIN_OUTAGE: Duration = Duration::from_millis(250);

/// Due times of TTIs under a real-time pace.
#[derive(Clone, Copy, Debug, Default)]
pub struct Schedule {
    /// The last TTI, and the moment from which the next ones count.
    last: Option<(Tti, Instant)>,
}

impl Schedule {
    /// Returns the moment at which `tti` is due, with TTIs of length `tti_duration`. The first TTI is due `now`. After
    /// a short delay the next TTIs are due as if there had been none. After a long one they follow at the pace from
    /// `now` on, which is when this TTI begins.
    pub fn due(&mut self, tti: Tti, tti_duration: Duration, now: Instant) -> Instant {
        let due = self.last.map_or(now, |(last, moment)| {
            moment + tti_duration.saturating_mul((tti - last) as u32)
        });
        let delay = now.saturating_duration_since(due);
        let is_outage = delay > MIN_OUTAGE.max(tti_duration.saturating_mul(MAX_CAUGHT_UP_TTIS));
        self.last = Some((tti, if is_outage { now } else { due }));
        due
    }

    /// The delay that the next TTIs have to catch up, when the last one began at `begin`.
    pub fn backlog(&self, begin: Instant) -> Duration {
        self.last
            .map_or(Duration::ZERO, |(_, moment)| begin.saturating_duration_since(moment))
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
/// ones catch up or follow at the pace.
const MIN_SLOW_TTIS: u64 = 20;
/// Smallest growth of the delay that [`PaceWatch`] reports. The largest step of a sequence does not count, since one
/// long TTI does not predict the others.
const MIN_REPORTED_GROWTH: Duration = Duration::from_millis(500);

/// Finds out whether TTIs take longer than the pace allows. Create a new one for each pace.
#[derive(Clone, Copy, Debug, Default)]
pub struct PaceWatch {
    slow_phase: Option<SlowPhase>,
    last_backlog: Duration,
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
    /// Records that `tti` begins at `now`, `delay` after it was due; the next TTIs have to catch up `backlog` of it.
    /// Returns the mean duration of the last TTIs if they are too slow for the pace. It does so at most once.
    pub fn record(&mut self, tti: Tti, delay: Duration, backlog: Duration, now: Instant) -> Option<Duration> {
        let step = delay.saturating_sub(self.last_backlog);
        self.last_backlog = backlog;
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
    /// Returns the times in ms at which TTIs began, the TTI before which the pace was reported as too fast, and the
    /// mean duration in ms.
    fn play(durations: &[u64]) -> (Vec<u64>, Option<(usize, u128)>) {
        let (mut schedule, mut watch) = (Schedule::default(), PaceWatch::default());
        let start = Instant::now();
        let (mut now, mut begins, mut report) = (start, Vec::new(), None);
        for (k, duration) in durations.iter().enumerate() {
            let tti = Tti(k as u64);
            let due = schedule.due(tti, Duration::from_millis(10), now);
            let begin = due.max(now);
            let mean = watch.record(tti, begin - due, schedule.backlog(begin), begin);
            report = report.or(mean.map(|mean| (k, mean.as_millis())));
            begins.push((begin - start).as_millis() as u64);
            now = begin + Duration::from_millis(*duration);
        }
        (begins, report)
    }

    fn watch(durations: &[u64]) -> Option<(usize, u128)> {
        play(durations).1
    }

    #[test]
    fn a_run_keeps_its_pace_after_an_outage_and_catches_up_jitter() {
        let mut durations = vec![1; 100];
        (durations[10], durations[50]) = (240, 20_000);
        let (begins, _) = play(&durations);
        assert_eq!(begins[11..14], [340, 341, 342], "without a pause after a short delay");
        assert_eq!(begins[49], 490, "on schedule again");
        let resumed = begins[51];
        assert_eq!(resumed, 20_500);
        let expected: Vec<u64> = (0..49).map(|k| resumed + 10 * k).collect();
        assert_eq!(begins[51..], expected, "at the pace after the outage");
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
        assert_eq!(watch(&frozen), None, "after a long TTI the others are on time");
        assert_eq!(watch(&[300; 100]), Some((21, 300)), "each TTI is as long as an outage");
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
