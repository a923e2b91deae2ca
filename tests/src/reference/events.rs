//! Start, epicentre and duration of events in the reference, computed TTI by TTI from the definition, for `world.rs`.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_bs::scenario::Scenario;
use reveille_common::event::{Aftershocks, DurationKind, EventBursts, HotSpots, ProcessSettings};
use reveille_common::geometry::{Area, Point};
use reveille_common::rng::{Geometric, Purpose, Stream};

/// Event process. Its clock also advances during an event: call [`Self::advance`] once for each TTI, in order. Without
/// an active event, [`Self::check_start`] follows. A start is followed by [`Self::draw_event`], the end of the event by
/// [`Self::end_event`].
#[derive(Clone, Debug)]
pub(super) struct ReferenceEvents<'a> {
    scenario: &'a Scenario,
    /// Phases of the process `bursts`.
    phases: Option<BurstPhases>,
    /// Start probability without phases.
    constant_alpha: f64,
    /// Start probability in this TTI; NaN before the first.
    alpha: f64,
    /// Number of the active event, or of the next.
    number: u64,
    /// The next event starts when `no_start_probability` falls below this.
    threshold: f64,
    /// Probability that no event has started since the last one ended.
    no_start_probability: f64,
    /// Centres of the process `hot-spots`; empty for others.
    hot_spots: Vec<Point>,
    previous_epicentre: Option<Point>,
}

/// Busy and quiet phases of the process.
#[derive(Clone, Debug)]
struct BurstPhases {
    bursts: EventBursts,
    stream: Stream,
    is_busy: bool,
    /// TTIs until the phase ends.
    remaining_ttis: u64,
}

impl BurstPhases {
    fn new(bursts: EventBursts, seed: u64) -> Self {
        let mut stream = Stream::new(seed, Purpose::EventPhases, 0);
        let is_busy = stream.unit() < bursts.busy_ttis / (bursts.busy_ttis + bursts.quiet_ttis);
        let mut phases = Self {
            bursts,
            stream,
            is_busy,
            remaining_ttis: 0,
        };
        phases.remaining_ttis = phases.draw_length();
        phases
    }

    fn draw_length(&mut self) -> u64 {
        let mean = if self.is_busy {
            self.bursts.busy_ttis
        } else {
            self.bursts.quiet_ttis
        };
        Geometric::new(1.0 / mean).draw(&mut self.stream)
    }

    /// Advances to the next TTI and returns its start probability.
    fn advance(&mut self) -> f64 {
        if self.remaining_ttis == 0 {
            self.is_busy = !self.is_busy;
            self.remaining_ttis = self.draw_length();
        }
        self.remaining_ttis -= 1;
        if self.is_busy {
            self.bursts.busy_alpha
        } else {
            self.bursts.quiet_alpha
        }
    }
}

impl<'a> ReferenceEvents<'a> {
    pub(super) fn new(scenario: &'a Scenario) -> Self {
        let seed = scenario.run.seed;
        let (mut hot_spots, mut phases) = (Vec::new(), None);
        match scenario.events.process {
            ProcessSettings::Uniform | ProcessSettings::Aftershocks(_) => {}
            ProcessSettings::HotSpots(settings) => {
                let mut stream = Stream::new(seed, Purpose::HotSpots, 0);
                for _ in 0..settings.places {
                    hot_spots.push(draw_in_area(&mut stream, scenario.area));
                }
            }
            ProcessSettings::Bursts(bursts) => phases = Some(BurstPhases::new(bursts, seed)),
        }
        let mut events = Self {
            scenario,
            phases,
            constant_alpha: scenario.events.alpha,
            alpha: f64::NAN,
            number: 0,
            threshold: f64::NAN,
            no_start_probability: 1.0,
            hot_spots,
            previous_epicentre: None,
        };
        events.draw_threshold();
        events
    }

    /// Number of the active event, or of the next.
    pub(super) const fn number(&self) -> u64 {
        self.number
    }

    /// Changes the start probability from the next [`Self::advance`] on. Without effect under `bursts`.
    pub(super) const fn set_alpha(&mut self, alpha: f64) {
        self.constant_alpha = alpha;
    }

    /// Advances to the next TTI and returns the start probability if no event is active.
    pub(super) fn advance(&mut self) -> f64 {
        self.alpha = match &mut self.phases {
            Some(phases) => phases.advance(),
            None => self.constant_alpha,
        };
        self.alpha
    }

    /// Updates the probability of no start by this TTI, and returns whether the next event starts now. Call once in
    /// each TTI without an active event.
    pub(super) fn check_start(&mut self) -> bool {
        self.no_start_probability *= 1.0 - self.alpha;
        self.no_start_probability < self.threshold
    }

    /// Draws epicentre and duration of the starting event.
    pub(super) fn draw_event(&mut self) -> (Point, u64) {
        let epicentre = self.draw_epicentre();
        self.previous_epicentre = Some(epicentre);
        (epicentre, self.draw_duration())
    }

    /// Records the end of the active event.
    pub(super) fn end_event(&mut self) {
        self.number += 1;
        self.draw_threshold();
    }

    fn draw_threshold(&mut self) {
        // Above 0, so that `no_start_probability` can fall below it after α has been above 0 for long enough.
        self.threshold = 1.0 - self.event_stream(Purpose::EventGap).unit();
        self.no_start_probability = 1.0;
    }

    /// Returns the stream of the active event, or of the next, for `purpose`.
    fn event_stream(&self, purpose: Purpose) -> Stream {
        Stream::new(self.scenario.run.seed, purpose, self.number)
    }

    fn draw_duration(&self) -> u64 {
        let mean = self.scenario.events.duration;
        match self.scenario.events.duration_kind {
            DurationKind::Fixed => mean,
            DurationKind::Geometric => {
                let threshold = 1.0 - self.event_stream(Purpose::EventDuration).unit();
                let (mut ttis, mut active_probability) = (0, 1.0);
                while active_probability >= threshold {
                    ttis += 1;
                    active_probability *= 1.0 - 1.0 / mean as f64;
                }
                ttis
            }
        }
    }

    fn draw_epicentre(&self) -> Point {
        let area = self.scenario.area;
        let mut stream = self.event_stream(Purpose::Attraction);
        match (self.scenario.events.process, self.previous_epicentre) {
            (ProcessSettings::HotSpots(HotSpots { share, sigma, .. }), _) if stream.unit() < share => {
                // The draws must come in the emulator's order, since they share a stream.
                let hot_spot = self.hot_spots[stream.below(self.hot_spots.len() as u64) as usize];
                let r = (-2.0 * libm::log1p(-stream.unit())).sqrt();
                let phi = 2.0 * std::f64::consts::PI * stream.unit();
                Point {
                    x: mirrored(hot_spot.x + sigma * (r * libm::cos(phi)), area.width),
                    y: mirrored(hot_spot.y + sigma * (r * libm::sin(phi)), area.height),
                }
            }
            (ProcessSettings::Aftershocks(Aftershocks { probability, radius }), Some(previous))
                if stream.unit() < probability =>
            {
                loop {
                    let x = draw_between(&mut stream, -previous.x, area.width - previous.x, radius);
                    let y = draw_between(&mut stream, -previous.y, area.height - previous.y, radius);
                    if x * x + y * y <= radius * radius {
                        break Point {
                            x: (previous.x + x).min(area.width).max(0.0),
                            y: (previous.y + y).min(area.height).max(0.0),
                        };
                    }
                }
            }
            _ => draw_in_area(&mut self.event_stream(Purpose::Epicentre), area),
        }
    }
}

fn draw_in_area(stream: &mut Stream, area: Area) -> Point {
    let x = stream.unit() * area.width;
    let y = stream.unit() * area.height;
    Point { x, y }
}

/// Draws a number from `low` to `high` that is at most `radius` from 0.
fn draw_between(stream: &mut Stream, low: f64, high: f64, radius: f64) -> f64 {
    let (low, high) = (low.max(-radius), high.min(radius));
    low + stream.unit() * (high - low)
}

/// Reflects `x` at 0 and at `side` until it is between them.
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
