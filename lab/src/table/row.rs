//! The row of one run: its identity and its results. Metrics are stored by position, in the order of
//! [`Metrics::NAMES`], also in tables and in the journals of sweeps.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use reveille_bs::cycle::RunOutcome;
use reveille_bs::scenario::Scenario;
use reveille_common::score::Metrics;

use super::columns::SweptValue;
use super::error::SchemaMismatch;

/// A SHA-256 sum; shown and read as 64 hexadecimal digits, in tables and journals.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Hash(pub [u8; 32]);

impl fmt::Display for Hash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Hash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for Hash {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let invalid = || format!("\"{}\" is not 64 hexadecimal digits", text.escape_default());
        // ASCII digits only: the slices below need character boundaries, and `from_str_radix` also accepts a sign.
        if text.len() != 64 || !text.bytes().all(|byte| byte.is_ascii_hexdigit()) {
            return Err(invalid());
        }
        let mut bytes = [0; 32];
        for (byte, position) in bytes.iter_mut().zip((0..64).step_by(2)) {
            *byte = u8::from_str_radix(&text[position..position + 2], 16).map_err(|_| invalid())?;
        }
        Ok(Self(bytes))
    }
}

/// A bound above every metric of any run: a table with a larger or infinite value was not written by Reveille.
const MAX_METRIC: f64 = 1e15;

/// One run: its identity and its results.
#[derive(Clone, Debug)]
pub struct ResultRow {
    /// SHA-256 of the scenario, its seed included. With the actions in [`super::TableMetadata`], it determines the run.
    pub scenario_hash: Hash,
    /// The preset that the scenario starts from.
    pub preset: Arc<str>,
    /// The policy's name.
    pub policy: Arc<str>,
    /// The number of devices N.
    pub n: u32,
    /// The length of the run K, TTIs.
    pub ttis: u64,
    /// The seed, `0 ..= 2⁶³-1`.
    pub seed: u64,
    /// The values of the swept fields, in the order of [`super::Schema::swept`].
    pub swept: Arc<[SweptValue]>,
    /// The metrics, in the order of [`Metrics::NAMES`]; NaN where not defined.
    pub metrics: [f64; Metrics::COUNT],
    /// The number of events that count.
    pub events: u64,
    /// The run's digest.
    pub digest: Hash,
}

impl ResultRow {
    /// The row of a complete run of `scenario` with the swept values `swept`.
    pub fn new(scenario: &Scenario, swept: Arc<[SweptValue]>, outcome: &RunOutcome) -> Self {
        Self {
            scenario_hash: Hash(scenario.hash()),
            preset: Arc::from(scenario.run.preset.as_str()),
            policy: Arc::from(scenario.policy.name()),
            n: scenario.run.devices,
            ttis: scenario.run.ttis,
            seed: scenario.run.seed,
            swept,
            metrics: outcome.metrics.values(),
            events: outcome.metrics.events,
            digest: Hash(outcome.digest.bytes()),
        }
    }

    /// Returns the row, if its metrics are possible values. Both decoders call this; `row_number` counts from 1.
    pub(super) fn check(self, row_number: usize) -> Result<Self, SchemaMismatch> {
        // False for NaN, which stands for an undefined metric.
        let is_impossible = |value: &f64| value.abs() > MAX_METRIC;
        match self.metrics.iter().position(is_impossible) {
            None => Ok(self),
            Some(index) => Err(SchemaMismatch::Broken(format!(
                "row {row_number}, {}: no run can have the value {:e}",
                Metrics::NAMES[index],
                self.metrics[index]
            ))),
        }
    }

    /// Returns the metric called `name`, which may be `events` or a former name. Returns `None` if it does not exist or
    /// is not defined for this run.
    pub fn metric(&self, name: &str) -> Option<f64> {
        if name == "events" {
            return Some(self.events as f64);
        }
        let name = Metrics::current_name(name);
        let index = Metrics::NAMES.iter().position(|metric| *metric == name)?;
        Some(self.metrics[index]).filter(|value| !value.is_nan())
    }
}

/// Compares metrics bit for bit; an undefined metric equals an undefined metric.
impl PartialEq for ResultRow {
    fn eq(&self, other: &Self) -> bool {
        let identity = |row: &Self| (row.scenario_hash, row.n, row.ttis, row.seed, row.events, row.digest);
        let bits = |row: &Self| {
            row.metrics
                .map(|value| if value.is_nan() { 0 } else { value.to_bits() })
        };
        identity(self) == identity(other)
            && self.preset == other.preset
            && self.policy == other.policy
            && self.swept == other.swept
            && bits(self) == bits(other)
    }
}

/// A cache of the last text, so that repeated texts share one allocation.
#[derive(Default)]
pub(super) struct LastText(Option<Arc<str>>);

impl LastText {
    /// Returns `text`, shared with the previous one if it is equal.
    pub(super) fn intern(&mut self, text: &str) -> Arc<str> {
        match &self.0 {
            Some(known) if **known == *text => Arc::clone(known),
            Some(_) | None => Arc::clone(self.0.insert(Arc::from(text))),
        }
    }
}
