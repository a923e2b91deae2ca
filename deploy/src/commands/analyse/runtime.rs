//! `reveille analyse runtime`: the only study that reads the wall clock, so its numbers differ from call to call. Names
//! of sheets and columns are a public interface (see `sheet`).

use reveille_bs::scenario::Scenario;
use reveille_study::analysis::runtime::{TimedWork, fit_power_law, paper_complexity};

use super::lists::{build_scenario, split_list};
use super::sheet::{Findings, Sheet, SheetValue};
use crate::cli::RuntimeArgs;
use crate::runtime::{median, now};

const TIME_COLUMNS: &[&str] = &[
    "policy",
    "n",
    "set_up_ms",
    "run_us_per_tti",
    "decision_us",
    "wake_ups_per_decision",
    "plan_us",
];
const FIT_COLUMNS: &[&str] = &["policy", "what", "exponent", "half_width", "paper"];

/// The cell of a time about which the paper makes no statement.
const NO_CLAIM: &str = "–";

/// The times of one policy with one N.
struct PolicyTimes {
    n: f64,
    set_up_s: f64,
    tti_s: f64,
    decision_s: f64,
    wake_ups_per_decision: f64,
    /// Seconds for a sensing decision; NaN if a plan never changes.
    plan_s: f64,
}

/// Times every policy with every N, and fits power laws.
pub(super) fn run(args: &RuntimeArgs) -> anyhow::Result<()> {
    let (mut rows, mut fits) = (Vec::new(), Vec::new());
    for policy in split_list("--policies", &args.policies, "knn,random")? {
        let mut times = Vec::new();
        let mut complexity = NO_CLAIM;
        for devices in split_list("--devices", &args.devices, "10,100,1000")? {
            let scenario = build_scenario(
                &args.study,
                &[
                    ("--policies", "policy.name", Some(policy)),
                    ("--devices", "devices", Some(devices)),
                    ("--ttis", "ttis", Some(&args.ttis)),
                ],
            )?;
            complexity = paper_complexity(&scenario.policy);
            let measured = measure(&scenario, args);
            rows.push(time_row(policy, &measured));
            times.push(measured);
        }
        fits.extend(fit_rows(policy, complexity, &times));
    }
    let findings = Findings {
        title: format!(
            "Wall time against N · preset {} · {} TTIs · {} events · medians of {}",
            args.study.scenario, args.ttis, args.events, args.repeat
        ),
        sheets: vec![
            Sheet {
                name: "times",
                title: "One core.".to_owned(),
                columns: TIME_COLUMNS,
                rows,
            },
            Sheet {
                name: "fits",
                title: "time ∝ N^exponent, ± 95 % by least squares of the logarithms; `paper`: its worst case for \
                    configuring a policy."
                    .to_owned(),
                columns: FIT_COLUMNS,
                rows: fits,
            },
        ],
        notes: vec![
            "adjusted searches one (t_on, t_DRX) for all devices, so its set-up takes ϱ pilot runs, not the ϱ^N runs \
             of a search for each device. knn finds neighbours in a grid, not by all N(N−1)/2 distances."
                .to_owned(),
            "q-learning decides in every TTI which devices sense (plan). A decision covers all wake-ups after a \
             report. The other policies keep one plan for the whole run."
                .to_owned(),
            "The area is fixed, so the density grows with N, as does the number of devices per report.".to_owned(),
        ],
    };
    findings.present(&args.study)
}

fn measure(scenario: &Scenario, args: &RuntimeArgs) -> PolicyTimes {
    let (mut set_ups, mut runs, mut decisions, mut plans) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut wake_ups = 0;
    for repetition in 0..args.repeat {
        // Each repetition has another seed, and so another deployment.
        let work = TimedWork::new(scenario.with_seed(scenario.run.seed.wrapping_add(repetition)));
        let started = now();
        let run = work.set_up();
        set_ups.push(started.elapsed().as_secs_f64());
        let started = now();
        TimedWork::run(run);
        runs.push(started.elapsed().as_secs_f64() / scenario.run.ttis as f64);
        let mut decisions_work = work.prepare_decisions(args.events);
        let started = now();
        wake_ups += decisions_work.decide_wake_ups();
        decisions.push(started.elapsed().as_secs_f64() / args.events as f64);
        let started = now();
        let planned = decisions_work.decide_plans(args.events);
        let seconds = started.elapsed().as_secs_f64() / args.events as f64;
        plans.push(planned.map_or(f64::NAN, |()| seconds));
    }
    PolicyTimes {
        n: f64::from(scenario.run.devices),
        set_up_s: median(set_ups),
        tti_s: median(runs),
        decision_s: median(decisions),
        plan_s: median(plans),
        wake_ups_per_decision: wake_ups as f64 / (args.events * args.repeat) as f64,
    }
}

fn time_row(policy: &str, times: &PolicyTimes) -> Vec<SheetValue> {
    vec![
        policy.into(),
        (times.n as u64).into(),
        (times.set_up_s * 1e3).into(),
        (times.tti_s * 1e6).into(),
        (times.decision_s * 1e6).into(),
        times.wake_ups_per_decision.into(),
        (times.plan_s * 1e6).into(),
    ]
}

/// One row for each kind of time; the exponent is NaN if none can be fitted. `complexity` is the paper's, of the
/// set-up.
fn fit_rows(policy: &str, complexity: &str, times: &[PolicyTimes]) -> Vec<Vec<SheetValue>> {
    let fit_row = |time_kind: &str, time: fn(&PolicyTimes) -> f64, claim: &str| {
        let points: Vec<(f64, f64)> = times.iter().map(|t| (t.n, time(t))).collect();
        let (exponent, half_width) =
            fit_power_law(&points).map_or((f64::NAN, f64::NAN), |law| (law.exponent, law.half_width));
        vec![
            policy.into(),
            time_kind.into(),
            exponent.into(),
            half_width.into(),
            claim.into(),
        ]
    };
    let mut fits = vec![
        fit_row("set-up", |t| t.set_up_s, complexity),
        fit_row("run, per TTI", |t| t.tti_s, NO_CLAIM),
        fit_row("decision", |t| t.decision_s, NO_CLAIM),
    ];
    if times.iter().all(|t| t.plan_s.is_finite()) {
        fits.push(fit_row("plan", |t| t.plan_s, NO_CLAIM));
    }
    fits
}
