//! The names of runs in figures, reports and tables for people: a series is a policy, with its ranking where needed.
//! The figures of `study` and the report of `reveille sweep` use them. Result tables keep policy and ranking apart.
//! [`split_policy`] splits the names that [`join_name`] joins, and the CSV files of figures contain them.
//!
//! Some policies can rank wake-up candidates in several ways; others always use one ranking. To compare like with like,
//! a series is a policy with its ranking wherever several rankings are shown together.

use reveille_bs::policy::registry;
use reveille_common::scenario::WakeUpRanking;

use crate::stats::CellRuns;
use crate::table::{ResultRow, Schema, Table};

/// The path of the field with the ranking of wake-up candidates, `WakeUpRanking`.
pub const RANKING: &str = "bs.ranking";
/// The separator between a policy and its ranking; the names of policies do not contain it.
const SEPARATOR: char = '+';

/// Returns the name of the runs of `policy` with `ranking`, next to runs of other rankings: `knn+posterior`. It is the
/// policy's name for the ranking by P_4,2 of the paper, and for policies that ignore the field.
pub fn join_name(policy: &str, ranking: &str) -> String {
    // A policy unknown to this program may use the field, so its ranking is named.
    let heeds_ranking = registry::named(policy).is_none_or(|entry| entry.heeds_ranking);
    if heeds_ranking && !is_paper_ranking(ranking) {
        format!("{policy}{SEPARATOR}{ranking}")
    } else {
        policy.to_owned()
    }
}

/// Returns whether `ranking` is the paper's, by P_4,2.
pub fn is_paper_ranking(ranking: &str) -> bool {
    ranking == WakeUpRanking::P42.name()
}

/// Splits off the policy of a series, and returns whether a ranking follows.
pub fn split_policy(series: &str) -> (&str, bool) {
    match series.split_once(SEPARATOR) {
        Some((policy, _)) => (policy, true),
        None => (series, false),
    }
}

/// Returns whether the runs `a` and `b` have the same seeds with the same outcomes, in the same order, as for a policy
/// that ignores rankings.
pub fn has_equal_outcomes<'r>(a: impl Iterator<Item = &'r ResultRow>, b: impl Iterator<Item = &'r ResultRow>) -> bool {
    a.map(|row| (row.seed, row.digest))
        .eq(b.map(|row| (row.seed, row.digest)))
}

/// The names of the rows of a table.
#[derive(Clone, Copy, Debug)]
pub struct SeriesNames {
    /// The index of [`RANKING`] among the swept columns, if the table holds several rankings.
    ranking_column: Option<usize>,
}

impl SeriesNames {
    /// Creates the names for the rows of `table`.
    pub fn from_table(table: &Table) -> Self {
        let ranking_column = ranking_column_of(&table.schema);
        let mut rankings = ranking_column
            .iter()
            .flat_map(|column| table.rows.iter().map(|row| row.swept[*column].to_string()));
        let first_ranking = rankings.next();
        // A ranking shared by all rows distinguishes none of them and would only lengthen the names.
        let has_several_rankings = rankings.any(|ranking| Some(&ranking) != first_ranking.as_ref());
        Self {
            ranking_column: ranking_column.filter(|_| has_several_rankings),
        }
    }

    /// Returns the name of the series of `row`.
    pub fn name(self, row: &ResultRow) -> String {
        self.ranking_column.map_or_else(
            || row.policy.to_string(),
            |column| join_name(&row.policy, &row.swept[column].to_string()),
        )
    }

    /// The index of the ranking among the swept columns; `None` unless the table holds several rankings.
    pub const fn ranking_column(self) -> Option<usize> {
        self.ranking_column
    }

    /// Returns the cells, without those that differ from an earlier cell only in the ranking and have the same
    /// outcomes.
    pub fn distinct_cells<'c, 't>(self, cells: &'c [CellRuns<'t>]) -> Vec<&'c CellRuns<'t>> {
        let Some(ranking_column) = self.ranking_column else {
            return cells.iter().collect();
        };
        // Everything but the ranking that distinguishes cells, as in `CellRuns::matches`.
        let other_fields = |cell: &CellRuns<'_>| {
            let other_columns = cell
                .swept
                .iter()
                .enumerate()
                .filter(|(column, _)| *column != ranking_column);
            let other_values: Vec<String> = other_columns.map(|(_, value)| value.to_string()).collect();
            (
                cell.preset.to_owned(),
                cell.policy.to_owned(),
                cell.n,
                cell.ttis,
                other_values,
            )
        };
        let is_repeat = |index: usize| {
            let cell = &cells[index];
            let mut earlier_cells = cells[..index].iter();
            earlier_cells.any(|earlier| {
                other_fields(earlier) == other_fields(cell)
                    && has_equal_outcomes(earlier.rows.iter().copied(), cell.rows.iter().copied())
            })
        };
        let indices = (0..cells.len()).filter(|index| !is_repeat(*index));
        indices.map(|index| &cells[index]).collect()
    }
}

/// Returns the index of [`RANKING`] among the swept columns.
fn ranking_column_of(schema: &Schema) -> Option<usize> {
    schema.swept.iter().position(|(path, _)| path == RANKING)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::stats::group_by_cell;
    use crate::table::{ColumnType, Hash, SweptValue, fixtures};

    /// Returns a table of runs with these policies, rankings and digests.
    fn table_of(runs: &[(&str, &str, u8)]) -> Table {
        let mut table = fixtures::table();
        let template = table.rows[0].clone();
        table.schema.swept = vec![
            ("harvest.lambda".to_owned(), ColumnType::Float),
            (RANKING.to_owned(), ColumnType::Text),
        ];
        let row = |(policy, ranking, digest): &(&str, &str, u8)| {
            let mut row = template.clone();
            row.policy = Arc::from(*policy);
            row.swept = Arc::from([SweptValue::Float(0.1), SweptValue::Text((*ranking).to_owned())]);
            row.digest = Hash([*digest; 32]);
            row
        };
        table.rows = runs.iter().map(row).collect();
        table
    }

    #[test]
    fn names_contain_the_ranking_if_a_table_has_several() {
        let two_rankings = table_of(&[
            ("knn", "p42", 1),
            ("knn", "posterior", 2),
            ("random", "posterior", 3),
            ("genie", "posterior", 4),
            ("dt", "posterior", 5),
            ("age-index", "posterior", 6),
        ]);
        let names = SeriesNames::from_table(&two_rankings);
        let labels: Vec<String> = two_rankings.rows.iter().map(|row| names.name(row)).collect();
        assert_eq!(labels, ["knn", "knn+posterior", "random", "genie", "dt", "age-index"]);
        assert_eq!(names.ranking_column(), Some(1));
        assert_eq!(split_policy("knn+posterior"), ("knn", true));
        assert_eq!(split_policy("q-learning"), ("q-learning", false));
        let one_ranking = table_of(&[("knn", "posterior", 2), ("random", "posterior", 3)]);
        assert_eq!(
            (
                SeriesNames::from_table(&one_ranking)
                    .name(&one_ranking.rows[0])
                    .as_str(),
                SeriesNames::from_table(&one_ranking).ranking_column()
            ),
            ("knn", None)
        );
        let no_ranking = fixtures::table();
        assert_eq!(SeriesNames::from_table(&no_ranking).name(&no_ranking.rows[0]), "knn");
    }

    #[test]
    fn cells_of_policies_without_a_ranking_count_once() {
        let table = table_of(&[
            ("knn", "p42", 1),
            ("random", "p42", 3),
            ("knn", "posterior", 2),
            ("random", "posterior", 3),
            ("dt", "posterior", 3),
        ]);
        let cells = group_by_cell(&table);
        let names = SeriesNames::from_table(&table);
        let labels: Vec<String> = names
            .distinct_cells(&cells)
            .iter()
            .map(|cell| names.name(cell.rows[0]))
            .collect();
        assert_eq!(labels, ["knn", "random", "knn+posterior", "dt"]);
    }
}
