//! `reveille analyse transitions`: the paper's P_m,n next to the frequencies in runs. P_m,n is the probability that a
//! device in state S_m changes to S_n. Names of columns are a public interface (see `sheet`). `docs/analysis.md` quotes
//! the numbers. The causes in [`explanations`] follow `study/src/analysis/transitions/mod.rs`.

use reveille_study::analysis::transitions::{Transition, Transitions, measure};

use super::lists::build_scenario;
use super::sheet::{Findings, Sheet, SheetValue};
use crate::cli::TransitionsArgs;
use crate::commands::resolve_scenario::check_single_policy;

/// The columns, in the order of [`transition_row`].
const COLUMNS: &[&str] = &[
    "transition",
    "printed",
    "printed_min",
    "printed_max",
    "not_a_probability",
    "by_duty_cycle",
    "measured",
    "half_width",
    "wilson_low",
    "wilson_high",
    "count",
    "visits",
];

/// Counts transitions.
pub(super) fn run(args: &TransitionsArgs) -> anyhow::Result<()> {
    check_single_policy(args.policy.as_deref())?;
    let scenario = build_scenario(
        &args.study,
        &[
            ("--devices", "devices", args.devices.as_deref()),
            ("--policy", "policy.name", args.policy.as_deref()),
            ("--ttis", "ttis", args.ttis.as_deref()),
        ],
    )?;
    let comparison = measure(&scenario, args.seeds)?;
    let findings = Findings {
        title: format!(
            "P_m,n of Sec. IV · {} · {} devices · {} TTIs · preset {} · {} runs",
            scenario.policy.name(),
            scenario.run.devices,
            scenario.run.ttis,
            scenario.run.preset,
            args.seeds
        ),
        sheets: vec![Sheet {
            name: "transitions",
            title: "Printed: mean and range over devices. Measured: share of the visits of S_m, ± 95 % between runs."
                .to_owned(),
            columns: COLUMNS,
            rows: comparison.transitions.iter().map(transition_row).collect(),
        }],
        notes: explanations(&comparison),
    };
    findings.present(&args.study)
}

fn transition_row(t: &Transition) -> Vec<SheetValue> {
    vec![
        format!("P_{},{}", t.from, t.to).into(),
        t.printed.into(),
        t.printed_range.0.into(),
        t.printed_range.1.into(),
        (t.improper_count as u64).into(),
        t.share_by_duty.unwrap_or(f64::NAN).into(),
        t.measured.mean.into(),
        t.measured.half_width.into(),
        t.wilson.0.into(),
        t.wilson.1.into(),
        t.count.into(),
        t.visits.into(),
    ]
}

/// Explains the measured and the printed values, and each printed form that is not a probability for some device.
fn explanations(comparison: &Transitions) -> Vec<String> {
    let mut notes = vec![
        "A measured frequency is the share of the visits of S_m whose next state is S_n, over all devices and measured \
         TTIs, with or without an event. Wilson's interval assumes independent visits. The half-width is Student's t \
         between runs and is more reliable."
            .to_owned(),
        "The printed forms use other conditions: P_4,1 = t_on/t_DRX is the share of S1 in all TTIs, not the share of \
         S4 visits that S1 follows (by_duty_cycle is the latter); P_1,2 = α p(d), averaged over the area, is for the \
         TTI in which an event starts; P_4,2 assumes that the closest device has just reported."
            .to_owned(),
    ];
    for t in comparison.transitions.iter().filter(|t| t.improper_count > 0) {
        let cause = match (t.from, t.to) {
            (1 | 3, 1) => "it sums several conditional probabilities of the same event, and is 0/0 where t_on = t_DRX",
            (1 | 3, 4) => "it is the complement of a sum that is not a probability",
            (4, 4) => "t_on/t_DRX + P_4,2 exceeds 1, as the two events are not disjoint",
            // Only P_2,3 and its complement P_2,4 remain: the other pairs have forms within [0, 1].
            _ => "it uses Eq. (8) as printed; see `reveille analyse battery`",
        };
        notes.push(format!(
            "P_{},{} as printed is not a probability for {} of {} devices: {cause}.",
            t.from, t.to, t.improper_count, comparison.device_count
        ));
    }
    notes
}
