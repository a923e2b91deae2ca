//! The search as Markdown.

use std::fmt::Write as _;

use super::super::judge::Verdict;
use super::super::markdown::{cell, folded, lower, made};
use super::super::notes::{absent, verdict};
use super::super::page_sections::{PageSection, wrapped};
use super::super::phrasing::number;
use super::{ClaimSplit, RankedSetting, SettingSearch};

/// Explanation of the ranking and of its limits.
pub(crate) const RULE: &str = "Every claim has a number, in the order of the report. Settings are ranked by the claims \
    with even numbers alone: by how many are reproduced, then by how many are within 20 %. The claims with odd numbers \
    do not affect the rank; the number of them that a setting meets shows whether its rank is more than luck. Claims \
    that were not run do not count. Each verdict is independent of the other claims. Both halves come from the same \
    runs, and a sentence about several policies gives several claims, so the halves are not independent of each other.";

/// Renders the whole page, with the first `count` settings and the presets.
pub fn markdown(search: &SettingSearch<'_>, count: usize, command: &str) -> String {
    let mut out = String::from("# Which settings meet most of the paper's claims\n\n");
    for line in summary(search).into_iter().chain(absent(&search.report)) {
        let _ = writeln!(out, "- {line}");
    }
    let _ = writeln!(out, "\n{RULE}\n\n## Settings\n");
    out.push_str(&ranking(search, count));
    out.push_str(&effects(search));
    out.push_str(&unmet(search));
    out.push_str(&verdicts(search));
    out.push_str(&made(&search.report, command));
    out
}

/// Renders the search as sections of a page, with the first `count` settings and the presets.
pub fn parts(search: &SettingSearch<'_>, count: usize, command: &str) -> Vec<PageSection> {
    let untitled = |text: String| {
        lower(
            text.split_once("## ")
                .and_then(|(_, rest)| rest.split_once('\n'))
                .map_or("", |(_, body)| body),
        )
    };
    vec![
        PageSection::list("search", summary(search).into_iter().chain(absent(&search.report))),
        PageSection::new("search-rule", wrapped(RULE, "")),
        PageSection::new("search-settings", ranking(search, count)),
        PageSection::new("search-effects", untitled(effects(search))),
        PageSection::new("search-unmet", untitled(unmet(search))),
        PageSection::new("search-claims", untitled(verdicts(search))),
        PageSection::new("search-made", folded(&made(&search.report, command))),
    ]
}

/// Summarises the search and its result, one sentence an item.
pub fn summary(search: &SettingSearch<'_>) -> Vec<String> {
    let [met, unmet, absent] = search.counts();
    let runs: usize = search.report.columns.iter().map(|c| c.condition.run_count()).sum();
    let lines = &search.report.lines;
    let halves = [ClaimSplit::Search, ClaimSplit::HeldOut].map(|half| {
        let numbered = (1..).zip(lines).filter(|(number, _)| ClaimSplit::of(*number) == half);
        numbered.filter(|(_, line)| line.is_run()).count()
    });
    let mut sentences = vec![
        format!(
            "{} settings, {runs} runs; {} claims, of which {} were run: {} to search by, {} held out.",
            search.settings.len(),
            lines.len(),
            met + unmet,
            halves[0],
            halves[1]
        ),
        format!("{met} claims are met by some setting, {unmet} by none, {absent} were not run."),
    ];
    if let Some(best) = search.settings.first() {
        sentences.push(format!(
            "The best of the search half meets {} of {} claims there and {} of {} of those held out, by which it has \
             place {} of {}.",
            best.search.met,
            best.search.judged,
            best.held_out.met,
            best.held_out.judged,
            best.held_out_place,
            search.settings.len()
        ));
    }
    if let Some(together) = search.correlation() {
        sentences.push(format!(
            "Over all settings, the numbers of claims met in the two halves have a correlation of {together:.2}."
        ));
    }
    sentences
}

/// Headings of the ranking: its own columns, then the fields in which settings differ.
pub fn heads(search: &SettingSearch<'_>) -> Vec<String> {
    let own = [
        "place",
        "met",
        "within 20 %",
        "of",
        "held out: met",
        "within 20 %",
        "of",
        "place",
    ];
    let own = own.map(str::to_owned).into_iter();
    let fields = search.fields().into_iter().map(str::to_owned);
    own.chain(["setting".to_owned()]).chain(fields).collect()
}

/// Formats a row of the ranking, in the order of [`heads`].
pub fn row(search: &SettingSearch<'_>, setting: &RankedSetting) -> Vec<String> {
    let (chosen, checked) = (setting.search, setting.held_out);
    let numbers = [
        setting.place,
        chosen.met,
        chosen.near,
        chosen.judged,
        checked.met,
        checked.near,
        checked.judged,
        setting.held_out_place,
    ];
    let condition = search.report.columns[setting.column].condition;
    let name = if condition.is_plain() {
        condition.preset.clone()
    } else {
        String::new()
    };
    let fields = search.fields().into_iter();
    let values = fields.map(|field| search.value(setting.column, field).unwrap_or("–").to_owned());
    let numbers = numbers.iter().map(ToString::to_string);
    numbers.chain([name]).chain(values).collect()
}

fn table(heads: &[String], rows: impl Iterator<Item = Vec<String>>) -> String {
    let line = |cells: &[String]| {
        let cells: Vec<String> = cells.iter().map(|text| cell(text)).collect();
        format!("| {} |\n", cells.join(" | "))
    };
    let mut out = line(heads);
    let _ = writeln!(out, "|{}", "---|".repeat(heads.len()));
    rows.for_each(|row| out.push_str(&line(&row)));
    out
}

fn ranking(search: &SettingSearch<'_>, count: usize) -> String {
    let shown: Vec<&RankedSetting> = search.shown(count).collect();
    let mut out = table(&heads(search), shown.iter().map(|setting| row(search, setting)));
    match search.settings.len() - shown.len() {
        0 => {}
        1 => out.push_str("\nOne more setting is not shown.\n"),
        rest => {
            let _ = writeln!(out, "\n{rest} more settings are not shown.");
        }
    }
    out
}

fn effects(search: &SettingSearch<'_>) -> String {
    let effects = search.effects();
    if effects.is_empty() {
        return String::new();
    }
    let heads = [
        "field",
        "value",
        "settings",
        "claims met, mean",
        "best",
        "held out: met, mean",
    ]
    .map(str::to_owned);
    let rows = effects.into_iter().map(|effect| {
        vec![
            format!("`{}`", effect.field),
            effect.value,
            effect.settings.to_string(),
            number(effect.search),
            effect.best.to_string(),
            number(effect.held_out),
        ]
    });
    format!(
        "\n## Effect of each value\n\nOver all settings with this value.\n\n{}",
        table(&heads, rows)
    )
}

fn unmet(search: &SettingSearch<'_>) -> String {
    let unmet = search.unmet();
    if unmet.is_empty() {
        return String::new();
    }
    let heads = [
        "claim", "figure", "policy", "N", "of", "stated", "closest", "verdict", "setting", "why",
    ];
    let heads = heads.map(str::to_owned);
    let rows = unmet.into_iter().map(|unmet| {
        let (line, closest) = (unmet.line, unmet.closest);
        let ours = &line.ours[closest];
        vec![
            unmet.number.to_string(),
            line.source.to_owned(),
            line.policy.clone(),
            line.sites.clone(),
            line.about.clone(),
            line.paper.clone(),
            ours.found.clone(),
            verdict(line, closest),
            search.label(closest).to_owned(),
            ours.why.clone(),
        ]
    });
    format!("\n## Claims that no setting meets\n\n{}", table(&heads, rows))
}

/// Lists every claim, its half, the number of settings that meet it, and its verdicts under presets and best setting.
fn verdicts(search: &SettingSearch<'_>) -> String {
    let best = search.settings.first().map(|setting| setting.column);
    // With a count of 0, `shown` yields only the presets.
    let presets = search.shown(0).map(|setting| setting.column);
    let mut columns: Vec<usize> = presets.collect();
    columns.sort_unstable();
    columns.extend(best.filter(|best| !columns.contains(best)));
    let heads = [
        "claim",
        "half",
        "figure",
        "policy",
        "N",
        "of",
        "stated",
        "settings that meet it",
    ];
    let mut heads: Vec<String> = heads.map(str::to_owned).to_vec();
    heads.extend(columns.iter().map(|column| search.label(*column).to_owned()));
    let lines = (1..).zip(&search.report.lines).filter(|(_, line)| line.is_run());
    let rows = lines.map(|(at, line)| {
        let met = line
            .ours
            .iter()
            .filter(|ours| ours.verdict == Verdict::Reproduced)
            .count();
        let mut row = vec![
            at.to_string(),
            ClaimSplit::of(at).words().to_owned(),
            line.source.to_owned(),
            line.policy.clone(),
            line.sites.clone(),
            line.about.clone(),
            line.paper.clone(),
            met.to_string(),
        ];
        let found = |column: &usize| match verdict(line, *column) {
            verdict if line.ours[*column].found.is_empty() => verdict,
            verdict => format!("{verdict}: {}", line.ours[*column].found),
        };
        row.extend(columns.iter().map(found));
        row
    });
    format!("\n## Claim by claim\n\n{}", table(&heads, rows))
}
