//! Errors in requests for figures.

use reveille_bs::policy::q_learning::learned::Lookback;
use thiserror::Error;

/// Reason why a figure cannot be drawn.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum FigureError {
    /// No figure has this name.
    #[error("figure `{name}`: there is none of that name; the figures are {known}")]
    Unknown {
        /// Requested name.
        name: String,
        /// All valid names.
        known: String,
    },
    /// The tables hold no run.
    #[error("{tables}: no rows, so there is nothing to draw; `reveille sweep` writes tables with runs")]
    Empty {
        /// Names of the tables.
        tables: String,
    },
    /// Two tables hold different outcomes of one run.
    #[error(
        "scenario {scenario}: the tables hold two different outcomes (digests {first} and {second}) of one scenario; \
         they come from versions of Reveille that do not agree, so make them again with one version"
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
        "event {event}: the run of {ttis} TTIs has {count} events, numbered from 0; give one of them, or \
         a longer run with --ttis"
    )]
    NoEvent {
        /// Requested event.
        event: u64,
        /// Number of events in the run.
        count: usize,
        /// Length of the run, TTIs.
        ttis: u64,
    },
    /// The policy has no attention weights; only `dt` has them.
    #[error("--policy {0}: what a decision attended to is drawn for dt alone; leave the option out")]
    NoAttention(String),
    /// The run has no TTI with this number.
    #[error("TTI {tti}: the last that can be shown is {last}; give an earlier one, or a longer run with --ttis")]
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
    /// The range of TTIs is empty, too long or outside the run.
    #[error("TTIs {from} to {to}: the run has TTIs 0 to {}, and a timeline shows 10 to 2000 of them", ttis - 1)]
    NoWindow {
        /// First TTI.
        from: u64,
        /// Last TTI.
        to: u64,
        /// Length of the run, TTIs.
        ttis: u64,
    },
    /// Too many devices for a legible figure.
    #[error("{count} devices: {what} shows {limit} at the most; {advice}")]
    Crowd {
        /// Requested number of devices.
        count: u32,
        /// Kind of figure.
        what: &'static str,
        /// Largest number of devices that the figure can show.
        limit: u32,
        /// Advice for the user.
        advice: &'static str,
    },
    /// The file has no table for this number of devices.
    #[error(
        "N = {devices}: {file} has tables for {known} devices with {own}, and for {windows}; \
            reveille train q-learning --devices {devices} --windows {window} --out FILE learns others",
        own = .window.in_words()
    )]
    NoEntry {
        /// Requested N.
        devices: u32,
        /// Window, TTIs.
        window: Lookback,
        /// File name.
        file: String,
        /// All N for which the file has a table with that window.
        known: String,
        /// All windows in the file.
        windows: String,
    },
    /// The file holds no learning curve.
    #[error("{file}: holds no learning curve; reveille train q-learning --out FILE writes tables with theirs")]
    NoCurve {
        /// File name.
        file: String,
    },
    /// Too many items for a legible figure of learning curves.
    #[error("{count} {what}: a picture of learning curves shows {limit} at the most")]
    Curves {
        /// Number of items.
        count: usize,
        /// Kind of item that is counted.
        what: &'static str,
        /// Largest number of items that the figure can show.
        limit: usize,
    },
    /// The runs have no field with this name.
    #[error("field `{name}`: the runs have none of that name; they have {known}")]
    Field {
        /// Requested field.
        name: String,
        /// Fields of the runs.
        known: String,
    },
    /// No metric has this name.
    #[error("metric `{name}`: there is none of that name; there are {known}")]
    Metric {
        /// Requested metric.
        name: String,
        /// All metrics.
        known: String,
    },
    /// No run has this value of the field.
    #[error("{field} = {value}: no run has that; the values are {known}")]
    Value {
        /// Field name.
        field: String,
        /// Requested value.
        value: String,
        /// Values in the runs.
        known: String,
    },
    /// The filter leaves no run.
    #[error("--x {x}: no run that has a value of it has all of {only}")]
    Nothing {
        /// Field along x.
        x: String,
        /// Requested filter.
        only: String,
    },
    /// The field along x has a value that is not a number.
    #[error(
        "--x {field}: {value} is no number, so that it has no place on an axis; draw a line for each with --by {field}"
    )]
    Words {
        /// Field name.
        field: String,
        /// One of its non-numeric values.
        value: String,
    },
    /// Field along x and field of the lines are equal.
    #[error("--x {field} --by {field}: a line would be a point; name another field with --by")]
    Twice {
        /// Field name.
        field: String,
    },
    /// Too many lines for a legible figure.
    #[error("--by {field}: {count} lines, and {most} can be told apart; choose some runs with --where FIELD=VALUE")]
    Lines {
        /// Field that selects the lines.
        field: String,
        /// Number of values of the field.
        count: usize,
        /// Largest number of lines.
        most: usize,
    },
    /// The runs would need too many figures.
    #[error(
        "--x {x} --by {by}: the runs differ in {fields} as well, which would be more than {most} pictures; choose some \
         with --where FIELD=VALUE"
    )]
    Facets {
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
    #[error("metric `{metric}`: no run has a value of it, as where there was no event")]
    Undefined {
        /// Metric name.
        metric: String,
    },
}
