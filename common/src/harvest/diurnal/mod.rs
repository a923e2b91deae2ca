//! The source `diurnal`: arrivals whose probability follows the sun of [`super::sun`] through day and night. Digests
//! depend on the draws, one per arrival. [`DiurnalSetup`] and [`DayKnowledge`] are part of the wire format. Doc
//! comments of fields and words appear in `docs/scenario.md`.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::arrivals::{Arrivals, ArrivalsSetup, eq5_probability};
use super::day_profile::DayProfile;
use super::gap::{HarvestGap, longest_gap};
use super::shared_tables::{CumulativeHazard, SharedSourceData, expected_energy};
use super::sun::{Sky, Sun};
use crate::declare::{FieldReader, FieldSink, Range, ScenarioError, Section, Visit, choice, choices, number, whole};
use crate::ids::Tti;
use crate::rng::Stream;
use crate::units::Energy;

/// Upper limit of an arrival's probability, exclusive: with a certain arrival, or one rounded to it, no gap can be
/// drawn.
const MAX_ARRIVAL_PROBABILITY: f64 = 1.0 - 1e-9;
/// Maximum number of TTIs per day, which bounds the tables of a day.
pub(super) const MAX_TTIS_PER_DAY: u32 = 100_000;

choices! {
    /// Reference of the intensity λ.
    pub enum IrradianceReference {
        /// The mean over a day: at any place and date, the mean harvest equals the `eq5` harvest with the same λ and
        /// `E_B`.
        DailyMean = "daily-mean",
        /// The sun in the zenith: places far from the equator harvest less, and so do winter days.
        Zenith = "zenith",
    }
}

choices! {
    /// The base station's knowledge of the day.
    #[derive(Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum DayKnowledge {
        /// Place, date and time, and thus the mean harvest of each TTI.
        Course = "course",
        /// The daily mean only.
        Mean = "mean",
    }
}

crate::declare! {
    /// Diurnal source: the probability of an arrival in a TTI follows the sun's irradiance.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Settings in "harvest.diurnal" only with "harvest.kind" = &["diurnal"]; {
        /// Latitude φ, positive north of the equator.
        latitude: f64 = number(Range::closed(-90.0, 90.0), 36.1).unit("degrees"),
        /// Day of the year, 1 for 1 January; it applies to every day of a run.
        day_of_year: u32 = whole(1, 365, 81).unit("days"),
        /// Solar time at the start of TTI 0.
        start_hour: f64 = number(Range::below(0.0, 24.0), 0.0).unit("hours"),
        /// Number of TTIs per day: 288 if a TTI represents five minutes.
        ttis_per_day: u32 = whole(1, MAX_TTIS_PER_DAY as u64, 288).unit("TTIs"),
        /// Attenuation of sunlight by the atmosphere.
        sky: Sky = choice::<Sky>("vacuum"),
        /// Reference for which λτ·exp(-λτ) is the probability of an arrival in a TTI.
        reference: IrradianceReference = choice::<IrradianceReference>("daily-mean"),
        /// The base station's prior knowledge of the day, in addition to E_B.
        known: DayKnowledge = choice::<DayKnowledge>("course"),
    }
}

/// An arrival in a TTI with the probability λτ·exp(-λτ)·g, where g follows the irradiance in the middle of the TTI.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Diurnal {
    /// λ and `E_B`.
    pub arrivals: Arrivals,
    /// Place and time.
    pub sun: Sun,
    /// Whether g is 1 in the daily mean, or with the sun at the zenith.
    pub reference: IrradianceReference,
    /// The base station's prior knowledge of the day.
    pub known: DayKnowledge,
    /// The daily mean of irradiance, relative to a sun in the zenith.
    mean_irradiance: f64,
}

impl Diurnal {
    /// The fields of this kind only.
    pub const SECTION: &'static Section = Settings::SECTION;

    /// Creates the source of these `arrivals` under `sun`. Loading a scenario checks that the probabilities are below
    /// 1, this function does not.
    pub fn new(arrivals: Arrivals, sun: Sun, reference: IrradianceReference, known: DayKnowledge) -> Self {
        let mean_irradiance = sun.mean_irradiance();
        Self {
            arrivals,
            sun,
            reference,
            known,
            mean_irradiance,
        }
    }

    /// Builds the settings in `reader`, for TTIs of duration `tau`.
    pub(super) fn from_fields(reader: &FieldReader<'_>, tau: f64) -> Result<Self, ScenarioError> {
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
        let diurnal = Self::new(arrivals, sun, reference, known);
        let no_sun = format!("the sun does not rise in any TTI of day {day_of_year}");
        match reference {
            IrradianceReference::DailyMean if diurnal.mean_irradiance <= 0.0 => {
                let allowed = format!(
                    "{no_sun}, so λ cannot be the daily mean; set another harvest.diurnal.day_of_year, or \
                     harvest.diurnal.reference = \"zenith\""
                );
                return Err(reader.invalid_value("harvest.diurnal.latitude", latitude, allowed));
            }
            IrradianceReference::Zenith if diurnal.mean_irradiance <= 0.0 => {
                reader.warn(format!("no energy is harvested: {no_sun}"));
            }
            IrradianceReference::DailyMean | IrradianceReference::Zenith => {}
        }
        // No TTI of the day is brighter than noon, so this bounds all of them.
        let noon_probability = diurnal.zenith_probability(tau) * sun.noon_irradiance();
        if noon_probability >= MAX_ARRIVAL_PROBABILITY {
            let allowed = format!(
                "makes the arrival probability {noon_probability:.3} per TTI at noon, and it must be below 1; set a \
                 smaller harvest.lambda, and a larger harvest.e_b for the same harvest"
            );
            return Err(reader.invalid_value("harvest.lambda", arrivals.lambda, allowed));
        }
        Ok(diurnal)
    }

    /// Passes every field to `sink`. The scenario hash depends on the order.
    pub(super) fn visit(&self, sink: &mut dyn FieldSink) {
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

    /// The probability of an arrival with the sun at the zenith; can exceed 1 if λ refers to the daily mean.
    fn zenith_probability(&self, tau: f64) -> f64 {
        let p = eq5_probability(self.arrivals.lambda, tau);
        match self.reference {
            IrradianceReference::DailyMean => p / self.mean_irradiance,
            IrradianceReference::Zenith => p,
        }
    }

    /// The setup for TTIs of duration `tau`.
    pub(super) fn setup(&self, tau: f64) -> DiurnalSetup {
        let zenith_probability = self.zenith_probability(tau);
        DiurnalSetup {
            sun: self.sun,
            zenith_probability,
            mean_probability: zenith_probability * self.mean_irradiance,
            e_b: self.arrivals.e_b,
            known: self.known,
        }
    }
}

/// The setup of a diurnal source on a device.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DiurnalSetup {
    /// Place and time.
    pub sun: Sun,
    /// Probability of an arrival in a TTI for an irradiance of 1, ≥ 0. It may exceed 1 where the sun stays lower.
    pub zenith_probability: f64,
    /// Mean probability of an arrival in a TTI, `[0, 1)`.
    pub mean_probability: f64,
    /// Energy E_B of an arrival.
    pub e_b: Energy,
    /// The base station's prior knowledge of the day.
    pub known: DayKnowledge,
}

impl DiurnalSetup {
    /// Whether a setup from the wire is valid: the limits of the fields and of [`Diurnal::from_fields`].
    pub(super) fn is_valid(&self) -> bool {
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
            && (1..=MAX_TTIS_PER_DAY).contains(&ttis_per_day);
        let noon_probability = self.zenith_probability * self.sun.noon_irradiance();
        is_a_day
            && self.zenith_probability >= 0.0
            && (0.0..MAX_ARRIVAL_PROBABILITY).contains(&noon_probability)
            && (0.0..1.0).contains(&self.mean_probability)
    }

    /// The mean harvest per TTI.
    pub(super) fn mean(&self) -> Energy {
        expected_energy(self.mean_probability, self.e_b)
    }

    /// The expected harvest in the first `ttis` TTIs, micro-units.
    pub(super) fn expected_micro_in(&self, ttis: u64) -> f64 {
        let day = u64::from(self.sun.ttis_per_day);
        let (days, last_day_ttis) = (ttis / day, (ttis % day) as usize);
        let (mut whole_day, mut last_day) = (0.0, 0.0);
        for (tti, p) in self.sun.arrival_probabilities(self.zenith_probability).enumerate() {
            whole_day += p;
            if tti < last_day_ttis {
                last_day += p;
            }
        }
        (days as f64 * whole_day + last_day) * self.e_b.micro() as f64
    }

    /// The longest night of the first `ttis` TTIs: TTIs in which no energy can arrive.
    pub(super) fn longest_gap(&self, ttis: u64) -> HarvestGap {
        let by_tti: Vec<f64> = self.sun.arrival_probabilities(self.zenith_probability).collect();
        let is_dark = |p: &f64| *p <= 0.0 || self.e_b == Energy::ZERO;
        longest_gap(by_tti.iter().map(|p| (is_dark(p), 1)), false, ttis)
    }

    /// The setup known before a run if only the mean is known: arrivals that are equally likely in all TTIs.
    pub(super) fn arrivals_if_mean_known(&self) -> Option<ArrivalsSetup> {
        match self.known {
            DayKnowledge::Course => None,
            DayKnowledge::Mean => Some(ArrivalsSetup {
                p: self.mean_probability,
                e_b: self.e_b,
            }),
        }
    }

    /// The expected energy by time of day, if it is known.
    pub(super) fn day_profile(&self) -> Option<DayProfile> {
        match self.known {
            DayKnowledge::Course => Some(DayProfile::new(
                self.sun.arrival_probabilities(self.zenith_probability),
                self.e_b,
            )),
            DayKnowledge::Mean => None,
        }
    }

    /// Creates the source. Also returns the TTI of its first arrival.
    pub(super) fn source(&self, shared: &SharedSourceData, stream: Stream) -> (DiurnalSource, Tti) {
        let mut source = DiurnalSource {
            hazards: shared.hazards(&self.sun, self.zenith_probability),
            stream,
            e_b: self.e_b,
        };
        let next = source.next_from(Tti::ZERO);
        (source, next)
    }
}

/// The state of the source on a device.
#[derive(Clone, Debug)]
pub(super) struct DiurnalSource {
    hazards: Arc<CumulativeHazard>,
    stream: Stream,
    e_b: Energy,
}

impl DiurnalSource {
    /// Returns the arrival in `now`, the TTI of the next arrival from the last call, and the TTI of the one after it.
    #[inline]
    pub(super) fn take(&mut self, now: Tti) -> (Energy, Tti) {
        (self.e_b, self.next_from(now + 1))
    }

    /// Draws the TTI of the first arrival in or after TTI `from`.
    fn next_from(&mut self, from: Tti) -> Tti {
        if self.e_b == Energy::ZERO {
            return Tti::NEVER;
        }
        // An exponential draw of mean 1: the hazard up to the next arrival.
        self.hazards.first_tti_beyond(from, -libm::log1p(-self.stream.unit()))
    }
}

#[cfg(test)]
mod tests;
