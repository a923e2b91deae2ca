//! Tells observers on the bus what happens on the air and in the world.

use reveille_common::bus::Bus;
use reveille_common::message::Frame;

use crate::observe::frames::Framed;
use crate::observe::{Happening, Observer};

/// An observer that hands what it sees to those on the bus, while there are any.
pub(super) struct Told<'a> {
    bus: &'a Bus,
    framed: Framed<Box<dyn FnMut(Frame) + Send + 'a>>,
}

impl<'a> Told<'a> {
    /// For the observers on `bus`, with the states of all devices every `states_every` TTIs; 0 for never.
    pub(super) fn new(bus: &'a Bus, states_every: u64) -> Self {
        Self {
            bus,
            framed: Framed::new(states_every, Box::new(|frame| bus.tell(frame))),
        }
    }
}

impl Observer for Told<'_> {
    fn see(&mut self, happening: &Happening<'_>) {
        if self.bus.is_observed() {
            self.framed.see(happening);
        }
    }

    fn wants_states(&self) -> bool {
        self.bus.is_observed() && self.framed.wants_states()
    }

    fn wants_beliefs(&self) -> bool {
        self.bus.is_observed()
    }
}
