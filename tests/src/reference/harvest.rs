//! Energy arrivals of the reference, drawn TTI by TTI from the random stream of the device.
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
        /// TTI of the next arrival.
        next: u64,
        e_b: u64,
    },
    /// Alternating on and off periods.
    OnOff {
        stream: Stream,
        on_law: Geometric,
        off_law: Geometric,
        is_on: bool,
        /// TTIs until the period ends.
        left: u64,
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
        day: Vec<f64>,
        /// Remaining sum of −ln(1 − p) until the next arrival.
        left: f64,
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
    /// Creates the source of device `id`, the `nth` of its class.
    pub(super) fn new(harvest: &Harvest, tau: f64, seed: u64, id: u64, nth: usize) -> Self {
        let stream = Stream::new(seed, Purpose::Harvest, id);
        match harvest {
            Harvest::Eq5(Arrivals { lambda, e_b }) => {
                let rate = lambda * tau;
                arrivals(stream, rate * libm::exp(-rate), e_b.micro())
            }
            Harvest::ExpMinusLambda(Arrivals { lambda, e_b }) => arrivals(stream, libm::exp(-lambda), e_b.micro()),
            Harvest::Mpp(OnOff { lambda, e_b, off_mean }) => on_off(stream, *lambda, 1.0 / off_mean, tau, e_b.micro()),
            Harvest::Diurnal(diurnal) => sunny(stream, diurnal, tau),
            Harvest::Trace(trace) => recorded(trace, nth),
        }
    }

    /// Returns the source as the base station knows it: `mean` in each TTI for recorded energy, and arrivals at any
    /// time for a solar source with unknown time of day.
    pub(super) fn with_known_harvest(self, mean: u64) -> Self {
        match self {
            Self::Recorded { .. } => Self::Recorded {
                rows: vec![mean],
                ttis_per_row: 1,
                repeats: true,
            },
            Self::Sunny {
                fresh_stream,
                is_day_known: false,
                day,
                e_b,
                ..
            } => arrivals(fresh_stream, day.iter().sum::<f64>() / day.len() as f64, e_b),
            other @ (Self::Arrivals { .. } | Self::OnOff { .. } | Self::Sunny { .. }) => other,
        }
    }

    /// Returns the micro-units that arrive in TTI `k`.
    pub(super) fn arriving(&mut self, k: u64) -> u64 {
        match self {
            Self::Arrivals {
                stream,
                gap_law,
                next,
                e_b,
            } => {
                if k != *next {
                    return 0;
                }
                *next = k.saturating_add(gap_law.draw(stream));
                *e_b
            }
            Self::OnOff {
                stream,
                on_law,
                off_law,
                is_on,
                left,
                e_b,
            } => {
                if *left == 0 {
                    *is_on = !*is_on;
                    *left = if *is_on {
                        on_law.draw(stream)
                    } else {
                        off_law.draw(stream)
                    };
                }
                *left -= 1;
                if *is_on { *e_b } else { 0 }
            }
            Self::Sunny {
                stream, day, left, e_b, ..
            } => {
                let hazard = -libm::log1p(-day[k as usize % day.len()]);
                if *left >= hazard {
                    *left -= hazard;
                    return 0;
                }
                *left = -libm::log1p(-stream.unit());
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

/// Returns the mean harvest per TTI of the `nth` device of its class, whole micro-units.
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
            let day = arrival_probabilities(diurnal, tau);
            expected_energy(day.iter().sum::<f64>() / day.len() as f64, diurnal.arrivals.e_b.micro())
        }
        Harvest::Trace(trace) => {
            let column = &trace.values[column(trace, nth)];
            let sum: u128 = column.iter().map(|energy| u128::from(energy.micro())).sum();
            (sum / column.len() as u128) as u64
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
    let sums: Vec<u64> = std::iter::once(0).chain(sums).collect();
    let energy_by_tti = sums.windows(2).map(|pair| pair[1] - pair[0]).collect();
    (diurnal.known == DayKnowledge::Course).then_some(energy_by_tti)
}

/// Whether the sun is up in the `k`th TTI.
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
    let day: Vec<f64> = (0..u64::from(sun.ttis_per_day)).map(|k| irradiance(sun, k)).collect();
    let reference_irradiance = match reference {
        IrradianceReference::DailyMean => day.iter().sum::<f64>() / day.len() as f64,
        IrradianceReference::Zenith => 1.0,
    };
    day.into_iter()
        .map(|irradiance| p / reference_irradiance * irradiance)
        .collect()
}

/// Returns the irradiance in the middle of the `k`th TTI, 1 with the sun in the zenith. It is the dot product of the
/// directions of the sun and of the observer's zenith.
fn irradiance(sun: &Sun, k: u64) -> f64 {
    // Solar time in the middle of the TTI.
    let hours = sun.start_hour + 24.0 * ((k % u64::from(sun.ttis_per_day)) as f64 + 0.5) / f64::from(sun.ttis_per_day);
    let (latitude, hour_angle) = (sun.latitude * PI / 180.0, (hours - 12.0) * PI / 12.0);
    // Cooper's formula.
    let declination = 23.45 * PI / 180.0 * libm::sin(2.0 * PI * f64::from(284 + sun.day_of_year) / 365.0);
    let zenith = [libm::cos(latitude), 0.0, libm::sin(latitude)];
    let sun_direction = [
        libm::cos(declination) * libm::cos(hour_angle),
        libm::cos(declination) * libm::sin(hour_angle),
        libm::sin(declination),
    ];
    let sine: f64 = zenith.iter().zip(sun_direction).map(|(a, b)| a * b).sum();
    match sun.sky {
        _ if sine <= 0.0 => 0.0,
        Sky::Vacuum => sine,
        // Normalised to an irradiance of 1 in the zenith.
        Sky::Clear => sine * libm::exp(-0.059 / sine) / libm::exp(-0.059),
    }
}

fn sunny(mut stream: Stream, diurnal: &Diurnal, tau: f64) -> ReferenceSource {
    let e_b = diurnal.arrivals.e_b.micro();
    let mut day = arrival_probabilities(diurnal, tau);
    if e_b == 0 {
        day.fill(0.0);
    }
    let fresh_stream = stream.clone();
    let left = -libm::log1p(-stream.unit());
    ReferenceSource::Sunny {
        fresh_stream,
        stream,
        is_day_known: diurnal.known == DayKnowledge::Course,
        day,
        left,
        e_b,
    }
}

fn arrivals(mut stream: Stream, p: f64, e_b: u64) -> ReferenceSource {
    let gap_law = Geometric::new(if e_b == 0 { 0.0 } else { p });
    // A gap of 1 means an arrival in TTI 0.
    let next = gap_law.draw(&mut stream) - 1;
    ReferenceSource::Arrivals {
        stream,
        gap_law,
        next,
        e_b,
    }
}

/// Creates a source that leaves "on" at rate `stop` and "off" at rate `start`, sampled every `tau`.
fn on_off(mut stream: Stream, stop: f64, start: f64, tau: f64, e_b: u64) -> ReferenceSource {
    let total_rate = stop + start;
    // Share of the equilibrium that is reached in a TTI.
    let relaxation = -libm::expm1(-total_rate * tau);
    let on_law = Geometric::new(stop / total_rate * relaxation);
    let off_law = Geometric::new(start / total_rate * relaxation);
    let is_on = stream.unit() < start / total_rate;
    let left = if is_on { on_law } else { off_law }.draw(&mut stream);
    ReferenceSource::OnOff {
        stream,
        on_law,
        off_law,
        is_on,
        left,
        e_b,
    }
}

/// Returns the trace column of the `nth` device of a class.
fn column(trace: &HarvestTrace, nth: usize) -> usize {
    match &trace.columns {
        TraceColumns::Shared(_) => 0,
        TraceColumns::PerDevice(names) => nth % names.len(),
    }
}

fn recorded(trace: &HarvestTrace, nth: usize) -> ReferenceSource {
    ReferenceSource::Recorded {
        rows: trace.values[column(trace, nth)]
            .iter()
            .map(|energy| energy.micro())
            .collect(),
        ttis_per_row: trace.ttis_per_row,
        repeats: trace.end == TraceEnd::Cycle,
    }
}
