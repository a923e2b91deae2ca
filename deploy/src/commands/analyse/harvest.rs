//! `reveille analyse harvest`: harvested and net energy against λ, next to the thresholds that the paper states. The
//! calculation is in `study/src/analysis/harvest.rs`. Names of sheets and columns are a public interface (see `sheet`).
//! The cells of a row follow its columns by position.

use reveille_common::units::Energy;
use reveille_lab::stats::Estimate;
use reveille_study::analysis::harvest::{
    HarvestPoint, HarvestStudy, LambdaReading, STATED_THRESHOLDS, StatedThreshold, lambdas_with_positive_net, measure,
    measure_consumption, measure_demand,
};

use super::lists::{build_scenario, parse_energies, parse_numbers, parse_readings, split_list};
use super::sheet::{Findings, Sheet, SheetValue};
use crate::cli::HarvestArgs;

/// One row per reading, E_B and λ: the cells of [`point_row`].
const POINT_COLUMNS: &[&str] = &[
    "reading",
    "e_b",
    "lambda",
    "closed_form",
    "harvested",
    "harvested_half_width",
    "spent",
    "net",
    "net_half_width",
];
/// One row per N, policy, consumption, E_B and reading: `n`, `policy` and `consumption`, then [`crossing_cells`].
const CROSSING_COLUMNS: &[&str] = &[
    "n",
    "policy",
    "consumption",
    "units",
    "half_width",
    "e_b",
    "reading",
    "net_positive_from",
    "net_positive_to",
    "paper",
];

/// Measures the curves and their crossings with the consumptions.
pub(super) fn run(args: &HarvestArgs) -> anyhow::Result<()> {
    let policies = split_list("--policies", &args.policies, "random,adjusted")?;
    let (readings, energies) = (parse_readings(&args.readings)?, parse_energies(&args.e_b)?);
    let base = build_scenario(
        &args.study,
        &[
            ("--policies", "policy.name", policies.first().copied()),
            ("--ttis", "ttis", args.ttis.as_deref()),
        ],
    )?;
    let study = HarvestStudy {
        scenario: base,
        readings: readings.clone(),
        lambdas: parse_numbers("--lambda", &args.lambda, "0.05,0.1,0.2")?,
        e_b: energies.clone(),
        seeds: args.seeds,
    };
    let points = measure(&study)?;
    let findings = Findings {
        title: format!(
            "Harvest against λ, Figs. 13 and 14 · {} · {} devices · {} TTIs · preset {} · {} runs per point",
            study.scenario.policy.name(),
            study.scenario.run.devices,
            study.scenario.run.ttis,
            study.scenario.run.preset,
            args.seeds
        ),
        sheets: vec![
            Sheet {
                name: "points",
                title: "Units per device and TTI; closed form E_B · Pr(arrival), runs ± 95 %.".to_owned(),
                columns: POINT_COLUMNS,
                rows: points.iter().map(point_row).collect(),
            },
            Sheet {
                name: "crossings",
                title: "λ between which the mean harvest exceeds a fixed consumption; `paper`: the λ that it states \
                    for these N, E_B."
                    .to_owned(),
                columns: CROSSING_COLUMNS,
                rows: crossing_rows(args, &policies, &readings, &energies)?,
            },
        ],
        notes: notes(&points),
    };
    findings.present(&args.study)
}

fn point_row(point: &HarvestPoint) -> Vec<SheetValue> {
    vec![
        point.reading.name().into(),
        point.e_b.into(),
        point.lambda.into(),
        point.closed_form.into(),
        point.harvested.mean.into(),
        point.harvested.half_width.into(),
        point.spent.mean.into(),
        point.net.mean.into(),
        point.net.half_width.into(),
    ]
}

fn crossing_rows(
    args: &HarvestArgs,
    policies: &[&str],
    readings: &[LambdaReading],
    energies: &[Energy],
) -> anyhow::Result<Vec<Vec<SheetValue>>> {
    let mut rows = Vec::new();
    for devices in split_list("--devices", &args.devices, "10,100,250")? {
        for policy in policies {
            let scenario = build_scenario(
                &args.study,
                &[
                    ("--devices", "devices", Some(devices)),
                    ("--policies", "policy.name", Some(policy)),
                    ("--ttis", "ttis", args.ttis.as_deref()),
                ],
            )?;
            let consumptions = [
                ("as in the scenario", measure_consumption(&scenario, args.seeds)?),
                ("never short", measure_demand(&scenario, args.seeds)?),
            ];
            for (consumption_name, consumed) in consumptions {
                for reading in readings {
                    for e_b in energies {
                        let key = [scenario.run.devices.into(), (*policy).into(), consumption_name.into()];
                        let cells =
                            crossing_cells(&consumed, *reading, e_b.units(), scenario.run.tau, scenario.run.devices);
                        rows.push(key.into_iter().chain(cells).collect());
                    }
                }
            }
        }
    }
    Ok(rows)
}

fn crossing_cells(consumed: &Estimate, reading: LambdaReading, e_b: f64, tau: f64, devices: u32) -> [SheetValue; 7] {
    // If no λ brings this much, both ends are NaN, which a table shows as a dash.
    let (from, to) = lambdas_with_positive_net(reading, e_b, consumed.mean, tau).unwrap_or((f64::NAN, f64::NAN));
    [
        consumed.mean.into(),
        consumed.half_width.into(),
        e_b.into(),
        reading.name().into(),
        from.into(),
        to.into(),
        stated_threshold(reading, devices, e_b).into(),
    ]
}

/// Formats the threshold that the paper states for these N and E_B, under Eq. (5) only; "–" without a threshold.
fn stated_threshold(reading: LambdaReading, devices: u32, e_b: f64) -> String {
    let applies =
        |s: &&StatedThreshold| reading == LambdaReading::Eq5 && s.devices == devices && (s.e_b - e_b).abs() < 1e-9;
    match STATED_THRESHOLDS.iter().find(applies) {
        Some(s) => {
            let ends: Vec<String> = s.ends().map(|end| format!("{} ({})", end.lambda, end.policy)).collect();
            format!("{}, {}", ends.join(" to "), s.paper_figure)
        }
        None => "–".to_owned(),
    }
}

fn notes(points: &[HarvestPoint]) -> Vec<String> {
    let outside = points
        .iter()
        .filter(|p| (p.harvested.mean - p.closed_form).abs() > p.harvested.half_width)
        .count();
    vec![
        format!(
            "The closed form lies outside the 95 % interval of {outside} of {} points; one in twenty is expected.",
            points.len()
        ),
        "The net of a run (harvested less spent, at the same λ) cannot stay below 0, as a device cannot spend more \
         than it has. This net is the overflow of full batteries plus the rest of the initial charge. The net in the \
         paper is the harvest less a consumption that does not depend on λ; net_positive_from/to uses the same \
         definition."
            .to_owned(),
        "`as in the scenario`: the consumption of the policy with the λ and E_B of the scenario, as in Fig. 8. `never \
         short`: its consumption with full batteries. Under Eq. (5) the harvest is at most E_B/e per TTI, and falls \
         with λ beyond λ = 1/τ; under exp(-λ) the harvest always falls with λ, which contradicts the statement \
         `positive above λ`."
            .to_owned(),
    ]
}
