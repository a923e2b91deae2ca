//! Energy arrivals of the reference, drawn TTI by TTI from the random stream of the device, and the base station's
//! expectation of them, for `world.rs`.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use std::f64::consts::PI;

use reveille_common::harvest::sun::{Sky, Sun};
use reveille_common::harvest::{Arrivals, DayKnowledge, Diurnal, IrradianceReference, OnOff};
use reveille_common::rng::{Geometric, Purpose, Stream};
use reveille_common::scenario::{Harvest, HarvestTrace, TraceColumns, TraceEnd};

/// Energy source of one device, micro-units. Call [`ReferenceSource::arriving`] once for each TTI, in order.
#[derive(Clone, Debug)]
pub(super) enum ReferenceSource {
    /// Arrivals with random gaps.
    Arrivals {
        stream: Stream,
        gap_law: Geometric,
        next_arrival: u64,
        /// Energy of an arrival.
        e_b: u64,
    },
    /// Alternating on and off periods.
    OnOff {
        stream: Stream,
        on_law: Geometric,
        off_law: Geometric,
        is_on: bool,
        /// TTIs until the period ends.
        remaining_ttis: u64,
        /// Energy of each TTI in an on period.
        e_b: u64,
    },
    /// Arrival probability proportional to irradiance.
    Sunny {
        /// State of the stream before the first draw.
        fresh_stream: Stream,
        stream: Stream,
        /// Whether the base station knows the time of day.
        is_day_known: bool,
        /// Probability of an arrival in each TTI of a day.
        probability_by_tti: Vec<f64>,
        /// Remaining sum of −ln(1 − p) until the next arrival.
        remaining_hazard: f64,
        /// Energy of an arrival.
        e_b: u64,
    },
    /// Recorded rows of a file.
    Recorded {
        /// Energy per TTI in each row.
        rows: Vec<u64>,
        ttis_per_row: u64,
        /// Whether the rows repeat after the last one; otherwise nothing arrives.
        repeats: bool,
    },
}

impl ReferenceSource {
    /// Creates the source of device `id`, the `nth` of its class, from 0.
    pub(super) fn new(harvest: &Harvest, tau: f64, seed: u64, id: u64, nth: usize) -> Self {
        let stream = Stream::new(seed, Purpose::Harvest, id);
        match harvest {
            Harvest::Eq5(Arrivals { lambda, e_b }) => {
                let rate = lambda * tau;
                arrivals(stream, rate * libm::exp(-rate), e_b.micro())
            }
            Harvest::ExpMinusLambda(Arrivals { lambda, e_b }) => arrivals(stream, libm::exp(-lambda), e_b.micro()),
            Harvest::Mpp(settings) => on_off(stream, settings, tau),
            Harvest::Diurnal(diurnal) => sunny(stream, diurnal, tau),
            Harvest::Trace(trace) => recorded(trace, nth),
        }
    }

    /// Returns the source as the base station knows it: `mean_harvest` in each TTI for recorded energy, and arrivals at
    /// any time for a solar source with unknown time of day.
    pub(super) fn with_known_harvest(self, mean_harvest: u64) -> Self {
        match self {
            Self::Recorded { .. } => Self::Recorded {
                rows: vec![mean_harvest],
                ttis_per_row: 1,
                repeats: true,
            },
            Self::Sunny {
                fresh_stream,
                is_day_known: false,
                probability_by_tti,
                e_b,
                ..
            } => arrivals(fresh_stream, mean(&probability_by_tti), e_b),
            other @ (Self::Arrivals { .. } | Self::OnOff { .. } | Self::Sunny { .. }) => other,
        }
    }

    /// Returns the micro-units that arrive in TTI `k`. Call once for each TTI, in order.
    pub(super) fn arriving(&mut self, k: u64) -> u64 {
        match self {
            Self::Arrivals {
                stream,
                gap_law,
                next_arrival,
                e_b,
            } => {
                if k != *next_arrival {
                    return 0;
                }
                *next_arrival = k.saturating_add(gap_law.draw(stream));
                *e_b
            }
            Self::OnOff {
                stream,
                on_law,
                off_law,
                is_on,
                remaining_ttis,
                e_b,
            } => {
                if *remaining_ttis == 0 {
                    *is_on = !*is_on;
                    *remaining_ttis = if *is_on {
                        on_law.draw(stream)
                    } else {
                        off_law.draw(stream)
                    };
                }
                *remaining_ttis -= 1;
                if *is_on { *e_b } else { 0 }
            }
            Self::Sunny {
                stream,
                probability_by_tti,
                remaining_hazard,
                e_b,
                ..
            } => {
                let hazard = -libm::log1p(-probability_by_tti[k as usize % probability_by_tti.len()]);
                if *remaining_hazard >= hazard {
                    *remaining_hazard -= hazard;
                    return 0;
                }
                *remaining_hazard = -libm::log1p(-stream.unit());
                *e_b
            }
            Self::Recorded {
                rows,
                ttis_per_row,
                repeats,
            } => {
                let row = (k / *ttis_per_row) as usize;
                if *repeats {
                    rows[row % rows.len()]
                } else {
                    rows.get(row).copied().unwrap_or(0)
                }
            }
        }
    }
}

/// Returns the base station's mean harvest per TTI of the `nth` device of its class, from 0, in whole micro-units.
pub(super) fn mean_harvest(harvest: &Harvest, tau: f64, nth: usize) -> u64 {
    let expected_energy = |probability: f64, e_b: u64| (probability * e_b as f64).round() as u64;
    match harvest {
        Harvest::Eq5(Arrivals { lambda, e_b }) => {
            let rate = lambda * tau;
            expected_energy(rate * libm::exp(-rate), e_b.micro())
        }
        Harvest::ExpMinusLambda(Arrivals { lambda, e_b }) => expected_energy(libm::exp(-lambda), e_b.micro()),
        Harvest::Mpp(OnOff { lambda, e_b, off_mean }) => {
            let on_rate = 1.0 / off_mean;
            expected_energy(on_rate / (lambda + on_rate), e_b.micro())
        }
        Harvest::Diurnal(diurnal) => {
            expected_energy(mean(&arrival_probabilities(diurnal, tau)), diurnal.arrivals.e_b.micro())
        }
        Harvest::Trace(trace) => {
            let rows = &trace.values[column_index(trace, nth)];
            let sum: u128 = rows.iter().map(|energy| u128::from(energy.micro())).sum();
            (sum / rows.len() as u128) as u64
        }
    }
}

/// Returns the expected harvest in each TTI of a day, whole micro-units; `None` if the base station knows only a mean.
pub(super) fn expected_day(harvest: &Harvest, tau: f64) -> Option<Vec<u64>> {
    let Harvest::Diurnal(diurnal) = harvest else {
        return None;
    };
    let mut expected_arrivals = 0.0;
    // Differences of rounded sums, so that a day adds up to its rounded total.
    let sums = arrival_probabilities(diurnal, tau).into_iter().map(|p| {
        expected_arrivals += p;
        (expected_arrivals * diurnal.arrivals.e_b.micro() as f64).round() as u64
    });
    let sums_from_zero: Vec<u64> = std::iter::once(0).chain(sums).collect();
    let energy_by_tti = sums_from_zero.windows(2).map(|pair| pair[1] - pair[0]).collect();
    (diurnal.known == DayKnowledge::Course).then_some(energy_by_tti)
}

/// Whether the sun is up in TTI `k`; true for a harvest without sun.
pub(super) fn is_day(harvest: &Harvest, k: u64) -> bool {
    let Harvest::Diurnal(Diurnal { sun, .. }) = harvest else {
        return true;
    };
    irradiance(sun, k) > 0.0
}

/// Probability of an arrival in each TTI of a day.
fn arrival_probabilities(diurnal: &Diurnal, tau: f64) -> Vec<f64> {
    let Diurnal {
        arrivals,
        sun,
        reference,
        ..
    } = diurnal;
    let rate = arrivals.lambda * tau;
    let p = rate * libm::exp(-rate);
    let irradiances: Vec<f64> = (0..u64::from(sun.ttis_per_day)).map(|k| irradiance(sun, k)).collect();
    let reference_irradiance = match reference {
        IrradianceReference::DailyMean => mean(&irradiances),
        IrradianceReference::Zenith => 1.0,
    };
    irradiances
        .into_iter()
        .map(|irradiance| p / reference_irradiance * irradiance)
        .collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Returns the irradiance in the middle of TTI `k`, 1 with the sun in the zenith. It is the dot product of the
/// directions of the sun and of the observer's zenith.
fn irradiance(sun: &Sun, k: u64) -> f64 {
    // Solar time in the middle of the TTI.
    let hours = sun.start_hour + 24.0 * ((k % u64::from(sun.ttis_per_day)) as f64 + 0.5) / f64::from(sun.ttis_per_day);
    let (latitude, hour_angle) = (sun.latitude * PI / 180.0, (hours - 12.0) * PI / 12.0);
    // Cooper's formula, in the constants of `common/src/harvest/sun.rs`.
    let declination = 23.45 * PI / 180.0 * libm::sin(2.0 * PI * f64::from(284 + sun.day_of_year) / 365.0);
    let zenith = [libm::cos(latitude), 0.0, libm::sin(latitude)];
    let sun_direction = [
        libm::cos(declination) * libm::cos(hour_angle),
        libm::cos(declination) * libm::sin(hour_angle),
        libm::sin(declination),
    ];
    let sine_of_elevation: f64 = zenith.iter().zip(sun_direction).map(|(a, b)| a * b).sum();
    match sun.sky {
        _ if sine_of_elevation <= 0.0 => 0.0,
        Sky::Vacuum => sine_of_elevation,
        // Haurwitz's model, normalised to an irradiance of 1 in the zenith.
        Sky::Clear => sine_of_elevation * libm::exp(-0.059 / sine_of_elevation) / libm::exp(-0.059),
    }
}

fn sunny(mut stream: Stream, diurnal: &Diurnal, tau: f64) -> ReferenceSource {
    let e_b = diurnal.arrivals.e_b.micro();
    let mut probability_by_tti = arrival_probabilities(diurnal, tau);
    // Like the emulator, draw no arrivals that have no energy.
    if e_b == 0 {
        probability_by_tti.fill(0.0);
    }
    let fresh_stream = stream.clone();
    let remaining_hazard = -libm::log1p(-stream.unit());
    ReferenceSource::Sunny {
        fresh_stream,
        stream,
        is_day_known: diurnal.known == DayKnowledge::Course,
        probability_by_tti,
        remaining_hazard,
        e_b,
    }
}

/// Creates a source with an arrival in each TTI with probability `p`.
fn arrivals(mut stream: Stream, p: f64, e_b: u64) -> ReferenceSource {
    // Like the emulator, draw no arrivals that have no energy.
    let gap_law = Geometric::new(if e_b == 0 { 0.0 } else { p });
    // A gap of 1 means an arrival in TTI 0.
    let next_arrival = gap_law.draw(&mut stream) - 1;
    ReferenceSource::Arrivals {
        stream,
        gap_law,
        next_arrival,
        e_b,
    }
}

/// Creates a source that leaves "on" at rate λ and "off" at rate 1/`off_mean`, sampled every `tau`.
fn on_off(mut stream: Stream, settings: &OnOff, tau: f64) -> ReferenceSource {
    let (stop_rate, start_rate) = (settings.lambda, 1.0 / settings.off_mean);
    let total_rate = stop_rate + start_rate;
    // Share of the equilibrium that is reached in a TTI.
    let relaxation = -libm::expm1(-total_rate * tau);
    let on_law = Geometric::new(stop_rate / total_rate * relaxation);
    let off_law = Geometric::new(start_rate / total_rate * relaxation);
    let is_on = stream.unit() < start_rate / total_rate;
    let remaining_ttis = if is_on { on_law } else { off_law }.draw(&mut stream);
    ReferenceSource::OnOff {
        stream,
        on_law,
        off_law,
        is_on,
        remaining_ttis,
        e_b: settings.e_b.micro(),
    }
}

/// Returns the index of the trace column of the `nth` device of a class, from 0.
fn column_index(trace: &HarvestTrace, nth: usize) -> usize {
    match &trace.columns {
        TraceColumns::Shared(_) => 0,
        TraceColumns::PerDevice(names) => nth % names.len(),
    }
}

fn recorded(trace: &HarvestTrace, nth: usize) -> ReferenceSource {
    ReferenceSource::Recorded {
        rows: trace.values[column_index(trace, nth)]
            .iter()
            .map(|energy| energy.micro())
            .collect(),
        ttis_per_row: trace.ttis_per_row,
        repeats: trace.end == TraceEnd::Cycle,
    }
}
