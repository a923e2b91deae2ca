//! The wake-up radio of a device, where it fails.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::radio::{Air, FalseWakes, Radio};

/// What a device's wake-up radio misses, and what it hears that nobody has sent.
#[derive(Clone, Debug)]
pub struct Ears {
    device: DeviceId,
    air: Air,
    false_wakes: FalseWakes,
}

impl Ears {
    /// Those of `device` in a run with `seed`; nothing where `radio` never fails.
    pub fn of(seed: u64, radio: &Radio, device: DeviceId) -> Option<Box<Self>> {
        let of = || Self {
            device,
            air: Air::new(seed, radio),
            false_wakes: FalseWakes::new(seed, radio.false_wake, device),
        };
        (!radio.is_perfect()).then(|| Box::new(of()))
    }

    /// The next TTI in which something wakes the device for nothing, if it sleeps.
    pub const fn false_wake(&self) -> Tti {
        self.false_wakes.next()
    }

    /// Takes that TTI, and gives the one after it.
    pub fn take_false_wake(&mut self) -> Tti {
        self.false_wakes.take()
    }

    /// Whether it misses a wake-up in TTI `k`, none before that of the last call.
    pub fn misses_wake_up(&mut self, k: Tti) -> bool {
        self.air.at(k).misses_wake_up(self.device)
    }
}
