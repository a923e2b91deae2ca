//! Harvest and net energy against λ (Sec. VI-B, Figs. 13 and 14): the closed form, and runs of the device machines.
//! `reveille analyse harvest`, the figures, the report and the advice about missed events use it.
//!
//! The paper holds the consumption of a policy fixed, "as shown in Fig. 8", and calls the harvest minus that
//! consumption the net energy. [`lambdas_with_positive_net`] does the same. A run cannot, because a device spends no
//! more than it has harvested. Its harvest minus its spending ([`HarvestPoint::net`]) is therefore never a lasting
//! deficit. It consists of the overflow of full batteries and the change from the initial charge. [`measure_demand`] is
//! the spending of a policy if no battery were ever short.

use reveille_bs::scenario::Scenario;
use reveille_common::harvest::{Arrivals, HarvestKind};
use reveille_common::scenario::Harvest;
use reveille_common::units::Energy;
use reveille_lab::preparation::run;
use reveille_lab::stats::Estimate;

use super::{AnalysisError, check_seeds, map_seeds};
use crate::claims::{Citation, Contradiction, FIG_8, FIG_13, FIG_14};

/// Largest λ of a study; a scenario may have a larger one.
const MAX_LAMBDA: f64 = 1000.0;
/// Halvings of an interval that contains a root; double precision needs no more.
const BISECTION_STEPS: u32 = 200;

/// Reading of the paper's λ as a probability of an arrival.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LambdaReading {
    /// λτ·exp(-λτ), Eq. (5).
    Eq5,
    /// exp(-λ), the text of Sec. III-B.
    ExpMinusLambda,
}

impl LambdaReading {
    /// Both readings.
    pub const ALL: [Self; 2] = [Self::Eq5, Self::ExpMinusLambda];

    /// Returns the kind of harvest with this reading of λ.
    pub fn kind(self) -> HarvestKind {
        self.harvest_source(0.0, Energy::ZERO).kind()
    }

    /// Name of the reading, as in `harvest.kind` of a scenario.
    pub fn name(self) -> &'static str {
        self.kind().name()
    }

    /// Computes the probability of an arrival in a TTI of duration `tau`, `[0, 1]`.
    pub fn probability(self, lambda: f64, tau: f64) -> f64 {
        let independent = self.harvest_source(lambda, Energy::ZERO).independent_probability(tau);
        independent.expect("its arrivals do not depend on each other")
    }

    /// Returns the energy source with this reading.
    pub const fn harvest_source(self, lambda: f64, e_b: Energy) -> Harvest {
        match self {
            Self::Eq5 => Harvest::Eq5(Arrivals { lambda, e_b }),
            Self::ExpMinusLambda => Harvest::ExpMinusLambda(Arrivals { lambda, e_b }),
        }
    }
}

/// Parameters of a harvest study.
#[derive(Clone, Debug)]
pub struct HarvestStudy {
    /// Scenario whose energy source is replaced in all device classes; its seed is the first.
    pub scenario: Scenario,
    /// Readings of λ.
    pub readings: Vec<LambdaReading>,
    /// Values of λ, `0 ..= 1000`.
    pub lambdas: Vec<f64>,
    /// Values of E_B, > 0 (the paper's figures: 1, 5 and 10 units).
    pub e_b: Vec<Energy>,
    /// Runs for each point, ≥ 1; intervals need at least 2.
    pub seeds: u64,
}

/// One point of Figs. 13 and 14. All energies are units per device and TTI.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HarvestPoint {
    /// Reading of λ.
    pub reading: LambdaReading,
    /// λ of the point.
    pub lambda: f64,
    /// E_B, units.
    pub e_b: f64,
    /// Mean harvest E_B · Pr(arrival).
    pub closed_form: f64,
    /// Harvest in the runs, overflow included.
    pub harvested: Estimate,
    /// Spending in the runs.
    pub spent: Estimate,
    /// Harvest minus spending, run by run.
    pub net: Estimate,
}

/// Measures the points of `study`: by reading, then E_B, then λ.
///
/// # Errors
/// If a list is empty or a value out of its range.
pub fn measure(study: &HarvestStudy) -> Result<Vec<HarvestPoint>, AnalysisError> {
    study.check()?;
    let mut points = Vec::new();
    for &reading in &study.readings {
        for &e_b in &study.e_b {
            points.extend(
                study
                    .lambdas
                    .iter()
                    .map(|&lambda| study.measure_point(reading, lambda, e_b)),
            );
        }
    }
    Ok(points)
}

impl HarvestStudy {
    fn check(&self) -> Result<(), AnalysisError> {
        let empty_list = |list, example| Err(AnalysisError::EmptyList { list, example });
        if self.readings.is_empty() {
            return empty_list("reading", "eq5");
        }
        if self.lambdas.is_empty() {
            return empty_list("lambda", "0.05,0.1,0.2");
        }
        if self.e_b.is_empty() {
            return empty_list("e-b", "1,5,10");
        }
        if let Some(out_of_range) = self.lambdas.iter().find(|l| !(0.0..=MAX_LAMBDA).contains(*l)) {
            let requirement = format!("must be a rate from 0 to {MAX_LAMBDA}");
            return Err(AnalysisError::invalid("lambda", out_of_range, requirement));
        }
        if self.e_b.contains(&Energy::ZERO) {
            return Err(AnalysisError::invalid("e-b", &0, "must be above 0 units"));
        }
        check_seeds(self.seeds)
    }

    fn measure_point(&self, reading: LambdaReading, lambda: f64, e_b: Energy) -> HarvestPoint {
        let scenario = with_source(&self.scenario, &reading.harvest_source(lambda, e_b));
        let metrics = map_seeds(&scenario, self.seeds, |seeded| run(seeded).metrics);
        HarvestPoint {
            reading,
            lambda,
            e_b: e_b.units(),
            closed_form: e_b.units() * reading.probability(lambda, scenario.run.tau),
            harvested: Estimate::from_values_or_nan(metrics.iter().map(|m| m.harvested_per_device_tti)),
            spent: Estimate::from_values_or_nan(metrics.iter().map(|m| m.energy_per_device_tti)),
            net: Estimate::from_values_or_nan(metrics.iter().map(|m| m.net_per_device_tti)),
        }
    }
}

/// Measures the units that `scenario` spends per device and TTI with its own energy source: the consumption of Fig. 8.
///
/// # Errors
/// If `seeds` is 0 or above 1 000 000.
pub fn measure_consumption(scenario: &Scenario, seeds: u64) -> Result<Estimate, AnalysisError> {
    check_seeds(seeds)?;
    Ok(Estimate::from_values_or_nan(map_seeds(scenario, seeds, |seeded| {
        run(seeded).metrics.energy_per_device_tti
    })))
}

/// Measures the units that `scenario` would spend per device and TTI with every battery full at the start of every TTI.
///
/// # Errors
/// If `seeds` is 0 or above 1 000 000.
pub fn measure_demand(scenario: &Scenario, seeds: u64) -> Result<Estimate, AnalysisError> {
    let mut with_full_batteries = scenario.clone();
    for class in &mut with_full_batteries.classes {
        // exp(-0) = 1: an arrival in every TTI.
        class.harvest = LambdaReading::ExpMinusLambda.harvest_source(0.0, class.energy.e_max);
    }
    measure_consumption(&with_full_batteries, seeds)
}

/// Computes the range of λ in which the mean harvest E_B · Pr(arrival) exceeds a fixed consumption `spent`, units per
/// TTI. Fig. 14's net energy is positive there. `None` if no λ gives that much. Under Eq. (5) the harvest rises up to λ
/// = 1/τ and falls beyond. Under exp(-λ) it only falls, so the range begins at 0. `e_b` and `spent` are above 0.
pub fn lambdas_with_positive_net(reading: LambdaReading, e_b: f64, spent: f64, tau: f64) -> Option<(f64, f64)> {
    let net = |lambda: f64| e_b * reading.probability(lambda, tau) - spent;
    let best_lambda = match reading {
        LambdaReading::Eq5 => 1.0 / tau,
        LambdaReading::ExpMinusLambda => 0.0,
    };
    if net(best_lambda) <= 0.0 {
        return None;
    }
    let lower_end = if best_lambda > 0.0 {
        bisect(&net, 0.0, best_lambda)
    } else {
        0.0
    };
    // The start must be above 0 even if the harvest is largest at λ = 0; otherwise doubling would not end. It ends
    // because the harvest tends to 0.
    let mut beyond_range = best_lambda.max(1.0 / tau);
    while net(beyond_range) > 0.0 {
        beyond_range *= 2.0;
    }
    Some((lower_end, bisect(&net, best_lambda, beyond_range)))
}

/// A λ that the paper states, at one end of a range of consumptions, and the policy whose consumption it belongs to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StatedEnd {
    /// λ, per TTI.
    pub lambda: f64,
    /// Policy.
    pub policy: &'static str,
}

/// A statement of the paper on the λ above which the net energy is positive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StatedThreshold {
    /// Number of devices N.
    pub devices: u32,
    /// E_B, units.
    pub e_b: f64,
    /// λ for the policy with the least consumption, according to the paper.
    pub least_consumption: StatedEnd,
    /// λ for the policy with the most consumption; `None` if the paper states only one λ.
    pub most_consumption: Option<StatedEnd>,
    /// Figure of the paper.
    pub paper_figure: &'static str,
    /// Sentence of the statement.
    pub citation: Citation,
    /// Contradiction with another statement, if any.
    pub contradicts: Option<Contradiction>,
}

/// All statements: the text on Fig. 13 (N = 10, 250) and on Fig. 14 (N = 100), which name the policies at both ends. A
/// test of [`crate::claims`] compares them with a transcript. [`crate::figures::energy`] marks them on the line of
/// their E_B, which must be one of the figures' E_B, and their order numbers the claims for [`crate::report::search`].
/// docs/reproduction.md contains the reasons.
///
/// A single λ is assigned to the policy that spends least, because the text says that λ "could be as low as" it. At N =
/// 10 it stands for 0.41 to 0.48 units. That is close to the 0.34 of `random` and far from the 0.83 at the upper end.
/// For E_B of 5 and 10 the text on Fig. 14 names the lower λ first and calls it the upper bound. Here the higher λ is
/// the upper bound.
pub const STATED_THRESHOLDS: [StatedThreshold; 9] = {
    /// The policies with the least and the most consumption at an N, according to the paper.
    type LeastAndMost = (&'static str, &'static str);
    const POLICIES_AT_N_10: LeastAndMost = ("random", "q-learning");
    const POLICIES_AT_N_100: LeastAndMost = ("random", "adjusted");
    const POLICIES_AT_N_250: LeastAndMost = ("dt", "adjusted");
    const ABOVE_ANY_HARVEST: Contradiction = Contradiction {
        other_citation: FIG_8.sentence(2),
        reason: "Under Eq. (5) the harvest with E_B = 1 is at most E_B/e = 0.368 units, but the method with the \
            highest consumption spends 0.83 there.",
    };
    const DIFFERENT_CONSUMPTIONS: Contradiction = Contradiction {
        other_citation: FIG_14.sentence(5),
        reason: "All three E_B share one consumption. Under Eq. (5) these λ correspond to 0.18 and 0.26 units, but the \
            λ of E_B = 5 and 10 to 0.22 to 0.25 and 0.44 to 0.46. A harvest of λ·E_B would bring them closer.",
    };
    /// Creates a statement on two λ: of the policy that spends least, then of the one that spends most.
    const fn with_two_lambdas(
        devices: u32,
        (least, most): LeastAndMost,
        e_b: f64,
        least_lambda: f64,
        most_lambda: f64,
        citation: Citation,
    ) -> StatedThreshold {
        StatedThreshold {
            most_consumption: Some(StatedEnd {
                lambda: most_lambda,
                policy: most,
            }),
            ..with_one_lambda(devices, (least, most), e_b, least_lambda, citation)
        }
    }
    /// Creates a statement on a single λ, which is assigned to the policy that spends least.
    const fn with_one_lambda(
        devices: u32,
        (policy, _): LeastAndMost,
        e_b: f64,
        lambda: f64,
        citation: Citation,
    ) -> StatedThreshold {
        StatedThreshold {
            devices,
            e_b,
            least_consumption: StatedEnd { lambda, policy },
            most_consumption: None,
            paper_figure: if devices == 100 { "Fig. 14" } else { "Fig. 13" },
            citation,
            contradicts: None,
        }
    }
    const fn contradicted(stated: StatedThreshold, contradiction: Contradiction) -> StatedThreshold {
        StatedThreshold {
            contradicts: Some(contradiction),
            ..stated
        }
    }
    // Arguments: N, policies, E_B in units, λ of the policy that spends least, λ of the one that spends most if stated.
    [
        contradicted(
            with_two_lambdas(10, POLICIES_AT_N_10, 1.0, 0.4, 0.9, FIG_13.sentence(6)),
            ABOVE_ANY_HARVEST,
        ),
        with_one_lambda(10, POLICIES_AT_N_10, 5.0, 0.09, FIG_13.sentence(7)),
        with_one_lambda(10, POLICIES_AT_N_10, 10.0, 0.05, FIG_13.sentence(7)),
        contradicted(
            with_two_lambdas(100, POLICIES_AT_N_100, 1.0, 0.23, 0.38, FIG_14.sentence(4)),
            DIFFERENT_CONSUMPTIONS,
        ),
        with_two_lambdas(100, POLICIES_AT_N_100, 5.0, 0.052, 0.096, FIG_14.sentence(5)),
        with_two_lambdas(100, POLICIES_AT_N_100, 10.0, 0.023, 0.048, FIG_14.sentence(5)),
        with_two_lambdas(250, POLICIES_AT_N_250, 1.0, 0.15, 0.3, FIG_13.sentence(6)),
        with_one_lambda(250, POLICIES_AT_N_250, 5.0, 0.05, FIG_13.sentence(7)),
        with_one_lambda(250, POLICIES_AT_N_250, 10.0, 0.02, FIG_13.sentence(7)),
    ]
};

impl StatedThreshold {
    /// Iterates over the stated ends: least, then most.
    pub fn ends(&self) -> impl Iterator<Item = StatedEnd> {
        std::iter::once(self.least_consumption).chain(self.most_consumption)
    }
}

/// Returns `scenario` with `source` in all device classes.
fn with_source(scenario: &Scenario, source: &Harvest) -> Scenario {
    let mut changed = scenario.clone();
    for class in &mut changed.classes {
        class.harvest = source.clone();
    }
    changed
}

/// Finds the sign change of `f` between `a` and `b` by halving.
fn bisect(f: &impl Fn(f64) -> f64, mut a: f64, mut b: f64) -> f64 {
    // The net energy rises up to the λ of the largest harvest and falls beyond it; both of its roots are sought here.
    let is_rising = f(b) > f(a);
    for _ in 0..BISECTION_STEPS {
        let middle = f64::midpoint(a, b);
        if (f(middle) > 0.0) == is_rising {
            b = middle;
        } else {
            a = middle;
        }
    }
    f64::midpoint(a, b)
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    fn scenario_with(overrides: &[&str]) -> Scenario {
        let parse = |text: &&str| Override::parse(text).expect("an override");
        let overrides: Vec<Override> = overrides.iter().map(parse).collect();
        load("paper", &overrides).expect("a scenario").scenario
    }

    fn energy_of(units: f64) -> Energy {
        Energy::from_units(units).expect("in range")
    }

    fn harvest_study(lambdas: &[f64], e_b: &[f64]) -> HarvestStudy {
        HarvestStudy {
            scenario: scenario_with(&["devices=40", "ttis=2000", "policy.name=random"]),
            readings: LambdaReading::ALL.to_vec(),
            lambdas: lambdas.to_vec(),
            e_b: e_b.iter().map(|&value| energy_of(value)).collect(),
            seeds: 6,
        }
    }

    #[test]
    fn measured_harvests_equal_the_closed_form() {
        let points = measure(&harvest_study(&[0.0, 0.05, 1.0, 3.0], &[1.0, 10.0])).expect("a study");
        assert_eq!(points.len(), 16);
        for point in points {
            // Arrivals in the 40 devices · 1800 TTIs · 6 seeds have a binomial spread.
            let p = point.closed_form / point.e_b;
            let spread = point.e_b * (p * (1.0 - p) / (40.0 * 1800.0 * 6.0)).sqrt();
            let difference = (point.harvested.mean - point.closed_form).abs();
            assert!(difference <= 4.0 * spread + 1e-12, "{point:?}");
            let residual = point.harvested.mean - point.spent.mean - point.net.mean;
            assert!(residual.abs() < 1e-9, "{point:?}");
        }
    }

    #[test]
    fn arrival_probabilities_equal_tabulated_exponentials() {
        // exp(-1/2) and exp(-1/4) from a printed table.
        assert!((LambdaReading::Eq5.probability(0.25, 2.0) - 0.5 * 0.606_530_659_7).abs() < 1e-10);
        assert!((LambdaReading::ExpMinusLambda.probability(0.25, 2.0) - 0.778_800_783_1).abs() < 1e-10);
    }

    #[test]
    fn net_energy_is_positive_in_a_range_of_lambda() {
        // The maximum of Eq. (5), at λ = 1, gives E_B / e.
        let e = std::f64::consts::E;
        assert_eq!(
            lambdas_with_positive_net(LambdaReading::Eq5, 1.0, 1.0 / e + 1e-9, 1.0),
            None
        );
        for (e_b, spent, tau) in [(1.0, 0.2, 1.0), (5.0, 0.25, 1.0), (10.0, 3.0, 0.5)] {
            let (from, to) = lambdas_with_positive_net(LambdaReading::Eq5, e_b, spent, tau).expect("a range");
            assert!(from < 1.0 / tau && to > 1.0 / tau, "range {from} to {to}");
            for limit in [from, to] {
                assert!((e_b * LambdaReading::Eq5.probability(limit, tau) - spent).abs() < 1e-9);
            }
        }
        let (from, to) = lambdas_with_positive_net(LambdaReading::ExpMinusLambda, 5.0, 0.25, 1.0).expect("a range");
        assert!(
            from == 0.0 && (to - libm::log(20.0)).abs() < 1e-12,
            "range {from} to {to}"
        );
        assert_eq!(
            lambdas_with_positive_net(LambdaReading::ExpMinusLambda, 1.0, 2.0, 1.0),
            None
        );
    }

    #[test]
    fn demand_is_the_consumption_with_full_batteries() {
        // Without events the genie's devices stay in S4.
        let genie = scenario_with(&["devices=10", "ttis=1000", "policy.name=genie", "events.alpha=1e-9"]);
        let spent = measure_demand(&genie, 2).expect("runs").mean;
        assert!((spent - 0.071_429).abs() < 1e-12, "demand {spent}");
        let random = scenario_with(&["devices=100", "ttis=1000", "policy.name=random", "harvest.e_b=0.1"]);
        let (consumption, demand) = (
            measure_consumption(&random, 3).expect("runs"),
            measure_demand(&random, 3).expect("runs"),
        );
        assert!(
            consumption.mean < 0.2 && demand.mean > 0.4,
            "consumption {consumption:?}, demand {demand:?}"
        );
    }

    #[test]
    fn invalid_studies_are_refused() {
        for (study, cause) in [
            (harvest_study(&[], &[1.0]), "lambda: the list is empty"),
            (harvest_study(&[0.1], &[]), "e-b: the list is empty"),
            (harvest_study(&[0.1], &[0.0]), "e-b = 0"),
            (harvest_study(&[0.1, -1.0], &[1.0]), "lambda = -1"),
            (harvest_study(&[f64::NAN], &[1.0]), "lambda = NaN"),
            (
                HarvestStudy {
                    seeds: 0,
                    ..harvest_study(&[0.1], &[1.0])
                },
                "seeds = 0",
            ),
            (
                HarvestStudy {
                    readings: vec![],
                    ..harvest_study(&[0.1], &[1.0])
                },
                "reading: the list is empty",
            ),
        ] {
            let message = measure(&study).expect_err(cause).to_string();
            assert!(message.contains(cause), "{message}");
        }
    }
}
