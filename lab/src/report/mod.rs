//! The report: every claim of the paper beside what the lab measured, with a verdict by a stated rule.
//!
//! [`claims`] is what the paper says, [`mod@judge`] the rule, [`Report`] both applied to result tables; [`page`] and
//! [`markdown`] write it down.

pub mod claims;
pub mod judge;
mod lambda;
pub mod markdown;
pub mod page;
mod why;
mod words;

use reveille_common::scenario::{Override, load};

use self::claims::{Claim, Sites, TOPICS, Topic};
use self::judge::{Verdict, judge};
use self::words::{number, relation};
use crate::figures::results::{Results, Setting};

/// The presets that the report always has columns for.
pub const PRESETS: [&str; 2] = ["paper", "paper-literal"];

/// Why a preset has no verdicts.
const NO_TABLE: &str = "No table of this preset was given.";

/// Our side of a claim under one setting.
#[derive(Clone, Debug, PartialEq)]
pub struct Ours {
    /// What we found, with its 95 % interval; empty without runs.
    pub found: String,
    /// The verdict.
    pub verdict: Verdict,
    /// Whether it holds throughout the interval.
    pub firm: bool,
    /// Why it is not met, as far as that is known; empty where it is met.
    pub why: String,
}

/// A claim and what became of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Where the paper says so.
    pub source: &'static str,
    /// The metric in words.
    pub about: String,
    /// The policy.
    pub policy: String,
    /// For which N.
    pub sites: String,
    /// What the paper says.
    pub paper: String,
    /// Ours, one for each of [`Report::columns`].
    pub ours: Vec<Ours>,
}

/// A column: one of [`PRESETS`], or another setting that the tables hold.
#[derive(Clone, Debug)]
pub struct Column<'r> {
    /// What it is.
    pub label: String,
    /// Its runs, if there are any.
    pub setting: Option<&'r Setting>,
}

/// The whole report, before it is a page.
#[derive(Clone, Debug)]
pub struct Report<'r> {
    /// The tables behind it.
    pub results: &'r Results,
    /// The columns.
    pub columns: Vec<Column<'r>>,
    /// The claims, by figure of the paper.
    pub lines: Vec<Line>,
}

impl<'r> Report<'r> {
    /// Judges every claim by `results`.
    pub fn new(results: &'r Results) -> Self {
        let columns = columns(results);
        let mut lines = Vec::new();
        for topic in TOPICS {
            lines.extend(topic.claims.iter().map(|claim| line(topic, claim, &columns)));
        }
        lines.extend(lambda::lines(&columns));
        Self {
            results,
            columns,
            lines,
        }
    }

    /// The claims by where the paper makes them.
    pub fn sections(&self) -> impl Iterator<Item = (&'static str, &[Line])> {
        let sections = self.lines.chunk_by(|a, b| a.source == b.source);
        sections.map(|lines| (lines[0].source, lines))
    }

    /// The tables that say which experiment they belong to, by name, with its text.
    pub fn experiments(&self) -> impl Iterator<Item = (&str, &str)> {
        let all = self.results.sources.iter();
        let texts = all.map(|source| (source.name.as_str(), source.about.experiment.trim_end()));
        texts.filter(|(_, text)| !text.is_empty())
    }

    /// How many claims have `verdict` in column `column`, in words, with those that are in doubt.
    pub fn tally(&self, column: usize, verdict: Verdict) -> String {
        let is_doubtful = |line: &&Line| line.ours[column].verdict == verdict && !line.ours[column].firm;
        let count = self.count(column, verdict);
        match self.lines.iter().filter(is_doubtful).count() {
            0 => count.to_string(),
            doubtful => format!("{count}, of which {doubtful} ?"),
        }
    }

    /// How many claims have `verdict` in column `column`, in doubt or not.
    pub fn count(&self, column: usize, verdict: Verdict) -> usize {
        self.lines
            .iter()
            .filter(|line| line.ours[column].verdict == verdict)
            .count()
    }
}

/// How many claims `setting` has runs for.
fn covered(setting: &Setting) -> usize {
    let claims = TOPICS.iter().flat_map(|topic| topic.claims);
    let is_run = |claim: &&Claim| setting.sizes(claim.policy).into_iter().any(|n| claim.sites.holds(n));
    claims.filter(is_run).count()
}

/// The presets' columns, each of the setting with most claims covered, then most runs, then the longest; then all others.
fn columns(results: &Results) -> Vec<Column<'_>> {
    let mut columns: Vec<Column<'_>> = Vec::new();
    for preset in PRESETS {
        let own = results.settings.iter().filter(|s| s.is_plain() && s.preset == preset);
        columns.push(Column {
            label: preset.to_owned(),
            setting: own.max_by_key(|s| (covered(s), s.run_count(), s.ttis)),
        });
    }
    for setting in &results.settings {
        let is_shown = columns
            .iter()
            .any(|c| c.setting.is_some_and(|s| std::ptr::eq(s, setting)));
        if !is_shown {
            columns.push(Column {
                label: format!("{}, K = {}", setting.label(), setting.ttis),
                setting: Some(setting),
            });
        }
    }
    columns
}

fn line(topic: &'static Topic, claim: &Claim, columns: &[Column<'_>]) -> Line {
    let ours = |column: &Column<'_>| match column.setting {
        Some(setting) => ours(topic, claim, setting),
        None => Ours {
            found: String::new(),
            verdict: Verdict::NotRun,
            firm: true,
            why: NO_TABLE.to_owned(),
        },
    };
    Line {
        source: topic.source,
        about: topic.about.to_owned(),
        policy: claim.policy.to_owned(),
        sites: match claim.sites {
            Sites::At(n) => format!("N = {n}"),
            Sites::Under(n) => format!("N < {n}"),
            Sites::Everywhere => "all N".to_owned(),
        },
        paper: relation(claim.relation),
        ours: columns.iter().map(ours).collect(),
    }
}

fn ours(topic: &Topic, claim: &Claim, setting: &Setting) -> Ours {
    let judgement = judge(topic, claim, setting);
    let findings = &judgement.findings;
    let least = findings.iter().min_by(|a, b| a.value.total_cmp(&b.value));
    let most = findings.iter().max_by(|a, b| a.value.total_cmp(&b.value));
    let found = match (least, most) {
        (Some(only), Some(_)) if findings.len() == 1 => words::found(claim.relation, only),
        (Some(least), Some(most)) => format!(
            "{} (N = {}) to {} (N = {})",
            number(least.value),
            least.n,
            number(most.value),
            most.n
        ),
        (None, _) | (_, None) => String::new(),
    };
    Ours {
        found,
        verdict: judgement.verdict,
        firm: judgement.firm,
        why: why::why(topic, claim, &judgement, setting),
    }
}

/// Why there are no runs of `policy`.
fn not_run(policy: &str) -> String {
    if is_built(policy) {
        "The tables hold no such runs.".to_owned()
    } else {
        format!("The policy {policy} is not built yet.")
    }
}

/// Whether this version of Reveille has the policy.
fn is_built(policy: &str) -> bool {
    let policy = Override::parse(&format!("policy.name={policy}"));
    policy.and_then(|policy| load(PRESETS[0], &[policy])).is_ok()
}

#[cfg(test)]
mod tests;
