//! When a device wakes for nothing.

use crate::ids::{DeviceId, Tti};
use crate::rng::{Geometric, Purpose, Stream};

/// The TTIs in which something makes a device's wake-up radio wake it for nothing, if it sleeps then and has power.
/// They come whatever the device does, and are drawn as gaps: a TTI without one costs nothing.
#[derive(Clone, Debug)]
pub struct FalseWakes {
    stream: Stream,
    law: Geometric,
    next: Tti,
}

impl FalseWakes {
    /// Those of `device` in a run with `seed`, in each TTI with probability `p`.
    pub fn new(seed: u64, p: f64, device: DeviceId) -> Self {
        let law = Geometric::new(p);
        let mut stream = Stream::new(seed, Purpose::FalseWakes, u64::from(device.0));
        // A gap of 1 is TTI 0.
        let next = Tti(law.draw(&mut stream)).saturating_sub_one();
        Self { stream, law, next }
    }

    /// The next of them that was not taken.
    pub const fn next(&self) -> Tti {
        self.next
    }

    /// Takes the next, and gives the one after it.
    pub fn take(&mut self) -> Tti {
        self.next = self.next.saturating_add(self.law.draw(&mut self.stream));
        self.next
    }
}
