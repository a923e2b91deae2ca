//! Search over the parameters that the paper leaves unstated, for the settings that meet most of its claims.
//!
//! Settings are the columns of a [`ClaimReport`], judged by the report's rule. Claims are numbered from 1 in the
//! report's order, run or not. Even claims choose: settings rank by the number reproduced, then by the number within 20
//! %. Odd claims check: they do not affect the ranking, so a setting chosen by luck does no better there than others.
//! The verdicts *reproduced* and *within 20 %* never depend on another claim, so the halves are independent. A
//! reproduced order does not count, since orders are derived from several claims.
//!
//! Limits: both halves come from the same runs, and claims of one sentence about several policies fall into both.

pub mod markdown;

use super::judge::Verdict;
use super::{ClaimReport, ClaimRow, PRESETS};

/// One half of the claims.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClaimSplit {
    /// Claims with even numbers, which rank the settings.
    Search,
    /// Claims with odd numbers, which check the ranking.
    HeldOut,
}

impl ClaimSplit {
    /// Returns the half of the claim with this number, from 1.
    pub const fn of(number: usize) -> Self {
        if number.is_multiple_of(2) {
            Self::Search
        } else {
            Self::HeldOut
        }
    }

    /// Name of the half.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Search => "search",
            Self::HeldOut => "held out",
        }
    }
}

/// Number of claims in a half that a setting meets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SplitScore {
    /// Claims reproduced.
    pub met: usize,
    /// Claims within 20 %.
    pub near: usize,
    /// Claims of the half that were run, including those met or near.
    pub judged: usize,
}

impl SplitScore {
    /// Counts the score of column `column` over `half` of `lines`.
    pub fn of(lines: &[ClaimRow], column: usize, half: ClaimSplit) -> Self {
        let own = || {
            let numbered = (1..)
                .zip(lines)
                .filter(move |(number, _)| ClaimSplit::of(*number) == half);
            numbered.map(move |(_, line)| line.ours[column].verdict)
        };
        let count = |wanted: Verdict| own().filter(|verdict| *verdict == wanted).count();
        Self {
            met: count(Verdict::Reproduced),
            near: count(Verdict::Near),
            judged: own().filter(|verdict| *verdict != Verdict::NotRun).count(),
        }
    }

    /// Sort key for the ranking.
    const fn key(self) -> (usize, usize) {
        (self.met, self.near)
    }
}

/// A setting with its scores.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RankedSetting {
    /// Column in the report.
    pub column: usize,
    /// Score by the claims that rank.
    pub search: SplitScore,
    /// Place by that score, from 1; equal scores share a place.
    pub place: usize,
    /// Score by the claims that check.
    pub held_out: SplitScore,
    /// Place by the checking score.
    pub held_out_place: usize,
}

/// A claim that no setting meets, with the closest setting.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct UnmetClaim<'s> {
    /// Number of the claim.
    pub number: usize,
    /// The claim.
    pub line: &'s ClaimRow,
    /// Column of the closest setting, by [`super::Assessment::off`].
    pub closest: usize,
}

/// Effect of one value of a field on the scores, over all values of the other fields.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct FieldEffect {
    /// The field.
    pub field: String,
    /// Value of the field.
    pub value: String,
    /// Number of settings with this value.
    pub settings: usize,
    /// Mean number of claims that they meet in the search half.
    pub search: f64,
    /// Largest number of claims that one of them meets in the search half.
    pub best: usize,
    /// Mean number of claims that they meet in the held-out half.
    pub held_out: f64,
}

/// Result of the search.
#[derive(Clone, Debug)]
pub struct SettingSearch<'r> {
    /// All settings, and the claims.
    pub report: ClaimReport<'r>,
    /// Settings, best first. Equal scores are in the order of the tables, presets first.
    pub settings: Vec<RankedSetting>,
}

impl<'r> SettingSearch<'r> {
    /// Ranks the settings of `report`.
    pub fn new(report: ClaimReport<'r>) -> Self {
        let scores = |half: ClaimSplit| -> Vec<SplitScore> {
            let columns = 0..report.columns.len();
            columns
                .map(|column| SplitScore::of(&report.lines, column, half))
                .collect()
        };
        let (search, held_out) = (scores(ClaimSplit::Search), scores(ClaimSplit::HeldOut));
        let mut settings: Vec<RankedSetting> = (0..report.columns.len())
            .map(|column| RankedSetting {
                column,
                search: search[column],
                place: place(&search, column),
                held_out: held_out[column],
                held_out_place: place(&held_out, column),
            })
            .collect();
        settings.sort_by_key(|setting| (setting.place, setting.column));
        Self { report, settings }
    }

    /// Iterates over the settings to show: the first `count` of the ranking, and the presets at any rank.
    pub fn shown(&self, count: usize) -> impl Iterator<Item = &RankedSetting> {
        let is_preset = |setting: &RankedSetting| PRESETS.contains(&self.label(setting.column));
        let all = self.settings.iter().enumerate();
        let shown = all.filter(move |(at, setting)| *at < count || is_preset(setting));
        shown.map(|(_, setting)| setting)
    }

    /// Name of a column.
    pub fn label(&self, column: usize) -> &str {
        &self.report.columns[column].label
    }

    /// Lists the claims that were run under some setting but are met by none.
    pub(crate) fn unmet(&self) -> Vec<UnmetClaim<'_>> {
        let lines = (1..).zip(&self.report.lines);
        let is_met = |line: &ClaimRow| line.ours.iter().any(|ours| ours.verdict == Verdict::Reproduced);
        let unmet = lines.filter(|(_, line)| line.is_run() && !is_met(line));
        let closest = |line: &ClaimRow| {
            let run = line.ours.iter().enumerate();
            let run = run.filter(|(_, ours)| ours.verdict != Verdict::NotRun);
            run.min_by(|a, b| a.1.off.total_cmp(&b.1.off)).map(|(column, _)| column)
        };
        let unmet = unmet.filter_map(|(number, line)| {
            let closest = closest(line)?;
            Some(UnmetClaim { number, line, closest })
        });
        unmet.collect()
    }

    /// Counts the claims met by some setting, those met by none, and those not run.
    pub fn counts(&self) -> [usize; 3] {
        let unmet = self.unmet().len();
        let absent = self.report.lines.iter().filter(|line| !line.is_run()).count();
        [self.report.lines.len() - unmet - absent, unmet, absent]
    }

    /// Computes Pearson's correlation, over all settings, between the numbers of claims met in the two halves, `[-1,
    /// 1]`. `None` if these numbers are all equal in one half.
    pub fn correlation(&self) -> Option<f64> {
        let pairs = || {
            self.settings
                .iter()
                .map(|s| (s.search.met as f64, s.held_out.met as f64))
        };
        let count = self.settings.len() as f64;
        let (a, b) = pairs().fold((0.0, 0.0), |(a, b), (x, y)| (a + x / count, b + y / count));
        let of = |product: &dyn Fn(f64, f64) -> f64| pairs().map(|(x, y)| product(x - a, y - b)).sum::<f64>();
        let spread = of(&|x, _| x * x) * of(&|_, y| y * y);
        (spread > 0.0).then(|| of(&|x, y| x * y) / spread.sqrt())
    }

    /// Names of the fields in which settings differ.
    pub fn fields(&self) -> Vec<&str> {
        let mut fields: Vec<&str> = Vec::new();
        for (path, _) in self.report.columns.iter().flat_map(|column| column.condition.changed()) {
            let is_known = fields.contains(&path.as_str());
            if !is_known && self.values(path).len() > 1 {
                fields.push(path);
            }
        }
        fields
    }

    /// Value of `field` in a column; `None` if it equals the preset's.
    pub fn value(&self, column: usize, field: &str) -> Option<&str> {
        let mut changed = self.report.columns[column].condition.changed();
        let own = changed.find(|(path, _)| path == field);
        own.map(|(_, value)| value.as_str())
    }

    /// Values of `field` over all settings, in the order of the tables; `None` is the presets' value.
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

    /// Computes the effect of each value of each swept field.
    pub(crate) fn effects(&self) -> Vec<FieldEffect> {
        let of = |field: &str, value: &str| {
            let has = |setting: &&RankedSetting| self.value(setting.column, field) == Some(value);
            let own: Vec<&RankedSetting> = self.settings.iter().filter(has).collect();
            let mean = |met: fn(&RankedSetting) -> usize| {
                let sum: usize = own.iter().map(|setting| met(setting)).sum();
                sum as f64 / own.len() as f64
            };
            FieldEffect {
                field: field.to_owned(),
                value: value.to_owned(),
                settings: own.len(),
                search: mean(|setting| setting.search.met),
                best: own.iter().map(|setting| setting.search.met).max().unwrap_or(0),
                held_out: mean(|setting| setting.held_out.met),
            }
        };
        let fields = self.fields().into_iter();
        let pairs = fields.flat_map(|field| {
            self.values(field)
                .into_iter()
                .flatten()
                .map(move |value| (field, value))
        });
        pairs.map(|(field, value)| of(field, value)).collect()
    }
}

/// Place of the score of `column` among `scores`, from 1.
fn place(scores: &[SplitScore], column: usize) -> usize {
    1 + scores.iter().filter(|score| score.key() > scores[column].key()).count()
}

#[cfg(test)]
mod tests;
