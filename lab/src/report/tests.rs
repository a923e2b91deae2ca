//! The report on small tables.

use super::judge::Verdict;
use super::markdown::markdown;
use super::page::page;
use super::*;
use crate::figures::results::{Results, fixtures};

fn results() -> Results {
    let runs: [(&str, u32, &[f64]); 5] = [
        ("knn", 10, &[0.5, 0.52]),
        ("knn", 250, &[0.15, 0.151]),
        ("random", 10, &[0.34, 0.35]),
        ("random", 250, &[0.25, 0.26]),
        ("genie", 250, &[0.0901, 0.09]),
    ];
    Results::new(&[fixtures::table("paper", "energy_per_device_tti", &runs)]).expect("runs")
}

fn line<'l>(report: &'l Report<'_>, source: &str, policy: &str, sites: &str) -> &'l Line {
    let found = report
        .lines
        .iter()
        .find(|l| l.source == source && l.policy == policy && l.sites == sites);
    found.unwrap_or_else(|| panic!("{source} {policy} {sites}"))
}

#[test]
fn every_claim_has_a_verdict_under_every_preset() {
    let results = results();
    let report = Report::new(&results);
    let labels: Vec<&str> = report.columns.iter().map(|c| c.label.as_str()).collect();
    assert_eq!(labels, PRESETS);
    let claims: usize = TOPICS.iter().map(|topic| topic.claims.len()).sum();
    assert_eq!(
        report.lines.len(),
        claims + 14,
        "those on λ: nine high ends and five low ones"
    );
    for column in 0..2 {
        let all = [
            Verdict::Reproduced,
            Verdict::OrderReproduced,
            Verdict::NotReproduced,
            Verdict::NotRun,
        ];
        let sum: usize = all.into_iter().map(|verdict| report.count(column, verdict)).sum();
        assert_eq!(sum, report.lines.len());
    }
    assert_eq!(
        report.count(1, Verdict::NotRun),
        report.lines.len(),
        "no table of paper-literal"
    );
    let verdict = |policy: &str, sites: &str| line(&report, "Fig. 8", policy, sites).ours[0].verdict;
    assert_eq!(verdict("knn", "N = 250"), Verdict::Reproduced);
    assert_eq!(verdict("random", "N = 250"), Verdict::Reproduced);
    assert_eq!(verdict("genie", "N = 250"), Verdict::OrderReproduced);
    assert_eq!(verdict("dt", "N = 250"), Verdict::NotRun);
    assert!(
        line(&report, "Fig. 8", "dt", "N = 250").ours[0]
            .why
            .contains("not built yet")
    );
    assert!(
        line(&report, "Fig. 8", "adjusted", "N = 250").ours[0]
            .why
            .contains("no such runs")
    );
    let genie = &line(&report, "Fig. 8", "genie", "N = 250").ours[0];
    assert!(
        genie.why.contains("1.64 times the paper's") && genie.why.contains("E_WuR"),
        "{}",
        genie.why
    );
}

#[test]
fn a_preset_is_shown_by_the_table_that_covers_most_claims() {
    let (name, wide) = fixtures::table(
        "paper",
        "misdetection_pct",
        &[("knn", 10, &[30.0]), ("random", 10, &[70.0])],
    );
    let (_, mut long) = fixtures::table("paper", "misdetection_pct", &[("knn", 10, &[31.0, 32.0, 33.0])]);
    for row in &mut long.rows {
        row.ttis = 90_000;
        let overrides = [
            "devices=10",
            "ttis=90000",
            "policy.name=knn",
            &format!("seed={}", row.seed),
        ];
        let overrides = overrides.map(|text| Override::parse(text).expect("an override"));
        row.scenario_hash = crate::table::Hash(load("paper", &overrides).expect("a scenario").hash());
    }
    let tables = [("long.parquet".to_owned(), long), (name, wide)];
    let results = Results::new(&tables).expect("runs");
    let report = Report::new(&results);
    assert_eq!(report.columns[0].setting.map(|s| s.ttis), Some(2000));
    assert_eq!(report.columns[2].label, "paper, K = 90000");
}

#[test]
fn the_lambda_of_a_consumption_solves_the_closed_form() {
    let results = results();
    let report = Report::new(&results);
    let at = |sites: &str, e_b: &str| {
        let own =
            |l: &&Line| l.about.ends_with(&format!("E_B = {e_b}")) && l.sites == sites && l.policy.ends_with("most");
        report.lines.iter().find(own).expect("a claim").ours[0].clone()
    };
    // λ·exp(-λ) = 0.51 has no solution, 5·λ·exp(-λ) = 0.51 has 0.1143 (0.1143 · 0.8920 = 0.1020).
    assert!(at("N = 10", "1").found.starts_with("never (knn)"));
    assert!(
        at("N = 10", "5").found.starts_with("0.114"),
        "{}",
        at("N = 10", "5").found
    );
    assert_eq!(at("N = 100", "1").verdict, Verdict::NotRun);
}

#[test]
fn the_page_is_well_formed_needs_nothing_and_holds_every_claim() {
    let results = results();
    let report = Report::new(&results);
    let picture = crate::figures::svg::svg(&crate::figures::scene::Scene::new(9.0, 9.0), "x");
    let html = page(&report, &[picture], "reveille report \"a & b\"");
    // Void elements apart, the page is XML.
    let xml = html
        .replace("<!DOCTYPE html>\n", "")
        .replace("charset=\"utf-8\">", "charset=\"utf-8\"/>");
    let xml = xml
        .replace("initial-scale=1\">", "initial-scale=1\"/>")
        .replace("<br>", "<br/>");
    let tree = roxmltree::Document::parse(&xml).unwrap_or_else(|error| panic!("{error}"));
    let rows = tree.descendants().filter(|n| n.has_tag_name("tr")).count();
    let heads = TOPICS.len() + 2;
    assert_eq!(
        rows,
        report.lines.len() + heads + 5,
        "a row a claim, heads, and the tally"
    );
    for outside in ["src=", "@import", "url(", "<script", "<link"] {
        assert!(!html.contains(outside), "{outside}");
    }
    assert!(html.contains("prefers-color-scheme: dark") && html.contains("@media print"));
    assert_eq!(
        html,
        page(
            &report,
            &[crate::figures::svg::svg(
                &crate::figures::scene::Scene::new(9.0, 9.0),
                "x"
            )],
            "reveille report \"a & b\""
        )
    );
}

#[test]
fn markdown_tables_are_straight() {
    let results = results();
    let report = Report::new(&results);
    let text = markdown(&report, &[("A".to_owned(), "a.svg".to_owned())], "reveille report x");
    let mut rows = 0;
    for block in text.split("\n\n").filter(|block| block.starts_with('|')) {
        let widths: Vec<usize> = block.lines().map(|line| line.matches('|').count()).collect();
        assert!(widths.windows(2).all(|pair| pair[0] == pair[1]), "{block}");
        rows += block.lines().count() - 2;
    }
    assert_eq!(rows, report.lines.len() + 4);
    assert!(
        text.contains("seeds 1 to 2") && text.contains("2 runs of 2000 TTIs a cell"),
        "{text}"
    );
}
