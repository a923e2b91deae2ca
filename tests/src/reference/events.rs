//! When events start, where they are and how long they last, TTI by TTI and by the definition.

use reveille_common::event::{Aftershocks, Bursts, DurationKind, HotSpots, Process};
use reveille_common::geometry::{Area, Point};
use reveille_common::rng::{Geometric, Purpose, Stream};
use reveille_common::scenario::Scenario;

/// What decides over events. Its clock goes on whether an event is under way or not.
#[derive(Clone, Debug)]
pub(super) struct Events<'a> {
    scenario: &'a Scenario,
    weather: Option<Weather>,
    /// The probability in force in this TTI.
    alpha: f64,
    /// The number of the next event, or of the one under way.
    number: u64,
    /// The next event starts when the probability that none has started yet falls below this.
    threshold: f64,
    none_yet: f64,
    places: Vec<Point>,
    previous: Option<Point>,
}

/// Busy and quiet phases.
#[derive(Clone, Debug)]
struct Weather {
    bursts: Bursts,
    stream: Stream,
    busy: bool,
    left: u64,
}

impl Weather {
    fn new(bursts: Bursts, seed: u64) -> Self {
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

impl<'a> Events<'a> {
    pub(super) fn new(scenario: &'a Scenario) -> Self {
        let seed = scenario.seed;
        let (mut places, mut weather) = (Vec::new(), None);
        match scenario.events.process {
            Process::Uniform | Process::Aftershocks(_) => {}
            Process::HotSpots(hot_spots) => {
                let mut stream = Stream::new(seed, Purpose::HotSpots, 0);
                for _ in 0..hot_spots.places {
                    places.push(anywhere(&mut stream, scenario.area));
                }
            }
            Process::Bursts(bursts) => weather = Some(Weather::new(bursts, seed)),
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

    /// The number of the event under way, or of the next.
    pub(super) const fn number(&self) -> u64 {
        self.number
    }

    /// The next TTI comes, with this probability that an event starts if none is active.
    pub(super) fn next_tti(&mut self) -> f64 {
        self.alpha = match &mut self.weather {
            Some(weather) => weather.next_tti(),
            None => self.scenario.events.alpha,
        };
        self.alpha
    }

    /// Whether the next event starts in this TTI, in which none is active.
    pub(super) fn starts(&mut self) -> bool {
        self.none_yet *= 1.0 - self.alpha;
        self.none_yet < self.threshold
    }

    /// Epicentre and duration of the event that starts.
    pub(super) fn event(&mut self) -> (Point, u64) {
        let epicentre = self.epicentre();
        self.previous = Some(epicentre);
        (epicentre, self.duration())
    }

    /// The event under way has ended.
    pub(super) fn ended(&mut self) {
        self.number += 1;
        self.wait();
    }

    fn wait(&mut self) {
        self.threshold = 1.0 - self.stream(Purpose::EventGap).unit();
        self.none_yet = 1.0;
    }

    fn stream(&self, purpose: Purpose) -> Stream {
        Stream::new(self.scenario.seed, purpose, self.number)
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
            (Process::HotSpots(HotSpots { share, sigma, .. }), _) if stream.unit() < share => {
                let place = self.places[stream.below(self.places.len() as u64) as usize];
                let r = (-2.0 * libm::log1p(-stream.unit())).sqrt();
                let phi = 2.0 * std::f64::consts::PI * stream.unit();
                Point {
                    x: mirrored(place.x + sigma * (r * libm::cos(phi)), area.width),
                    y: mirrored(place.y + sigma * (r * libm::sin(phi)), area.height),
                }
            }
            (Process::Aftershocks(Aftershocks { probability, radius }), Some(before))
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

/// A number from `low` to `high` that is no farther than `radius` from 0.
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
