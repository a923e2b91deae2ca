//! Energy sources (paper Sec. III-A): when energy arrives at a device, and how much.
//!
//! A source is a sequence of arrivals in rising order of TTI that depends on nothing but the scenario, the seed and the
//! device. Nothing is drawn in a TTI without an arrival.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::ids::{DeviceId, Tti};
use crate::rng::{GapTable, Geometric, Purpose, Stream};
use crate::scenario::{Harvest, TraceEnd};
use crate::units::Energy;

/// A source's parameters in the form that a device needs, model time already counted in TTIs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum HarvestSetup {
    /// Independent arrivals.
    Arrivals {
        /// Probability of an arrival in a TTI, `[0, 1]`.
        p: f64,
        /// Energy E_B of an arrival.
        e_b: Energy,
    },
    /// An on/off source: an arrival in each TTI that begins while it is on.
    OnOff {
        /// Probability that it is on in TTI 0, `[0, 1]`.
        on_share: f64,
        /// Probability that it is off one TTI after it was on, `[0, 1]`.
        p_off: f64,
        /// Probability that it is on one TTI after it was off, `[0, 1]`.
        p_on: f64,
        /// Energy E_B of an arrival.
        e_b: Energy,
    },
    /// Recorded energy, from one of the run's traces.
    Trace {
        /// Which of the run's traces.
        trace: u32,
        /// TTIs that one row lasts, ≥ 1.
        ttis_per_row: u64,
        /// What follows the last row.
        end: TraceEnd,
    },
}

impl HarvestSetup {
    /// The setup of `harvest` for TTIs of duration `tau`; `trace` is the trace to read where it reads one.
    pub fn new(harvest: &Harvest, tau: f64, trace: u32) -> Self {
        match *harvest {
            Harvest::Eq5 { lambda, e_b } => Self::Arrivals {
                p: eq5_probability(lambda, tau),
                e_b,
            },
            Harvest::ExpMinusLambda { lambda, e_b } => Self::Arrivals {
                p: libm::exp(-lambda),
                e_b,
            },
            Harvest::Mpp { lambda, e_b, off_mean } => {
                // The continuous-time chain on → off at rate λ, off → on at rate 1/off_mean, looked at every τ.
                let (leave_on, leave_off) = (lambda, 1.0 / off_mean);
                let on_share = leave_off / (leave_on + leave_off);
                let forgotten = -libm::expm1(-(leave_on + leave_off) * tau);
                Self::OnOff {
                    on_share,
                    p_off: (1.0 - on_share) * forgotten,
                    p_on: on_share * forgotten,
                    e_b,
                }
            }
            Harvest::Trace(ref t) => Self::Trace {
                trace,
                ttis_per_row: t.ttis_per_row,
                end: t.end,
            },
        }
    }
}

impl HarvestSetup {
    /// The mean harvest in a TTI, to the nearest micro-unit; `traces` are the run's, energy per TTI by row.
    pub fn mean(&self, traces: &[Arc<Vec<Energy>>]) -> Energy {
        let share = |p: f64, e_b: Energy| Energy::from_micro((p * e_b.micro() as f64).round() as u64);
        match *self {
            Self::Arrivals { p, e_b } => share(p, e_b),
            Self::OnOff { on_share, e_b, .. } => share(on_share, e_b),
            Self::Trace { trace, .. } => {
                let rows = traces.get(trace as usize).map_or(&[][..], |rows| rows);
                let sum: u128 = rows.iter().map(|energy| u128::from(energy.micro())).sum();
                Energy::from_micro((sum / (rows.len() as u128).max(1)) as u64)
            }
        }
    }
}

/// The probability λτ·exp(-λτ) of Eq. (5), at most 1/e.
pub fn eq5_probability(lambda: f64, tau: f64) -> f64 {
    lambda * tau * libm::exp(-lambda * tau)
}

/// What the sources of a run share: recorded energy, and the tables that gaps are drawn from.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    traces: Vec<Arc<Vec<Energy>>>,
    /// By the bits of the probability of an arrival.
    tables: Vec<(u64, Arc<GapTable>)>,
}

impl Sources {
    /// What sources of the kinds `setups` need. `traces` are the run's traces, energy per TTI by row.
    pub fn new<'a>(setups: impl IntoIterator<Item = &'a HarvestSetup>, traces: Vec<Arc<Vec<Energy>>>) -> Self {
        let mut tables: Vec<(u64, Arc<GapTable>)> = Vec::new();
        for setup in setups {
            if let HarvestSetup::Arrivals { p, .. } = *setup
                && tables.iter().all(|&(known, _)| known != p.to_bits())
            {
                tables.push((p.to_bits(), Arc::new(GapTable::new(Geometric::new(p)))));
            }
        }
        Self { traces, tables }
    }

    /// The gaps between arrivals of probability `p`, from a table shared with other devices if there is one.
    fn gaps(&self, p: f64) -> Arc<GapTable> {
        let known = self.tables.iter().find(|(bits, _)| *bits == p.to_bits());
        known.map_or_else(
            || Arc::new(GapTable::new(Geometric::new(p))),
            |(_, table)| Arc::clone(table),
        )
    }
}

/// The arrivals of one device's source.
#[derive(Clone, Debug)]
pub struct HarvestSource {
    next: Tti,
    kind: Kind,
}

#[derive(Clone, Debug)]
enum Kind {
    Arrivals {
        gaps: Arc<GapTable>,
        stream: Stream,
        e_b: Energy,
    },
    OnOff {
        on_run: Geometric,
        off_run: Geometric,
        last_on: Tti,
        stream: Stream,
        e_b: Energy,
    },
    Trace {
        rows: Arc<Vec<Energy>>,
        ttis_per_row: u64,
        end: TraceEnd,
    },
}

impl HarvestSource {
    /// The source of `device`.
    ///
    /// # Panics
    /// If `setup` names a trace that is not among those of `shared`.
    pub fn new(setup: &HarvestSetup, shared: &Sources, seed: u64, device: DeviceId) -> Self {
        let mut stream = Stream::new(seed, Purpose::Harvest, u64::from(device.0));
        match *setup {
            HarvestSetup::Arrivals { p, e_b } => {
                let gaps = shared.gaps(p);
                let next = if e_b == Energy::ZERO {
                    Tti::NEVER
                } else {
                    Tti(gaps.draw(&mut stream)).saturating_sub_one()
                };
                Self {
                    next,
                    kind: Kind::Arrivals { gaps, stream, e_b },
                }
            }
            HarvestSetup::OnOff {
                on_share,
                p_off,
                p_on,
                e_b,
            } => {
                let (on_run, off_run) = (Geometric::new(p_off), Geometric::new(p_on));
                let on_now = stream.unit() < on_share;
                let next = if on_now {
                    Tti::ZERO
                } else {
                    Tti(off_run.draw(&mut stream))
                };
                let last_on = last_of_run(next, on_run, &mut stream);
                Self {
                    next,
                    kind: Kind::OnOff {
                        on_run,
                        off_run,
                        last_on,
                        stream,
                        e_b,
                    },
                }
            }
            HarvestSetup::Trace {
                trace,
                ttis_per_row,
                end,
            } => {
                let rows = Arc::clone(&shared.traces[trace as usize]);
                let next = next_in_trace(&rows, ttis_per_row, end, Tti::ZERO);
                Self {
                    next,
                    kind: Kind::Trace {
                        rows,
                        ttis_per_row,
                        end,
                    },
                }
            }
        }
    }

    /// The TTI of the next arrival; [`Tti::NEVER`] if there is none.
    pub const fn next(&self) -> Tti {
        self.next
    }

    /// Takes the next arrival. Only where there is one.
    #[inline]
    pub fn take(&mut self) -> Energy {
        let now = self.next;
        match &mut self.kind {
            Kind::Arrivals { gaps, stream, e_b } => {
                self.next = now.saturating_add(gaps.draw(stream));
                *e_b
            }
            Kind::OnOff {
                on_run,
                off_run,
                last_on,
                stream,
                e_b,
            } => {
                if now < *last_on {
                    self.next = now + 1;
                } else {
                    self.next = now.saturating_add(off_run.draw(stream)).saturating_add(1);
                    *last_on = last_of_run(self.next, *on_run, stream);
                }
                *e_b
            }
            Kind::Trace {
                rows,
                ttis_per_row,
                end,
            } => {
                let row = now.0 / *ttis_per_row % rows.len() as u64;
                self.next = next_in_trace(rows, *ttis_per_row, *end, now + 1);
                rows[row as usize]
            }
        }
    }
}

impl Tti {
    /// One TTI earlier, except that never stays never.
    const fn saturating_sub_one(self) -> Self {
        if self.0 == u64::MAX { self } else { Self(self.0 - 1) }
    }
}

/// The last TTI of a run of on-TTIs that starts at `first`.
fn last_of_run(first: Tti, on_run: Geometric, stream: &mut Stream) -> Tti {
    first.saturating_add(on_run.draw(stream)).saturating_sub_one()
}

/// The first TTI, not before `from`, whose row is not zero.
fn next_in_trace(rows: &[Energy], ttis_per_row: u64, end: TraceEnd, from: Tti) -> Tti {
    let (first, n) = (from.0 / ttis_per_row, rows.len() as u64);
    let past_last = match end {
        TraceEnd::Cycle => first.saturating_add(n + 1),
        TraceEnd::Stop => n,
    };
    (first..past_last)
        .find(|&row| rows[(row % n) as usize] > Energy::ZERO)
        .map_or(Tti::NEVER, |row| Tti((row * ttis_per_row).max(from.0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const E_B: Energy = Energy::from_micro(5_000_000);

    fn source(harvest: &Harvest, device: u32) -> HarvestSource {
        HarvestSource::new(
            &HarvestSetup::new(harvest, 1.0, 0),
            &Sources::default(),
            11,
            DeviceId(device),
        )
    }

    fn arrivals(source: &mut HarvestSource, ttis: u64) -> u64 {
        let mut n = 0;
        while source.next() < Tti(ttis) {
            let before = source.next();
            assert_eq!(source.take(), E_B);
            assert!(source.next() > before);
            n += 1;
        }
        n
    }

    /// Mean arrivals per TTI over independent devices, and its standard error.
    fn measure(harvest: &Harvest) -> (f64, f64) {
        let (devices, ttis) = (400, 5_000);
        let rates: Vec<f64> = (0..devices)
            .map(|d| arrivals(&mut source(harvest, d), ttis) as f64 / ttis as f64)
            .collect();
        let mean = rates.iter().sum::<f64>() / rates.len() as f64;
        let variance = rates.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / (rates.len() - 1) as f64;
        (mean, (variance / rates.len() as f64).sqrt())
    }

    #[test]
    fn means_follow_the_closed_forms() {
        let lambda = 0.3;
        let cases = [
            (Harvest::Eq5 { lambda, e_b: E_B }, lambda * libm::exp(-lambda)),
            (Harvest::ExpMinusLambda { lambda, e_b: E_B }, libm::exp(-lambda)),
            (
                Harvest::Mpp {
                    lambda,
                    e_b: E_B,
                    off_mean: 7.0,
                },
                (1.0 / lambda) / (1.0 / lambda + 7.0),
            ),
        ];
        for (harvest, expected) in cases {
            let (mean, error) = measure(&harvest);
            assert!(
                (mean - expected).abs() < 3.0 * error,
                "{harvest:?}: {mean} ± {error}, expected {expected}"
            );
        }
    }

    #[test]
    fn on_runs_of_mpp_are_as_long_as_its_chain_says() {
        let (lambda, off_mean) = (0.05, 10.0);
        let mut s = source(
            &Harvest::Mpp {
                lambda,
                e_b: E_B,
                off_mean,
            },
            1,
        );
        let (mut runs, mut length, mut last) = (0u64, 0u64, Tti::NEVER);
        while s.next() < Tti(400_000) {
            let now = s.next();
            s.take();
            length += 1;
            runs += u64::from(last == Tti::NEVER || now != last + 1);
            last = now;
        }
        // A run ends after each of its TTIs with the probability that the sampled chain leaves "on".
        let rate = lambda + 1.0 / off_mean;
        let leave = (1.0 - (1.0 / off_mean) / rate) * (1.0 - libm::exp(-rate));
        let mean = length as f64 / runs as f64;
        assert!(
            (mean * leave - 1.0).abs() < 4.0 / (runs as f64).sqrt(),
            "mean run {mean}, expected {}",
            1.0 / leave
        );
    }

    #[test]
    fn a_trace_cycles_or_stops_and_skips_zeros() {
        let rows = Arc::new([0, 3, 0, 4].map(Energy::from_micro).to_vec());
        let make = |end, ttis_per_row| {
            HarvestSource::new(
                &HarvestSetup::Trace {
                    trace: 0,
                    ttis_per_row,
                    end,
                },
                &Sources::new([], vec![Arc::clone(&rows)]),
                0,
                DeviceId(0),
            )
        };
        let collect = |mut s: HarvestSource, ttis: u64| {
            let mut seen = Vec::new();
            while s.next() < Tti(ttis) {
                let k = s.next().0;
                seen.push((k, s.take().micro()));
            }
            seen
        };
        assert_eq!(collect(make(TraceEnd::Cycle, 1), 9), [(1, 3), (3, 4), (5, 3), (7, 4)]);
        assert_eq!(collect(make(TraceEnd::Stop, 1), 9), [(1, 3), (3, 4)]);
        assert_eq!(collect(make(TraceEnd::Stop, 2), 99), [(2, 3), (3, 3), (6, 4), (7, 4)]);
        let dark = HarvestSource::new(
            &HarvestSetup::Trace {
                trace: 0,
                ttis_per_row: 1,
                end: TraceEnd::Cycle,
            },
            &Sources::new([], vec![Arc::new(vec![Energy::ZERO; 5])]),
            0,
            DeviceId(0),
        );
        assert_eq!(dark.next(), Tti::NEVER);
    }
}
