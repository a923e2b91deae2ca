//! `reveille analyse runtime`: the only study that reads the wall clock, so its numbers differ from call to call. Names
//! of sheets and columns are a public interface (see `sheet`), as are the kinds of time in [`fit_rows`], by which
//! `tests/program/analyse.rs` finds the columns. `docs/analysis.md` quotes the numbers.

use reveille_bs::scenario::Scenario;
use reveille_study::analysis::runtime::{TimedWork, fit_power_law, paper_complexity};

use super::lists::{build_scenario, split_list};
use super::sheet::{Findings, Sheet, SheetValue};
use crate::cli::RuntimeArgs;
use crate::runtime::{median, now};

/// Columns of the sheet `times`, in the order of [`time_row`].
const TIME_COLUMNS: &[&str] = &[
    "policy",
    "n",
    "set_up_ms",
    "run_us_per_tti",
    "decision_us",
    "wake_ups_per_decision",
    "plan_us",
];
/// Columns of the sheet `fits`, in the order of [`fit_rows`]; `what` is the kind of time.
const FIT_COLUMNS: &[&str] = &["policy", "what", "exponent", "half_width", "paper"];

/// The cell of a time about which the paper makes no statement; `paper_complexity` repeats it.
const NO_CLAIM: &str = "–";

/// The times of one policy with one N, each the median of all repetitions.
struct PolicyTimes {
    /// Number of devices N.
    n: f64,
    /// Seconds to deploy the devices and configure the policy.
    set_up_s: f64,
    /// Seconds for a TTI of the run.
    tti_s: f64,
    /// Seconds for all wake-ups after the reports of an event.
    decision_s: f64,
    /// Mean over all repetitions.
    wake_ups_per_decision: f64,
    /// Seconds for a sensing decision, of one TTI; NaN if the first plan stays valid for the whole run.
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
    let (mut set_up_times, mut tti_times) = (Vec::new(), Vec::new());
    let (mut decision_times, mut plan_times) = (Vec::new(), Vec::new());
    let mut wake_ups = 0;
    for repetition in 0..args.repeat {
        // Each repetition has another seed, and so another deployment.
        let work = TimedWork::new(scenario.with_seed(scenario.run.seed.wrapping_add(repetition)));
        let started = now();
        let run = work.set_up();
        set_up_times.push(started.elapsed().as_secs_f64());
        let started = now();
        TimedWork::run(run);
        tti_times.push(started.elapsed().as_secs_f64() / scenario.run.ttis as f64);
        let mut timed_decisions = work.prepare_decisions(args.events);
        let started = now();
        wake_ups += timed_decisions.decide_wake_ups();
        decision_times.push(started.elapsed().as_secs_f64() / args.events as f64);
        let started = now();
        // `--events` is also the number of planned TTIs.
        let planned = timed_decisions.decide_plans(args.events);
        let seconds = started.elapsed().as_secs_f64() / args.events as f64;
        plan_times.push(planned.map_or(f64::NAN, |()| seconds));
    }
    PolicyTimes {
        n: f64::from(scenario.run.devices),
        set_up_s: median(set_up_times),
        tti_s: median(tti_times),
        decision_s: median(decision_times),
        plan_s: median(plan_times),
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

/// Returns a row for each kind of time; the plan has one only if it was timed for every N. The exponent is NaN if none
/// can be fitted. `complexity` is the paper's, of the set-up.
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
