//! Which device is of which class.

use super::model::Scenario;
use crate::rng::{Purpose, Stream};

/// The class of each device as an index into [`Scenario::classes`]. The layout's file may say it; else it is the same
/// for the same seed: the numbers of devices follow the shares by largest remainder, which devices they are is drawn
/// from the seed.
pub fn assign_classes(scenario: &Scenario) -> Vec<u16> {
    if let Some(classes) = scenario.layout.classes() {
        return classes.to_vec();
    }
    let counts = class_counts(scenario);
    let mut classes: Vec<u16> = (0u16..)
        .zip(&counts)
        .flat_map(|(class, &count)| std::iter::repeat_n(class, count))
        .collect();
    if counts.len() > 1 {
        Stream::new(scenario.seed, Purpose::Classes, 0).shuffle(&mut classes);
    }
    classes
}

/// Devices in each class, N in all.
fn class_counts(scenario: &Scenario) -> Vec<usize> {
    let devices = scenario.devices as usize;
    let quotas: Vec<f64> = scenario
        .classes
        .iter()
        .map(|class| class.share * devices as f64)
        .collect();
    let mut left = devices;
    let mut counts = Vec::with_capacity(quotas.len());
    for quota in &quotas {
        let count = (quota.floor() as usize).min(left);
        left -= count;
        counts.push(count);
    }
    let mut by_remainder: Vec<usize> = (0..quotas.len()).collect();
    by_remainder.sort_by(|&a, &b| quotas[b].fract().total_cmp(&quotas[a].fract()));
    for &class in by_remainder.iter().cycle().take(left) {
        counts[class] += 1;
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::DeviceClass;
    use crate::scenario::testing::load;

    fn with_shares(devices: u32, shares: &[f64]) -> Scenario {
        let mut scenario = load("paper", &[]).expect("a preset");
        scenario.devices = devices;
        let class = scenario.classes[0].clone();
        scenario.classes = shares
            .iter()
            .map(|&share| DeviceClass { share, ..class.clone() })
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
                class_counts(&with_shares(devices, &shares)),
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
