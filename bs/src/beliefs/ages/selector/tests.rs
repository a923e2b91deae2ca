//! Tests of [`DeviceSelector`]: choices against the best subset of a few devices, without redundant devices, and within
//! prices. `tests/tests/age_index.rs` compares whole choices with the reference.

use reveille_common::geometry::{Layout, place_devices};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::sensing::{DetectionKind, Fusion, Sensing};

use super::super::MIN_PRICE;
use super::*;

const AREA: Area = Area {
    width: 12.0,
    height: 9.0,
};
const D_MAX: f64 = 3.0;
const KINDS: [DetectionKind; 2] = [DetectionKind::Range, DetectionKind::Probabilistic];

fn sensing(kind: DetectionKind) -> Sensing {
    Sensing {
        kind,
        d_max: D_MAX,
        eta: 0.3,
        psi: 1.0,
        g: Fusion::Max,
    }
}

fn positions_and_ages(kind: DetectionKind, n: u32, seed: u64) -> (Vec<Point>, Ages) {
    let positions = place_devices(&Layout::Uniform, AREA, n, seed);
    let ages = Ages::new(&positions, AREA, &sensing(kind));
    (positions, ages)
}

/// Returns the worth of a choice less its prices.
fn net_worth(ages: &Ages, prices: &[f64], devices: impl IntoIterator<Item = usize>) -> f64 {
    let mut ages = ages.clone();
    ages.clear();
    let mut net = 0.0;
    for j in devices {
        net += ages.gain(j) - prices[j];
        ages.add(j);
    }
    net
}

#[test]
fn given_gains_lead_to_the_same_choice() {
    const N: u32 = 40;
    for kind in KINDS {
        let (positions, mut ages) = positions_and_ages(kind, N, 3);
        let mut selector = DeviceSelector::new(&positions, AREA, D_MAX);
        let prices = vec![70.0; N as usize];
        for _ in 0..6 {
            let gains: Vec<f64> = (0..N as usize).map(|j| ages.gain(j)).collect();
            let mut other_ages = ages.clone();
            let chosen = selector.choose(&mut ages, &prices);
            assert_eq!(selector.choose_with_gains(&mut other_ages, &prices, &gains), chosen);
            ages.advance(false);
        }
    }
}

/// Over 80 % of the choices equal the best of all subsets. Each has at least 70 % of its net worth, over 99 % on
/// average. These are limits for the seeds below, not requirements.
#[test]
fn choices_are_close_to_the_best_subset() {
    const N: u32 = 7;
    for kind in KINDS {
        let (mut decisions, mut optimal_choices, mut ratio_sum) = (0, 0, 0.0);
        for seed in 0..12 {
            let (positions, mut ages) = positions_and_ages(kind, N, seed);
            let mut selector = DeviceSelector::new(&positions, AREA, D_MAX);
            let mut stream = Stream::new(seed, Purpose::Epicentre, 0);
            for k in 0..12 {
                let prices: Vec<f64> = (0..N).map(|_| 60.0 + 90.0 * stream.unit()).collect();
                let chosen = selector.choose(&mut ages, &prices);
                let chosen_net = net_worth(&ages, &prices, chosen.iter().map(|device| device.index()));
                let subset = |bits: u32| (0..N as usize).filter(move |j| bits >> j & 1 == 1);
                let best_net = (0..1 << N)
                    .map(|bits| net_worth(&ages, &prices, subset(bits)))
                    .fold(0.0, f64::max);
                assert!(
                    chosen_net <= best_net + 1e-6 && chosen_net >= 0.7 * best_net,
                    "{kind:?}: net worth {chosen_net} of {best_net}"
                );
                if best_net > 0.0 {
                    decisions += 1;
                    optimal_choices += u32::from(chosen_net > best_net - 1e-6);
                    ratio_sum += chosen_net / best_net;
                }
                // An event is reported in every seventh TTI.
                ages.advance(k % 7 == 6);
            }
        }
        assert!(
            decisions > 80 && optimal_choices * 10 > decisions * 8,
            "{kind:?}: {optimal_choices} of {decisions} choices are optimal"
        );
        assert!(
            ratio_sum > 0.99 * f64::from(decisions),
            "{kind:?}: ratios add up to {ratio_sum} in {decisions} decisions"
        );
    }
}

#[test]
fn a_device_that_covers_all_cells_is_chosen_alone() {
    // The first covers all but a strip of 0.1 m, less than a cell; the other two cover the area only together. All ages
    // are 1, so a gain is a number of cells.
    let area = Area {
        width: 6.0,
        height: 0.4,
    };
    let positions = [Point::new(3.1, 0.2), Point::new(0.5, 0.2), Point::new(5.5, 0.2)];
    let mut ages = Ages::new(&positions, area, &sensing(DetectionKind::Range));
    let cells_covered = ages.gain(0);
    // A price below the gain of one cell.
    let chosen = DeviceSelector::new(&positions, area, D_MAX).choose(&mut ages, &[0.2; 3]);
    // A cell has 0.16 m².
    let covers_all = (cells_covered * ages.cell_surface() - area.surface()).abs() < 0.3;
    assert!(covers_all, "device 0 covers {cells_covered} cells");
    assert_eq!(chosen, [DeviceId(0)], "no other device adds anything");
    ages.clear();
    // The first may not be chosen.
    let prices = [f64::INFINITY, 0.2, 0.2];
    let chosen = DeviceSelector::new(&positions, area, D_MAX).choose(&mut ages, &prices);
    assert_eq!(chosen, [DeviceId(1), DeviceId(2)]);
}

#[test]
fn without_prices_all_cells_in_range_are_covered_and_no_device_is_redundant() {
    for kind in KINDS {
        let (positions, mut ages) = positions_and_ages(kind, 60, 4);
        let mut selector = DeviceSelector::new(&positions, AREA, D_MAX);
        let mut prices = vec![MIN_PRICE; 60];
        // Some devices may not be chosen.
        (0..60).step_by(7).for_each(|j| prices[j] = f64::INFINITY);
        for _ in 0..5 {
            let chosen = selector.choose(&mut ages, &prices);
            assert!(!chosen.iter().any(|device| device.index() % 7 == 0));
            let mut distinct = chosen.clone();
            distinct.sort_unstable();
            distinct.dedup();
            assert_eq!(distinct.len(), chosen.len(), "a device is chosen twice");
            for j in (0..60).filter(|j| j % 7 != 0 && !chosen.contains(&DeviceId(*j as u32))) {
                assert!(ages.gain(j) <= 1e-9, "{kind:?}: device {j} would gain {}", ages.gain(j));
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
fn a_device_whose_price_exceeds_any_gain_is_not_chosen() {
    let (positions, mut ages) = positions_and_ages(DetectionKind::Range, 40, 8);
    let mut selector = DeviceSelector::new(&positions, AREA, D_MAX);
    // A sensing area has at most 16 · 16 cells, each worth 1 at first.
    assert!(selector.choose(&mut ages, &[256.0; 40]).is_empty());
    (0..30).for_each(|_| ages.advance(false));
    assert!(
        !selector.choose(&mut ages, &[256.0; 40]).is_empty(),
        "30 TTIs later, gains exceed the prices"
    );
}

#[test]
fn choices_with_and_without_lists_of_neighbours_are_equal() {
    for kind in KINDS {
        let (positions, mut ages) = positions_and_ages(kind, 60, 3);
        let mut with_lists = DeviceSelector::new(&positions, AREA, D_MAX);
        let lists = |max_entries| NeighbourLists::new(&positions, &with_lists.buckets, D_MAX, max_entries);
        let entries = lists(usize::MAX).expect("no limit").devices.len();
        assert!(lists(entries).is_some() && lists(entries - 1).is_none());
        let mut without_lists = DeviceSelector {
            neighbours: None,
            ..with_lists.clone()
        };
        let mut stream = Stream::new(3, Purpose::Epicentre, 0);
        for k in 0..40 {
            let prices: Vec<f64> = (0..60).map(|_| 20.0 + 90.0 * stream.unit()).collect();
            let chosen = without_lists.choose(&mut ages.clone(), &prices);
            assert_eq!(with_lists.choose(&mut ages, &prices), chosen, "{kind:?}, TTI {k}");
            ages.advance(k % 7 == 6);
        }
    }
}

/// Reviews, and the instructions of the selector, change the time of a choice, never the choice.
#[test]
fn choices_with_and_without_reviews_are_equal() {
    for kind in KINDS {
        let (positions, mut ages) = positions_and_ages(kind, 90, 6);
        let selector = DeviceSelector::new(&positions, AREA, D_MAX);
        let mut stream = Stream::new(6, Purpose::Epicentre, 0);
        for k in 0..40 {
            let prices: Vec<f64> = (0..90).map(|_| 10.0 + 60.0 * stream.unit()).collect();
            let choose = |first_review: usize, vector_width: VectorWidth| {
                let mut selector = DeviceSelector {
                    first_review,
                    vector_width,
                    ..selector.clone()
                };
                selector.choose(&mut ages.clone(), &prices)
            };
            let never = choose(usize::MAX, VectorWidth::fastest());
            assert!(!never.is_empty() || k % 7 == 0, "{kind:?}, TTI {k}: no choice");
            for vector_width in VectorWidth::supported() {
                for first_review in [1, 2, 5] {
                    assert_eq!(choose(first_review, vector_width), never, "{kind:?}, TTI {k}");
                }
            }
            for device in never {
                ages.add(device.index());
            }
            ages.advance(k % 7 == 6);
        }
    }
}
