//! The limit on device processes that start at the same time, for `supervisor`. `docs/command-line.md` states it.
//!
//! A starting process needs milliseconds of a core until its devices run. A thousand processes started together would
//! delay each other beyond the timeouts of links and base station, so each waits before it starts.

use std::num::NonZero;

/// Processes per core that may be starting at the same time: started, and not yet running their devices.
const STARTS_PER_CORE: usize = 16;

/// Limits the number of starting processes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StartLimiter {
    max_starting: usize,
}

impl StartLimiter {
    /// Creates the limit for this machine.
    pub(crate) fn new() -> Self {
        Self::for_cores(std::thread::available_parallelism().map_or(1, NonZero::get))
    }

    const fn for_cores(cores: usize) -> Self {
        Self {
            max_starting: STARTS_PER_CORE * cores,
        }
    }

    /// The number of `waiting` processes that may start now, if `living` have been started and `joined` of them already
    /// run their devices.
    pub(crate) fn allowed_starts(self, waiting: usize, living: usize, joined: usize) -> usize {
        // Two threads count these, so `joined` can exceed `living` for a moment.
        let starting = living.saturating_sub(joined);
        self.max_starting.saturating_sub(starting).min(waiting)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn starts_are_limited_by_the_processes_that_have_not_joined() {
        let limiter = StartLimiter::for_cores(2);
        assert_eq!(limiter.allowed_starts(1000, 0, 0), 32);
        assert_eq!(limiter.allowed_starts(968, 32, 0), 0);
        assert_eq!(limiter.allowed_starts(968, 32, 5), 5);
        assert_eq!(limiter.allowed_starts(3, 40, 40), 3);
        assert_eq!(limiter.allowed_starts(0, 40, 40), 0);
        assert_eq!(
            limiter.allowed_starts(7, 30, 33),
            7,
            "more joined than living: ended processes are still counted as joined"
        );
    }

    #[test]
    fn all_processes_start_if_they_join_one_by_one() {
        let limiter = StartLimiter::for_cores(1);
        let (mut waiting, mut living, mut joined, mut most_starting) = (1000, 0, 0, 0);
        while joined < 1000 {
            let allowed = limiter.allowed_starts(waiting, living, joined);
            (waiting, living) = (waiting - allowed, living + allowed);
            most_starting = most_starting.max(living - joined);
            joined += 1;
        }
        assert_eq!((waiting, living, most_starting), (0, 1000, STARTS_PER_CORE));
    }
}
