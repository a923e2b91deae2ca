//! Differences between sweeps: each policy of a table is compared with itself in the first table, over the same seeds.
//! Pairs of values are in the order first table, other table. Programs of users read the keys of the JSON.

use std::collections::{BTreeMap, BTreeSet};

use reveille_bs::scenario::compare_scenarios;
use reveille_common::io::Disk;
use reveille_lab::table::Table;
use reveille_study::figures::FigureError;
use reveille_study::figures::paired::PairedDifference;
use reveille_study::figures::results::{Results, RunCondition};
use serde_json::{Value, json};

use super::rows::{DifferenceRow, format_blocks};
use crate::display::{WIDTH, wrap_text};

/// The difference of a condition from its counterpart in the first table.
pub(super) struct TableDifference<'r> {
    table: &'r str,
    reference_table: &'r str,
    condition: &'r RunCondition,
    reference_condition: &'r RunCondition,
    /// Differing fields with the values of the reference and of the condition; `None` if a table does not identify its
    /// fields.
    fields: Option<BTreeMap<String, [String; 2]>>,
    /// Differences of the policies, by metric.
    pub rows: Vec<DifferenceRow<'r>>,
}

impl TableDifference<'_> {
    /// Whether actions failed devices in one of the two conditions.
    pub(super) fn has_failures(&self) -> bool {
        let scripts = [self.condition, self.reference_condition].map(RunCondition::action_text);
        has_other_actions(self.condition, self.reference_condition)
            && scripts.iter().flatten().any(|script| script.contains("fail"))
    }
}

/// Returns the results of each table. Conditions of different tables are not merged.
pub(super) fn read_separately(tables: &[(String, Table)]) -> Result<Vec<Results>, FigureError> {
    let with_runs = tables.iter().filter(|(_, table)| !table.rows.is_empty());
    with_runs
        .map(|table| Results::new(std::slice::from_ref(table), &Disk))
        .collect()
}

/// Compares every table with the first one. Conditions with equal settings have equal runs, and are left out.
pub(super) fn compare<'r>(tables: &'r [Results], metrics: &[&'r str]) -> Vec<TableDifference<'r>> {
    let Some((first, others)) = tables.split_first() else {
        return Vec::new();
    };
    let pairs = others.iter().flat_map(|table| {
        let conditions = table.conditions.iter();
        conditions.filter_map(move |condition| {
            let reference = counterpart(condition, &table.conditions, &first.conditions)?;
            Some((table, condition, reference))
        })
    });
    pairs
        .filter_map(|(table, condition, reference)| {
            let rows: Vec<DifferenceRow<'_>> = metrics
                .iter()
                .flat_map(|metric| compare_policies(condition, reference, metric))
                .collect();
            // A field of one policy does not occur in the scenarios of the others.
            let fields: Option<Vec<_>> = rows
                .iter()
                .map(|row| (row.policy, row.n))
                .collect::<BTreeSet<_>>()
                .into_iter()
                .map(|policy_and_n| differing_fields(condition, reference, policy_and_n))
                .collect();
            let fields: Option<BTreeMap<_, _>> = fields.map(|by_policy| by_policy.into_iter().flatten().collect());
            let has_equal_settings = fields.as_ref().is_some_and(BTreeMap::is_empty);
            let is_compared = !rows.is_empty() && (!has_equal_settings || has_other_actions(condition, reference));
            is_compared.then(|| TableDifference {
                table: &table.tables[0].name,
                reference_table: &first.tables[0].name,
                condition,
                reference_condition: reference,
                fields,
                rows,
            })
        })
        .collect()
}

/// Returns the names of the tables of which no runs can be compared with the first table.
pub(super) fn without_counterpart<'r>(tables: &'r [Results], metrics: &[&str]) -> Vec<&'r str> {
    let Some((first, others)) = tables.split_first() else {
        return Vec::new();
    };
    let is_compared = |table: &&Results| {
        table.conditions.iter().any(|condition| {
            // Policies of tables with the same settings are compared with each other.
            let has_same_settings =
                |other: &RunCondition| (other.label(), other.ttis) == (condition.label(), condition.ttis);
            let reference = counterpart(condition, &table.conditions, &first.conditions);
            let has_rows = |reference: &RunCondition| {
                metrics
                    .iter()
                    .any(|metric| !compare_policies(condition, reference, metric).is_empty())
            };
            first.conditions.iter().any(has_same_settings) || reference.is_some_and(has_rows)
        })
    };
    let others = others.iter().filter(|table| !is_compared(table));
    others.map(|table| table.tables[0].name.as_str()).collect()
}

/// Returns the condition of the first table, one of `references`, that `condition` is compared with: the one with the
/// same preset, length and swept fields; else the one with the same swept fields, if it is the only one in both tables;
/// else the first table's only condition. `table_conditions` has all conditions of the table of `condition`.
fn counterpart<'r>(
    condition: &RunCondition,
    table_conditions: &[RunCondition],
    references: &'r [RunCondition],
) -> Option<&'r RunCondition> {
    let has_same_key = |other: &RunCondition| {
        (&other.preset, other.ttis, &other.swept_fields) == (&condition.preset, condition.ttis, &condition.swept_fields)
    };
    if let Some(same) = references.iter().find(|other| has_same_key(other)) {
        return Some(same);
    }
    let has_same_fields = |other: &&RunCondition| other.swept_fields == condition.swept_fields;
    let mut candidates = references.iter().filter(has_same_fields);
    match (
        candidates.next(),
        candidates.next(),
        table_conditions.iter().filter(has_same_fields).count(),
        references,
    ) {
        (Some(reference), None, 1, _) | (_, _, _, [reference]) => Some(reference),
        _ => None,
    }
}

/// Compares the policies that both conditions have, by N.
fn compare_policies<'r>(
    condition: &'r RunCondition,
    reference: &'r RunCondition,
    metric: &'r str,
) -> Vec<DifferenceRow<'r>> {
    let mut rows = Vec::new();
    for policy in condition.policies() {
        for n in condition.device_counts(policy) {
            let comparison = PairedDifference::new((condition, policy), (reference, policy), n, metric);
            rows.extend(comparison.map(|comparison| DifferenceRow {
                metric,
                policy,
                n,
                comparison,
            }));
        }
    }
    rows
}

fn has_other_actions(condition: &RunCondition, reference: &RunCondition) -> bool {
    condition.action_text() != reference.action_text()
}

/// Returns the fields that differ in the runs of a policy with `n` devices, with the values of `reference` and
/// `condition`; `None` if they cannot be determined.
fn differing_fields(
    condition: &RunCondition,
    reference: &RunCondition,
    (policy, n): (&str, u32),
) -> Option<BTreeMap<String, [String; 2]>> {
    let reference_hashes: BTreeMap<u64, _> = reference
        .runs(policy, n)
        .map(|row| (row.seed, &row.scenario_hash))
        .collect();
    let mut hash_pairs = condition
        .runs(policy, n)
        .filter_map(|row| Some((&row.scenario_hash, *reference_hashes.get(&row.seed)?)));
    if hash_pairs.all(|(hash, reference_hash)| hash == reference_hash) {
        return Some(BTreeMap::new());
    }
    let scenario_toml = |condition: &RunCondition| condition.scenario_toml(policy, n, &Disk);
    let differences = compare_scenarios(&scenario_toml(reference)?, &scenario_toml(condition)?).ok()?;
    // The first runs of both conditions can have different seeds, which are not a setting.
    let settings = differences.into_iter().filter(|(field, ..)| field != "seed");
    Some(settings.map(|(field, first, other)| (field, [first, other])).collect())
}

/// Formats a difference: the tables, their differing settings and the metrics.
pub(super) fn format_difference(difference: &TableDifference<'_>) -> String {
    let TableDifference {
        table,
        reference_table,
        condition,
        ..
    } = difference;
    let heading = format!("differences of {table} from {reference_table} over the same seeds, with 95 % intervals");
    let mut settings = Vec::new();
    if has_other_actions(condition, difference.reference_condition) {
        settings.push("actions".to_owned());
    }
    match &difference.fields {
        Some(fields) => settings.extend(
            fields
                .iter()
                .map(|(field, [first, other])| format!("{field} = {first} | {other}")),
        ),
        None => settings.push("fields that the tables do not identify".to_owned()),
    }
    let label = format!("preset {} · TTIs {}", condition.label(), condition.ttis);
    let lines = [
        heading,
        format!("they differ in: {}", settings.join(", ")),
        String::new(),
        label,
    ];
    let introduction: String = lines.iter().map(|line| wrap_text(line, WIDTH) + "\n").collect();
    introduction + &format_blocks("reference", &difference.rows)
}

pub(super) fn json_report(differences: &[TableDifference<'_>]) -> Value {
    let report = |difference: &TableDifference<'_>| {
        json!({
            "table": difference.table, "against_table": difference.reference_table,
            "condition": difference.condition.label(), "against_condition": difference.reference_condition.label(),
            "ttis": difference.condition.ttis, "fields": difference.fields,
            "actions_differ": has_other_actions(difference.condition, difference.reference_condition),
            "differences": difference.rows.iter().map(DifferenceRow::to_json).collect::<Vec<_>>(),
        })
    };
    differences.iter().map(report).collect()
}
