//! `reveille bench`: speed against stated baselines, both sides in one go.

mod bare;
mod bus;
mod memory;

use std::process::ExitCode;

use crate::cli::BenchCommand;

/// Measures.
pub fn run(command: &BenchCommand) -> anyhow::Result<ExitCode> {
    match command {
        BenchCommand::Bus(args) => bus::run(args),
        BenchCommand::Memory(args) => memory::run(args),
        BenchCommand::BareHost {
            kind,
            at,
            sizes,
            number,
        } => bare::host(kind, at, *sizes, *number),
    }
}

/// The middle of `values`, NaN without any.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    match n {
        0 => f64::NAN,
        _ if n % 2 == 1 => values[n / 2],
        _ => f64::midpoint(values[n / 2 - 1], values[n / 2]),
    }
}
