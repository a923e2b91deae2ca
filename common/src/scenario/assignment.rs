//! Which device is of which class.

use super::classes::DeviceClass;
use super::members::{Members, Zone};
use super::model::Scenario;
use crate::geometry::place;
use crate::rng::{Purpose, Stream};

/// The class of each device as an index into [`Scenario::classes`]. The layout's file may say it. Else devices are of
/// the class that names them by number, and of those left over those that stand at the place of a class are of the
/// first such. The rest is the same for the same seed: the numbers of devices follow the shares by largest remainder,
/// which devices they are is drawn from the seed.
///
/// # Panics
/// If a device is of no class, which no scenario that was loaded lets happen.
pub fn assign_classes(scenario: &Scenario) -> Vec<u16> {
    let assigned = try_assign(scenario);
    assigned.unwrap_or_else(|j| panic!("device {j} is of no class"))
}

/// The same; the first device that is of no class where there is one.
pub(super) fn try_assign(scenario: &Scenario) -> Result<Vec<u16>, usize> {
    if let Some(classes) = scenario.layout.classes() {
        return Ok(classes.to_vec());
    }
    let named = named(scenario);
    let left = named.iter().filter(|class| class.is_none()).count();
    let counts = class_counts(scenario, left);
    let mut rest: Vec<u16> = (0u16..)
        .zip(&counts)
        .flat_map(|(class, &count)| std::iter::repeat_n(class, count))
        .collect();
    if counts.len() > 1 {
        Stream::new(scenario.seed, Purpose::Classes, 0).shuffle(&mut rest);
    }
    let mut rest = rest.into_iter();
    let of = |(j, class): (usize, Option<u16>)| class.or_else(|| rest.next()).ok_or(j);
    named.into_iter().enumerate().map(of).collect()
}

/// The class of each device that some class names by number or by place.
fn named(scenario: &Scenario) -> Vec<Option<u16>> {
    let mut named = vec![None; scenario.devices as usize];
    for (class, kind) in (0u16..).zip(&scenario.classes) {
        if let Members::Devices(devices) = &kind.members {
            for &j in devices {
                named[j as usize] = Some(class);
            }
        }
    }
    let zone = |(class, kind): (u16, &DeviceClass)| match kind.members {
        Members::Within(zone) => Some((class, zone)),
        Members::Share(_) | Members::Devices(_) | Members::Layout => None,
    };
    let zones: Vec<(u16, Zone)> = (0u16..).zip(&scenario.classes).filter_map(zone).collect();
    if !zones.is_empty() {
        let positions = place(&scenario.layout, scenario.area, scenario.devices, scenario.seed);
        for (named, position) in named.iter_mut().zip(positions).filter(|(named, _)| named.is_none()) {
            let first = zones.iter().find(|(_, zone)| zone.contains(position));
            *named = first.map(|&(class, _)| class);
        }
    }
    named
}

/// Of `devices` devices that no class names otherwise, those in each class; none where no class has a share.
fn class_counts(scenario: &Scenario, devices: usize) -> Vec<usize> {
    let share = |class: &DeviceClass| match class.members {
        Members::Share(share) => share,
        Members::Devices(_) | Members::Within(_) | Members::Layout => 0.0,
    };
    let quotas: Vec<f64> = scenario
        .classes
        .iter()
        .map(|class| share(class) * devices as f64)
        .collect();
    let mut left = devices;
    let mut counts = Vec::with_capacity(quotas.len());
    for quota in &quotas {
        let count = (quota.floor() as usize).min(left);
        left -= count;
        counts.push(count);
    }
    let has_share = |&index: &usize| matches!(scenario.classes[index].members, Members::Share(_));
    let mut by_remainder: Vec<usize> = (0..quotas.len()).filter(has_share).collect();
    by_remainder.sort_by(|&a, &b| quotas[b].fract().total_cmp(&quotas[a].fract()));
    for &class in by_remainder.iter().cycle().take(left) {
        counts[class] += 1;
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::testing::load;

    fn with_shares(devices: u32, shares: &[f64]) -> Scenario {
        let mut scenario = load("paper", &[]).expect("a preset");
        scenario.devices = devices;
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
                class_counts(&with_shares(devices, &shares), devices as usize),
                counts,
                "{devices} {shares:?}"
            );
        }
    }

    #[test]
    fn the_seed_decides_who_is_in_which_class() {
        let mut scenario = with_shares(100, &[0.3, 0.7]);
        let first = assign_classes(&scenario);
        assert_eq!(first, assign_classes(&scenario));
        assert_eq!(first.iter().filter(|&&class| class == 0).count(), 30);
        scenario.seed += 1;
        assert_ne!(first, assign_classes(&scenario));
        assert_eq!(assign_classes(&with_shares(5, &[1.0])), [0; 5]);
    }
}
