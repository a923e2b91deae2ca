//! The first differences in the messages of two recordings as text, found by `view/src/compare.rs`. The text is also
//! `first` in `--json`; `tests/browser/check.py` and `docs/watching.md` repeat the start of its first line.

use std::fmt::Write as _;

use reveille_view::compare::{FirstDifference, RunSide, compare_recordings};
use reveille_view::recording::RecordingError;

use crate::commands::inspect::source::RecordingFile;

/// Most devices that a difference between plans names.
const MAX_NAMED_DEVICES: usize = 12;

/// The differences of two recordings.
pub(super) struct MessageDifference {
    /// The first difference of each kind of message, a line and two indented lines each; `None` without a difference.
    pub(super) text: Option<String>,
    /// The side and the error of a recording that is torn. The messages before the tear were compared.
    pub(super) torn: Option<(RunSide, RecordingError)>,
}

/// Finds the first differences of the recordings of run 1, `this`, and of run `other_number`, from their current
/// positions.
pub(super) fn compare(this: &mut RecordingFile, other: &mut RecordingFile, other_number: usize) -> MessageDifference {
    let (comparison, torn) = compare_recordings(this, other);
    let mut text = String::new();
    for (nth, difference) in comparison.differences().iter().enumerate() {
        let _infallible = write!(text, "{}", format_difference(difference, other_number, nth == 0));
    }
    let text = text.trim_end().to_owned();
    MessageDifference {
        text: (!text.is_empty()).then_some(text),
        torn,
    }
}

/// Formats a difference, followed by a line break and the indentation of the next difference.
fn format_difference(difference: &FirstDifference, other_number: usize, is_first: bool) -> String {
    let FirstDifference { tti, kind, .. } = difference;
    let label = if is_first { "first difference" } else { "then" };
    let devices = difference.devices();
    let named_devices: Vec<String> = devices
        .iter()
        .take(MAX_NAMED_DEVICES)
        .map(ToString::to_string)
        .collect();
    let device_list = match devices.len() {
        0 => String::new(),
        count if count > MAX_NAMED_DEVICES => format!(
            ", of devices {} and {} more",
            named_devices.join(", "),
            count - MAX_NAMED_DEVICES
        ),
        _ => format!(", of devices {}", named_devices.join(", ")),
    };
    format!(
        "{label}: {} in TTI {tti}{device_list}\n    run 1: {}\n    run {other_number}: {}\n  ",
        kind.name(),
        difference.describe(RunSide::This),
        difference.describe(RunSide::Other)
    )
}
