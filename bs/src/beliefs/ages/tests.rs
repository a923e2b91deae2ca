//! Ages and worths of cells against their definition, computed from all devices and cells.

use reveille_common::geometry::{Layout, place_devices};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::sensing::Fusion;

use super::*;

fn sensing(kind: DetectionKind) -> Sensing {
    Sensing {
        kind,
        d_max: 4.0,
        eta: 0.4,
        psi: 1.0,
        g: Fusion::Max,
    }
}

const AREAS: [(f64, f64); 5] = [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (9.1, 8.6), (70.0, 12.0)];

/// a(a + 1)/2 up to the limit of a byte.
fn triangle() -> AgeIndexTable {
    std::array::from_fn(|age| (age * (age + 1) / 2).min(253) as u8)
}

/// Returns each cell with its middle.
fn middles(ages: &Ages) -> Vec<(usize, Point)> {
    let cells = &ages.cells;
    let of = |cell: usize| cells.middle(cell / cells.stride(), cell % cells.stride());
    cells.all().map(|cell| (cell, of(cell))).collect()
}

/// Keeps ages and worths by definition, cell by cell, and compares them in random choices.
#[test]
fn ages_and_worths_are_those_of_the_definition() {
    for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
        for (area, (width, height)) in AREAS.into_iter().enumerate() {
            let area_of = Area { width, height };
            let points = place_devices(&Layout::Uniform, area_of, 30, 5);
            let sensing = sensing(kind);
            let mut ages = Ages::new(&points, area_of, &sensing, triangle());
            let cells = middles(&ages);
            let mut expected = vec![1.0_f64; cells.len()];
            let mut stream = Stream::new(area as u64, Purpose::Epicentre, 0);
            for k in 0..60 {
                let chosen: Vec<usize> = (0..30).filter(|_| stream.unit() < 0.07).collect();
                let finds = |at: Point, j: usize| match points[j].distance(at) {
                    d if d > 4.0 => 0.0,
                    _ if kind == DetectionKind::Range => 1.0,
                    d => libm::exp(-0.4 * d),
                };
                let missed = |at: Point| chosen.iter().map(|&j| 1.0 - finds(at, j)).product::<f64>();
                // Adds and removes a device in between, in any order.
                let detour = (k * 7) % 30;
                if !chosen.contains(&detour) {
                    ages.add(detour);
                }
                chosen.iter().rev().for_each(|&j| ages.add(j));
                if !chosen.contains(&detour) {
                    ages.remove(detour);
                }
                let worth = |age: f64| {
                    let of = |age: f64| (age * (age + 1.0) / 2.0).min(253.0);
                    of(age.floor()) * (1.0 - age.fract()) + of(age.floor() + 1.0) * age.fract()
                };
                for j in (0..30).filter(|j| !chosen.contains(j)) {
                    let of = |(i, &(_, at)): (usize, &(usize, Point))| worth(expected[i]) * missed(at) * finds(at, j);
                    let sum: f64 = cells.iter().enumerate().map(of).sum();
                    let told = ages.gain(j);
                    assert!(
                        (told - sum).abs() < 1e-6 * sum.max(1.0),
                        "{kind:?} {width} {k} {j}: {told} {sum}"
                    );
                }
                let is_found = k % 23 == 22;
                ages.advance(is_found);
                for (age, &(_, at)) in expected.iter_mut().zip(&cells) {
                    *age = if is_found { 1.0 } else { *age * missed(at) + 1.0 };
                    assert!((ages.age_at(at) - *age).abs() < 1e-6, "{kind:?} {width} {k}");
                }
            }
        }
    }
}

#[test]
fn a_place_that_nobody_sees_gets_old_and_no_older() {
    let area = Area {
        width: 40.0,
        height: 8.0,
    };
    let mut ages = Ages::new(
        &[Point::new(2.0, 4.0)],
        area,
        &sensing(DetectionKind::Range),
        triangle(),
    );
    for k in 1..400_u32 {
        assert!((ages.age_at(Point::new(39.0, 1.0)) - f64::from(k.min(255))).abs() < 1e-12);
        assert!((ages.age_at(Point::new(2.5, 4.5)) - 1.0).abs() < 1e-12);
        ages.add(0);
        ages.advance(false);
    }
    ages.advance(true);
    assert!(
        (ages.age_at(Point::new(39.0, 1.0)) - 1.0).abs() < 1e-12,
        "an event was found"
    );
}

#[test]
fn the_cells_that_count_are_those_within_reach() {
    for (width, height) in AREAS {
        let area = Area { width, height };
        let points = place_devices(&Layout::Uniform, area, 12, 9);
        let mut one = [0; index_table::MAX_AGE + 1];
        one[1] = 1;
        let ages = Ages::new(&points, area, &sensing(DetectionKind::Range), one);
        let mut stream = Stream::new(2, Purpose::Epicentre, 0);
        for (j, p) in points.iter().enumerate() {
            // The share of the area in range, by random draws.
            let draw = |_: &u32| Point::new(width * stream.unit(), height * stream.unit()).distance(*p) <= 4.0;
            let share = (0..20_000).filter(draw).count() as f64 / 20_000.0;
            let counted = ages.gain(j) * ages.cell_surface() / area.surface();
            assert!((counted - share).abs() < 0.02, "{width} {j}: {counted}, not {share}");
        }
    }
}

#[test]
fn taking_all_back_leaves_what_was_there() {
    for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
        let area = Area {
            width: 20.0,
            height: 20.0,
        };
        let points = place_devices(&Layout::Uniform, area, 300, 2);
        let mut ages = Ages::new(&points, area, &sensing(kind), triangle());
        (0..4).for_each(|_| ages.advance(false));
        let before: Vec<f64> = (0..300).map(|j| ages.gain(j)).collect();
        let same = |ages: &Ages| (0..300).all(|j| (ages.gain(j) - before[j]).abs() < 1e-6);
        (0..300).for_each(|j| ages.add(j));
        assert!(!same(&ages));
        (0..300).for_each(|j| ages.remove(j));
        assert!(same(&ages), "{kind:?}");
        (0..300).for_each(|j| ages.add(j));
        ages.clear();
        assert!(same(&ages), "{kind:?}");
    }
}
