//! `reveille inspect compare`: finds the first difference of two recordings.

use std::fmt::Write as _;
use std::process::ExitCode;

use anyhow::bail;
use reveille_view::compare::{FirstDifference, RunSide, fields, recordings};

use super::source::open;
use crate::cli::CompareArgs;
use crate::display::print;
use crate::exit::ExitReason;

/// Most devices that are listed.
const NAMED: usize = 12;

/// Compares both recordings in parallel.
pub(super) fn run(args: &CompareArgs) -> anyhow::Result<ExitCode> {
    let (mut this, mut other) = (open(&args.this)?, open(&args.other)?);
    let mut said = String::new();
    for (field, this, other) in fields(&this.bundle().scenario, &other.bundle().scenario)? {
        let _infallible = writeln!(
            said,
            "scenario: {field} is {this} in this recording, {other} in the other"
        );
    }
    let (comparison, torn) = recordings(&mut this, &mut other);
    let differences = comparison.differences();
    for (nth, difference) in differences.iter().enumerate() {
        let text = format_difference(difference, nth == 0);
        said = format!("{said}{text}");
    }
    if differences.is_empty() {
        said = format!("{said}no difference in the messages of both recordings\n");
    }
    print(&said)?;
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
    let nth = if is_first { "first difference" } else { "then" };
    let devices = difference.devices();
    let named: Vec<String> = devices.iter().take(NAMED).map(ToString::to_string).collect();
    let whose = match devices.len() {
        0 => String::new(),
        more if more > NAMED => format!(", of devices {} and {} more", named.join(", "), more - NAMED),
        _ => format!(", of devices {}", named.join(", ")),
    };
    format!(
        "{nth}: {} in TTI {tti}{whose}\n  this:  {}\n  other: {}\n",
        kind.name(),
        difference.describe(RunSide::This),
        difference.describe(RunSide::Other)
    )
}
