//! Search over the parameters that the paper leaves unstated, for the conditions that meet most of its claims.
//!
//! Conditions are the columns of a [`ClaimReport`], judged by the report's rule. Claims are numbered from 1 in the
//! report's order, run or not. Claims with even numbers are the search half: conditions rank by the number of them that
//! are reproduced, then by the number within 20 %. Claims with odd numbers are held out: they do not affect the
//! ranking, so a condition chosen by luck does no better there than others. A claim added in the middle moves all later
//! claims to the other half. The verdicts *reproduced* and *within 20 %* never depend on another claim. A reproduced
//! order does not count, since orders are derived from several claims.
//!
//! Limits: both halves come from the same runs, and claims of one sentence about several policies fall into both.
//! `RANKING_RULE` in [`markdown`] and docs/figures-and-report.md state the same rule: change all three. The command
//! `reveille report search` prints and writes the ranking.

pub mod markdown;

use super::judge::Verdict;
use super::{ClaimReport, ClaimRow, REPORT_PRESETS};

/// One half of the claims.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClaimHalf {
    /// Claims with even numbers, by which conditions rank.
    Search,
    /// Claims with odd numbers, which do not affect the rank.
    HeldOut,
}

impl ClaimHalf {
    /// Returns the half of the claim with this number, from 1.
    pub const fn of_number(number: usize) -> Self {
        if number.is_multiple_of(2) {
            Self::Search
        } else {
            Self::HeldOut
        }
    }

    /// Name of the half.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Search => "search",
            Self::HeldOut => "held out",
        }
    }
}

/// Numbers of claims in a half by the verdict of a condition.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HalfScore {
    /// Claims reproduced.
    pub met: usize,
    /// Claims within 20 %.
    pub near: usize,
    /// Claims of the half that were run, including those met or near.
    pub judged: usize,
}

impl HalfScore {
    /// Counts the score of column `column` over `half` of `rows`, which are all rows of a report.
    ///
    /// # Panics
    /// If the rows have no such column.
    pub fn of_column(rows: &[ClaimRow], column: usize, half: ClaimHalf) -> Self {
        let verdicts = || {
            let numbered = (1..)
                .zip(rows)
                .filter(move |(number, _)| ClaimHalf::of_number(*number) == half);
            numbered.map(move |(_, row)| row.assessments[column].verdict)
        };
        let count = |wanted: Verdict| verdicts().filter(|verdict| *verdict == wanted).count();
        Self {
            met: count(Verdict::Reproduced),
            near: count(Verdict::Near),
            judged: verdicts().filter(|verdict| *verdict != Verdict::NotRun).count(),
        }
    }

    /// Sort key for the ranking.
    const fn ranking_key(self) -> (usize, usize) {
        (self.met, self.near)
    }
}

/// A condition with its scores.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RankedCondition {
    /// Index in the report's columns.
    pub column: usize,
    /// Score in the search half.
    pub search: HalfScore,
    /// Rank by that score, from 1; equal scores share a rank.
    pub rank: usize,
    /// Score in the held-out half.
    pub held_out: HalfScore,
    /// Rank by that score.
    pub held_out_rank: usize,
}

/// A claim that no condition meets, with the closest condition.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct UnmetClaim<'s> {
    /// Number of the claim.
    pub number: usize,
    /// The claim.
    pub row: &'s ClaimRow,
    /// Column of the closest condition, by [`super::Assessment::deviation`].
    pub closest_column: usize,
}

/// Effect of one value of a field on the scores, over all values of the other fields.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct FieldEffect {
    /// The field.
    pub field: String,
    /// Value of the field.
    pub value: String,
    /// Number of conditions with this value.
    pub condition_count: usize,
    /// Mean number of claims that they meet in the search half.
    pub mean_met_search: f64,
    /// Largest number of claims that one of them meets in the search half.
    pub most_met_search: usize,
    /// Mean number of claims that they meet in the held-out half.
    pub mean_met_held_out: f64,
}

/// Numbers of claims over all conditions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClaimCounts {
    /// Claims that some condition meets.
    pub met: usize,
    /// Claims that were run and that no condition meets.
    pub unmet: usize,
    /// Claims without runs.
    pub not_run: usize,
}

/// The conditions of a report, ranked by the search half.
#[derive(Clone, Debug)]
pub struct ConditionRanking<'r> {
    /// All conditions, and the claims.
    pub report: ClaimReport<'r>,
    /// Conditions, best first. Equal scores are in the order of the report's columns, which starts with the presets.
    pub conditions: Vec<RankedCondition>,
}

impl<'r> ConditionRanking<'r> {
    /// Ranks the conditions of `report`.
    pub fn new(report: ClaimReport<'r>) -> Self {
        let scores = |half: ClaimHalf| -> Vec<HalfScore> {
            let columns = 0..report.columns.len();
            columns
                .map(|column| HalfScore::of_column(&report.rows, column, half))
                .collect()
        };
        let (search, held_out) = (scores(ClaimHalf::Search), scores(ClaimHalf::HeldOut));
        let mut conditions: Vec<RankedCondition> = (0..report.columns.len())
            .map(|column| RankedCondition {
                column,
                search: search[column],
                rank: rank_of(&search, column),
                held_out: held_out[column],
                held_out_rank: rank_of(&held_out, column),
            })
            .collect();
        conditions.sort_by_key(|ranked| (ranked.rank, ranked.column));
        Self { report, conditions }
    }

    /// Iterates over the conditions to show: the first `count` of the ranking, and the presets at any rank.
    pub fn conditions_to_show(&self, count: usize) -> impl Iterator<Item = &RankedCondition> {
        let is_preset = |ranked: &RankedCondition| REPORT_PRESETS.contains(&self.label(ranked.column));
        let all = self.conditions.iter().enumerate();
        let shown = all.filter(move |(index, ranked)| *index < count || is_preset(ranked));
        shown.map(|(_, ranked)| ranked)
    }

    /// Name of a column.
    ///
    /// # Panics
    /// If the report has no such column.
    pub fn label(&self, column: usize) -> &str {
        &self.report.columns[column].label
    }

    /// Lists the claims that were run under some condition but are met by none.
    pub(crate) fn unmet(&self) -> Vec<UnmetClaim<'_>> {
        let numbered = (1..).zip(&self.report.rows);
        let is_met = |row: &ClaimRow| {
            row.assessments
                .iter()
                .any(|assessment| assessment.verdict == Verdict::Reproduced)
        };
        let unmet_rows = numbered.filter(|(_, row)| row.has_runs() && !is_met(row));
        let find_closest = |row: &ClaimRow| {
            let judged = row.assessments.iter().enumerate();
            let judged = judged.filter(|(_, assessment)| assessment.verdict != Verdict::NotRun);
            judged
                .min_by(|a, b| a.1.deviation.total_cmp(&b.1.deviation))
                .map(|(column, _)| column)
        };
        let unmet_claims = unmet_rows.filter_map(|(number, row)| {
            let closest_column = find_closest(row)?;
            Some(UnmetClaim {
                number,
                row,
                closest_column,
            })
        });
        unmet_claims.collect()
    }

    /// Counts the claims.
    pub fn counts(&self) -> ClaimCounts {
        let unmet = self.unmet().len();
        let not_run = self.report.rows.iter().filter(|row| !row.has_runs()).count();
        ClaimCounts {
            met: self.report.rows.len() - unmet - not_run,
            unmet,
            not_run,
        }
    }

    /// Computes Pearson's correlation, over all conditions, between the numbers of claims met in the two halves, `[-1,
    /// 1]`. `None` if these numbers are all equal in one half.
    pub fn correlation(&self) -> Option<f64> {
        let pairs = || {
            self.conditions
                .iter()
                .map(|ranked| (ranked.search.met as f64, ranked.held_out.met as f64))
        };
        let count = self.conditions.len() as f64;
        let (mean_search, mean_held_out) = pairs().fold((0.0, 0.0), |(mean_search, mean_held_out), (x, y)| {
            (mean_search + x / count, mean_held_out + y / count)
        });
        let co_moment = |product: &dyn Fn(f64, f64) -> f64| {
            pairs()
                .map(|(x, y)| product(x - mean_search, y - mean_held_out))
                .sum::<f64>()
        };
        let variance_product = co_moment(&|x, _| x * x) * co_moment(&|_, y| y * y);
        (variance_product > 0.0).then(|| co_moment(&|x, y| x * y) / variance_product.sqrt())
    }

    /// Names of the fields in which conditions differ.
    pub fn fields(&self) -> Vec<&str> {
        let mut fields: Vec<&str> = Vec::new();
        for (path, _) in self
            .report
            .columns
            .iter()
            .flat_map(|column| column.condition.all_changes())
        {
            let is_known = fields.contains(&path.as_str());
            if !is_known && self.values(path).len() > 1 {
                fields.push(path);
            }
        }
        fields
    }

    /// Value of `field` in a column; `None` for the value of the condition's own preset.
    ///
    /// # Panics
    /// If the report has no such column.
    pub fn value(&self, column: usize, field: &str) -> Option<&str> {
        let mut changed = self.report.columns[column].condition.all_changes();
        let change = changed.find(|(path, _)| path == field);
        change.map(|(_, value)| value.as_str())
    }

    /// Values of `field` over all conditions, in the order of the columns; `None` is the value of a condition's own
    /// preset.
    fn values(&self, field: &str) -> Vec<Option<&str>> {
        let mut values = Vec::new();
        for column in 0..self.report.columns.len() {
            let value = self.value(column, field);
            if !values.contains(&value) {
                values.push(value);
            }
        }
        values
    }

    /// Computes the effect of each value, other than the presets' own, of each field in which conditions differ.
    pub(crate) fn effects(&self) -> Vec<FieldEffect> {
        let effect = |field: &str, value: &str| {
            let has_value = |ranked: &&RankedCondition| self.value(ranked.column, field) == Some(value);
            let with_value: Vec<&RankedCondition> = self.conditions.iter().filter(has_value).collect();
            let mean = |count: fn(&RankedCondition) -> usize| {
                let sum: usize = with_value.iter().map(|ranked| count(ranked)).sum();
                sum as f64 / with_value.len() as f64
            };
            FieldEffect {
                field: field.to_owned(),
                value: value.to_owned(),
                condition_count: with_value.len(),
                mean_met_search: mean(|ranked| ranked.search.met),
                most_met_search: with_value.iter().map(|ranked| ranked.search.met).max().unwrap_or(0),
                mean_met_held_out: mean(|ranked| ranked.held_out.met),
            }
        };
        let fields = self.fields().into_iter();
        let pairs = fields.flat_map(|field| {
            self.values(field)
                .into_iter()
                .flatten()
                .map(move |value| (field, value))
        });
        pairs.map(|(field, value)| effect(field, value)).collect()
    }
}

/// Rank of the score of `column` among `scores`, from 1.
fn rank_of(scores: &[HalfScore], column: usize) -> usize {
    1 + scores
        .iter()
        .filter(|score| score.ranking_key() > scores[column].ranking_key())
        .count()
}

#[cfg(test)]
mod tests;
