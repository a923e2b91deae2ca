//! Tests of [`Ages`]: the age of each cell, and the gain of letting a device sense, against a slow computation over all
//! devices and cells from the definition; also the largest age, the cells in range, and the removal of devices. Lost
//! reports are not tested here. The worths repeat the definition, not `index_table`.

use reveille_common::geometry::{Layout, place_devices};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::sensing::Fusion;

use super::*;

const D_MAX: f64 = 4.0;
const ETA: f64 = 0.4;
const KINDS: [DetectionKind; 2] = [DetectionKind::Range, DetectionKind::Probabilistic];
/// Width and height of areas with fewer rows or columns than a sensing square, and of large ones, m.
const AREAS: [(f64, f64); 5] = [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (9.1, 8.6), (70.0, 12.0)];
/// Largest triangular number that fits a byte.
const WORTH_CAP: u8 = 253;

fn sensing(kind: DetectionKind) -> Sensing {
    Sensing {
        kind,
        d_max: D_MAX,
        eta: ETA,
        psi: 1.0,
        g: Fusion::Max,
    }
}

/// Returns the middle of each cell.
fn cell_middles(ages: &Ages) -> Vec<Point> {
    let cells = &ages.cells;
    let middle_of = |cell: usize| cells.middle(cell / cells.stride(), cell % cells.stride());
    cells.all().map(middle_of).collect()
}

/// Returns the probability that a device at `position` detects an event at `place`.
fn detection_probability(kind: DetectionKind, position: Point, place: Point) -> f64 {
    match position.distance(place) {
        d if d > D_MAX => 0.0,
        _ if kind == DetectionKind::Range => 1.0,
        d => libm::exp(-ETA * d),
    }
}

/// Returns the worth of `age`, interpolated between whole ages.
fn worth(age: f64) -> f64 {
    let worth_at = |age: f64| (age * (age + 1.0) / 2.0).min(f64::from(WORTH_CAP));
    worth_at(age.floor()) * (1.0 - age.fract()) + worth_at(age.floor() + 1.0) * age.fract()
}

/// Lets random devices sense in each TTI.
#[test]
fn ages_and_gains_equal_their_definition() {
    const DEVICES: usize = 30;
    for kind in KINDS {
        for (seed, (width, height)) in (0..).zip(AREAS) {
            let area = Area { width, height };
            let positions = place_devices(&Layout::Uniform, area, DEVICES as u32, 5);
            let mut ages = Ages::new(&positions, area, &sensing(kind));
            let places = cell_middles(&ages);
            let mut expected_ages = vec![1.0_f64; places.len()];
            let mut stream = Stream::new(seed, Purpose::Epicentre, 0);
            for k in 0..60 {
                let sensing_devices: Vec<usize> = (0..DEVICES).filter(|_| stream.unit() < 0.07).collect();
                let detection = |place: Point, j: usize| detection_probability(kind, positions[j], place);
                let miss_probability = |place: Point| {
                    sensing_devices
                        .iter()
                        .map(|&j| 1.0 - detection(place, j))
                        .product::<f64>()
                };
                // Another device is added first and removed last, which must not change the result.
                let temporary = Some((k * 7) % DEVICES).filter(|j| !sensing_devices.contains(j));
                if let Some(j) = temporary {
                    ages.add(j);
                }
                sensing_devices.iter().rev().for_each(|&j| ages.add(j));
                if let Some(j) = temporary {
                    ages.remove(j);
                }
                for j in (0..DEVICES).filter(|j| !sensing_devices.contains(j)) {
                    let expected_gain_of_cell =
                        |(&age, &place): (&f64, &Point)| worth(age) * miss_probability(place) * detection(place, j);
                    let expected_gain: f64 = expected_ages.iter().zip(&places).map(expected_gain_of_cell).sum();
                    let gain = ages.gain(j);
                    // The ages round logarithms of probabilities to 2⁻³², and a gain sums over up to 256 cells.
                    assert!(
                        (gain - expected_gain).abs() < 1e-6 * expected_gain.max(1.0),
                        "{kind:?}, {width} m wide, TTI {k}, device {j}: gain {gain}, not {expected_gain}"
                    );
                }
                let is_event_reported = k % 23 == 22;
                for (age, &place) in expected_ages.iter_mut().zip(&places) {
                    *age = if is_event_reported {
                        1.0
                    } else {
                        *age * miss_probability(place) + 1.0
                    };
                }
                ages.advance(is_event_reported);
                for (&expected_age, &place) in expected_ages.iter().zip(&places) {
                    let age = ages.age_at(place);
                    assert!(
                        (age - expected_age).abs() < 1e-6,
                        "{kind:?}, {width} m wide, TTI {k}, {place:?}: age {age}, not {expected_age}"
                    );
                }
            }
        }
    }
}

#[test]
fn an_unseen_place_ages_up_to_the_maximum() {
    let area = Area {
        width: 40.0,
        height: 8.0,
    };
    let device = Point::new(2.0, 4.0);
    let (seen, unseen) = (Point::new(2.5, 4.5), Point::new(39.0, 1.0));
    let mut ages = Ages::new(&[device], area, &sensing(DetectionKind::Range));
    // With certain detection ages are whole numbers, so they are exact.
    let age_at = |ages: &Ages, place: Point| ages.age_at(place).to_bits();
    for k in 1..400_usize {
        let expected_age = k.min(usize::from(index_table::MAX_AGE)) as f64;
        assert_eq!(age_at(&ages, unseen), expected_age.to_bits(), "unseen place, TTI {k}");
        assert_eq!(age_at(&ages, seen), 1.0_f64.to_bits(), "seen place, TTI {k}");
        ages.add(0);
        ages.advance(false);
    }
    ages.advance(true);
    assert_eq!(age_at(&ages, unseen), 1.0_f64.to_bits(), "after an event was reported");
}

#[test]
fn the_gain_covers_exactly_the_area_in_range() {
    const DRAWS: u32 = 20_000;
    for (width, height) in AREAS {
        let area = Area { width, height };
        let positions = place_devices(&Layout::Uniform, area, 12, 9);
        // At first every age is 1, which has worth 1, so the gain is the number of cells in range.
        let ages = Ages::new(&positions, area, &sensing(DetectionKind::Range));
        let mut stream = Stream::new(2, Purpose::Epicentre, 0);
        for (j, position) in positions.iter().enumerate() {
            let mut draw_place = || Point::new(width * stream.unit(), height * stream.unit());
            let in_range = (0..DRAWS).filter(|_| draw_place().distance(*position) <= D_MAX).count();
            let expected_share = in_range as f64 / f64::from(DRAWS);
            let share = ages.gain(j) * ages.cell_surface() / area.surface();
            // The error of the draws is about 0.004, and the border of the range is made of whole cells.
            assert!(
                (share - expected_share).abs() < 0.02,
                "{width} m wide, device {j}: {share} of the area, not {expected_share}"
            );
        }
    }
}

#[test]
fn removing_or_clearing_all_devices_restores_the_gains() {
    const DEVICES: usize = 300;
    for kind in KINDS {
        let area = Area {
            width: 20.0,
            height: 20.0,
        };
        let positions = place_devices(&Layout::Uniform, area, DEVICES as u32, 2);
        let mut ages = Ages::new(&positions, area, &sensing(kind));
        (0..4).for_each(|_| ages.advance(false));
        let initial_gains: Vec<f64> = (0..DEVICES).map(|j| ages.gain(j)).collect();
        // Exactly, since the ages add logarithms of probabilities as whole numbers.
        let is_restored = |ages: &Ages| (0..DEVICES).all(|j| ages.gain(j).to_bits() == initial_gains[j].to_bits());
        (0..DEVICES).for_each(|j| ages.add(j));
        assert!(!is_restored(&ages), "{kind:?}: adding all devices changes no gain");
        (0..DEVICES).for_each(|j| ages.remove(j));
        assert!(is_restored(&ages), "{kind:?}: after removing all devices");
        (0..DEVICES).for_each(|j| ages.add(j));
        ages.clear();
        assert!(is_restored(&ages), "{kind:?}: after clearing the choice");
    }
}
