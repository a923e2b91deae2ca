//! Tests of the figure of a tuning: legibility with crowded points and with a flat objective. The header of the history
//! repeats the names and forms that `TuningPlan::header` writes.

use super::super::tuning;
use super::{check_properties, texts_of};
use reveille_lab::tuning::{Evaluation, History, Ranges, Surface, TuningPoint, WeightPair};

/// Returns a history with the values of `objective` at `pairs`.
fn history(pairs: &[WeightPair], objective: impl Fn(WeightPair) -> f64) -> History {
    let header = [
        ("objective", "balance: information (P1) − 1 × energy − 1 × share missed"),
        ("devices", "100"),
        ("mu1", "0.5 to 20"),
        ("mu2", "1 to 5"),
        ("training", "12 episodes of 3000 TTIs, epsilon 0.1 to 0.03"),
        ("evaluation", "8 runs of 10000 TTIs"),
        ("ranking", "posterior"),
        ("preset", "paper"),
        ("seed", "1"),
    ];
    let mut history = History::new(header.map(|(name, value)| (name.to_owned(), value.to_owned())).to_vec());
    for &weights in pairs {
        let evaluation = Evaluation {
            objective: objective(weights),
            objective_half_width: 0.01,
            information: 0.4,
            information_half_width: 0.01,
            misdetection_pct: 0.1,
            energy: 0.2,
            wake_ups: 1.0,
        };
        history.points.push(TuningPoint { weights, evaluation });
    }
    history
}

/// Returns a surface with the values of `objective` in the middles of 40 × 40 cells over `ranges`.
fn surface(ranges: &Ranges, objective: impl Fn(WeightPair) -> f64) -> Surface {
    let middle = |i: u32| (f64::from(i) + 0.5) / 40.0;
    let row = |j: u32| {
        (0..40)
            .map(|i| objective(ranges.pair_at([middle(i), middle(j)])))
            .collect()
    };
    Surface {
        rows: (0..40).map(row).collect(),
    }
}

/// An objective with its maximum at μ1 = 6, μ2 = 2.
fn hill([mu1, mu2]: WeightPair) -> f64 {
    let (x, y) = (libm::log(mu1 / 6.0), libm::log(mu2 / 2.0));
    0.3 - 0.02 * x * x - 0.1 * y * y
}

#[test]
fn a_tuning_with_crowded_pairs_is_legible() {
    let ranges = Ranges::new((0.5, 20.0), (1.0, 5.0)).expect("ranges");
    let spread: [WeightPair; 6] = [[14.0, 1.6], [0.5, 1.0], [20.0, 5.0], [2.0, 3.0], [1.0, 4.9], [9.0, 2.5]];
    let crowd = (0..14).map(|i| [6.0 + 0.03 * f64::from(i), 2.0 + 0.004 * f64::from(i % 3)]);
    let pairs: Vec<WeightPair> = spread.into_iter().chain(crowd).collect();
    let scene = tuning::scene(&history(&pairs, hill), &ranges, &surface(&ranges, hill));
    check_properties("tuning", &scene);
    let texts = texts_of(&scene);
    for number in 1..=pairs.len() {
        assert!(
            texts.contains(&number.to_string().as_str()),
            "number {number} is missing"
        );
    }
    assert!(scene.title.contains("N = 100") && scene.description.contains("number 7: μ1 = 6, μ2 = 2"));
    let values = texts.iter().filter(|text| text.starts_with("0.")).count();
    assert!(values >= 5, "levels in the key and on lines: {texts:?}");
}

#[test]
fn a_flat_tuning_can_be_drawn() {
    let ranges = Ranges::new((1.0, 10.0), (1.0, 1000.0)).expect("ranges");
    let flat = |_: WeightPair| 0.25;
    let scene = tuning::scene(
        &history(&[[1.0, 1.0], [2.0, 10.0], [9.0, 900.0]], flat),
        &ranges,
        &surface(&ranges, flat),
    );
    check_properties("flat", &scene);
}
