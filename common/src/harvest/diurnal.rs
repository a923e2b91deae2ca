//! Energy from the sun: day and night.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::arrivals::{Arrivals, ArrivalsSetup, eq5_probability};
use super::course::Course;
use super::hazards::Hazards;
use super::sources::{Sources, expected};
use super::sun::{Sky, Sun};
use crate::declare::{Range, Reader, ScenarioError, Section, Sink, choice, choices, number, whole};
use crate::ids::Tti;
use crate::rng::Stream;
use crate::units::Energy;

/// An arrival has to be less likely than this: with one that is sure, or that rounding makes so, no gap can be drawn.
const SURE: f64 = 1.0 - 1e-9;
/// The most TTIs of a day.
pub const MOST_TTIS: u32 = 100_000;

choices! {
    /// Of what moment or span λ speaks.
    pub enum Reference {
        /// Of the mean over a day: the mean harvest is that of `eq5` with the same λ and `E_B`, wherever and whenever.
        DailyMean = "daily-mean",
        /// Of a sun in the zenith: places far from the equator and days of winter have less.
        Zenith = "zenith",
    }
}

choices! {
    /// What a BS knows of the day.
    #[derive(Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum Known {
        /// Its course: place, date and time are known, so the mean harvest is known for each TTI.
        Course = "course",
        /// The daily mean alone.
        Mean = "mean",
    }
}

crate::declare! {
    /// Day and night: an arrival in a TTI with a probability that follows the irradiance of the sun.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Settings in "harvest.diurnal" only with "harvest.kind" = &["diurnal"]; {
        /// Latitude φ, north of the equator above 0.
        latitude: f64 = number(Range::closed(-90.0, 90.0), 36.1).unit("degrees"),
        /// Day of the year, 1 for the first of January; all days of a run are like it.
        day_of_year: u32 = whole(1, 365, 81).unit("days"),
        /// Solar time at which TTI 0 begins.
        start_hour: f64 = number(Range::below(0.0, 24.0), 0.0).unit("hours"),
        /// TTIs of a day: 288 if a TTI stands for five minutes.
        ttis_per_day: u32 = whole(1, MOST_TTIS as u64, 288).unit("TTIs"),
        /// What becomes of sunlight on its way.
        sky: Sky = choice::<Sky>("vacuum"),
        /// What λτ·exp(-λτ), the probability of an arrival in a TTI, holds for.
        reference: Reference = choice::<Reference>("daily-mean"),
        /// What a BS knows of the day beforehand, beside E_B.
        known: Known = choice::<Known>("course"),
    }
}

/// An arrival in a TTI with the probability λτ·exp(-λτ)·g, where g follows the irradiance in the middle of the TTI.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Diurnal {
    /// λ and `E_B`.
    pub arrivals: Arrivals,
    /// Where and when.
    pub sun: Sun,
    /// Whether g is 1 in the daily mean, or under a sun in the zenith.
    pub reference: Reference,
    /// What a BS knows.
    pub known: Known,
    /// The daily mean of irradiance, as a share of that under a sun in the zenith.
    mean: f64,
}

impl Diurnal {
    /// The fields that are its own.
    pub const SECTION: &'static Section = Settings::SECTION;

    /// The source of these `arrivals` under `sun`.
    pub fn new(arrivals: Arrivals, sun: Sun, reference: Reference, known: Known) -> Self {
        let mean = sun.mean();
        Self {
            arrivals,
            sun,
            reference,
            known,
            mean,
        }
    }

    /// The settings that `reader` has, for TTIs of duration `tau`.
    pub(super) fn settle(reader: &Reader<'_>, tau: f64) -> Result<Self, ScenarioError> {
        let arrivals = Arrivals::read(reader)?;
        let Settings {
            latitude,
            day_of_year,
            start_hour,
            ttis_per_day,
            sky,
            reference,
            known,
        } = Settings::read(reader)?;
        let sun = Sun {
            latitude,
            day_of_year,
            start_hour,
            ttis_per_day,
            sky,
        };
        let made = Self::new(arrivals, sun, reference, known);
        let dark = format!("the sun does not rise in any TTI of day {day_of_year}");
        match reference {
            Reference::DailyMean if made.mean <= 0.0 => {
                let allowed = format!(
                    "must be such that there is daylight, and {dark}, so λ cannot be its daily mean; set another \
                     harvest.diurnal.day_of_year, or harvest.diurnal.reference = \"zenith\""
                );
                return Err(reader.refuse("harvest.diurnal.latitude", latitude, allowed));
            }
            Reference::Zenith if made.mean <= 0.0 => reader.warn(format!("nothing is harvested: {dark}")),
            Reference::DailyMean | Reference::Zenith => {}
        }
        let noon = made.zenith(tau) * sun.noon();
        if noon >= SURE {
            let allowed = format!(
                "makes the probability of an arrival in a TTI {noon:.3} at noon, and it has to be below 1; set a \
                 smaller harvest.lambda, and a larger harvest.e_b for the same harvest"
            );
            return Err(reader.refuse("harvest.lambda", arrivals.lambda, allowed));
        }
        Ok(made)
    }

    /// Hands every field to `sink`.
    pub(super) fn visit(&self, sink: &mut dyn Sink) {
        self.arrivals.visit(sink);
        let Sun {
            latitude,
            day_of_year,
            start_hour,
            ttis_per_day,
            sky,
        } = self.sun;
        Settings {
            latitude,
            day_of_year,
            start_hour,
            ttis_per_day,
            sky,
            reference: self.reference,
            known: self.known,
        }
        .visit(sink);
    }

    /// The probability of an arrival under a sun in the zenith; where λ speaks of a daily mean it may be above 1.
    fn zenith(&self, tau: f64) -> f64 {
        let p = eq5_probability(self.arrivals.lambda, tau);
        match self.reference {
            Reference::DailyMean => p / self.mean,
            Reference::Zenith => p,
        }
    }

    /// The source for TTIs of duration `tau`.
    pub(super) fn setup(&self, tau: f64) -> DiurnalSetup {
        let zenith = self.zenith(tau);
        DiurnalSetup {
            sun: self.sun,
            zenith,
            mean: zenith * self.mean,
            e_b: self.arrivals.e_b,
            known: self.known,
        }
    }
}

/// Day and night as a device needs them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DiurnalSetup {
    /// Where and when.
    pub sun: Sun,
    /// Probability of an arrival in a TTI for an irradiance of 1, ≥ 0.
    pub zenith: f64,
    /// Mean probability of an arrival in a TTI, `[0, 1)`.
    pub mean: f64,
    /// Energy E_B of an arrival.
    pub e_b: Energy,
    /// What a BS knows.
    pub known: Known,
}

impl DiurnalSetup {
    /// Whether a device can be given it.
    pub(super) fn is_sound(&self) -> bool {
        let Sun {
            latitude,
            day_of_year,
            start_hour,
            ttis_per_day,
            sky: _,
        } = self.sun;
        let is_a_day = (-90.0..=90.0).contains(&latitude)
            && (1..=365).contains(&day_of_year)
            && (0.0..24.0).contains(&start_hour)
            && (1..=MOST_TTIS).contains(&ttis_per_day);
        let noon = self.zenith * self.sun.noon();
        is_a_day && self.zenith >= 0.0 && (0.0..SURE).contains(&noon) && (0.0..1.0).contains(&self.mean)
    }

    /// The mean harvest in a TTI.
    pub(super) fn mean(&self) -> Energy {
        expected(self.mean, self.e_b)
    }

    /// What is known of it before a run where that is its mean alone: arrivals that are equally likely in all TTIs.
    pub(super) fn as_known(&self) -> Option<ArrivalsSetup> {
        match self.known {
            Known::Course => None,
            Known::Mean => Some(ArrivalsSetup {
                p: self.mean,
                e_b: self.e_b,
            }),
        }
    }

    /// What is to be expected of it at which time of the day, if that is known.
    pub(super) fn course(&self) -> Option<Course> {
        match self.known {
            Known::Course => Some(Course::new(self.sun.times(self.zenith), self.e_b)),
            Known::Mean => None,
        }
    }

    /// The source, and the TTI of its first arrival.
    pub(super) fn source(&self, shared: &Sources, stream: Stream) -> (DiurnalSource, Tti) {
        let mut source = DiurnalSource {
            hazards: shared.hazards(&self.sun, self.zenith),
            stream,
            e_b: self.e_b,
        };
        let next = source.next_from(Tti::ZERO);
        (source, next)
    }
}

/// Day and night at one device.
#[derive(Clone, Debug)]
pub(super) struct DiurnalSource {
    hazards: Arc<Hazards>,
    stream: Stream,
    e_b: Energy,
}

impl DiurnalSource {
    /// The arrival in `now`, and the TTI of the next.
    #[inline]
    pub(super) fn take(&mut self, now: Tti) -> (Energy, Tti) {
        (self.e_b, self.next_from(now + 1))
    }

    fn next_from(&mut self, from: Tti) -> Tti {
        if self.e_b == Energy::ZERO {
            return Tti::NEVER;
        }
        self.hazards.passed(from, -libm::log1p(-self.stream.unit()))
    }
}

#[cfg(test)]
#[path = "diurnal_tests.rs"]
mod tests;
