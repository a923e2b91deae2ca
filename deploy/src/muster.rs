//! How many device processes are started at a time.
//!
//! A process that starts takes milliseconds of a core until it carries its devices. A thousand that start at once all
//! wait for each other, longer than links and base station have patience; so each waits for its turn before it starts.

use std::num::NonZero;

/// Processes that may be on their way for each core.
const EACH: usize = 16;

/// Says when it is whose turn.
#[derive(Clone, Copy, Debug)]
pub struct Muster {
    at_once: usize,
}

impl Muster {
    /// For this machine.
    pub fn new() -> Self {
        Self::for_cores(std::thread::available_parallelism().map_or(1, NonZero::get))
    }

    const fn for_cores(cores: usize) -> Self {
        Self { at_once: EACH * cores }
    }

    /// How many of `waiting` processes may start now, when `living` have been started and `there` of them carry their
    /// devices.
    pub fn may_start(self, waiting: usize, living: usize, there: usize) -> usize {
        let on_their_way = living.saturating_sub(there);
        self.at_once.saturating_sub(on_their_way).min(waiting)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_more_are_on_their_way_than_the_machine_can_take() {
        let muster = Muster::for_cores(2);
        assert_eq!(muster.may_start(1000, 0, 0), 32);
        assert_eq!(muster.may_start(968, 32, 0), 0);
        assert_eq!(muster.may_start(968, 32, 5), 5);
        assert_eq!(muster.may_start(3, 40, 40), 3);
        assert_eq!(muster.may_start(0, 40, 40), 0);
        assert_eq!(
            muster.may_start(7, 30, 33),
            7,
            "some have ended that still count as there"
        );
    }

    #[test]
    fn all_come_to_their_turn_however_slowly_they_arrive() {
        let muster = Muster::for_cores(1);
        let (mut waiting, mut living, mut there, mut most) = (1000, 0, 0, 0);
        while there < 1000 {
            let now = muster.may_start(waiting, living, there);
            (waiting, living) = (waiting - now, living + now);
            most = most.max(living - there);
            there += 1;
        }
        assert_eq!((waiting, living, most), (0, 1000, EACH));
    }
}
