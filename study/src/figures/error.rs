//! What can be wrong with a wish for a picture.

use reveille_bs::policy::q_learning::learned::Lookback;
use thiserror::Error;

/// Why there is no picture.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum FigureError {
    /// There is no figure of that name.
    #[error("figure `{name}`: there is none of that name; the figures are {known}")]
    Unknown {
        /// The name asked for.
        name: String,
        /// All names.
        known: String,
    },
    /// The tables hold no run.
    #[error("{tables}: no rows, so there is nothing to draw; `reveille sweep` writes tables with runs")]
    Empty {
        /// The tables.
        tables: String,
    },
    /// Two tables disagree about a run.
    #[error(
        "scenario {scenario}: the tables hold two different outcomes (digests {first} and {second}) of one scenario; \
         they come from versions of Reveille that do not agree, so make them again with one version"
    )]
    Contradiction {
        /// The scenario's hash.
        scenario: String,
        /// One digest.
        first: String,
        /// The other.
        second: String,
    },
    /// The run has no such event.
    #[error(
        "event {event}: the run of {ttis} TTIs has {count} events, numbered from 0; give one of them, or \
         a longer run with --ttis"
    )]
    NoEvent {
        /// The event asked for.
        event: u64,
        /// Events in the run.
        count: usize,
        /// Length of the run.
        ttis: u64,
    },
    /// The policy does not attend to anything.
    #[error("--policy {0}: what a decision attended to is drawn for dt alone; leave the option out")]
    NoAttention(String),
    /// The run has no such TTI.
    #[error("TTI {tti}: the last that can be shown is {last}; give an earlier one, or a longer run with --ttis")]
    NoTti {
        /// The TTI asked for.
        tti: u64,
        /// The last that can be.
        last: u64,
    },
    /// The run has no such device.
    #[error("device {device}: the scenario has {count} devices, numbered 0 to {}", count - 1)]
    NoDevice {
        /// The device asked for.
        device: u32,
        /// Devices in the run.
        count: u32,
    },
    /// The TTIs asked for are none, too many, or not in the run.
    #[error("TTIs {from} to {to}: the run has TTIs 0 to {}, and a timeline shows 10 to 2000 of them", ttis - 1)]
    NoWindow {
        /// First TTI.
        from: u64,
        /// Last TTI.
        to: u64,
        /// Length of the run.
        ttis: u64,
    },
    /// Too many devices for a picture that can be read.
    #[error("{count} devices: {what} shows {limit} at the most; {advice}")]
    Crowd {
        /// Devices asked for.
        count: u32,
        /// The picture.
        what: &'static str,
        /// The most that it can show.
        limit: u32,
        /// What to do.
        advice: &'static str,
    },
    /// The file has no table for this number of devices.
    #[error(
        "N = {devices}: {file} has tables for {known} devices with {own}, and for {windows}; \
            reveille train q-learning --devices {devices} --windows {window} --out FILE learns others",
        own = .window.in_words()
    )]
    NoEntry {
        /// N asked for.
        devices: u32,
        /// The window, TTIs.
        window: Lookback,
        /// The file.
        file: String,
        /// Every N that it has for that window.
        known: String,
        /// Every window that it has.
        windows: String,
    },
    /// The file does not tell how its training went.
    #[error("{file}: holds no learning curve; reveille train q-learning --out FILE writes tables with theirs")]
    NoCurve {
        /// The file.
        file: String,
    },
    /// Too much for a picture of learning curves that can be read.
    #[error("{count} {what}: a picture of learning curves shows {limit} at the most")]
    Curves {
        /// How many there are.
        count: usize,
        /// What is counted.
        what: &'static str,
        /// The most that it can show.
        limit: usize,
    },
    /// The runs have no such field.
    #[error("field `{name}`: the runs have none of that name; they have {known}")]
    Field {
        /// The field asked for.
        name: String,
        /// The fields that they have.
        known: String,
    },
    /// There is no such metric.
    #[error("metric `{name}`: there is none of that name; there are {known}")]
    Metric {
        /// The metric asked for.
        name: String,
        /// All metrics.
        known: String,
    },
    /// No run has this value of a field.
    #[error("{field} = {value}: no run has that; the values are {known}")]
    Value {
        /// The field.
        field: String,
        /// The value asked for.
        value: String,
        /// The values that runs have.
        known: String,
    },
    /// No run is left.
    #[error("--x {x}: no run that has a value of it has all of {only}")]
    Nothing {
        /// The field along x.
        x: String,
        /// What was asked for.
        only: String,
    },
    /// A field along x whose values are no numbers.
    #[error(
        "--x {field}: {value} is no number, so that it has no place on an axis; draw a line for each with --by {field}"
    )]
    Words {
        /// The field.
        field: String,
        /// One of its values.
        value: String,
    },
    /// The same field twice.
    #[error("--x {field} --by {field}: a line would be a point; name another field with --by")]
    Twice {
        /// The field.
        field: String,
    },
    /// Too many lines for a picture that can be read.
    #[error("--by {field}: {count} lines, and {most} can be told apart; choose some runs with --where FIELD=VALUE")]
    Lines {
        /// The field.
        field: String,
        /// How many values it has.
        count: usize,
        /// The most lines.
        most: usize,
    },
    /// Too many pictures.
    #[error(
        "--x {x} --by {by}: the runs differ in {fields} as well, which would be more than {most} pictures; choose some \
         with --where FIELD=VALUE"
    )]
    Facets {
        /// The most pictures.
        most: usize,
        /// The fields.
        fields: String,
        /// The field along x.
        x: String,
        /// The field that has the lines.
        by: String,
    },
    /// No run has a value of the metric.
    #[error("metric `{metric}`: no run has a value of it, as where there was no event")]
    Undefined {
        /// The metric.
        metric: String,
    },
}
