//! Run time against N (Sec. V-D): the work to time, and power laws fitted to the times. The caller provides the clock.
//!
//! The paper counts the cost of a *configuration*: O(ϱ^N) for the exhaustive search of the adjusted duty cycle,
//! O(N(N−1)/2) for KNN clusters, O(N²) for Q-learning and for the decision transformer. [`TimedWork::set_up`] is that
//! configuration. [`TimedWork::run`] is the run after it, and [`TimedWork::prepare_decisions`] the BS's share of that
//! run: its answers to events. Times vary. `reveille analyse runtime` measures them; docs/analysis.md and
//! docs/benchmarks.md quote measurements.

use reveille_bs::cycle::PreparedRun;
use reveille_bs::knowledge::Knowledge;
use reveille_bs::observation::Observation;
use reveille_bs::policy::interface::Policy;
use reveille_bs::policy::registry;
use reveille_bs::scenario::{PolicyChoice, Scenario};
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, EventId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::rng::{Purpose, Stream};
use reveille_common::units::Energy;
use reveille_lab::preparation::{prepare, start};
use reveille_lab::run::{Run, RunOptions};
use statrs::distribution::{ContinuousCDF, StudentsT};

use super::AnalysisError;

/// Returns the paper's complexity for configuring a policy, as its entry in the registry states it.
pub fn paper_complexity(policy: &PolicyChoice) -> &'static str {
    registry::named(policy.name()).map_or("–", |policy| policy.runtime)
}

/// A scenario to time.
pub struct TimedWork {
    scenario: Scenario,
}

impl TimedWork {
    /// Creates the work of `scenario`.
    pub const fn new(scenario: Scenario) -> Self {
        Self { scenario }
    }

    /// Deploys the devices and configures the policy: clusters, or a search. Done once per deployment.
    pub fn set_up(&self) -> Run {
        start(&self.scenario, RunOptions::default())
    }

    /// Runs to the end.
    pub fn run(run: Run) {
        // Without `black_box` the compiler may omit work whose result is unused.
        std::hint::black_box(run.finish(&mut ()));
    }

    /// Prepares `events` events for the BS to decide, with a policy that is configured again, outside the timed calls.
    pub fn prepare_decisions(&self, events: u64) -> TimedDecisions {
        TimedDecisions::new(&prepare(&self.scenario), events)
    }
}

/// Events with their first reports, for one policy.
pub struct TimedDecisions {
    knowledge: Knowledge,
    /// Random charges, on average half full.
    batteries: Vec<Energy>,
    policy: Box<dyn Policy>,
    plan: Plan,
    /// TTI, event and first reports of each event to decide.
    events_with_reports: Vec<(Tti, Stimulus, Vec<Report>)>,
}

impl TimedDecisions {
    fn new(prepared: &PreparedRun, events: u64) -> Self {
        let (scenario, deployment) = (&prepared.scenario, &prepared.deployment);
        let knowledge = prepared.knowledge();
        let mut policy = prepared.policy(&knowledge);
        let all_off = Plan::from_bits(knowledge.devices.iter().map(|_| false));
        let mut stream = Stream::new(scenario.run.seed, Purpose::Training, 0);
        let mut random_charge = |full: Energy| Energy::from_micro((stream.unit() * full.micro() as f64) as u64);
        let batteries: Vec<Energy> = deployment
            .devices
            .iter()
            .map(|d| random_charge(d.energy.e_max))
            .collect();
        let plan = policy.decide(&observe(&knowledge, &batteries, &all_off, Tti::ZERO, 0.0));
        let event_with_reports = |event| {
            let mut stream = Stream::new(scenario.run.seed, Purpose::Epicentre, event);
            let epicentre = Point::new(
                stream.unit() * scenario.area.width,
                stream.unit() * scenario.area.height,
            );
            let tti = Tti(event);
            let sensing_now = (0..scenario.run.devices)
                .map(DeviceId)
                .filter(|&j| plan.duty_cycle(j).is_on(tti));
            let reports = sensing_now.map(|j| report_from(&knowledge, j, tti, epicentre));
            // Beyond d_max the information is 0: such a device detects nothing.
            let reports = reports.filter(|r| r.information > 0.0).collect();
            let event = EventId(event);
            (tti, Stimulus { event, epicentre }, reports)
        };
        let events_with_reports = (0..events).map(event_with_reports).collect();
        Self {
            knowledge,
            batteries,
            policy,
            plan,
            events_with_reports,
        }
    }

    /// Decides the plans of `ttis` TTIs in order. Returns `None` for a policy whose first plan stays valid for the
    /// whole run. May be called repeatedly.
    pub fn decide_plans(&mut self, ttis: u64) -> Option<()> {
        let Self {
            knowledge,
            batteries,
            policy,
            plan,
            ..
        } = self;
        for k in (1..=ttis).map(Tti) {
            // Such a policy makes no further decisions, so there is nothing to time.
            if policy.next_decision(k) == Tti::NEVER {
                return None;
            }
            *plan = policy.decide(&observe(knowledge, batteries, plan, k, 0.0));
        }
        Some(())
    }

    /// Decides all events and returns the number of wake-ups. Each event lasts until the policy requests no more
    /// wake-ups, and all wake-ups are answered. A policy with ground truth only decides whether it wakes a device. May
    /// be called repeatedly.
    pub fn decide_wake_ups(&mut self) -> u64 {
        let Self {
            knowledge,
            batteries,
            policy,
            plan,
            events_with_reports,
        } = self;
        let mut wake_ups = 0;
        for (tti, stimulus, reports) in events_with_reports {
            if let Some(oracle) = policy.oracle() {
                oracle.reveal_event(stimulus);
                wake_ups += u64::from(oracle.needs_wake_up());
                continue;
            }
            if reports.is_empty() {
                continue;
            }
            let by_report = reports.iter().map(|r| r.information);
            let mut information = by_report.fold(0.0, |so_far, i| knowledge.sensing.fuse(so_far, i));
            policy.reports_received(&observe(knowledge, batteries, plan, *tti, information), reports);
            while let Some(woken) = policy.next_wake_up(&observe(knowledge, batteries, plan, *tti, information)) {
                wake_ups += 1;
                let report = report_from(knowledge, woken, *tti, stimulus.epicentre);
                information = knowledge.sensing.fuse(information, report.information);
                policy.take_wake_up_answer(&observe(knowledge, batteries, plan, *tti, information), Some(&report));
            }
        }
        wake_ups
    }
}

/// Creates the report of `device` on an event at `epicentre`, without information beyond d_max.
fn report_from(known: &Knowledge, device: DeviceId, tti: Tti, epicentre: Point) -> Report {
    let d = known.devices[device.index()].position.distance(epicentre);
    Report {
        device,
        tti,
        information: known.sensing.information(d),
        battery: Energy::ZERO,
    }
}

const fn observe<'a>(
    known: &'a Knowledge,
    batteries: &'a [Energy],
    plan: &'a Plan,
    now: Tti,
    information: f64,
) -> Observation<'a> {
    Observation {
        now,
        known,
        plan,
        information,
        batteries,
        battery_estimator: None,
    }
}

/// A power law y = c · x^exponent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PowerLaw {
    /// Exponent.
    pub exponent: f64,
    /// Half the width of the exponent's 95 % interval; NaN for two points.
    pub half_width: f64,
    /// Factor c.
    pub factor: f64,
}

/// Fits the power law through `points` (x, y), all above 0, by least squares of the logarithms.
///
/// # Errors
/// With fewer than two different x, or a value that has no logarithm.
pub fn fit_power_law(points: &[(f64, f64)]) -> Result<PowerLaw, AnalysisError> {
    if let Some(bad) = points.iter().find(|(x, y)| !(*x > 0.0 && *y > 0.0)) {
        let requirement = "must both be above 0 for a power law";
        return Err(AnalysisError::invalid(
            "point (N, time)",
            &format!("{bad:?}"),
            requirement,
        ));
    }
    let logs: Vec<(f64, f64)> = points.iter().map(|(x, y)| (libm::log(*x), libm::log(*y))).collect();
    let n = logs.len() as f64;
    let (mean_x, mean_y) = (
        logs.iter().map(|l| l.0).sum::<f64>() / n,
        logs.iter().map(|l| l.1).sum::<f64>() / n,
    );
    let sum_xx: f64 = logs.iter().map(|(x, _)| (x - mean_x).powi(2)).sum();
    if logs.len() < 2 || sum_xx <= 0.0 {
        let requirement = "must hold at least two different values for an exponent to be fitted";
        return Err(AnalysisError::invalid("devices", &points.len(), requirement));
    }
    let sum_xy: f64 = logs.iter().map(|(x, y)| (x - mean_x) * (y - mean_y)).sum();
    let exponent = sum_xy / sum_xx;
    let intercept = mean_y - exponent * mean_x;
    let squared_residuals: f64 = logs.iter().map(|(x, y)| (y - intercept - exponent * x).powi(2)).sum();
    // Two parameters are fitted, so two points leave no degree of freedom and no interval.
    let quantile = StudentsT::new(0.0, 1.0, n - 2.0).map_or(f64::NAN, |t| t.inverse_cdf(0.975));
    Ok(PowerLaw {
        exponent,
        half_width: quantile * (squared_residuals / (n - 2.0) / sum_xx).sqrt(),
        factor: libm::exp(intercept),
    })
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    #[test]
    fn a_fitted_power_law_equals_a_calculation_by_hand() {
        let exact: Vec<(f64, f64)> = [10.0, 50.0, 250.0, 2500.0]
            .map(|x: f64| (x, 3.0 * x * x.sqrt()))
            .to_vec();
        let law = fit_power_law(&exact).expect("a law");
        assert!((law.exponent - 1.5).abs() < 1e-12 && (law.factor - 3.0).abs() < 1e-9 && law.half_width < 1e-6);
        // Logarithms 0, 1, 2 and 0, 1, 4: slope 2, residuals 1/3, −2/3, 1/3, t with one degree of freedom 12.706.
        let exp = |power: f64| libm::exp(power);
        let law = fit_power_law(&[(exp(0.0), exp(0.0)), (exp(1.0), exp(1.0)), (exp(2.0), exp(4.0))]).expect("a law");
        assert!((law.exponent - 2.0).abs() < 1e-12, "{law:?}");
        assert!(
            (law.half_width - 12.706_205 * (2.0_f64 / 3.0 / 2.0).sqrt()).abs() < 1e-3,
            "{law:?}"
        );
        assert!(fit_power_law(&[(10.0, 1.0)]).is_err() && fit_power_law(&[(10.0, 1.0), (10.0, 2.0)]).is_err());
        assert!(fit_power_law(&[(10.0, 0.0), (20.0, 1.0)]).is_err());
    }

    #[test]
    fn wake_up_decisions_can_be_repeated() {
        for policy in ["knn", "random", "genie", "adjusted"] {
            let name = format!("policy.name={policy}");
            let overrides = [
                name.as_str(),
                "devices=80",
                "ttis=400",
                "policy.adjusted.pilot_ttis=100",
            ];
            let parse = |text: &&str| Override::parse(text).expect("an override");
            let overrides: Vec<Override> = overrides.iter().map(parse).collect();
            let work = TimedWork::new(load("paper", &overrides).expect("a scenario").scenario);
            TimedWork::run(work.set_up());
            let mut decisions = work.prepare_decisions(200);
            let wake_ups = decisions.decide_wake_ups();
            assert_eq!(wake_ups, decisions.decide_wake_ups(), "{policy}");
            assert_eq!(wake_ups > 0, policy != "random", "{policy}: {wake_ups} wake-ups");
        }
    }
}
