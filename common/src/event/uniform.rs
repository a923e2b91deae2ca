//! Events anywhere.

use crate::geometry::{Area, Point};
use crate::ids::EventId;
use crate::rng::{Purpose, Stream};

/// Epicentres that are uniform on the area.
#[derive(Clone, Copy, Debug)]
pub(super) struct Uniform {
    pub(super) seed: u64,
    pub(super) area: Area,
}

impl Uniform {
    /// The epicentre of `event`.
    pub(super) fn draw(&self, event: EventId) -> Point {
        let mut stream = Stream::new(self.seed, Purpose::Epicentre, event.0);
        self.anywhere(&mut stream)
    }

    /// Any point of the area, two draws from `stream`.
    pub(super) fn anywhere(&self, stream: &mut Stream) -> Point {
        Point::new(stream.unit() * self.area.width, stream.unit() * self.area.height)
    }
}
