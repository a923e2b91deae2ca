//! The sun's position over a place, and its irradiance, for the harvest source `diurnal`.
//!
//! All transcendental functions come from `libm`, and the order of operations is fixed, so that digests agree on all
//! platforms. `tests/src/reference/harvest.rs` repeats the model and its constants; `docs/energy.md` states them.
//! [`Sun`] and [`Sky`] are part of the wire format (`WIRE_VERSION`), the words and help of [`Sky`] of
//! `docs/scenario.md`.
//!
//! The formulas follow J. A. Duffie and W. A. Beckman, *Solar Engineering of Thermal Processes*, Sec. 1.6: the
//! declination of P. I. Cooper (1969), Eq. (1.6.1a), the hour angle of solar time, the elevation by Eq. (1.6.5), and
//! the hour angle of sunset by Eq. (1.6.10), cos ω₀ = −tan φ tan δ. A clear sky follows B. Haurwitz (1945).

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

use crate::declare::choices;

/// The tilt of the Earth's axis in Cooper's formula.
const AXIAL_TILT_DEGREES: f64 = 23.45;
/// Attenuation by a clear sky (Haurwitz): irradiance is proportional to s·exp(-0.059/s), with s the sine of the
/// elevation.
const HAURWITZ_ATTENUATION: f64 = 0.059;

choices! {
    /// Attenuation of sunlight by the atmosphere.
    #[derive(Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum Sky {
        /// Irradiance is proportional to the sine of the sun's elevation.
        Vacuum = "vacuum",
        /// Clear sky: the attenuation grows as the sun's elevation falls (Haurwitz 1945).
        Clear = "clear",
    }
}

impl Sky {
    /// Irradiance on level ground for the sine `sine` of the sun's elevation, relative to a sun in the zenith, `[0,
    /// 1]`; 0 below the horizon.
    pub fn irradiance(self, sine: f64) -> f64 {
        if sine <= 0.0 {
            return 0.0;
        }
        match self {
            Self::Vacuum => sine,
            Self::Clear => sine * libm::exp(HAURWITZ_ATTENUATION - HAURWITZ_ATTENUATION / sine),
        }
    }
}

/// The path of the sun over a place on a day of the year; every day of a run is the same.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sun {
    /// Latitude φ, degrees north, `-90 ..= 90`.
    pub latitude: f64,
    /// Day n of a year of 365 days, `1 ..= 365`; 1 is the first of January.
    pub day_of_year: u32,
    /// Solar time at which TTI 0 begins, hours, `[0, 24)`.
    pub start_hour: f64,
    /// TTIs per day, ≥ 1.
    pub ttis_per_day: u32,
    /// The attenuation by the atmosphere.
    pub sky: Sky,
}

impl Sun {
    /// The declination δ in radians: 23.45°·sin(360°·(284 + n)/365).
    pub(crate) fn declination(&self) -> f64 {
        AXIAL_TILT_DEGREES.to_radians() * libm::sin(TAU * (284.0 + f64::from(self.day_of_year)) / 365.0)
    }

    /// The sine of the elevation at the hour angle `omega` in radians, 0 at noon:
    /// sin φ sin δ + cos φ cos δ cos ω.
    pub fn elevation_sine(&self, omega: f64) -> f64 {
        let (phi, delta) = (self.latitude.to_radians(), self.declination());
        libm::sin(phi) * libm::sin(delta) + libm::cos(phi) * libm::cos(delta) * libm::cos(omega)
    }

    /// The share of the day with the sun above the horizon, `[0, 1]`: ω₀/π with cos ω₀ = −tan φ tan δ; 0 in the polar
    /// night and 1 in the polar day.
    #[cfg(test)]
    fn daylight(&self) -> f64 {
        let cosine = -libm::tan(self.latitude.to_radians()) * libm::tan(self.declination());
        // Beyond ±1 the sun does not rise, or does not set; at a pole the tangent is very large.
        libm::acos(cosine.clamp(-1.0, 1.0)) / std::f64::consts::PI
    }

    /// Irradiance in the middle of each TTI of a day, from TTI 0 on, relative to a sun in the zenith, `[0, 1]`.
    pub fn irradiance_by_tti(&self) -> impl Iterator<Item = f64> + '_ {
        let ttis = f64::from(self.ttis_per_day);
        // As in `Self::elevation_sine`, with the factors that are constant over a day computed once.
        let (phi, delta) = (self.latitude.to_radians(), self.declination());
        let (constant, amplitude) = (libm::sin(phi) * libm::sin(delta), libm::cos(phi) * libm::cos(delta));
        (0..self.ttis_per_day).map(move |tti| {
            let day_share = self.start_hour / 24.0 + (f64::from(tti) + 0.5) / ttis;
            // The hour angle is 0 at noon.
            self.sky
                .irradiance(constant + amplitude * libm::cos(TAU * (day_share - 0.5)))
        })
    }

    /// The probability of an arrival in each TTI of a day; `zenith_probability` is the one for an irradiance of 1.
    pub fn arrival_probabilities(&self, zenith_probability: f64) -> impl Iterator<Item = f64> + '_ {
        self.irradiance_by_tti()
            .map(move |irradiance| zenith_probability * irradiance)
    }

    /// Irradiance at noon, the upper bound of [`Self::irradiance_by_tti`].
    pub fn noon_irradiance(&self) -> f64 {
        self.sky.irradiance(self.elevation_sine(0.0))
    }

    /// The mean of [`Self::irradiance_by_tti`], `[0, 1]`.
    pub fn mean_irradiance(&self) -> f64 {
        self.irradiance_by_tti().sum::<f64>() / f64::from(self.ttis_per_day)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    fn sun_at(latitude: f64, day_of_year: u32) -> Sun {
        Sun {
            latitude,
            day_of_year,
            start_hour: 0.0,
            ttis_per_day: 1440,
            sky: Sky::Vacuum,
        }
    }

    /// Days with a declination of about 0, near its maximum, and near its minimum.
    const EQUINOX: u32 = 81;
    const MIDSUMMER: u32 = 172;
    const MIDWINTER: u32 = 355;

    #[test]
    fn the_declination_equals_published_values() {
        // Duffie and Beckman, Table 1.6.1: the recommended average days of the months.
        for (day, expected) in [
            (17, -20.9),
            (47, -13.0),
            (75, -2.4),
            (105, 9.4),
            (162, 23.1),
            (344, -23.0),
        ] {
            let declination = sun_at(0.0, day).declination().to_degrees();
            assert!(
                (declination - expected).abs() < 0.06,
                "day {day}: {declination}°, not {expected}°"
            );
        }
        assert!(sun_at(0.0, EQUINOX).declination().abs() < 1e-12);
    }

    #[test]
    fn the_length_of_a_day_equals_the_formula() {
        for (latitude, day) in [
            (0.0, 1),
            (36.1, 185),
            (-33.9, 20),
            (52.5, MIDWINTER),
            (65.0, MIDSUMMER),
            (-60.0, 300),
        ] {
            let sun = sun_at(latitude, day);
            let lit_minutes = sun.irradiance_by_tti().filter(|&irradiance| irradiance > 0.0).count();
            let expected_minutes = 1440.0 * sun.daylight();
            assert!(
                (lit_minutes as f64 - expected_minutes).abs() <= 2.0,
                "latitude {latitude}°, day {day}: {lit_minutes} minutes, not {expected_minutes}"
            );
        }
        // Madison, 43° N, on 13 February: 2·acos(−tan 43° · tan −13.95°)/15° = 10.22 hours.
        let madison_hours = 24.0 * sun_at(43.0, 44).daylight();
        assert!((madison_hours - 10.22).abs() < 0.01, "{madison_hours} hours");
        for latitude in [-80.0, -20.0, 0.0, 45.0] {
            assert!(
                (sun_at(latitude, EQUINOX).daylight() - 0.5).abs() < 1e-9,
                "half the day at latitude {latitude}°"
            );
        }
    }

    #[test]
    fn polar_days_and_nights_last_all_day() {
        for (latitude, day, daylight) in [
            (78.0, MIDSUMMER, 1.0),
            (78.0, MIDWINTER, 0.0),
            (-78.0, MIDWINTER, 1.0),
            (-78.0, MIDSUMMER, 0.0),
            (90.0, MIDSUMMER, 1.0),
            (-90.0, MIDSUMMER, 0.0),
        ] {
            let sun = sun_at(latitude, day);
            assert_eq!(
                sun.daylight().to_bits(),
                f64::to_bits(daylight),
                "latitude {latitude}°, day {day}"
            );
            let lit_minutes = sun.irradiance_by_tti().filter(|&irradiance| irradiance > 0.0).count();
            assert_eq!(
                lit_minutes,
                if daylight > 0.0 { 1440 } else { 0 },
                "latitude {latitude}°, day {day}"
            );
        }
    }

    #[test]
    fn a_day_is_symmetric_around_noon_and_shifted_by_the_start_hour() {
        for sky in [Sky::Vacuum, Sky::Clear] {
            let sun = Sun {
                sky,
                ..sun_at(40.0, 100)
            };
            let day: Vec<f64> = sun.irradiance_by_tti().collect();
            for (morning, evening) in day.iter().zip(day.iter().rev()) {
                assert!((morning - evening).abs() < 1e-12);
            }
            let max_irradiance = day.iter().copied().fold(0.0, f64::max);
            assert!(
                max_irradiance <= sun.noon_irradiance() && max_irradiance > 0.9999 * sun.noon_irradiance(),
                "largest irradiance {max_irradiance}"
            );
            // A run that begins at another hour has the same day, shifted.
            let shifted = Sun { start_hour: 6.0, ..sun };
            for (minute, irradiance) in shifted.irradiance_by_tti().enumerate() {
                assert!((irradiance - day[(minute + 360) % 1440]).abs() < 1e-12);
            }
        }
    }

    /// Compares the daily mean of irradiance with its closed form (Duffie and Beckman, Eq. (1.10.3)), and for a clear
    /// sky with Simpson's rule.
    #[test]
    fn the_daily_mean_equals_the_integral() {
        for (latitude, day) in [(0.0, 81), (36.1, 185), (52.5, 355), (70.0, 172), (-40.0, 10)] {
            let vacuum = sun_at(latitude, day);
            let (phi, delta, omega) = (latitude.to_radians(), vacuum.declination(), PI * vacuum.daylight());
            let closed_form =
                (omega * libm::sin(phi) * libm::sin(delta) + libm::cos(phi) * libm::cos(delta) * libm::sin(omega)) / PI;
            assert!(
                (vacuum.mean_irradiance() - closed_form).abs() < 1e-5,
                "vacuum, latitude {latitude}°, day {day}: {}, not {closed_form}",
                vacuum.mean_irradiance()
            );
            let clear = Sun {
                sky: Sky::Clear,
                ..vacuum
            };
            let (steps, mut sum) = (20_000_u32, 0.0);
            for step in 0..=steps {
                let weight = match step {
                    0 => 1.0,
                    last if last == steps => 1.0,
                    odd if odd % 2 == 1 => 4.0,
                    _ => 2.0,
                };
                let sine = clear.elevation_sine(omega * f64::from(step) / f64::from(steps));
                sum += weight
                    * if sine > 1e-9 {
                        sine * libm::exp(HAURWITZ_ATTENUATION - HAURWITZ_ATTENUATION / sine)
                    } else {
                        0.0
                    };
            }
            let integral = sum * omega / (3.0 * f64::from(steps)) / PI;
            assert!(
                (clear.mean_irradiance() - integral).abs() < 1e-5,
                "clear sky, latitude {latitude}°, day {day}: {}, not {integral}",
                clear.mean_irradiance()
            );
            assert!(clear.mean_irradiance() < vacuum.mean_irradiance());
        }
    }
}
