//! Errors in requests for figures. The texts go to the user of `reveille figures`, so they name options and the fix.
//! `deploy/src/commands/figures.rs` adds a hint to `UnvariedField`. The Python package passes the texts on as the
//! messages of its exceptions, options included.

use reveille_bs::policy::q_learning::learned::Lookback;
use thiserror::Error;

/// Reason why a figure cannot be drawn.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum FigureError {
    /// No figure has this name.
    #[error("figure `{name}`: unknown figure; use {known}")]
    UnknownFigure {
        /// Requested name.
        name: String,
        /// All valid names.
        known: String,
    },
    /// The tables hold no run.
    #[error("{tables}: the table has no runs to draw; use a table that `reveille sweep` wrote")]
    NoRuns {
        /// Names of the tables.
        tables: String,
    },
    /// The tables hold no run of a preset, which the report needs.
    #[error(
        "the tables hold {conditions} and no runs of an unchanged preset, on which the paper's claims are judged; add \
         a table of `reveille sweep --scenario paper`, rank the conditions with `reveille report search`, or draw them \
         with `reveille figures`"
    )]
    NoPreset {
        /// Conditions in the tables.
        conditions: String,
    },
    /// Two tables hold different outcomes of one run.
    #[error(
        "scenario {scenario}: the tables hold two outcomes of it (digests {first} and {second}), from different \
         versions of Reveille; repeat the sweeps with one version"
    )]
    Contradiction {
        /// Hash of the scenario.
        scenario: String,
        /// Digest in one table.
        first: String,
        /// Digest in the other table.
        second: String,
    },
    /// The run has no event with this number.
    #[error(
        "event {event}: the run of {ttis} TTIs has {count} events, numbered from 0; give one of these numbers, or a \
         longer run with --ttis"
    )]
    UnknownEvent {
        /// Requested event.
        event: u64,
        /// Number of events in the run.
        count: usize,
        /// Length of the run, TTIs.
        ttis: u64,
    },
    /// The run has no event.
    #[error(
        "the run of {ttis} TTIs has no events; use --event none, a longer run with --ttis, or a larger events.alpha"
    )]
    NoEvent {
        /// Length of the run, TTIs.
        ttis: u64,
    },
    /// An event is active in every TTI after the warm-up.
    #[error("--event none: an event is active in every TTI after the warm-up; give a longer run with --ttis")]
    NoQuietTti,
    /// The policy has no attention weights; only `dt` has them.
    #[error("--policy {0}: the attention figure is for policy dt only; leave the option out")]
    NoAttention(String),
    /// The model of `dt` has no attention over time.
    #[error("policy.dt.model: this model has no attention over time; use --set policy.dt.model=attention")]
    NoAttentionInModel,
    /// The run has no TTI with this number.
    #[error("TTI {tti}: must be at most {last}; give an earlier TTI, or a longer run with --ttis")]
    NoTti {
        /// Requested TTI.
        tti: u64,
        /// Last TTI that can be shown.
        last: u64,
    },
    /// The run has no device with this number.
    #[error("device {device}: the scenario has {count} devices, numbered 0 to {}", count - 1)]
    NoDevice {
        /// Requested device.
        device: u32,
        /// Number of devices in the run.
        count: u32,
    },
    /// The range of TTIs is empty, too long or outside the run. The text repeats the limits of a timeline.
    #[error("TTIs {from} to {to}: must be 10 to 2000 TTIs within 0 to {}, the TTIs of the run", ttis - 1)]
    NoWindow {
        /// First TTI.
        from: u64,
        /// Last TTI.
        to: u64,
        /// Length of the run, TTIs.
        ttis: u64,
    },
    /// Too many devices for a legible figure.
    #[error("{count} devices: {figure} shows at most {limit}; {advice}")]
    TooManyDevices {
        /// Requested number of devices.
        count: u32,
        /// Kind of figure.
        figure: &'static str,
        /// Largest number of devices that the figure can show.
        limit: u32,
        /// Advice for the user.
        advice: &'static str,
    },
    /// The file has no table for this number of devices with this window.
    #[error(
        "N = {devices}: {file} has tables for {known} devices with {requested}, and for {windows}; train the missing \
         tables with reveille train q-learning --devices {devices} --windows {window} --out FILE",
        requested = .window.describe()
    )]
    NoEntry {
        /// Requested N.
        devices: u32,
        /// The window in TTIs, or the ages of places.
        window: Lookback,
        /// File name.
        file: String,
        /// All N for which the file has a table with that window, or `no`.
        known: String,
        /// All windows in the file.
        windows: String,
    },
    /// The file holds no learning curve.
    #[error("{file}: holds no learning curve; use tables that reveille train q-learning wrote")]
    NoCurve {
        /// File name.
        file: String,
    },
    /// Too many items for a legible figure of learning curves.
    #[error("{count} {items}: a figure of learning curves shows at most {limit}; give fewer")]
    TooManyCurves {
        /// Number of items.
        count: usize,
        /// Kind of item that is counted.
        items: &'static str,
        /// Largest number of items that the figure can show.
        limit: usize,
    },
    /// The runs do not differ in a field with this name.
    #[error("field `{name}`: not varied in these runs; use {known}")]
    UnvariedField {
        /// Requested field.
        name: String,
        /// Fields in which the runs differ, and the columns of every table.
        known: String,
    },
    /// No metric has this name.
    #[error("metric `{name}`: unknown metric; use {known}")]
    UnknownMetric {
        /// Requested metric.
        name: String,
        /// All metrics.
        known: String,
    },
    /// No run has this value of the field.
    #[error("{field} = {value}: no run has this value; use {known}")]
    UnknownValue {
        /// Field name.
        field: String,
        /// Requested value.
        value: String,
        /// Values in the runs.
        known: String,
    },
    /// The filter leaves no run.
    #[error("--x {x}: no run with a value of this field matches {only}; change --where")]
    NoMatchingRun {
        /// Field along x.
        x: String,
        /// Requested filter.
        only: String,
    },
    /// The field along x has a value that is not a number.
    #[error("--x {field}: {value} is not a number; draw a line for each value with --by {field}")]
    NotNumeric {
        /// Field name.
        field: String,
        /// One of its non-numeric values.
        value: String,
    },
    /// Field along x and field of the lines are equal.
    #[error("--x {field} --by {field}: each line would be a single point; name another field with --by")]
    SameField {
        /// Field name.
        field: String,
    },
    /// Too many lines for a legible figure.
    #[error("--by {field}: {count} lines, but a figure shows at most {most}; select runs with --where FIELD=VALUE")]
    TooManyLines {
        /// Field that selects the lines.
        field: String,
        /// Number of values of the field.
        count: usize,
        /// Largest number of lines.
        most: usize,
    },
    /// The runs would need too many figures.
    #[error(
        "--x {x} --by {by}: the runs also differ in {fields}, which makes more than {most} figures; select runs with \
         --where FIELD=VALUE"
    )]
    TooManyFacets {
        /// Largest number of figures.
        most: usize,
        /// Other fields in which the runs differ.
        fields: String,
        /// Field along x.
        x: String,
        /// Field that selects the lines.
        by: String,
    },
    /// The metric is undefined in every run.
    #[error(
        "metric `{metric}`: no run defines it, for example because no event occurred; use other runs or another \
        metric"
    )]
    Undefined {
        /// Metric name.
        metric: String,
    },
}
