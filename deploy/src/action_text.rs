//! The actions of a run as text, for `compare`, `inspect misses` and `clock act`. The JSON of the first two holds the
//! names as `first_actions`.

use std::collections::BTreeSet;

use reveille_common::ids::DeviceId;
use reveille_common::message::{Change, OperatorAction};

use crate::display::count_noun;

/// Maximum number of actions of a run that are named.
const MAX_NAMED: usize = 3;

/// Explains the energy of runs with failed devices; lines of at most 80 columns.
pub(crate) const FAILURE_NOTE: &str = "failed devices spend nothing and count in all means, so less energy or a\n\
                                       fuller battery after failures is no saving\n";

/// Names the first of `actions`, in the order in which they take effect, with their TTIs.
pub(crate) fn name_actions(actions: &[OperatorAction]) -> Vec<String> {
    let mut first_actions: Vec<_> = actions.iter().collect();
    first_actions.sort_by_key(|action| action.tti);
    first_actions.truncate(MAX_NAMED);
    let mut failed = BTreeSet::new();
    first_actions
        .into_iter()
        .map(|action| format!("TTI {} {}", action.tti, describe_change(&action.change, 0, &mut failed)))
        .collect()
}

/// Describes a change in a run of `device_count` devices, and applies it to `failed`, the devices that have failed.
/// Names devices on which it has no effect.
pub(crate) fn describe_change(change: &Change, device_count: u32, failed: &mut BTreeSet<DeviceId>) -> String {
    let (devices, past) = match change.with_all_resolved(device_count) {
        Change::Fail(devices) => (devices, "had already failed"),
        Change::Revive(devices) => (devices, "had not failed"),
        Change::AddEnergy(..) | Change::Set(..) => return change.to_string(),
    };
    let is_failure = matches!(change, Change::Fail(_));
    let mut has_no_effect = |device: DeviceId| {
        if is_failure {
            !failed.insert(device)
        } else {
            !failed.remove(&device)
        }
    };
    let unaffected = devices.devices().filter(|device| has_no_effect(*device)).count();
    match change.devices() {
        Some(named) if unaffected > 0 && unaffected == devices.count as usize => format!("{named} {past}"),
        _ if unaffected > 0 => format!("{change} ({unaffected} of them {past})"),
        _ => change.to_string(),
    }
}

/// Counts `actions` and names the first of them; `None` without actions.
pub(crate) fn describe_actions(actions: &[OperatorAction]) -> Option<String> {
    let ellipsis = if actions.len() > MAX_NAMED { ", …" } else { "" };
    let names = name_actions(actions).join(", ");
    (!actions.is_empty()).then(|| format!("{}: {names}{ellipsis}", count_noun(actions.len(), "action")))
}

#[cfg(test)]
mod tests {
    use reveille_common::message::DeviceRange;

    use super::*;

    #[test]
    fn changes_without_effect_are_described() {
        let range = |first, count| DeviceRange {
            first: DeviceId(first),
            count,
        };
        // The number of devices is not always known.
        let text = describe_change(&Change::Fail(DeviceRange::ALL), 0, &mut BTreeSet::new());
        assert_eq!(text, "all devices fail");
        let mut failed = BTreeSet::new();
        for (change, text) in [
            (Change::Revive(range(7, 1)), "device 7 had not failed"),
            (Change::Fail(range(7, 1)), "device 7 fails"),
            (Change::Fail(range(7, 1)), "device 7 had already failed"),
            (
                Change::Fail(range(6, 3)),
                "devices 6 to 8 fail (1 of them had already failed)",
            ),
            (
                Change::Revive(DeviceRange::ALL),
                "all devices are revived (7 of them had not failed)",
            ),
            (Change::Revive(DeviceRange::ALL), "all devices had not failed"),
        ] {
            assert_eq!(describe_change(&change, 10, &mut failed), text);
        }
    }
}
