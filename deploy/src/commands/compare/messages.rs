//! The first differences in the messages of two recordings, found by `view/src/compare.rs`.

use std::fmt::Write as _;

use reveille_view::compare::{FirstDifference, RunSide, compare_recordings};
use reveille_view::recording::RecordingError;

use crate::commands::inspect::source::RecordingFile;

/// Most devices that are listed.
const MAX_NAMED_DEVICES: usize = 12;

/// The difference of two recordings.
pub(super) struct MessageDifference {
    /// The first difference of each kind of message, a line and two indented lines each; `None` without one.
    pub(super) text: Option<String>,
    /// The side and the error of a recording that is torn. The messages before the tear were compared.
    pub(super) torn: Option<(RunSide, RecordingError)>,
}

/// Finds the first differences of the recordings of run 1 and of run `number` from their current positions.
pub(super) fn compare(this: &mut RecordingFile, other: &mut RecordingFile, number: usize) -> MessageDifference {
    let (comparison, torn) = compare_recordings(this, other);
    let mut text = String::new();
    for (nth, difference) in comparison.differences().iter().enumerate() {
        let _infallible = write!(text, "{}", format_difference(difference, number, nth == 0));
    }
    let text = text.trim_end().to_owned();
    MessageDifference {
        text: (!text.is_empty()).then_some(text),
        torn,
    }
}

/// Formats a difference, followed by a line break and the indentation of the next difference.
fn format_difference(difference: &FirstDifference, number: usize, is_first: bool) -> String {
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
        count if count > MAX_NAMED_DEVICES => format!(
            ", of devices {} and {} more",
            named.join(", "),
            count - MAX_NAMED_DEVICES
        ),
        _ => format!(", of devices {}", named.join(", ")),
    };
    format!(
        "{label}: {} in TTI {tti}{of_devices}\n    run 1: {}\n    run {number}: {}\n  ",
        kind.name(),
        difference.describe(RunSide::This),
        difference.describe(RunSide::Other)
    )
}
