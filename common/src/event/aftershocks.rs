//! The event process `aftershocks`: many epicentres lie near the previous one. Digests depend on the order of draws:
//! whether the event is near, then x and y offsets in turn. `tests/src/reference/events.rs` repeats it. Doc comments of
//! fields appear in `docs/scenario.md`.

use super::uniform::UniformEpicentres;
use crate::declare::{NOT_NEGATIVE, PROBABILITY, number};
use crate::geometry::{Area, Point};
use crate::ids::EventId;
use crate::rng::{Purpose, Stream};

crate::declare! {
    /// Events near the previous event, whether or not it was reported. The other events are uniform on the area.
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct Aftershocks in "events.aftershocks" only with "events.process" = &["aftershocks"]; {
        /// Probability that an event is near the previous event.
        pub probability: f64 = number(PROBABILITY, 0.6),
        /// Largest distance from the previous event. The epicentre is uniform within this distance and inside the area.
        pub radius: f64 = number(NOT_NEGATIVE, 2.0).unit("metres"),
    }
}

/// The epicentres of events under `aftershocks`.
#[derive(Clone, Debug)]
pub(super) struct AftershockEpicentres {
    uniform: UniformEpicentres,
    settings: Aftershocks,
    /// The epicentre of the previous event.
    previous: Option<Point>,
}

impl AftershockEpicentres {
    pub(super) fn new(settings: Aftershocks, uniform: UniformEpicentres) -> Self {
        Self {
            uniform,
            settings,
            previous: None,
        }
    }

    /// Draws the epicentre of `event`, which must follow the event of the last call. A call changes the state: each
    /// event needs exactly one.
    pub(super) fn draw(&mut self, event: EventId) -> Point {
        let mut stream = Stream::new(self.uniform.seed, Purpose::Attraction, event.0);
        let epicentre = match self.previous {
            Some(previous) if stream.unit() < self.settings.probability => {
                draw_near(previous, self.settings.radius, self.uniform.area, &mut stream)
            }
            Some(_) | None => self.uniform.draw(event),
        };
        *self.previous.insert(epicentre)
    }
}

/// Draws a point uniformly from the part of `area` within `radius` of `centre`, which lies in `area`.
fn draw_near(centre: Point, radius: f64, area: Area, stream: &mut Stream) -> Point {
    let mut offset = |coordinate: f64, side: f64| {
        let (lowest, highest) = ((-radius).max(-coordinate), radius.min(side - coordinate));
        lowest + stream.unit() * (highest - lowest)
    };
    // Drawn from the part of the circle's square that lies in the area. At least π/4 of it is in the circle, for any
    // radius.
    let (dx, dy) = loop {
        let (dx, dy) = (offset(centre.x, area.width), offset(centre.y, area.height));
        if dx * dx + dy * dy <= radius * radius {
            break (dx, dy);
        }
    };
    // Rounding may put a sum just outside the area.
    Point::new(
        (centre.x + dx).clamp(0.0, area.width),
        (centre.y + dy).clamp(0.0, area.height),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_in_the_area_and_within_the_radius_for_any_centre() {
        let mut stream = Stream::new(3, Purpose::Attraction, 0);
        for (width, height) in [(20.0, 20.0), (1e-3, 1e6), (1e6, 1e-300), (1e-300, 1e-300)] {
            let area = Area { width, height };
            for (x, y) in [(0.0, 0.0), (1.0, 1.0), (0.5, 0.0), (0.3, 0.9)] {
                let centre = Point::new(x * area.width, y * area.height);
                for radius in [0.0, 1e-320, 1e-16, 1e-15, 0.7, 2.0, 19.0, 30.0, 1e6] {
                    for _ in 0..200 {
                        let point = draw_near(centre, radius, area, &mut stream);
                        // Rounding of the coordinates.
                        let tolerance = 1e-15 * (centre.x + centre.y);
                        assert!(area.contains(point), "{point:?} in {area:?}");
                        assert!(
                            point.distance(centre) <= radius * (1.0 + 1e-12) + tolerance,
                            "{point:?}, more than {radius} from {centre:?} in {area:?}"
                        );
                    }
                }
            }
        }
    }
}
