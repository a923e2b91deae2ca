//! Start, epicentre and duration of events, computed TTI by TTI from the definition.

use reveille_bs::scenario::Scenario;
use reveille_common::event::{Aftershocks, DurationKind, EventBursts, HotSpots, ProcessSettings};
use reveille_common::geometry::{Area, Point};
use reveille_common::rng::{Geometric, Purpose, Stream};

/// Event process. Its clock also advances during an event.
#[derive(Clone, Debug)]
pub(super) struct ReferenceEvents<'a> {
    scenario: &'a Scenario,
    weather: Option<Weather>,
    /// Start probability in this TTI.
    alpha: f64,
    /// Number of the active event, or of the next.
    number: u64,
    /// The next event starts when `none_yet`, the probability that none has started yet, falls below this.
    threshold: f64,
    none_yet: f64,
    places: Vec<Point>,
    previous: Option<Point>,
}

/// Busy and quiet phases of the process.
#[derive(Clone, Debug)]
struct Weather {
    bursts: EventBursts,
    stream: Stream,
    busy: bool,
    left: u64,
}

impl Weather {
    fn new(bursts: EventBursts, seed: u64) -> Self {
        let mut stream = Stream::new(seed, Purpose::Phases, 0);
        let busy = stream.unit() < bursts.busy_ttis / (bursts.busy_ttis + bursts.quiet_ttis);
        let mut weather = Self {
            bursts,
            stream,
            busy,
            left: 0,
        };
        weather.left = weather.length();
        weather
    }

    fn length(&mut self) -> u64 {
        let mean = if self.busy {
            self.bursts.busy_ttis
        } else {
            self.bursts.quiet_ttis
        };
        Geometric::new(1.0 / mean).draw(&mut self.stream)
    }

    fn next_tti(&mut self) -> f64 {
        if self.left == 0 {
            self.busy = !self.busy;
            self.left = self.length();
        }
        self.left -= 1;
        if self.busy {
            self.bursts.busy_alpha
        } else {
            self.bursts.quiet_alpha
        }
    }
}

impl<'a> ReferenceEvents<'a> {
    pub(super) fn new(scenario: &'a Scenario) -> Self {
        let seed = scenario.run.seed;
        let (mut places, mut weather) = (Vec::new(), None);
        match scenario.events.process {
            ProcessSettings::Uniform | ProcessSettings::Aftershocks(_) => {}
            ProcessSettings::HotSpots(hot_spots) => {
                let mut stream = Stream::new(seed, Purpose::HotSpots, 0);
                for _ in 0..hot_spots.places {
                    places.push(anywhere(&mut stream, scenario.area));
                }
            }
            ProcessSettings::Bursts(bursts) => weather = Some(Weather::new(bursts, seed)),
        }
        let mut events = Self {
            scenario,
            weather,
            alpha: f64::NAN,
            number: 0,
            threshold: f64::NAN,
            none_yet: 1.0,
            places,
            previous: None,
        };
        events.wait();
        events
    }

    /// Number of the active event, or of the next.
    pub(super) const fn number(&self) -> u64 {
        self.number
    }

    /// Advances to the next TTI and returns the start probability if no event is active.
    pub(super) fn next_tti(&mut self) -> f64 {
        self.alpha = match &mut self.weather {
            Some(weather) => weather.next_tti(),
            None => self.scenario.events.alpha,
        };
        self.alpha
    }

    /// Whether the next event starts in this TTI; no event may be active.
    pub(super) fn starts(&mut self) -> bool {
        self.none_yet *= 1.0 - self.alpha;
        self.none_yet < self.threshold
    }

    /// Draws epicentre and duration of the starting event.
    pub(super) fn event(&mut self) -> (Point, u64) {
        let epicentre = self.epicentre();
        self.previous = Some(epicentre);
        (epicentre, self.duration())
    }

    /// Records the end of the active event.
    pub(super) fn ended(&mut self) {
        self.number += 1;
        self.wait();
    }

    fn wait(&mut self) {
        // Above 0, so that `none_yet` can fall below it after α has been above 0 for long enough.
        self.threshold = 1.0 - self.stream(Purpose::EventGap).unit();
        self.none_yet = 1.0;
    }

    fn stream(&self, purpose: Purpose) -> Stream {
        Stream::new(self.scenario.run.seed, purpose, self.number)
    }

    fn duration(&self) -> u64 {
        let mean = self.scenario.events.duration;
        match self.scenario.events.duration_kind {
            DurationKind::Fixed => mean,
            DurationKind::Geometric => {
                let over = 1.0 - self.stream(Purpose::EventDuration).unit();
                let (mut ttis, mut still) = (0, 1.0);
                while still >= over {
                    ttis += 1;
                    still *= 1.0 - 1.0 / mean as f64;
                }
                ttis
            }
        }
    }

    fn epicentre(&self) -> Point {
        let area = self.scenario.area;
        let mut stream = self.stream(Purpose::Attraction);
        match (self.scenario.events.process, self.previous) {
            (ProcessSettings::HotSpots(HotSpots { share, sigma, .. }), _) if stream.unit() < share => {
                // The draws must come in the emulator's order, since they share a stream.
                let place = self.places[stream.below(self.places.len() as u64) as usize];
                let r = (-2.0 * libm::log1p(-stream.unit())).sqrt();
                let phi = 2.0 * std::f64::consts::PI * stream.unit();
                Point {
                    x: mirrored(place.x + sigma * (r * libm::cos(phi)), area.width),
                    y: mirrored(place.y + sigma * (r * libm::sin(phi)), area.height),
                }
            }
            (ProcessSettings::Aftershocks(Aftershocks { probability, radius }), Some(before))
                if stream.unit() < probability =>
            {
                loop {
                    let x = between(&mut stream, -before.x, area.width - before.x, radius);
                    let y = between(&mut stream, -before.y, area.height - before.y, radius);
                    if x * x + y * y <= radius * radius {
                        break Point {
                            x: (before.x + x).min(area.width).max(0.0),
                            y: (before.y + y).min(area.height).max(0.0),
                        };
                    }
                }
            }
            _ => anywhere(&mut self.stream(Purpose::Epicentre), area),
        }
    }
}

fn anywhere(stream: &mut Stream, area: Area) -> Point {
    let x = stream.unit() * area.width;
    let y = stream.unit() * area.height;
    Point { x, y }
}

/// Draws a number from `low` to `high` that is at most `radius` from 0.
fn between(stream: &mut Stream, low: f64, high: f64, radius: f64) -> f64 {
    let (low, high) = (low.max(-radius), high.min(radius));
    low + stream.unit() * (high - low)
}

fn mirrored(mut x: f64, side: f64) -> f64 {
    loop {
        if x < 0.0 {
            x = -x;
        } else if x > side {
            x = 2.0 * side - x;
        } else {
            return x;
        }
    }
}
