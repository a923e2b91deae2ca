//! The limit on device processes that start at the same time.
//!
//! A starting process needs milliseconds of a core until its devices run. A thousand processes started together would
//! delay each other beyond the timeouts of links and base station, so each waits before it starts.

use std::num::NonZero;

/// Starting processes per core.
const EACH: usize = 16;

/// Limits the number of starting processes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StartLimiter {
    at_once: usize,
}

impl StartLimiter {
    /// Creates the limit for this machine.
    pub(crate) fn new() -> Self {
        Self::for_cores(std::thread::available_parallelism().map_or(1, NonZero::get))
    }

    const fn for_cores(cores: usize) -> Self {
        Self { at_once: EACH * cores }
    }

    /// The number of `waiting` processes that may start now, if `living` have been started and `there` of them already
    /// run their devices.
    pub(crate) fn allowed_starts(self, waiting: usize, living: usize, there: usize) -> usize {
        // Two threads count these, so `there` can exceed `living` for a moment.
        let on_their_way = living.saturating_sub(there);
        self.at_once.saturating_sub(on_their_way).min(waiting)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_more_starts_than_the_machine_can_take() {
        let muster = StartLimiter::for_cores(2);
        assert_eq!(muster.allowed_starts(1000, 0, 0), 32);
        assert_eq!(muster.allowed_starts(968, 32, 0), 0);
        assert_eq!(muster.allowed_starts(968, 32, 5), 5);
        assert_eq!(muster.allowed_starts(3, 40, 40), 3);
        assert_eq!(muster.allowed_starts(0, 40, 40), 0);
        assert_eq!(
            muster.allowed_starts(7, 30, 33),
            7,
            "ended processes can still be counted"
        );
    }

    #[test]
    fn all_processes_start_even_if_slow() {
        let muster = StartLimiter::for_cores(1);
        let (mut waiting, mut living, mut there, mut most) = (1000, 0, 0, 0);
        while there < 1000 {
            let now = muster.allowed_starts(waiting, living, there);
            (waiting, living) = (waiting - now, living + now);
            most = most.max(living - there);
            there += 1;
        }
        assert_eq!((waiting, living, most), (0, 1000, EACH));
    }
}
