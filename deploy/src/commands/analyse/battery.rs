//! `reveille analyse battery`: the chain of Sec. III-B and Eq. (8) next to measured batteries. The calculation is in
//! `study/src/analysis/battery/`. Names of sheets and columns are a public interface (see `sheet`). The cells of a row
//! follow its columns by position. `tests/program/analyse.rs` compares parts of the notes.

use anyhow::bail;
use reveille_bs::scenario::Scenario;
use reveille_common::scenario::{DeviceClass, Harvest};
use reveille_study::analysis::battery::{BatteryComparison, BatteryStudy, LevelBin, SampleConfig, compare};
use reveille_study::analysis::harvest::LambdaReading;

use super::lists::{build_scenario, parse_duties, parse_energies, parse_numbers};
use super::sheet::{Findings, Sheet, SheetValue};
use crate::cli::BatteryArgs;

/// One row per battery: the cells of [`chain_row`].
const CHAIN_COLUMNS: &[&str] = &[
    "e_b",
    "duty",
    "activation",
    "total_variation",
    "chain_mean",
    "measured_mean",
    "half_width",
    "residual",
    "ttis_to_steady",
];
/// Two rows per battery: the cells of [`availability_rows`]. The `eq8_…` columns are the `sum`, `sum_by_beta` and
/// `printed_beta` of `Eq8`.
const AVAILABILITY_COLUMNS: &[&str] = &[
    "event",
    "e_b",
    "duty",
    "activation",
    "chain",
    "measured",
    "half_width",
    "eq8_printed",
    "eq8_sum_by_beta",
    "eq8_beta_as_named",
];
/// One row per bin of each battery: the cells of [`level_rows`].
const LEVEL_COLUMNS: &[&str] = &["e_b", "duty", "activation", "battery_from", "chain", "measured"];

/// Solves the chain, measures the run and compares both.
pub(super) fn run(args: &BatteryArgs) -> anyhow::Result<()> {
    let scenario = build_scenario(&args.study, &[])?;
    let class = only_class(&scenario)?;
    let (reading, lambda) = energy_source(&class.harvest)?;
    let study_of = |(t_on, t_drx), e_b, activation| BatteryStudy {
        model: class.energy,
        reading,
        lambda,
        tau: scenario.run.tau,
        e_b,
        t_on,
        t_drx,
        activation,
        sample: SampleConfig {
            seed: scenario.run.seed,
            devices: args.devices,
            ttis: args.ttis,
            // The default share of a scenario; the help of `--ttis` states it.
            warm_up: args.ttis / 10,
        },
        bin_width: args.bin,
    };
    let (duties, energies) = (parse_duties(&args.duty)?, parse_energies(&args.e_b)?);
    let activations = parse_numbers("--activation", &args.activation, "0,0.01")?;
    let mut comparisons = Vec::new();
    for &duty in &duties {
        for &activation in &activations {
            for &e_b in &energies {
                let study = study_of(duty, e_b, activation);
                comparisons.push((study, compare(&study)?));
            }
        }
    }
    let findings = Findings {
        title: format!(
            "Battery level · {} λ {lambda} · E_max {} · {} devices × {} TTIs · seed {}",
            reading.name(),
            class.energy.e_max,
            args.devices,
            args.ttis,
            scenario.run.seed
        ),
        sheets: sheets(&comparisons, args),
        notes: notes(&comparisons, args.bin),
    };
    findings.present(&args.study)
}

/// Returns the class of all devices.
fn only_class(scenario: &Scenario) -> anyhow::Result<&DeviceClass> {
    match &scenario.classes[..] {
        [class] => Ok(class),
        many => bail!(
            "the scenario has {} device classes, but the chain describes one battery; use a scenario with one class",
            many.len()
        ),
    }
}

/// Returns the reading of λ and λ of the scenario's energy source.
fn energy_source(harvest: &Harvest) -> anyhow::Result<(LambdaReading, f64)> {
    let reading = LambdaReading::ALL
        .into_iter()
        .find(|reading| reading.kind() == harvest.kind());
    let Some((reading, arrivals)) = reading.zip(harvest.arrivals()) else {
        bail!("the chain needs independent arrivals; use --set harvest.kind=eq5 or exp-minus-lambda");
    };
    Ok((reading, arrivals.lambda))
}

type BatteryResults = [(BatteryStudy, BatteryComparison)];

/// Returns the tables. The distribution comes first, for `--csv`, if only one battery is studied; otherwise only JSON
/// has it.
fn sheets(results: &BatteryResults, args: &BatteryArgs) -> Vec<Sheet> {
    let chain = Sheet {
        name: "chain",
        title: format!(
            "Chain and machines: total variation over bins of {} units, mean battery.",
            args.bin
        ),
        columns: CHAIN_COLUMNS,
        rows: results.iter().map(chain_row).collect(),
    };
    let availability = Sheet {
        name: "availability",
        title: "Pr(B ≥ E) at the end of a TTI, four ways.".to_owned(),
        columns: AVAILABILITY_COLUMNS,
        rows: results.iter().flat_map(availability_rows).collect(),
    };
    let levels = Sheet {
        name: "levels",
        title: "The distribution of the battery level.".to_owned(),
        columns: LEVEL_COLUMNS,
        rows: results.iter().flat_map(level_rows).collect(),
    };
    if args.study.csv.is_some() && results.len() == 1 {
        vec![levels, chain, availability]
    } else if args.study.json {
        vec![chain, availability, levels]
    } else {
        vec![chain, availability]
    }
}

/// Returns the cells of `e_b`, `duty` and `activation`, which identify a battery in every sheet.
fn key_cells(study: &BatteryStudy) -> [SheetValue; 3] {
    [
        study.e_b.units().into(),
        format!("{}/{}", study.t_on, study.t_drx).into(),
        study.activation.into(),
    ]
}

fn chain_row((study, comparison): &(BatteryStudy, BatteryComparison)) -> Vec<SheetValue> {
    let values: [SheetValue; 6] = [
        comparison.total_variation.into(),
        comparison.chain_mean.into(),
        comparison.measured_mean.mean.into(),
        comparison.measured_mean.half_width.into(),
        comparison.steady.residual.into(),
        comparison.steady.transitions_to_steady_state.into(),
    ];
    key_cells(study).into_iter().chain(values).collect()
}

fn availability_rows((study, comparison): &(BatteryStudy, BatteryComparison)) -> Vec<Vec<SheetValue>> {
    // In the order of `BatteryComparison::availability`.
    let event_names = ["B ≥ E_Tx", "B ≥ E_idle"];
    let events = event_names.into_iter().zip(&comparison.availability);
    events
        .map(|(event_name, availability)| {
            let values: [SheetValue; 6] = [
                availability.chain.into(),
                availability.measured.mean.into(),
                availability.measured.half_width.into(),
                availability.eq8.sum.into(),
                availability.eq8.sum_by_beta.into(),
                availability.eq8.printed_beta.into(),
            ];
            [event_name.into()]
                .into_iter()
                .chain(key_cells(study))
                .chain(values)
                .collect()
        })
        .collect()
}

fn level_rows((study, comparison): &(BatteryStudy, BatteryComparison)) -> Vec<Vec<SheetValue>> {
    let row = |&LevelBin { from, chain, measured }: &LevelBin| {
        let values: [SheetValue; 3] = [from.into(), chain.into(), measured.into()];
        key_cells(study).into_iter().chain(values).collect()
    };
    comparison.bins.iter().map(row).collect()
}

fn notes(results: &BatteryResults, bin_width: f64) -> Vec<String> {
    let largest = results
        .iter()
        .map(|(_, comparison)| comparison.total_variation)
        .fold(0.0, f64::max);
    let mut notes = vec![format!(
        "Largest total variation distance of chain and machines: {largest:.4}."
    )];
    if let Some((study, comparison)) = results.first() {
        let per_unit = comparison.lattice.quanta_per_unit;
        notes.push(format!(
            "The chain counts in 1/{per_unit} of a unit; E_WuR is {} micro-units in the machines and {} such quanta in \
             the chain. Levels of both go to the nearest quantum, then into bins [0, {bin_width}), [{bin_width}, {}), \
             … of units.",
            study.model.e_wur.micro(),
            comparison.lattice.e_wur,
            2.0 * bin_width
        ));
    }
    let sums_above_one: Vec<String> = results
        .iter()
        .flat_map(|(study, comparison)| describe_sums_above_one(study, comparison))
        .collect();
    if let Some(example) = sums_above_one.first() {
        notes.push(format!(
            "Eq. (8) as printed is not a probability: {example} ({} rows above 1). Its terms have different numbers of \
             trials, so the sum is Pr(E+1 successes within M+1 trials)/P and tends to 1/P.",
            sums_above_one.len()
        ));
    }
    if let Some(example) = results.iter().find_map(|result| describe_fall(result, results)) {
        notes.push(format!(
            "Eq. (8) as printed falls with a larger harvest: {example}. A larger E_B makes M = ⌈E_max/E_λ⌉ smaller, \
             while B and E count units. P, the probability to spend, is used as the probability of success."
        ));
    }
    notes.push(
        "eq8_sum_by_beta is the incomplete beta form of the printed sum, I_P(E+1, M−E+1)/P. The form that the paper \
         names, β_{1−P}(E+1, E_max+1), lies in [0, 1] but is another function: it does not contain the harvest, and is \
         1 at P = 0 for every harvest."
            .to_owned(),
    );
    notes
}

/// Describes the probabilities of Eq. (8) as printed that are above 1.
fn describe_sums_above_one(study: &BatteryStudy, comparison: &BatteryComparison) -> Vec<String> {
    let above_one = comparison.availability.iter().filter(|a| a.eq8.sum > 1.0);
    above_one
        .map(|a| {
            format!(
                "{:.3} for E = {} units, E_B = {}, P = {}",
                a.eq8.sum,
                a.threshold,
                study.e_b.units(),
                study.activation
            )
        })
        .collect()
}

/// Describes two studies that differ only in E_B, where the printed sum falls while the chain's probability rises.
fn describe_fall((study, comparison): &(BatteryStudy, BatteryComparison), results: &BatteryResults) -> Option<String> {
    let has_same_settings = |other: &BatteryStudy| {
        (other.t_on, other.t_drx) == (study.t_on, study.t_drx)
            // Compared by bits, since both values come from one list of the command line.
            && other.activation.to_bits() == study.activation.to_bits()
    };
    results
        .iter()
        .filter(|(other, _)| has_same_settings(other) && other.e_b > study.e_b)
        .find_map(|(other, other_comparison)| {
            let pairs = comparison.availability.iter().zip(&other_comparison.availability);
            pairs
            // A fall of less than 10⁻⁶ can be rounding.
            .filter(|(a, b)| b.eq8.sum < a.eq8.sum * (1.0 - 1e-6) && b.chain > a.chain)
            .map(|(a, b)| {
                format!(
                    "for E = {} units and P = {} from {:.2e} with E_B = {} to {:.2e} with E_B = {}, where the chain \
                     rises from {:.3} to {:.3}",
                    a.threshold,
                    study.activation,
                    a.eq8.sum,
                    study.e_b.units(),
                    b.eq8.sum,
                    other.e_b.units(),
                    a.chain,
                    b.chain
                )
            })
            .next()
        })
}
