//! Energy arrivals, drawn TTI by TTI.

use reveille_common::harvest::{Arrivals, Mpp};
use reveille_common::rng::{Geometric, Purpose, Stream};
use reveille_common::scenario::{Harvest, Trace, TraceColumns, TraceEnd};

/// One device's source. [`Source::arriving`] is asked once for each TTI, in order.
#[derive(Clone, Debug)]
pub(super) enum Source {
    /// An arrival now and then.
    Arrivals {
        stream: Stream,
        law: Geometric,
        next: u64,
        e_b: u64,
    },
    /// On for a run of TTIs, off for a run, and so on.
    OnOff {
        stream: Stream,
        on_run: Geometric,
        off_run: Geometric,
        on: bool,
        left: u64,
        e_b: u64,
    },
    /// Rows of a file.
    Recorded {
        rows: Vec<u64>,
        ttis_per_row: u64,
        again: bool,
    },
}

impl Source {
    /// The source of device `id`, the `nth` of its class.
    pub(super) fn new(harvest: &Harvest, tau: f64, seed: u64, id: u64, nth: usize) -> Self {
        let stream = Stream::new(seed, Purpose::Harvest, id);
        match harvest {
            Harvest::Eq5(Arrivals { lambda, e_b }) => {
                let rate = lambda * tau;
                arrivals(stream, rate * libm::exp(-rate), e_b.micro())
            }
            Harvest::ExpMinusLambda(Arrivals { lambda, e_b }) => arrivals(stream, libm::exp(-lambda), e_b.micro()),
            Harvest::Mpp(Mpp { lambda, e_b, off_mean }) => on_off(stream, *lambda, 1.0 / off_mean, tau, e_b.micro()),
            Harvest::Trace(trace) => recorded(trace, nth),
        }
    }

    /// Of recorded energy: `mean` in each TTI instead.
    pub(super) fn by_its_mean(self, mean: u64) -> Self {
        match self {
            Self::Recorded { .. } => Self::Recorded {
                rows: vec![mean],
                ttis_per_row: 1,
                again: true,
            },
            other @ (Self::Arrivals { .. } | Self::OnOff { .. }) => other,
        }
    }

    /// Micro-units that arrive in TTI `k`.
    pub(super) fn arriving(&mut self, k: u64) -> u64 {
        match self {
            Self::Arrivals { stream, law, next, e_b } => {
                if k != *next {
                    return 0;
                }
                *next = k.saturating_add(law.draw(stream));
                *e_b
            }
            Self::OnOff {
                stream,
                on_run,
                off_run,
                on,
                left,
                e_b,
            } => {
                if *left == 0 {
                    *on = !*on;
                    *left = if *on { on_run.draw(stream) } else { off_run.draw(stream) };
                }
                *left -= 1;
                if *on { *e_b } else { 0 }
            }
            Self::Recorded {
                rows,
                ttis_per_row,
                again,
            } => {
                let row = (k / *ttis_per_row) as usize;
                if *again {
                    rows[row % rows.len()]
                } else {
                    rows.get(row).copied().unwrap_or(0)
                }
            }
        }
    }
}

/// The mean harvest in a TTI of the `nth` device of its class, whole micro-units.
pub(super) fn mean(harvest: &Harvest, tau: f64, nth: usize) -> u64 {
    let share_of = |share: f64, e_b: u64| (share * e_b as f64).round() as u64;
    match harvest {
        Harvest::Eq5(Arrivals { lambda, e_b }) => {
            let rate = lambda * tau;
            share_of(rate * libm::exp(-rate), e_b.micro())
        }
        Harvest::ExpMinusLambda(Arrivals { lambda, e_b }) => share_of(libm::exp(-lambda), e_b.micro()),
        Harvest::Mpp(Mpp { lambda, e_b, off_mean }) => {
            let back = 1.0 / off_mean;
            share_of(back / (lambda + back), e_b.micro())
        }
        Harvest::Trace(trace) => {
            let column = &trace.values[column(trace, nth)];
            let sum: u64 = column.iter().map(|energy| energy.micro()).sum();
            sum / column.len() as u64
        }
    }
}

fn arrivals(mut stream: Stream, p: f64, e_b: u64) -> Source {
    let law = Geometric::new(if e_b == 0 { 0.0 } else { p });
    let next = law.draw(&mut stream) - 1;
    Source::Arrivals { stream, law, next, e_b }
}

/// A source that leaves "on" at rate `stop` and "off" at rate `start`, looked at every `tau`.
fn on_off(mut stream: Stream, stop: f64, start: f64, tau: f64, e_b: u64) -> Source {
    let both = stop + start;
    let moved = -libm::expm1(-both * tau);
    let on_run = Geometric::new(stop / both * moved);
    let off_run = Geometric::new(start / both * moved);
    let on = stream.unit() < start / both;
    let left = if on { on_run } else { off_run }.draw(&mut stream);
    Source::OnOff {
        stream,
        on_run,
        off_run,
        on,
        left,
        e_b,
    }
}

/// The column that the `nth` device of a class reads.
fn column(trace: &Trace, nth: usize) -> usize {
    match &trace.columns {
        TraceColumns::Shared(_) => 0,
        TraceColumns::PerDevice(names) => nth % names.len(),
    }
}

fn recorded(trace: &Trace, nth: usize) -> Source {
    Source::Recorded {
        rows: trace.values[column(trace, nth)]
            .iter()
            .map(|energy| energy.micro())
            .collect(),
        ttis_per_row: trace.ttis_per_row,
        again: trace.end == TraceEnd::Cycle,
    }
}
