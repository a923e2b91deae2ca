//! Energy sources (paper Sec. III-A): the times and amounts of energy that arrives at a device.
//!
//! A source is a sequence of arrivals by ascending TTI. It depends only on the scenario, the seed and the device.
//! Digests depend on the order of draws. [`Harvest`] is the declared source of a class, [`HarvestSetup`] its form in
//! the wire format (`WIRE_VERSION`), [`HarvestSource`] the arrivals that a device draws.
//!
//! Each kind of source has a file with its fields, its wire format and its draws; this module has an arm for each.
//! `tests/src/reference/harvest.rs` draws the same arrivals TTI by TTI, so change both. A test compares the words and
//! doc comments of choices and fields with `docs/scenario.md`, here and in the other files.

mod arrivals;
mod day_profile;
mod diurnal;
mod gap;
mod on_off;
mod panel;
mod shared_tables;
pub mod sun;
#[cfg(test)]
pub(crate) mod testing;
mod trace;

use std::sync::Arc;

use serde::{Deserialize, Serialize};

pub use self::arrivals::{Arrivals, ArrivalsSetup};
pub use self::day_profile::DayProfile;
pub use self::diurnal::{DayKnowledge, Diurnal, DiurnalSetup, IrradianceReference};
pub use self::gap::HarvestGap;
pub use self::on_off::{OnOff, OnOffSetup};
pub use self::panel::Panel;
pub use self::shared_tables::SharedSourceData;
pub use self::trace::{HarvestTrace, TraceColumns, TraceEnd, TraceQuantity, TraceSetup};

use self::arrivals::ArrivalsSource;
use self::diurnal::DiurnalSource;
use self::on_off::OnOffSource;
use self::trace::TraceSource;
use crate::declare::{FieldReader, FieldSink, ScenarioError, Section, Visit, choice, choices};
use crate::ids::{DeviceId, Tti};
use crate::rng::{Purpose, Stream};
use crate::units::{Energy, MICRO_PER_UNIT};

const SECONDS_PER_DAY: f64 = 86_400.0;

choices! {
    /// Kind of a device's energy source.
    pub enum HarvestKind {
        /// An arrival in a TTI with probability λτ·exp(-λτ), Eq. (5).
        Eq5 = "eq5",
        /// An arrival in a TTI with probability exp(-λ), the alternative reading in Sec. III-B.
        ExpMinusLambda = "exp-minus-lambda",
        /// On/off source with exponential durations, as described in the text of Sec. III-A.
        Mpp = "mpp",
        /// Diurnal source: the probability of an arrival in a TTI follows the sun at a given place and day of the year.
        Diurnal = "diurnal",
        /// Recorded energy from a file.
        Trace = "trace",
    }
}

crate::declare! {
    /// Energy source of a device (paper Sec. III-A).
    #[derive(Clone, Copy, Debug)]
    struct Settings in "harvest" {
        /// Kind of the energy source.
        kind: HarvestKind = choice::<HarvestKind>("eq5").source("Eq. (5)"),
    }
}

/// An energy source (paper Sec. III-A). λ is per unit of model time and at least 0; `E_B` is the energy of one arrival.
#[derive(Clone, Debug, PartialEq)]
pub enum Harvest {
    /// See [`HarvestKind::Eq5`].
    Eq5(Arrivals),
    /// See [`HarvestKind::ExpMinusLambda`].
    ExpMinusLambda(Arrivals),
    /// See [`HarvestKind::Mpp`].
    Mpp(OnOff),
    /// See [`HarvestKind::Diurnal`].
    Diurnal(Diurnal),
    /// See [`HarvestKind::Trace`].
    Trace(HarvestTrace),
}

impl Harvest {
    /// The fields of all kinds.
    pub(crate) const SECTIONS: [&'static Section; 7] = {
        let [quantity, trace, panel] = HarvestTrace::SECTIONS;
        let (arrivals, mpp, diurnal) = (Arrivals::SECTION, OnOff::SECTION, Diurnal::SECTION);
        [Settings::SECTION, arrivals, mpp, diurnal, quantity, trace, panel]
    };

    /// Builds the source in `reader`, for a run of `ttis` TTIs of duration `tau`.
    ///
    /// # Errors
    /// If a value is not allowed, or a trace cannot be read.
    pub fn from_fields(reader: &FieldReader<'_>, tau: f64, ttis: u64) -> Result<Self, ScenarioError> {
        Ok(match Settings::read(reader)?.kind {
            HarvestKind::Eq5 => Self::Eq5(Arrivals::read(reader)?),
            HarvestKind::ExpMinusLambda => Self::ExpMinusLambda(Arrivals::read(reader)?),
            HarvestKind::Mpp => Self::Mpp(OnOff::from_fields(reader, tau)?),
            HarvestKind::Diurnal => Self::Diurnal(Diurnal::from_fields(reader, tau)?),
            HarvestKind::Trace => Self::Trace(HarvestTrace::from_fields(reader, ttis)?),
        })
    }

    /// The kind of the source.
    pub const fn kind(&self) -> HarvestKind {
        match self {
            Self::Eq5(_) => HarvestKind::Eq5,
            Self::ExpMinusLambda(_) => HarvestKind::ExpMinusLambda,
            Self::Mpp(_) => HarvestKind::Mpp,
            Self::Diurnal(_) => HarvestKind::Diurnal,
            Self::Trace(_) => HarvestKind::Trace,
        }
    }

    /// Passes every field to `sink`. The scenario hash depends on the order.
    pub fn visit(&self, sink: &mut dyn FieldSink) {
        Settings { kind: self.kind() }.visit(sink);
        match self {
            Self::Eq5(arrivals) | Self::ExpMinusLambda(arrivals) => arrivals.visit(sink),
            Self::Mpp(mpp) => mpp.visit(sink),
            Self::Diurnal(diurnal) => diurnal.visit(sink),
            Self::Trace(trace) => trace.visit(sink),
        }
    }

    /// The setup for a device, for TTIs of duration `tau`; `trace` is the index of the trace to read, if it reads one.
    pub fn setup(&self, tau: f64, trace: u32) -> HarvestSetup {
        match self {
            Self::Eq5(arrivals) => HarvestSetup::Arrivals(arrivals.eq5(tau)),
            Self::ExpMinusLambda(arrivals) => HarvestSetup::Arrivals(arrivals.exp_minus_lambda()),
            Self::Mpp(mpp) => HarvestSetup::OnOff(mpp.setup(tau)),
            Self::Diurnal(diurnal) => HarvestSetup::Diurnal(diurnal.setup(tau)),
            Self::Trace(recorded) => HarvestSetup::Trace(recorded.setup(trace)),
        }
    }

    /// The duration of a TTI in seconds, for sources that define it.
    pub fn tti_seconds(&self) -> Option<f64> {
        match self {
            Self::Diurnal(diurnal) => Some(SECONDS_PER_DAY / f64::from(diurnal.sun.ttis_per_day)),
            Self::Trace(trace) => trace.panel.map(|panel| panel.tti_seconds),
            Self::Eq5(_) | Self::ExpMinusLambda(_) | Self::Mpp(_) => None,
        }
    }

    /// The recorded energy of the source, energy per TTI by column and row.
    pub fn trace_columns(&self) -> &[Vec<Energy>] {
        match self {
            Self::Trace(trace) => &trace.values,
            Self::Eq5(_) | Self::ExpMinusLambda(_) | Self::Mpp(_) | Self::Diurnal(_) => &[],
        }
    }

    /// The index in [`Self::trace_columns`] for the `nth` device of a class, counted from 0; 0 if it reads none.
    pub(crate) fn column_index(&self, nth: u32) -> u32 {
        match self {
            Self::Trace(trace) => trace.column_index(nth),
            Self::Eq5(_) | Self::ExpMinusLambda(_) | Self::Mpp(_) | Self::Diurnal(_) => 0,
        }
    }

    /// The mean harvest in a TTI of duration `tau`; for a trace, the mean of its first column.
    pub fn mean(&self, tau: f64) -> Energy {
        // The setup reads trace 0 of the list that `mean` receives, which holds only the first column.
        let first_column = self.trace_columns().first().cloned().map(Arc::new);
        self.setup(tau, 0).mean(first_column.as_slice())
    }

    /// The largest energy in a TTI.
    pub fn max_per_tti(&self) -> Energy {
        match self {
            Self::Eq5(Arrivals { e_b, .. })
            | Self::ExpMinusLambda(Arrivals { e_b, .. })
            | Self::Mpp(OnOff { e_b, .. })
            | Self::Diurnal(Diurnal {
                arrivals: Arrivals { e_b, .. },
                ..
            }) => *e_b,
            Self::Trace(trace) => trace.max_per_tti(),
        }
    }

    /// λ and `E_B`, for sources that have them and are the same in all TTIs.
    pub const fn arrivals(&self) -> Option<Arrivals> {
        match self {
            Self::Eq5(arrivals) | Self::ExpMinusLambda(arrivals) => Some(*arrivals),
            Self::Mpp(OnOff { lambda, e_b, .. }) => Some(Arrivals {
                lambda: *lambda,
                e_b: *e_b,
            }),
            Self::Diurnal(_) | Self::Trace(_) => None,
        }
    }

    /// The probability of an arrival in a TTI of duration `tau`, for sources with independent arrivals that are equally
    /// likely in all TTIs.
    pub fn independent_probability(&self, tau: f64) -> Option<f64> {
        match self.setup(tau, 0) {
            HarvestSetup::Arrivals(ArrivalsSetup { p, .. }) => Some(p),
            HarvestSetup::OnOff(_) | HarvestSetup::Diurnal(_) | HarvestSetup::Trace(_) => None,
        }
    }
}

/// The parameters of a source for a device, with model time already converted to TTIs. The order of variants and
/// fields is part of the wire format.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum HarvestSetup {
    /// Independent arrivals.
    Arrivals(ArrivalsSetup),
    /// An on/off source.
    OnOff(OnOffSetup),
    /// Recorded energy.
    Trace(TraceSetup),
    /// A diurnal source.
    Diurnal(DiurnalSetup),
}

impl HarvestSetup {
    /// The mean harvest per TTI as a base station knows it, rounded to micro-units (down for a trace, whose end it does
    /// not know). `traces` are the run's, energy per TTI by row.
    pub fn mean(&self, traces: &[Arc<Vec<Energy>>]) -> Energy {
        match self {
            Self::Arrivals(arrivals) => arrivals.mean(),
            Self::OnOff(on_off) => on_off.mean(),
            Self::Trace(trace) => trace.mean(traces),
            Self::Diurnal(diurnal) => diurnal.mean(),
        }
    }

    /// The expected harvest per TTI, in units, over the first `ttis` (≥ 1) TTIs of a run; exact for a trace. `traces`
    /// are the run's, energy per TTI by row.
    pub fn mean_over_run(&self, traces: &[Arc<Vec<Energy>>], ttis: u64) -> f64 {
        let micro_per_tti = match self {
            Self::Arrivals(arrivals) => arrivals.expected_micro(),
            Self::OnOff(on_off) => on_off.expected_micro(),
            Self::Trace(trace) => trace.micro_in(traces, ttis) as f64 / ttis as f64,
            Self::Diurnal(diurnal) => diurnal.expected_micro_in(ttis) / ttis as f64,
        };
        micro_per_tti / MICRO_PER_UNIT as f64
    }

    /// The longest gap in the first `ttis` TTIs of a run: rows without energy in a trace, or the longest night of a
    /// diurnal source. `None` for sources whose energy can arrive in any TTI.
    pub fn longest_gap(&self, traces: &[Arc<Vec<Energy>>], ttis: u64) -> Option<HarvestGap> {
        match self {
            Self::Arrivals(_) | Self::OnOff(_) => None,
            Self::Trace(trace) => Some(trace.longest_gap(traces, ttis)),
            Self::Diurnal(diurnal) => Some(diurnal.longest_gap(ttis)),
        }
    }

    /// Whether the setup is valid for a device: its arrivals have probabilities within 0 and 1, and a trace is among
    /// the run's `traces` and has rows. [`HarvestSource::new`] relies on it.
    pub fn is_valid(&self, traces: &[Arc<Vec<Energy>>]) -> bool {
        match self {
            Self::Arrivals(arrivals) => arrivals.is_valid(),
            Self::OnOff(on_off) => on_off.is_valid(),
            Self::Trace(trace) => trace.is_valid(traces),
            Self::Diurnal(diurnal) => diurnal.is_valid(),
        }
    }

    /// The source as known before a run. A trace is known by its mean only, which then arrives in each TTI; so may be a
    /// diurnal source. `traces` are the run's, energy per TTI by row.
    #[must_use]
    pub fn known_before_run(&self, traces: &[Arc<Vec<Energy>>]) -> Self {
        match self {
            Self::Arrivals(_) | Self::OnOff(_) => *self,
            Self::Trace(trace) => Self::Arrivals(ArrivalsSetup {
                p: 1.0,
                e_b: trace.mean(traces),
            }),
            Self::Diurnal(diurnal) => diurnal.arrivals_if_mean_known().map_or(*self, Self::Arrivals),
        }
    }

    /// The expected energy by time of day, for a source that depends on it and is known before a run.
    pub fn day_profile(&self) -> Option<DayProfile> {
        match self {
            Self::Arrivals(_) | Self::OnOff(_) | Self::Trace(_) => None,
            Self::Diurnal(diurnal) => diurnal.day_profile(),
        }
    }

    /// Whether the source reads one of the run's traces.
    pub(crate) const fn reads_trace(&self) -> bool {
        match self {
            Self::Trace(_) => true,
            Self::Arrivals(_) | Self::OnOff(_) | Self::Diurnal(_) => false,
        }
    }
}

impl SharedSourceData {
    /// Creates the shared data of the sources with these `setups`. `traces` are the run's traces, energy per TTI by
    /// row.
    pub fn new<'a>(setups: impl IntoIterator<Item = &'a HarvestSetup>, traces: Vec<Arc<Vec<Energy>>>) -> Self {
        let mut shared = Self::with_traces(traces);
        for setup in setups {
            match setup {
                HarvestSetup::Arrivals(ArrivalsSetup { p, .. }) => shared.add_gap_table(*p),
                HarvestSetup::Diurnal(diurnal) => shared.add_day_hazards(&diurnal.sun, diurnal.zenith_probability),
                HarvestSetup::OnOff(_) | HarvestSetup::Trace(_) => {}
            }
        }
        shared
    }
}

/// The arrivals of one device's source.
#[derive(Clone, Debug)]
pub struct HarvestSource {
    next: Tti,
    source: SourceState,
}

#[derive(Clone, Debug)]
enum SourceState {
    Arrivals(ArrivalsSource),
    OnOff(OnOffSource),
    Trace(TraceSource),
    Diurnal(DiurnalSource),
}

impl HarvestSource {
    /// Creates the source of `device`.
    ///
    /// # Panics
    /// If `setup` is not [valid](HarvestSetup::is_valid) with the traces of `shared`.
    pub fn new(setup: &HarvestSetup, shared: &SharedSourceData, seed: u64, device: DeviceId) -> Self {
        let stream = Stream::new(seed, Purpose::Harvest, u64::from(device.0));
        let (source, next) = match setup {
            HarvestSetup::Arrivals(setup) => {
                let (source, next) = setup.source(shared, stream);
                (SourceState::Arrivals(source), next)
            }
            HarvestSetup::OnOff(setup) => {
                let (source, next) = setup.source(stream);
                (SourceState::OnOff(source), next)
            }
            HarvestSetup::Trace(setup) => {
                let (source, next) = setup.source(&shared.traces);
                (SourceState::Trace(source), next)
            }
            HarvestSetup::Diurnal(setup) => {
                let (source, next) = setup.source(shared, stream);
                (SourceState::Diurnal(source), next)
            }
        };
        Self { next, source }
    }

    /// The TTI of the next arrival; [`Tti::NEVER`] without one.
    pub const fn next_arrival(&self) -> Tti {
        self.next
    }

    /// Takes the next arrival, which must exist.
    #[inline]
    pub fn take_arrival(&mut self) -> Energy {
        let (energy, next) = match &mut self.source {
            SourceState::Arrivals(source) => source.take(self.next),
            SourceState::OnOff(source) => source.take(self.next),
            SourceState::Trace(source) => source.take(self.next),
            SourceState::Diurnal(source) => source.take(self.next),
        };
        self.next = next;
        energy
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const E_B: Energy = Energy::from_micro(5_000_000);
    /// Length of a TTI τ in the setup of a source, as in the paper.
    const TAU: f64 = 1.0;
    /// The index of a trace, which the sources without a trace ignore.
    const NO_TRACE: u32 = 0;
    const SEED: u64 = 11;

    fn source_of(harvest: &Harvest, device: u32) -> HarvestSource {
        HarvestSource::new(
            &harvest.setup(TAU, NO_TRACE),
            &SharedSourceData::default(),
            SEED,
            DeviceId(device),
        )
    }

    /// Counts the arrivals in the first `ttis` TTIs.
    fn count_arrivals(source: &mut HarvestSource, ttis: u64) -> u64 {
        let mut count = 0;
        while source.next_arrival() < Tti(ttis) {
            let arrival = source.next_arrival();
            assert_eq!(source.take_arrival(), E_B);
            assert!(source.next_arrival() > arrival);
            count += 1;
        }
        count
    }

    /// Returns the mean number of arrivals per TTI over independent devices, and its standard error.
    fn measure_rate(harvest: &Harvest) -> (f64, f64) {
        let (devices, ttis) = (400, 5_000);
        let rates: Vec<f64> = (0..devices)
            .map(|d| count_arrivals(&mut source_of(harvest, d), ttis) as f64 / ttis as f64)
            .collect();
        let mean = rates.iter().sum::<f64>() / rates.len() as f64;
        let variance = rates.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / (rates.len() - 1) as f64;
        (mean, (variance / rates.len() as f64).sqrt())
    }

    #[test]
    fn rates_equal_the_closed_forms() {
        let lambda = 0.3;
        let cases = [
            (Harvest::Eq5(Arrivals { lambda, e_b: E_B }), lambda * libm::exp(-lambda)),
            (
                Harvest::ExpMinusLambda(Arrivals { lambda, e_b: E_B }),
                libm::exp(-lambda),
            ),
            (
                Harvest::Mpp(OnOff {
                    lambda,
                    e_b: E_B,
                    off_mean: 7.0,
                }),
                (1.0 / lambda) / (1.0 / lambda + 7.0),
            ),
        ];
        for (harvest, expected) in cases {
            let (mean, standard_error) = measure_rate(&harvest);
            assert!(
                (mean - expected).abs() < 3.0 * standard_error,
                "{harvest:?}: {mean} ± {standard_error}, not {expected}"
            );
        }
    }

    #[test]
    fn the_mean_on_period_of_mpp_equals_the_one_of_its_chain() {
        let (lambda, off_mean) = (0.05, 10.0);
        let mut source = source_of(
            &Harvest::Mpp(OnOff {
                lambda,
                e_b: E_B,
                off_mean,
            }),
            1,
        );
        let (mut period_count, mut on_ttis, mut last) = (0u64, 0u64, Tti::NEVER);
        while source.next_arrival() < Tti(400_000) {
            let now = source.next_arrival();
            source.take_arrival();
            on_ttis += 1;
            period_count += u64::from(last == Tti::NEVER || now != last + 1);
            last = now;
        }
        // An on-period ends after each of its TTIs with the probability that the sampled chain leaves "on".
        let rate = lambda + 1.0 / off_mean;
        let leave_probability = (1.0 - (1.0 / off_mean) / rate) * (1.0 - libm::exp(-rate));
        let mean_period = on_ttis as f64 / period_count as f64;
        assert!(
            (mean_period * leave_probability - 1.0).abs() < 4.0 / (period_count as f64).sqrt(),
            "mean on-period of {mean_period} TTIs, not {}",
            1.0 / leave_probability
        );
    }

    #[test]
    fn a_trace_cycles_or_stops_and_zeros_are_no_arrivals() {
        let rows = Arc::new([0, 3, 0, 4].map(Energy::from_micro).to_vec());
        let trace_source = |end, ttis_per_row| {
            HarvestSource::new(
                &HarvestSetup::Trace(TraceSetup {
                    trace: 0,
                    ttis_per_row,
                    end,
                }),
                &SharedSourceData::new([], vec![Arc::clone(&rows)]),
                0,
                DeviceId(0),
            )
        };
        let collect_arrivals = |mut source: HarvestSource, ttis: u64| {
            let mut arrivals = Vec::new();
            while source.next_arrival() < Tti(ttis) {
                let k = source.next_arrival().0;
                arrivals.push((k, source.take_arrival().micro()));
            }
            arrivals
        };
        assert_eq!(
            collect_arrivals(trace_source(TraceEnd::Cycle, 1), 9),
            [(1, 3), (3, 4), (5, 3), (7, 4)]
        );
        assert_eq!(collect_arrivals(trace_source(TraceEnd::Stop, 1), 9), [(1, 3), (3, 4)]);
        assert_eq!(
            collect_arrivals(trace_source(TraceEnd::Stop, 2), 99),
            [(2, 3), (3, 3), (6, 4), (7, 4)]
        );
        let without_energy = HarvestSource::new(
            &HarvestSetup::Trace(TraceSetup {
                trace: 0,
                ttis_per_row: 1,
                end: TraceEnd::Cycle,
            }),
            &SharedSourceData::new([], vec![Arc::new(vec![Energy::ZERO; 5])]),
            0,
            DeviceId(0),
        );
        assert_eq!(without_energy.next_arrival(), Tti::NEVER);
    }
}
