//! The event process `hot-spots`: most epicentres lie around a few places that the seed draws. Digests depend on the
//! order of draws: whether the event is near a place, the place, two for the offset. `tests/src/reference/events.rs`
//! repeats it. Doc comments of fields appear in `docs/scenario.md`.

use super::uniform::UniformEpicentres;
use crate::declare::{NOT_NEGATIVE, PROBABILITY, number, whole};
use crate::geometry::{Area, Point};
use crate::ids::EventId;
use crate::rng::{Purpose, Stream};

crate::declare! {
    /// Events around a few places, which are drawn uniformly on the area from the seed. The other events are uniform on
    /// the area.
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct HotSpots in "events.hot-spots" only with "events.process" = &["hot-spots"]; {
        /// Number of places.
        pub places: u32 = whole(1, 1000, 3),
        /// Share of events that occur around one of the places, each equally likely.
        pub share: f64 = number(PROBABILITY, 0.7),
        /// Standard deviation σ of the distance from the place, along each axis. The distribution is normal and is
        /// reflected at the edges of the area.
        pub sigma: f64 = number(NOT_NEGATIVE, 1.5).unit("metres"),
    }
}

/// The epicentres of events under `hot-spots`.
#[derive(Clone, Debug)]
pub(super) struct HotSpotEpicentres {
    uniform: UniformEpicentres,
    settings: HotSpots,
    /// The positions of the places, as many as [`HotSpots::places`].
    centres: Vec<Point>,
}

impl HotSpotEpicentres {
    pub(super) fn new(settings: HotSpots, uniform: UniformEpicentres) -> Self {
        let mut stream = Stream::new(uniform.seed, Purpose::HotSpots, 0);
        Self {
            uniform,
            settings,
            centres: (0..settings.places).map(|_| uniform.draw_point(&mut stream)).collect(),
        }
    }

    /// Draws the epicentre of `event`.
    pub(super) fn draw(&self, event: EventId) -> Point {
        let mut stream = Stream::new(self.uniform.seed, Purpose::Attraction, event.0);
        if stream.unit() >= self.settings.share {
            return self.uniform.draw(event);
        }
        let centre = self.centres[stream.below(self.centres.len() as u64) as usize];
        let (east, north) = draw_two_normal(&mut stream);
        let Area { width, height } = self.uniform.area;
        Point::new(
            reflect(centre.x + self.settings.sigma * east, width),
            reflect(centre.y + self.settings.sigma * north, height),
        )
    }
}

/// Draws two independent standard normal numbers, by the method of Box and Muller.
fn draw_two_normal(stream: &mut Stream) -> (f64, f64) {
    // A draw is below 1, so the logarithm is finite. libm has the same result on every machine, unlike the standard
    // library.
    let radius = (-2.0 * libm::log1p(-stream.unit())).sqrt();
    let angle = std::f64::consts::TAU * stream.unit();
    (radius * libm::cos(angle), radius * libm::sin(angle))
}

/// Reflects `x` at 0 and at `side` until it lies in `[0, side]`.
fn reflect(x: f64, side: f64) -> f64 {
    // Mirrors at 0 and `side` make an even pattern with the period 2 · side. Both steps are exact in floating point.
    let phase = x.abs() % (2.0 * side);
    if phase > side { 2.0 * side - phase } else { phase }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reflect_mirrors_at_both_edges() {
        for (x, expected) in [
            (0.0, 0.0),
            (3.0, 3.0),
            (20.0, 20.0),
            (-0.25, 0.25),
            (20.25, 19.75),
            (-20.5, 19.5),
            (40.0, 0.0),
            (41.5, 1.5),
            (-43.0, 3.0),
            (60.5, 19.5),
            (-61.0, 19.0),
        ] {
            assert_eq!(
                reflect(x, 20.0).to_bits(),
                f64::to_bits(expected),
                "{x} on a side of 20"
            );
        }
        for side in [1e-300, 1e-9, 0.1, 20.0, 1e6] {
            for x in [1e-320, 0.3, 7.7, 1e5, 1e15, 1e300] {
                for x in [x, -x] {
                    assert!((0.0..=side).contains(&reflect(x, side)), "{x} on a side of {side}");
                }
            }
        }
    }
}
