//! P_m,n of Sec. IV: the printed closed forms, the values for δ alone, and frequencies counted in runs.
//!
//! **Conditioning.** A frequency is the share of the visits of S_m whose next state is S_n, over all devices and
//! measured TTIs, with or without events. A visit of S1 or S4 is one TTI, unless a detection or wake-up ends it
//! earlier. The printed forms use other conditions. P_4,1 = t_on/t_DRX is the share of *all* TTIs spent in S1, not of
//! the TTIs in S4. P_1,2 = α p(d_ij) holds for the TTI in which an event starts. P_4,2 assumes that a device has just
//! reported.
//!
//! **Not probabilities.** P_1,1 and P_3,1 are sums of several conditional probabilities of the same event. They leave
//! [0, 1] once t_on is a large part of t_DRX, and are 0/0 if both are equal. Their complements P_1,4 and P_3,4 then
//! turn negative. P_4,4 is negative if t_on/t_DRX + P_4,2 exceeds 1. P_2,3 is Eq. (8), see [`super::battery::Eq8`],
//! with P_1,2 + P_4,2 for P, which may itself exceed 1.

mod closed_form;
mod measured;

pub use closed_form::{ClosedFormInputs, PAIRS, evaluate_printed};
pub use measured::TransitionCounts;

use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::plan::DutyCycle;

use super::{AnalysisError, check_seeds, map_seeds};
use reveille_lab::stats::Estimate;

/// Quantile of the normal distribution for a 95 % interval.
const NORMAL_QUANTILE_975: f64 = 1.959_963_984_540_054;

/// One transition probability P_m,n.
#[derive(Clone, Copy, Debug)]
pub struct Transition {
    /// State before, m.
    pub from: usize,
    /// State after, n.
    pub to: usize,
    /// Printed form: the mean over devices and deployments, except those for which it is NaN: 0/0, or an undefined
    /// Eq. (8).
    pub printed: f64,
    /// Minimum and maximum of the printed form.
    pub printed_range: (f64, f64),
    /// Number of devices, over all deployments, for which the form is not a probability: below 0, above 1, or NaN.
    pub improper_count: usize,
    /// Share of the visits if δ alone decides (no events, no failures), over all devices, by the duty cycles of the
    /// first TTI: without meaning under a policy that decides in every TTI. `None` for other pairs than S1 and S4, and
    /// without a visit.
    pub share_by_duty: Option<f64>,
    /// Number of transitions S_m → S_n.
    pub count: u64,
    /// Number of visits of S_m.
    pub visits: u64,
    /// Counted share; its interval is between runs.
    pub measured: Estimate,
    /// 95 % interval of the share by Wilson's score, as if visits were independent, which they are not.
    pub wilson: (f64, f64),
}

/// The P_m,n of a scenario. `reveille analyse transitions` prints them, and docs/analysis.md quotes them.
#[derive(Clone, Debug)]
pub struct Transitions {
    /// The transitions in the order of [`PAIRS`].
    pub transitions: Vec<Transition>,
    /// Number of devices over all deployments.
    pub device_count: usize,
}

/// Counts the transitions of `scenario` under `seeds` consecutive seeds from its own, and evaluates the printed forms
/// for the same deployments. The forms use the duty cycles of the first TTI.
///
/// # Errors
/// If `seeds` is 0 or above 1 000 000, or the radio is not perfect.
pub fn measure(scenario: &Scenario, seeds: u64) -> Result<Transitions, AnalysisError> {
    check_seeds(seeds)?;
    if !scenario.radio.is_perfect() {
        let requirement = "must have no losses, false wake-ups or latency: the printed forms assume a perfect radio, \
                           and so does the count; leave out the fields of `radio`";
        return Err(AnalysisError::invalid("radio", &"impaired", requirement));
    }
    let runs = map_seeds(scenario, seeds, |seeded| {
        let deployment = Deployment::new(seeded);
        let (counts, duties) = measured::count_run(seeded, &deployment);
        let classes = closed_form::device_classes(seeded);
        let inputs = closed_form::device_inputs(seeded, &deployment.positions(), &duties, &classes);
        let printed: Vec<_> = inputs
            .iter()
            .map(|i| evaluate_printed(i, seeded.events.alpha))
            .collect();
        (counts, duties, printed)
    });
    let mut pooled = TransitionCounts::default();
    for (counts, ..) in &runs {
        pooled.add(counts);
    }
    let duties: Vec<DutyCycle> = runs.iter().flat_map(|(_, duties, _)| duties.iter().copied()).collect();
    let transition = |(index, (from, to)): (usize, (usize, usize))| {
        let values: Vec<f64> = runs
            .iter()
            .flat_map(|(.., printed)| printed.iter().map(move |p| p[index]))
            .collect();
        let defined = values.iter().copied().filter(|v| !v.is_nan());
        let (count, visits) = (pooled.get(from, to), pooled.visits(from));
        Transition {
            from,
            to,
            printed: Estimate::from_values_or_nan(defined.clone()).mean,
            // `min` and `max` ignore NaN, so NaN remains only if the form is NaN for all devices.
            printed_range: (
                defined.clone().fold(f64::NAN, f64::min),
                defined.fold(f64::NAN, f64::max),
            ),
            improper_count: values.iter().filter(|v| !is_probability(**v)).count(),
            share_by_duty: share_by_duty(&duties, from, to),
            count,
            visits,
            measured: Estimate::from_values_or_nan(
                runs.iter()
                    .map(|(counts, ..)| share(counts.get(from, to), counts.visits(from))),
            ),
            wilson: wilson_interval(count, visits),
        }
    };
    Ok(Transitions {
        transitions: PAIRS.into_iter().enumerate().map(transition).collect(),
        device_count: duties.len(),
    })
}

/// Whether `value` is within [0, 1], up to rounding.
fn is_probability(value: f64) -> bool {
    (-1e-12..=1.0 + 1e-12).contains(&value)
}

/// Share of the visits of S_from that lead to S_to if δ alone decides; `None` for other pairs than S1 and S4, and
/// without a visit of S_from.
fn share_by_duty(duties: &[DutyCycle], from: usize, to: usize) -> Option<f64> {
    // In each cycle, a device that is neither always on nor always off has one change each way.
    let (mut changes, mut ttis_on, mut ttis_off) = (0.0, 0.0, 0.0);
    for duty in duties {
        let (t_on, t_drx) = (f64::from(duty.t_on), f64::from(duty.t_drx));
        changes += f64::from(u8::from(duty.t_on > 0 && duty.t_on < duty.t_drx)) / t_drx;
        ttis_on += t_on / t_drx;
        ttis_off += 1.0 - t_on / t_drx;
    }
    let change = match (from, to) {
        (1, 1 | 4) => changes / ttis_on,
        (4, 1 | 4) => changes / ttis_off,
        _ => return None,
    };
    let value = if from == to { 1.0 - change } else { change };
    value.is_finite().then_some(value)
}

fn share(count: u64, visits: u64) -> f64 {
    count as f64 / visits as f64
}

/// Wilson's 95 % score interval of a binomial share.
fn wilson_interval(count: u64, visits: u64) -> (f64, f64) {
    let (n, p) = (visits as f64, share(count, visits));
    let centre = (p + NORMAL_QUANTILE_975 * NORMAL_QUANTILE_975 / (2.0 * n))
        / (1.0 + NORMAL_QUANTILE_975 * NORMAL_QUANTILE_975 / n);
    let half = NORMAL_QUANTILE_975 / (1.0 + NORMAL_QUANTILE_975 * NORMAL_QUANTILE_975 / n)
        * (p * (1.0 - p) / n + NORMAL_QUANTILE_975 * NORMAL_QUANTILE_975 / (4.0 * n * n)).sqrt();
    ((centre - half).max(0.0), (centre + half).min(1.0))
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    fn measure_with(overrides: &[&str], seeds: u64) -> Transitions {
        let parse = |text: &&str| Override::parse(text).expect("an override");
        let overrides: Vec<Override> = overrides.iter().map(parse).collect();
        measure(&load("paper", &overrides).expect("a scenario").scenario, seeds).expect("a study")
    }

    fn find(transitions: &Transitions, from: usize, to: usize) -> Transition {
        let mut pairs = transitions.transitions.iter();
        *pairs
            .find(|pair| (pair.from, pair.to) == (from, to))
            .expect("one of PAIRS")
    }

    #[test]
    fn shares_of_a_state_add_up_to_1_and_s2_is_left_as_often_as_entered() {
        let transitions = measure_with(&["devices=30", "ttis=1500"], 4);
        for state in 1..=4 {
            let of_state = transitions.transitions.iter().filter(|pair| pair.from == state);
            let sum: f64 = of_state.map(|pair| share(pair.count, pair.visits)).sum();
            assert!((sum - 1.0).abs() < 1e-12, "shares of S{state} add up to {sum}");
        }
        let entered = find(&transitions, 1, 2).count + find(&transitions, 4, 2).count;
        assert_eq!(entered, find(&transitions, 2, 3).visits);
        assert!(entered > 100);
    }

    #[test]
    fn without_events_and_with_enough_energy_only_delta_decides() {
        let enough_energy = [
            "devices=24",
            "ttis=2000",
            "policy.name=random",
            "events.alpha=1e-9",
            "harvest.e_b=40",
        ];
        let transitions = measure_with(&enough_energy, 3);
        for (from, to) in [(1, 1), (1, 4), (4, 1), (4, 4)] {
            let transition = find(&transitions, from, to);
            let expected = transition.share_by_duty.expect("δ decides");
            assert!(
                (share(transition.count, transition.visits) - expected).abs() < 2e-3,
                "{transition:?}"
            );
        }
        assert_eq!(find(&transitions, 2, 3).visits, 0);
        assert!(find(&transitions, 2, 3).measured.mean.is_nan());
    }

    #[test]
    fn wilson_intervals_equal_printed_values() {
        // 8 of 10: interval 0.490 to 0.943.
        let (low, high) = wilson_interval(8, 10);
        assert!(
            (low - 0.490_162).abs() < 1e-6 && (high - 0.943_318).abs() < 1e-6,
            "interval {low} to {high}"
        );
        assert!(wilson_interval(0, 50).0 < 1e-15 && wilson_interval(50, 50).1 > 1.0 - 1e-15);
    }

    #[test]
    fn forms_outside_the_unit_interval_are_counted() {
        // Devices spend half of the time in S1. If P_4,2 is above one half, P_4,4 is negative.
        let dense = measure_with(&["devices=250", "ttis=60", "policy.name=random"], 1);
        let p44 = find(&dense, 4, 4);
        assert!(p44.printed_range.0 <= p44.printed && p44.printed <= p44.printed_range.1);
        // One device has t_on = t_DRX = 2.
        assert!(find(&dense, 1, 1).improper_count > 0 && find(&dense, 3, 1).improper_count > 0);
    }
}
