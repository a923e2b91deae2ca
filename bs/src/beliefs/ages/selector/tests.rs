//! Tests of [`DeviceSelector`]: close to the best subset, no redundant device, prices respected.

use reveille_common::geometry::{Layout, place_devices};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::sensing::{DetectionKind, Fusion, Sensing};

use super::super::index_table::age_worths;
use super::*;

const AREA: Area = Area {
    width: 12.0,
    height: 9.0,
};
const KINDS: [DetectionKind; 2] = [DetectionKind::Range, DetectionKind::Probabilistic];

fn positions_and_ages(kind: DetectionKind, n: u32, seed: u64) -> (Vec<Point>, Ages) {
    let sensing = Sensing {
        kind,
        d_max: 3.0,
        eta: 0.3,
        psi: 1.0,
        g: Fusion::Max,
    };
    let positions = place_devices(&Layout::Uniform, AREA, n, seed);
    let ages = Ages::new(&positions, AREA, &sensing, age_worths());
    (positions, ages)
}

/// Returns the worth of a choice less its price.
fn net(ages: &Ages, prices: &[f64], chosen: impl IntoIterator<Item = usize>) -> f64 {
    let mut ages = ages.clone();
    ages.clear();
    let mut sum = 0.0;
    for j in chosen {
        sum += ages.gain(j) - prices[j];
        ages.add(j);
    }
    sum
}

/// Compares choices with the best subset of a few devices: they are never better. Over 80 % are equal to it, and each
/// has at least 70 % of its net worth, over 99 % on average.
#[test]
fn choices_are_mostly_the_best_subset() {
    const N: u32 = 7;
    for kind in KINDS {
        let (mut decisions, mut best_ones, mut ratio_sum) = (0, 0, 0.0);
        for seed in 0..12 {
            let (positions, mut ages) = positions_and_ages(kind, N, seed);
            let mut selector = DeviceSelector::new(&positions, AREA, 3.0);
            let mut stream = Stream::new(seed, Purpose::Epicentre, 0);
            for k in 0..12 {
                let prices: Vec<f64> = (0..N).map(|_| 60.0 + 90.0 * stream.unit()).collect();
                let chosen = selector.choose(&mut ages, &prices);
                let chosen_net = net(&ages, &prices, chosen.iter().map(|device| device.index()));
                let subset = |bits: u32| (0..N as usize).filter(move |j| bits >> j & 1 == 1);
                let best_net = (0..1 << N)
                    .map(|bits| net(&ages, &prices, subset(bits)))
                    .fold(0.0, f64::max);
                assert!(
                    chosen_net <= best_net + 1e-6 && chosen_net >= 0.7 * best_net,
                    "{kind:?}: {chosen_net} of {best_net}"
                );
                if best_net > 0.0 {
                    decisions += 1;
                    best_ones += u32::from(chosen_net > best_net - 1e-6);
                    ratio_sum += chosen_net / best_net;
                }
                // An event is reported in every seventh TTI.
                ages.advance(k % 7 == 6);
            }
        }
        assert!(
            decisions > 80 && best_ones * 10 > decisions * 8,
            "{best_ones} of {decisions}"
        );
        assert!(
            ratio_sum > 0.99 * f64::from(decisions),
            "{kind:?}: {ratio_sum} of {decisions}"
        );
    }
}

/// A device that covers all cells is chosen alone; if it may not be chosen, the other two are.
#[test]
fn one_device_that_covers_all_is_chosen_alone() {
    let sensing = Sensing {
        kind: DetectionKind::Range,
        d_max: 3.0,
        eta: 1.0,
        psi: 1.0,
        g: Fusion::Max,
    };
    // The first covers all but a strip of 0.1 m, less than a cell; the other two cover the area only together.
    let area = Area {
        width: 6.0,
        height: 0.4,
    };
    let positions = [Point::new(3.1, 0.2), Point::new(0.5, 0.2), Point::new(5.5, 0.2)];
    let mut ages = Ages::new(&positions, area, &sensing, age_worths());
    let cells_gained = ages.gain(0);
    let chosen = DeviceSelector::new(&positions, area, 3.0).choose(&mut ages, &[0.2; 3]);
    let sees_all = (cells_gained * ages.cell_surface() - area.surface()).abs() < 0.3;
    assert!(sees_all, "{cells_gained}");
    assert_eq!(chosen, [DeviceId(0)], "one sees it all");
    ages.clear();
    // The first may not be chosen.
    let prices = [f64::INFINITY, 0.2, 0.2];
    let chosen = DeviceSelector::new(&positions, area, 3.0).choose(&mut ages, &prices);
    assert_eq!(chosen, [DeviceId(1), DeviceId(2)]);
}

#[test]
fn without_a_price_no_place_in_reach_is_left_out_and_no_redundant_device_is_chosen() {
    for kind in KINDS {
        let (positions, mut ages) = positions_and_ages(kind, 60, 4);
        let mut selector = DeviceSelector::new(&positions, AREA, 3.0);
        let mut prices = vec![1e-30; 60];
        // Some devices may not be chosen.
        (0..60).step_by(7).for_each(|j| prices[j] = f64::INFINITY);
        for _ in 0..5 {
            let chosen = selector.choose(&mut ages, &prices);
            assert!(!chosen.iter().any(|device| device.index() % 7 == 0));
            let mut each = chosen.clone();
            each.sort_unstable();
            each.dedup();
            assert_eq!(each.len(), chosen.len(), "each once");
            for j in (0..60).filter(|j| j % 7 != 0 && !chosen.contains(&DeviceId(*j as u32))) {
                assert!(ages.gain(j) <= 1e-9, "{kind:?} {j}: {}", ages.gain(j));
            }
            for device in &chosen {
                ages.remove(device.index());
                assert!(ages.gain(device.index()) > 0.0, "{device:?} is redundant");
                ages.add(device.index());
            }
            // No event is reported.
            ages.advance(false);
        }
    }
}

#[test]
fn a_device_that_costs_more_than_any_gain_stays_asleep() {
    let (positions, mut ages) = positions_and_ages(DetectionKind::Range, 40, 8);
    let mut selector = DeviceSelector::new(&positions, AREA, 3.0);
    // No sensing area has more than 16 · 16 cells.
    assert!(selector.choose(&mut ages, &[256.0; 40]).is_empty());
    (0..30).for_each(|_| ages.advance(false));
    assert!(
        !selector.choose(&mut ages, &[256.0; 40]).is_empty(),
        "places have got old"
    );
}
