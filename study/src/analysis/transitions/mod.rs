//! P_m,n of Sec. IV: the printed closed forms, what δ alone makes of them, and frequencies counted in runs.
//!
//! **Conditioning.** A frequency is the share of the visits of S_m whose next state is S_n, over all devices and all
//! measured TTIs, with or without an event. A visit of S1 or S4 is one TTI, unless a detection or wake-up ends it
//! within. The printed forms condition differently, and not all alike: P_4,1 = t_on/t_DRX is the share of *all* TTIs
//! that are spent in S1, not of those in S4; P_1,2 = α p(d_ij) is for the TTI in which an event starts; P_4,2 takes for
//! granted that some device has just reported.
//!
//! **Not probabilities.** P_1,1 and P_3,1 are sums of several conditional probabilities of the same event and leave [0,
//! 1] once t_on is a large part of t_DRX (and are 0/0 where they are equal); P_1,4 and P_3,4, the complements, then
//! turn negative; P_4,4 is negative where t_on/t_DRX + P_4,2 exceeds 1; P_2,3 is Eq. (8), see [`super::battery::Eq8`],
//! with P_1,2 + P_4,2 for P, which may itself exceed 1.

mod closed;
mod counted;
mod pairs;

pub use closed::{Terms, printed};
pub use counted::Counts;
pub use pairs::PAIRS;

use reveille_common::deployment::Deployment;
use reveille_common::plan::DutyCycle;
use reveille_common::scenario::Scenario;

use super::AnalysisError;
use super::runs::{check_seeds, over_seeds};
use reveille_lab::stats::Estimate;

/// The quantile of the normal law for a 95 % interval.
const Z: f64 = 1.959_963_984_540_054;

/// One transition probability P_m,n.
#[derive(Clone, Copy, Debug)]
pub struct Transition {
    /// m.
    pub from: usize,
    /// n.
    pub to: usize,
    /// The printed form: mean over devices and deployments, leaving out those for which it is 0/0.
    pub printed: f64,
    /// Its least and largest value.
    pub printed_range: (f64, f64),
    /// Devices, of all deployments, for which it is no probability: below 0, above 1, or 0/0.
    pub improper: usize,
    /// Where δ alone decides (no events, no failures): the share of the same visits, over all devices.
    pub by_duty: Option<f64>,
    /// Counted transitions S_m → S_n.
    pub count: u64,
    /// Counted visits of S_m.
    pub visits: u64,
    /// The counted share; the interval is between runs.
    pub measured: Estimate,
    /// The share's 95 % interval by Wilson's score, as if visits were independent, which they are not.
    pub wilson: (f64, f64),
}

/// The P_m,n of a scenario.
#[derive(Clone, Debug)]
pub struct Transitions {
    /// The transitions in the order of [`PAIRS`].
    pub transitions: Vec<Transition>,
    /// Devices of all deployments together.
    pub devices: usize,
}

/// Counts the transitions of `scenario` under each of `seeds` seeds from its own on, beside the printed forms for the
/// same deployments. Forms are evaluated for the duty cycles of the first TTI.
///
/// # Errors
/// If `seeds` is 0.
pub fn measure(scenario: &Scenario, seeds: u64) -> Result<Transitions, AnalysisError> {
    check_seeds(seeds)?;
    let runs = over_seeds(scenario, seeds, |one| {
        let deployment = Deployment::new(one);
        let (counts, duties) = counted::count(one, &deployment);
        let terms = closed::terms(one, &deployment.positions(), &duties, &closed::classes(one));
        let printed: Vec<_> = terms.iter().map(|t| printed(t, one.events.alpha)).collect();
        (counts, duties, printed)
    });
    let mut pooled = Counts::default();
    for (counts, ..) in &runs {
        pooled.add(counts);
    }
    let duties: Vec<DutyCycle> = runs.iter().flat_map(|(_, duties, _)| duties.iter().copied()).collect();
    let transition = |(index, (from, to)): (usize, (usize, usize))| {
        let values: Vec<f64> = runs
            .iter()
            .flat_map(|(.., all)| all.iter().map(move |p| p[index]))
            .collect();
        let proper = values.iter().copied().filter(|v| !v.is_nan());
        let (count, visits) = (pooled.of(from, to), pooled.visits(from));
        Transition {
            from,
            to,
            printed: Estimate::over(proper.clone()).mean,
            printed_range: (proper.clone().fold(f64::NAN, f64::min), proper.fold(f64::NAN, f64::max)),
            improper: values.iter().filter(|v| !is_probability(**v)).count(),
            by_duty: by_duty(&duties, from, to),
            count,
            visits,
            measured: Estimate::over(
                runs.iter()
                    .map(|(counts, ..)| share(counts.of(from, to), counts.visits(from))),
            ),
            wilson: wilson(count, visits),
        }
    };
    Ok(Transitions {
        transitions: PAIRS.into_iter().enumerate().map(transition).collect(),
        devices: duties.len(),
    })
}

/// Whether `value` is within [0, 1], up to rounding.
fn is_probability(value: f64) -> bool {
    (-1e-12..=1.0 + 1e-12).contains(&value)
}

/// What share of the visits of S_from leads to S_to if δ alone decides; `None` for states that events lead to or from.
fn by_duty(duties: &[DutyCycle], from: usize, to: usize) -> Option<f64> {
    // A cycle of a device that is neither always on nor always off has one change each way.
    let (mut changes, mut on, mut off) = (0.0, 0.0, 0.0);
    for duty in duties {
        let (t_on, t_drx) = (f64::from(duty.t_on), f64::from(duty.t_drx));
        changes += f64::from(u8::from(duty.t_on > 0 && duty.t_on < duty.t_drx)) / t_drx;
        on += t_on / t_drx;
        off += 1.0 - t_on / t_drx;
    }
    let change = match (from, to) {
        (1, 1 | 4) => changes / on,
        (4, 1 | 4) => changes / off,
        _ => return None,
    };
    let value = if from == to { 1.0 - change } else { change };
    value.is_finite().then_some(value)
}

fn share(count: u64, visits: u64) -> f64 {
    count as f64 / visits as f64
}

/// Wilson's 95 % score interval of a binomial share.
fn wilson(count: u64, visits: u64) -> (f64, f64) {
    let (n, p) = (visits as f64, share(count, visits));
    let centre = (p + Z * Z / (2.0 * n)) / (1.0 + Z * Z / n);
    let half = Z / (1.0 + Z * Z / n) * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    ((centre - half).max(0.0), (centre + half).min(1.0))
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    fn study(overrides: &[&str], seeds: u64) -> Transitions {
        let parse = |text: &&str| Override::parse(text).expect("an override");
        let overrides: Vec<Override> = overrides.iter().map(parse).collect();
        measure(&load("paper", &overrides).expect("a scenario"), seeds).expect("a study")
    }

    fn find(found: &Transitions, from: usize, to: usize) -> Transition {
        let mut all = found.transitions.iter();
        *all.find(|t| (t.from, t.to) == (from, to)).expect("one of PAIRS")
    }

    #[test]
    fn shares_of_a_state_add_up_to_one_and_s2_is_left_as_often_as_entered() {
        let found = study(&["devices=30", "ttis=1500"], 4);
        for state in 1..=4 {
            let of_state = found.transitions.iter().filter(|t| t.from == state);
            let sum: f64 = of_state.map(|t| share(t.count, t.visits)).sum();
            assert!((sum - 1.0).abs() < 1e-12, "S{state}: {sum}");
        }
        let entered = find(&found, 1, 2).count + find(&found, 4, 2).count;
        assert_eq!(entered, find(&found, 2, 3).visits);
        assert!(entered > 100);
    }

    #[test]
    fn without_events_and_want_delta_alone_decides() {
        let rich = [
            "devices=24",
            "ttis=2000",
            "policy.name=random",
            "events.alpha=1e-9",
            "harvest.e_b=40",
        ];
        let found = study(&rich, 3);
        for (from, to) in [(1, 1), (1, 4), (4, 1), (4, 4)] {
            let transition = find(&found, from, to);
            let expected = transition.by_duty.expect("δ decides");
            assert!(
                (share(transition.count, transition.visits) - expected).abs() < 2e-3,
                "{transition:?}"
            );
        }
        assert_eq!(find(&found, 2, 3).visits, 0);
        assert!(find(&found, 2, 3).measured.mean.is_nan());
    }

    #[test]
    fn wilson_intervals_are_the_textbooks() {
        // 8 of 10: 0.490 to 0.943.
        let (low, high) = wilson(8, 10);
        assert!(
            (low - 0.490_162).abs() < 1e-6 && (high - 0.943_318).abs() < 1e-6,
            "{low} {high}"
        );
        assert!(wilson(0, 50).0 < 1e-15 && wilson(50, 50).1 > 1.0 - 1e-15);
    }

    #[test]
    fn improper_forms_are_counted() {
        // Half of the time in S1: with a P_4,2 above one half P_4,4 is negative.
        let dense = study(&["devices=250", "ttis=60", "policy.name=random"], 1);
        let p44 = find(&dense, 4, 4);
        assert!(p44.printed_range.0 <= p44.printed && p44.printed <= p44.printed_range.1);
        // A device with t_on = t_DRX = 2.
        assert!(find(&dense, 1, 1).improper > 0 && find(&dense, 3, 1).improper > 0);
    }
}
