//! What runs are called where they are shown beside others: in figures, reports and tables for people.
//!
//! Policies that wake devices can rank them in several ways, and some always rank in one. So that like stands with
//! like, a series is a policy with its ranking wherever runs of several rankings are shown together.

use reveille_bs::policy::registry;
use reveille_common::scenario::WakeUpRanking;

use crate::stats::Cell;
use crate::table::{Row, Schema, Table};

/// The field that says how wake-up candidates are ranked.
pub const RANKING: &str = "bs.ranking";
/// What stands between a policy and its ranking.
const WITH: char = '+';

/// The name of the runs of `policy` with `ranking`, beside runs of other rankings: `knn+posterior`. That by P_4,2, as
/// the paper ranks, is the policy's name, as is that of policies that do not heed the field.
pub fn name(policy: &str, ranking: &str) -> String {
    let ranks = registry::named(policy).is_none_or(|known| known.profile().heeds_ranking);
    if ranks && !is_the_papers(ranking) {
        format!("{policy}{WITH}{ranking}")
    } else {
        policy.to_owned()
    }
}

/// Whether `ranking` is by P_4,2.
pub fn is_the_papers(ranking: &str) -> bool {
    ranking == WakeUpRanking::P42.name()
}

/// The policy of a series, and whether it has a ranking of its own in its name.
pub fn policy(series: &str) -> (&str, bool) {
    match series.split_once(WITH) {
        Some((policy, _)) => (policy, true),
        None => (series, false),
    }
}

/// Whether these are the same runs: the same seeds with the same outcomes, as of a policy that heeds no ranking.
pub fn is_same<'r>(a: impl Iterator<Item = &'r Row>, b: impl Iterator<Item = &'r Row>) -> bool {
    a.map(|row| (row.seed, row.digest))
        .eq(b.map(|row| (row.seed, row.digest)))
}

/// The names of the rows of a table.
#[derive(Clone, Copy, Debug)]
pub struct Names {
    /// The place of [`RANKING`] among the swept columns, if the table holds several rankings.
    at: Option<usize>,
}

impl Names {
    /// Of the rows of `table`.
    pub fn of(table: &Table) -> Self {
        let at = column(&table.schema);
        let mut rankings = at
            .iter()
            .flat_map(|at| table.rows.iter().map(|row| row.swept[*at].to_string()));
        let first = rankings.next();
        let has_several = rankings.any(|other| Some(&other) != first.as_ref());
        Self {
            at: at.filter(|_| has_several),
        }
    }

    /// The name of the series that `row` belongs to.
    pub fn name(self, row: &Row) -> String {
        self.at.map_or_else(
            || row.policy.to_string(),
            |at| name(&row.policy, &row.swept[at].to_string()),
        )
    }

    /// The place among the swept columns of that which the names tell, if they do.
    pub const fn told(self) -> Option<usize> {
        self.at
    }

    /// The cells of `cells` but those that repeat another one's runs under another ranking.
    pub fn distinct<'c, 't>(self, cells: &'c [Cell<'t>]) -> Vec<&'c Cell<'t>> {
        let Some(at) = self.at else {
            return cells.iter().collect();
        };
        let rest = |cell: &Cell<'_>| {
            let others = cell.swept.iter().enumerate().filter(|(place, _)| *place != at);
            let others: Vec<String> = others.map(|(_, value)| value.to_string()).collect();
            (
                cell.preset.to_owned(),
                cell.policy.to_owned(),
                cell.n,
                cell.ttis,
                others,
            )
        };
        let repeats = |place: usize| {
            let own = &cells[place];
            let mut before = cells[..place].iter();
            before
                .any(|other| rest(other) == rest(own) && is_same(other.rows.iter().copied(), own.rows.iter().copied()))
        };
        let places = (0..cells.len()).filter(|place| !repeats(*place));
        places.map(|place| &cells[place]).collect()
    }
}

/// The place of [`RANKING`] among the swept columns.
fn column(schema: &Schema) -> Option<usize> {
    schema.swept.iter().position(|(path, _)| path == RANKING)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::stats::cells;
    use crate::table::{ColumnType, Hash, Value, fixtures};

    fn table(runs: &[(&str, &str, u8)]) -> Table {
        let mut table = fixtures::table();
        let first = table.rows[0].clone();
        table.schema.swept = vec![
            ("harvest.lambda".to_owned(), ColumnType::Float),
            (RANKING.to_owned(), ColumnType::Text),
        ];
        let row = |(policy, ranking, digest): &(&str, &str, u8)| {
            let mut row = first.clone();
            row.policy = Arc::from(*policy);
            row.swept = Arc::from([Value::Float(0.1), Value::Text((*ranking).to_owned())]);
            row.digest = Hash([*digest; 32]);
            row
        };
        table.rows = runs.iter().map(row).collect();
        table
    }

    #[test]
    fn a_ranking_is_told_of_policies_that_rank_where_there_are_several() {
        let several = table(&[
            ("knn", "p42", 1),
            ("knn", "posterior", 2),
            ("random", "posterior", 3),
            ("genie", "posterior", 4),
            ("dt", "posterior", 5),
            ("age-index", "posterior", 6),
        ]);
        let names = Names::of(&several);
        let told: Vec<String> = several.rows.iter().map(|row| names.name(row)).collect();
        assert_eq!(told, ["knn", "knn+posterior", "random", "genie", "dt", "age-index"]);
        assert_eq!(names.told(), Some(1));
        assert_eq!(policy("knn+posterior"), ("knn", true));
        assert_eq!(policy("q-learning"), ("q-learning", false));
        let one = table(&[("knn", "posterior", 2), ("random", "posterior", 3)]);
        assert_eq!(
            (Names::of(&one).name(&one.rows[0]).as_str(), Names::of(&one).told()),
            ("knn", None)
        );
        let none = fixtures::table();
        assert_eq!(Names::of(&none).name(&none.rows[0]), "knn");
    }

    #[test]
    fn runs_that_heed_no_ranking_count_once() {
        let several = table(&[
            ("knn", "p42", 1),
            ("random", "p42", 3),
            ("knn", "posterior", 2),
            ("random", "posterior", 3),
            ("dt", "posterior", 3),
        ]);
        let all = cells(&several);
        let names = Names::of(&several);
        let kept: Vec<String> = names
            .distinct(&all)
            .iter()
            .map(|cell| names.name(cell.rows[0]))
            .collect();
        assert_eq!(kept, ["knn", "random", "knn+posterior", "dt"]);
    }
}
