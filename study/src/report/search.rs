//! The search over what the paper leaves unstated: which settings meet most of its claims.
//!
//! Settings are the columns of a [`Report`], and the judge is the report's. Claims are numbered from 1 in the report's
//! order, whatever was run. The even ones choose: settings are ranked by how many of those they meet, then by how many
//! they come within 20 % of. The odd ones check: they have no part in the ranking, and a setting that was chosen by
//! luck does not do better there than others. Neither verdict, *reproduced* or *within 20 %*, looks at another claim,
//! so that nothing of one half tells on the other; an order that is reproduced counts for nothing, since orders are
//! taken from several claims.
//!
//! What it cannot rule out: both halves come from the same runs, and claims of one sentence about several policies fall
//! into both.

pub mod markdown;

use super::judge::Verdict;
use super::{Line, PRESETS, Report};

/// One half of the claims.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Half {
    /// Those with even numbers, by which settings are ranked.
    Search,
    /// Those with odd numbers, which check.
    HeldOut,
}

impl Half {
    /// The half of the claim with this number, from 1.
    pub const fn of(number: usize) -> Self {
        if number.is_multiple_of(2) {
            Self::Search
        } else {
            Self::HeldOut
        }
    }

    /// What it is called.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Search => "search",
            Self::HeldOut => "held out",
        }
    }
}

/// How many claims of a half a setting meets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Score {
    /// Claims reproduced.
    pub met: usize,
    /// Claims within 20 %.
    pub near: usize,
    /// Claims of the half that were run, these among them.
    pub judged: usize,
}

impl Score {
    /// That of column `column` over `half` of `lines`.
    pub fn of(lines: &[Line], column: usize, half: Half) -> Self {
        let own = || {
            let numbered = (1..).zip(lines).filter(move |(number, _)| Half::of(*number) == half);
            numbered.map(move |(_, line)| line.ours[column].verdict)
        };
        let count = |wanted: Verdict| own().filter(|verdict| *verdict == wanted).count();
        Self {
            met: count(Verdict::Reproduced),
            near: count(Verdict::Near),
            judged: own().filter(|verdict| *verdict != Verdict::NotRun).count(),
        }
    }

    /// What ranks it.
    const fn key(self) -> (usize, usize) {
        (self.met, self.near)
    }
}

/// A setting with its scores.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Setting {
    /// Its column in the report.
    pub column: usize,
    /// Its score by the claims that rank.
    pub search: Score,
    /// Its place by that score, from 1; equal scores share a place.
    pub place: usize,
    /// Its score by the other claims.
    pub held_out: Score,
    /// Its place by that score.
    pub held_out_place: usize,
}

/// A claim that no setting meets, with the figure that comes closest.
#[derive(Clone, Debug, PartialEq)]
pub struct Unmet<'s> {
    /// Its number.
    pub number: usize,
    /// The claim.
    pub line: &'s Line,
    /// The column of the setting that comes closest, by [`super::Ours::off`].
    pub closest: usize,
}

/// What a value of a field does to the scores, all other fields taken together.
#[derive(Clone, Debug, PartialEq)]
pub struct Effect {
    /// The field.
    pub field: String,
    /// Its value.
    pub value: String,
    /// How many settings have it.
    pub settings: usize,
    /// Their mean number of claims met in the search half.
    pub search: f64,
    /// The most that one of them meets there.
    pub best: usize,
    /// Their mean number of claims met in the held-out half.
    pub held_out: f64,
}

/// The search.
#[derive(Clone, Debug)]
pub struct Search<'r> {
    /// All settings, and the claims.
    pub report: Report<'r>,
    /// The settings, the best first; those of equal scores in the order of the tables, presets in front.
    pub settings: Vec<Setting>,
}

impl<'r> Search<'r> {
    /// Ranks the settings of `report`.
    pub fn new(report: Report<'r>) -> Self {
        let scores = |half: Half| -> Vec<Score> {
            let columns = 0..report.columns.len();
            columns.map(|column| Score::of(&report.lines, column, half)).collect()
        };
        let (search, held_out) = (scores(Half::Search), scores(Half::HeldOut));
        let mut settings: Vec<Setting> = (0..report.columns.len())
            .map(|column| Setting {
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

    /// What is shown of the ranking: the first `count` settings, and the presets wherever they are.
    pub fn shown(&self, count: usize) -> impl Iterator<Item = &Setting> {
        let is_preset = |setting: &Setting| PRESETS.contains(&self.label(setting.column));
        let all = self.settings.iter().enumerate();
        let shown = all.filter(move |(at, setting)| *at < count || is_preset(setting));
        shown.map(|(_, setting)| setting)
    }

    /// What a column is called.
    pub fn label(&self, column: usize) -> &str {
        &self.report.columns[column].label
    }

    /// The claims that were run under some setting, and that none meets.
    pub fn unmet(&self) -> Vec<Unmet<'_>> {
        let lines = (1..).zip(&self.report.lines);
        let is_met = |line: &Line| line.ours.iter().any(|ours| ours.verdict == Verdict::Reproduced);
        let unmet = lines.filter(|(_, line)| line.is_run() && !is_met(line));
        let closest = |line: &Line| {
            let run = line.ours.iter().enumerate();
            let run = run.filter(|(_, ours)| ours.verdict != Verdict::NotRun);
            run.min_by(|a, b| a.1.off.total_cmp(&b.1.off)).map(|(column, _)| column)
        };
        let unmet = unmet.filter_map(|(number, line)| {
            let closest = closest(line)?;
            Some(Unmet { number, line, closest })
        });
        unmet.collect()
    }

    /// How many claims some setting meets, how many none does, and how many were not run.
    pub fn counts(&self) -> [usize; 3] {
        let unmet = self.unmet().len();
        let absent = self.report.lines.iter().filter(|line| !line.is_run()).count();
        [self.report.lines.len() - unmet - absent, unmet, absent]
    }

    /// Pearson's correlation, over all settings, of the numbers of claims met in the two halves, `[-1, 1]`; `None`
    /// where all are alike in one of them.
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

    /// The fields in which settings differ, by name; without those that every setting has alike.
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

    /// The value of `field` in a column; `None` where it is its preset's.
    pub fn value(&self, column: usize, field: &str) -> Option<&str> {
        let mut changed = self.report.columns[column].condition.changed();
        let own = changed.find(|(path, _)| path == field);
        own.map(|(_, value)| value.as_str())
    }

    /// The values of `field` over all settings, in the order of the tables; `None` stands for the presets'.
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

    /// What each value of each field that is swept does.
    pub fn effects(&self) -> Vec<Effect> {
        let of = |field: &str, value: &str| {
            let has = |setting: &&Setting| self.value(setting.column, field) == Some(value);
            let own: Vec<&Setting> = self.settings.iter().filter(has).collect();
            let mean = |met: fn(&Setting) -> usize| {
                let sum: usize = own.iter().map(|setting| met(setting)).sum();
                sum as f64 / own.len() as f64
            };
            Effect {
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

/// The place of the score of `column` among `scores`, from 1.
fn place(scores: &[Score], column: usize) -> usize {
    1 + scores.iter().filter(|score| score.key() > scores[column].key()).count()
}

#[cfg(test)]
mod tests;
