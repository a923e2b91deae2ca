//! The assignment of devices to classes, for [`crate::deployment`]. The seed decides which devices a share receives.
//! Digests of scenarios with classes depend on the counts, on ties and on the shuffle. The reference in `tests/src/`
//! calls [`assign_classes`] too, so it cannot find an error here.

use super::class_members::{Members, Zone};
use super::classes::DeviceClass;
use super::model::Scenario;
use crate::geometry::place_devices;
use crate::rng::{Purpose, Stream};

/// Returns the class of each device as an index into [`Scenario::classes`].
///
/// The layout's file may specify the classes. Otherwise a class takes the devices that it lists by number, then the
/// devices in its zone; the first class with a matching zone applies. The remaining devices follow the shares: the
/// largest remainder method sets the number of devices in each class, and the seed alone determines the devices.
///
/// # Panics
/// If a device has no class, which loading a scenario rules out for its seed: see [`Scenario::with_seed`].
pub fn assign_classes<P>(scenario: &Scenario<P>) -> Vec<u16> {
    let assigned = try_assign_classes(scenario);
    assigned.unwrap_or_else(|j| panic!("device {j} has no class"))
}

/// Returns the class of each device, or the first device without a class as the error. Validation calls it to check the
/// classes and to count their devices.
pub(super) fn try_assign_classes<P>(scenario: &Scenario<P>) -> Result<Vec<u16>, usize> {
    if let Some(classes) = scenario.layout.classes() {
        return Ok(classes.to_vec());
    }
    let selected = assign_by_number_or_zone(scenario);
    let unselected_count = selected.iter().filter(|class_index| class_index.is_none()).count();
    let counts = class_counts(scenario, unselected_count);
    let mut drawn_classes: Vec<u16> = (0u16..)
        .zip(&counts)
        .flat_map(|(class_index, &count)| std::iter::repeat_n(class_index, count))
        .collect();
    if counts.len() > 1 {
        Stream::new(scenario.run.seed, Purpose::Classes, 0).shuffle(&mut drawn_classes);
    }
    let mut drawn_classes = drawn_classes.into_iter();
    let class_of = |(j, index): (usize, Option<u16>)| index.or_else(|| drawn_classes.next()).ok_or(j);
    selected.into_iter().enumerate().map(class_of).collect()
}

/// Returns the class of each device that some class lists by number or covers by its zone.
fn assign_by_number_or_zone<P>(scenario: &Scenario<P>) -> Vec<Option<u16>> {
    let mut assigned = vec![None; scenario.run.devices as usize];
    for (index, class) in (0u16..).zip(&scenario.classes) {
        if let Members::Devices(devices) = &class.members {
            for &j in devices {
                // `validate` has rejected numbers ≥ N.
                assigned[j as usize] = Some(index);
            }
        }
    }
    let zone = |(index, class): (u16, &DeviceClass)| match class.members {
        Members::Within(zone) => Some((index, zone)),
        Members::Share(_) | Members::Devices(_) | Members::Layout => None,
    };
    let zones: Vec<(u16, Zone)> = (0u16..).zip(&scenario.classes).filter_map(zone).collect();
    if !zones.is_empty() {
        let positions = place_devices(&scenario.layout, scenario.area, scenario.run.devices, scenario.run.seed);
        for (class_index, position) in assigned.iter_mut().zip(positions) {
            if class_index.is_none() {
                let first_match = zones.iter().find(|(_, zone)| zone.contains(position));
                *class_index = first_match.map(|&(index, _)| index);
            }
        }
    }
    assigned
}

/// Distributes `device_count` devices over the classes by their shares; all counts are 0 if no class has a share.
fn class_counts<P>(scenario: &Scenario<P>, device_count: usize) -> Vec<usize> {
    let share = |class: &DeviceClass| match class.members {
        Members::Share(share) => share,
        Members::Devices(_) | Members::Within(_) | Members::Layout => 0.0,
    };
    let quotas: Vec<f64> = scenario
        .classes
        .iter()
        .map(|class| share(class) * device_count as f64)
        .collect();
    let mut remaining = device_count;
    let mut counts = Vec::with_capacity(quotas.len());
    for quota in &quotas {
        // Shares may add up to slightly more than 1, see `SHARE_TOLERANCE`.
        let count = (quota.floor() as usize).min(remaining);
        remaining -= count;
        counts.push(count);
    }
    let has_share = |&index: &usize| matches!(scenario.classes[index].members, Members::Share(_));
    let mut by_remainder: Vec<usize> = (0..quotas.len()).filter(has_share).collect();
    // A stable sort: of equal remainders the earlier class comes first.
    by_remainder.sort_by(|&a, &b| quotas[b].fract().total_cmp(&quotas[a].fract()));
    for &class_index in by_remainder.iter().cycle().take(remaining) {
        counts[class_index] += 1;
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::testing::load;

    fn scenario_with_shares(devices: u32, shares: &[f64]) -> Scenario<()> {
        let mut scenario = load("paper", &[]).expect("a preset").with_policy(());
        scenario.run.devices = devices;
        let class = scenario.classes[0].clone();
        scenario.classes = shares
            .iter()
            .map(|&share| DeviceClass {
                members: Members::Share(share),
                ..class.clone()
            })
            .collect();
        scenario
    }

    #[test]
    fn counts_follow_the_largest_remainder() {
        for (devices, shares, counts) in [
            (10, vec![0.5, 0.5], vec![5, 5]),
            (10, vec![0.34, 0.33, 0.33], vec![4, 3, 3]),
            (2, vec![0.25, 0.3, 0.45], vec![0, 1, 1]),
            (100, vec![0.29, 0.71], vec![29, 71]),
            (7, vec![1.0], vec![7]),
        ] {
            assert_eq!(
                class_counts(&scenario_with_shares(devices, &shares), devices as usize),
                counts,
                "{devices} devices, shares {shares:?}"
            );
        }
    }

    #[test]
    fn the_seed_determines_the_members_of_classes() {
        let mut scenario = scenario_with_shares(100, &[0.3, 0.7]);
        let first = assign_classes(&scenario);
        assert_eq!(first, assign_classes(&scenario));
        assert_eq!(first.iter().filter(|&&class| class == 0).count(), 30);
        scenario.run.seed += 1;
        assert_ne!(first, assign_classes(&scenario));
        assert_eq!(assign_classes(&scenario_with_shares(5, &[1.0])), [0; 5]);
    }
}
