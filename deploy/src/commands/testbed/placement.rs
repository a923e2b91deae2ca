//! The names of a testbed's containers, and their devices. A container runs devices of one class. Shares scatter the
//! devices of a class over all ids, so a container can have many ranges.

use std::collections::BTreeSet;

use reveille_common::ids::DeviceId;
use reveille_common::message::DeviceRange;

/// The container of the base station.
pub(super) const BS_SERVICE: &str = "bs";
/// The container of the dashboard.
pub(super) const DASHBOARD_SERVICE: &str = "dashboard";
/// The container that makes the certificates, and then ends.
pub(super) const CERTIFICATES_SERVICE: &str = "certificates";
/// The prefix of containers without declared classes, whose only class has this name.
const DEFAULT_CLASS: (&str, &str) = ("default", "device");

/// Most letters of a prefix before it is made unique: a host name has at most 63.
const MAX_PREFIX_CHARS: usize = 40;

/// Splits the devices of a class, in the order of ids, among `containers`: as equally as possible, the first ones get
/// the remainder. Returns the ranges of each.
pub(super) fn split_devices(devices: &[DeviceId], containers: usize) -> Vec<Vec<DeviceRange>> {
    let mut rest = devices;
    (0..containers)
        .map(|index| {
            let (own, others) = rest.split_at(rest.len().div_ceil(containers - index));
            rest = others;
            to_ranges(own)
        })
        .collect()
}

/// Returns the ranges of consecutive devices in a sorted list.
fn to_ranges(devices: &[DeviceId]) -> Vec<DeviceRange> {
    let neighbours = devices.chunk_by(|a, b| a.0 + 1 == b.0);
    neighbours
        .map(|range| DeviceRange {
            first: range[0],
            count: range.len() as u32,
        })
        .collect()
}

/// Formats ranges as `device --range` takes them: `0-3,7,9-12`.
pub(super) fn format_ranges(ranges: &[DeviceRange]) -> String {
    let format = |range: &DeviceRange| match (range.first.0, range.count) {
        (first, 1) => first.to_string(),
        (first, count) => format!("{first}-{}", first + count - 1),
    };
    ranges.iter().map(format).collect::<Vec<_>>().join(",")
}

/// Distributes `total` containers over classes with these numbers of devices: one for each class with devices, and each
/// further one for the class with the most devices per container. Fewer if there are fewer devices, more if there are
/// more classes.
pub(super) fn distribute(total: usize, class_sizes: &[usize]) -> Vec<usize> {
    let mut containers: Vec<usize> = class_sizes.iter().map(|size| usize::from(*size > 0)).collect();
    for _ in containers.iter().sum()..total {
        let load = |index: &usize| class_sizes[*index] as f64 / containers[*index] as f64;
        let has_room = |index: &usize| containers[*index] < class_sizes[*index];
        // Of equal loads the first class counts: `max_by` returns the last.
        let fullest = (0..class_sizes.len())
            .rev()
            .filter(has_room)
            .max_by(|a, b| load(a).total_cmp(&load(b)));
        let Some(fullest) = fullest else { break };
        containers[fullest] += 1;
    }
    containers
}

/// Returns a prefix of container names for each class: its name in the letters of host names, unique.
pub(super) fn name_prefixes<'a>(classes: impl IntoIterator<Item = &'a str>) -> Vec<String> {
    let mut taken = BTreeSet::new();
    let unique_prefix = |class: &str| {
        let to_host_char = |c: char| {
            if c.is_ascii_alphanumeric() {
                c.to_ascii_lowercase()
            } else {
                '-'
            }
        };
        let letters: String = class.chars().map(to_host_char).take(MAX_PREFIX_CHARS).collect();
        let stem = match letters.trim_matches('-') {
            "" => "class",
            stem if stem == DEFAULT_CLASS.0 => DEFAULT_CLASS.1,
            stem => stem,
        };
        let mut prefix = stem.to_owned();
        let mut number = 2;
        while !taken.insert(prefix.clone()) {
            prefix = format!("{stem}-{number}");
            number += 1;
        }
        prefix
    };
    classes.into_iter().map(unique_prefix).collect()
}

/// Returns the name of the link of the class with this prefix.
pub(super) fn link_name(prefix: &str) -> String {
    // Names of containers with devices end in a digit.
    format!("{prefix}-link")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_are_split_equally_into_ranges() {
        let devices: Vec<DeviceId> = [0, 1, 2, 5, 6, 9, 20].map(DeviceId).to_vec();
        let split = |containers| {
            split_devices(&devices, containers)
                .iter()
                .map(|own| format_ranges(own))
                .collect::<Vec<_>>()
        };
        assert_eq!(split(1), ["0-2,5-6,9,20"]);
        assert_eq!(split(2), ["0-2,5", "6,9,20"]);
        assert_eq!(split(3), ["0-2", "5-6", "9,20"]);
        assert_eq!(split(7), ["0", "1", "2", "5", "6", "9", "20"]);
    }

    #[test]
    fn containers_follow_the_numbers_of_devices() {
        for (total, sizes, expected) in [
            (5, vec![50], vec![5]),
            (5, vec![80, 20], vec![4, 1]),
            (1, vec![80, 20], vec![1, 1]),
            (5, vec![80, 0, 20], vec![4, 0, 1]),
            (9, vec![3, 2], vec![3, 2]),
            (3, vec![10, 10], vec![2, 1]),
        ] {
            assert_eq!(distribute(total, &sizes), expected, "{total} for {sizes:?}");
        }
    }

    #[test]
    fn prefixes_are_unique_host_names() {
        let classes = ["default", "Weak", "weak", "β", "on roof (2)", "weak-2", "device"];
        let expected = [
            "device",
            "weak",
            "weak-2",
            "class",
            "on-roof--2",
            "weak-2-2",
            "device-2",
        ];
        assert_eq!(name_prefixes(classes), expected);
    }
}
