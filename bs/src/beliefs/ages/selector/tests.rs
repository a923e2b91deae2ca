//! Choices of devices against the best of all subsets.

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

fn grounds(kind: DetectionKind, n: u32, seed: u64) -> (Vec<Point>, Ages) {
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

/// Compares choices with the best subset of a few devices: they are never better, mostly equal and otherwise little
/// worse.
#[test]
fn of_all_choices_it_is_mostly_the_best() {
    const N: u32 = 7;
    for kind in KINDS {
        let (mut decisions, mut best_ones, mut share) = (0, 0, 0.0);
        for seed in 0..12 {
            let (positions, mut ages) = grounds(kind, N, seed);
            let mut choice = DeviceSelector::new(&positions, AREA, 3.0);
            let mut stream = Stream::new(seed, Purpose::Epicentre, 0);
            for k in 0..12 {
                let prices: Vec<f64> = (0..N).map(|_| 60.0 + 90.0 * stream.unit()).collect();
                let chosen = choice.choose(&mut ages, &prices);
                let reached = net(&ages, &prices, chosen.iter().map(|device| device.index()));
                let subset = |bits: u32| (0..N as usize).filter(move |j| bits >> j & 1 == 1);
                let most = (0..1 << N)
                    .map(|bits| net(&ages, &prices, subset(bits)))
                    .fold(0.0, f64::max);
                assert!(
                    reached <= most + 1e-6 && reached >= 0.7 * most,
                    "{kind:?}: {reached} of {most}"
                );
                if most > 0.0 {
                    decisions += 1;
                    best_ones += u32::from(reached > most - 1e-6);
                    share += reached / most;
                }
                ages.advance(k % 7 == 6);
            }
        }
        assert!(
            decisions > 80 && best_ones * 10 > decisions * 8,
            "{best_ones} of {decisions}"
        );
        assert!(share > 0.99 * f64::from(decisions), "{kind:?}: {share} of {decisions}");
    }
}

/// A device that covers the whole area is chosen alone; if it may not be chosen, the other two are.
#[test]
fn a_device_that_others_have_made_superfluous_is_taken_out() {
    let sensing = Sensing {
        kind: DetectionKind::Range,
        d_max: 3.0,
        eta: 1.0,
        psi: 1.0,
        g: Fusion::Max,
    };
    // The first covers the whole area; the other two cover it only together.
    let area = Area {
        width: 6.0,
        height: 0.4,
    };
    let positions = [Point::new(3.1, 0.2), Point::new(0.5, 0.2), Point::new(5.5, 0.2)];
    let mut ages = Ages::new(&positions, area, &sensing, age_worths());
    let cell = ages.gain(0);
    let chosen = DeviceSelector::new(&positions, area, 3.0).choose(&mut ages, &[0.2; 3]);
    let sees_all = (cell * ages.cell_surface() - area.surface()).abs() < 0.3;
    assert!(sees_all, "{cell}");
    assert_eq!(chosen, [DeviceId(0)], "one sees it all");
    ages.clear();
    // The first may not be chosen.
    let prices = [f64::INFINITY, 0.2, 0.2];
    let chosen = DeviceSelector::new(&positions, area, 3.0).choose(&mut ages, &prices);
    assert_eq!(chosen, [DeviceId(1), DeviceId(2)]);
}

#[test]
fn without_a_price_no_place_in_reach_is_left_out_and_nobody_idle_is_chosen() {
    for kind in KINDS {
        let (positions, mut ages) = grounds(kind, 60, 4);
        let mut choice = DeviceSelector::new(&positions, AREA, 3.0);
        let mut prices = vec![1e-30; 60];
        // Some devices may not be chosen.
        (0..60).step_by(7).for_each(|j| prices[j] = f64::INFINITY);
        for _ in 0..5 {
            let chosen = choice.choose(&mut ages, &prices);
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
            ages.advance(false);
        }
    }
}

#[test]
fn a_device_that_costs_more_than_any_look_is_worth_stays_asleep() {
    let (positions, mut ages) = grounds(DetectionKind::Range, 40, 8);
    let mut choice = DeviceSelector::new(&positions, AREA, 3.0);
    // No sensing area has more than 16 · 16 cells.
    assert!(choice.choose(&mut ages, &[256.0; 40]).is_empty());
    (0..30).for_each(|_| ages.advance(false));
    assert!(
        !choice.choose(&mut ages, &[256.0; 40]).is_empty(),
        "places have got old"
    );
}
