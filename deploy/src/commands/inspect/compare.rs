//! `reveille inspect compare`: prints the first difference of two recordings, found by `view/src/compare.rs`. Scripts
//! rely on its exit code, 1 if the recordings differ.

use std::fmt::Write as _;
use std::process::ExitCode;

use anyhow::bail;
use reveille_view::compare::{FirstDifference, RunSide, compare_recordings, compare_scenarios};

use super::source::open;
use crate::cli::CompareArgs;
use crate::display::print_stdout;
use crate::exit::ExitReason;

/// Most devices that are listed.
const MAX_NAMED_DEVICES: usize = 12;

/// Compares both recordings in parallel.
pub(super) fn run(args: &CompareArgs) -> anyhow::Result<ExitCode> {
    let (mut this, mut other) = (open(&args.this)?, open(&args.other)?);
    let mut report = String::new();
    for (field, this, other) in compare_scenarios(&this.bundle().text, &other.bundle().text)? {
        let _infallible = writeln!(
            report,
            "scenario: {field} is {this} in this recording, {other} in the other"
        );
    }
    let (comparison, torn) = compare_recordings(&mut this, &mut other);
    let differences = comparison.differences();
    for (nth, difference) in differences.iter().enumerate() {
        let text = format_difference(difference, nth == 0);
        report = format!("{report}{text}");
    }
    if differences.is_empty() {
        report = format!("{report}no difference in the messages of both recordings\n");
    }
    print_stdout(&report)?;
    if let Some((side, error)) = torn {
        let path = match side {
            RunSide::This => &args.this,
            RunSide::Other => &args.other,
        };
        bail!(
            "{}: {error}; the recordings were compared up to this point",
            path.display()
        );
    }
    Ok(if differences.is_empty() {
        ExitReason::Done
    } else {
        ExitReason::Failed
    }
    .into())
}

fn format_difference(difference: &FirstDifference, is_first: bool) -> String {
    let FirstDifference { tti, kind, .. } = difference;
    let label = if is_first { "first difference" } else { "then" };
    let devices = difference.devices();
    let named: Vec<String> = devices
        .iter()
        .take(MAX_NAMED_DEVICES)
        .map(ToString::to_string)
        .collect();
    let of_devices = match devices.len() {
        0 => String::new(),
        more if more > MAX_NAMED_DEVICES => format!(
            ", of devices {} and {} more",
            named.join(", "),
            more - MAX_NAMED_DEVICES
        ),
        _ => format!(", of devices {}", named.join(", ")),
    };
    format!(
        "{label}: {} in TTI {tti}{of_devices}\n  this:  {}\n  other: {}\n",
        kind.name(),
        difference.describe(RunSide::This),
        difference.describe(RunSide::Other)
    )
}
