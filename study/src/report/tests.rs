//! Tests of [`ClaimReport`] and its pages, on small tables with values chosen around the paper's. They rely on claims
//! in `study/src/claims/`, found by figure, policy and text. The runs of `fixtures` have 2000 TTIs and 300 events. The
//! judgement of single claims is tested in `judge`.

use reveille_bs::scenario::{Override, load};
use reveille_common::declare::NoFiles;
use reveille_common::score::Metrics;

use super::judge::Verdict;
use super::markdown::markdown;
use super::page::page;
use super::*;
use crate::figures::results::{Results, fixtures};
use reveille_lab::table::SweptValue;

/// Returns runs of three policies with energies near the values of Fig. 8.
fn small_results() -> Results {
    let runs: [(&str, u32, &[f64]); 5] = [
        ("knn", 10, &[0.5, 0.52]),
        ("knn", 250, &[0.15, 0.151]),
        ("random", 10, &[0.34, 0.35]),
        ("random", 250, &[0.25, 0.26]),
        ("genie", 250, &[0.0901, 0.09]),
    ];
    Results::new(&[fixtures::table("paper", "energy_per_device_tti", &runs)], &NoFiles).expect("runs")
}

fn row_for<'l>(report: &'l ClaimReport<'_>, paper_figure: &str, policy: &str, device_counts: &str) -> &'l ClaimRow {
    let found = report
        .rows
        .iter()
        .find(|row| row.paper_figure == paper_figure && row.policy == policy && row.device_counts == device_counts);
    found.unwrap_or_else(|| panic!("no row for {paper_figure}, {policy}, {device_counts}"))
}

/// Finds the row of a policy whose stated value is `stated`.
fn row_with_value<'l>(report: &'l ClaimReport<'_>, paper_figure: &str, policy: &str, stated: &str) -> &'l ClaimRow {
    let found = report
        .rows
        .iter()
        .find(|row| row.paper_figure == paper_figure && row.policy == policy && row.stated == stated);
    found.unwrap_or_else(|| panic!("no row for {paper_figure}, {policy}, {stated}"))
}

#[test]
fn each_claim_has_a_verdict_under_each_preset() {
    let results = small_results();
    let report = ClaimReport::new(&results);
    let labels: Vec<&str> = report.columns.iter().map(|column| column.label.as_str()).collect();
    assert_eq!(labels, ["paper"], "no table of paper-literal");
    assert_eq!(report.missing_presets().collect::<Vec<_>>(), ["paper-literal"]);
    let claims: usize = TOPICS.iter().map(|topic| topic.claims.len()).sum();
    assert_eq!(
        report.rows.len(),
        claims + 14,
        "claims on λ: nine low ends and five high ones"
    );
    let counts = Verdict::ALL.map(|verdict| report.count_verdict(0, verdict));
    assert_eq!(counts.iter().sum::<usize>(), report.rows.len());
    let verdict = |policy: &str, stated: &str| row_with_value(&report, "Fig. 8", policy, stated).assessments[0].verdict;
    assert_eq!(verdict("knn", "≈ 0.145"), Verdict::Reproduced);
    assert_eq!(verdict("random", "> 0.18"), Verdict::Reproduced);
    assert_eq!(verdict("knn", "falls with N"), Verdict::Reproduced);
    assert_eq!(verdict("knn", "less than random"), Verdict::Reproduced);
    assert_eq!(verdict("genie", "≈ 0.055"), Verdict::OrderReproduced);
    assert_eq!(verdict("dt", "0.9 × knn"), Verdict::NotRun);
    assert!(
        row_for(&report, "Fig. 8", "dt", "N = 250").assessments[0]
            .explanation
            .contains("no such runs")
    );
    assert!(
        row_for(&report, "Fig. 8", "adjusted", "N = 250").assessments[0]
            .explanation
            .contains("no such runs")
    );
    let genie = &row_with_value(&report, "Fig. 8", "genie", "≈ 0.055").assessments[0];
    assert!(
        genie.explanation.contains("1.64 times the paper's") && genie.explanation.contains("E_WuR"),
        "{}",
        genie.explanation
    );
}

#[test]
fn the_preset_column_has_the_table_that_covers_most_claims() {
    let (name, two_policies) = fixtures::table(
        "paper",
        "misdetection_pct",
        &[("knn", 10, &[30.0]), ("random", 10, &[70.0])],
    );
    let (_, mut one_policy) = fixtures::table("paper", "misdetection_pct", &[("knn", 10, &[31.0, 32.0, 33.0])]);
    for row in &mut one_policy.rows {
        row.ttis = 90_000;
        let overrides = [
            "devices=10",
            "ttis=90000",
            "policy.name=knn",
            &format!("seed={}", row.seed),
        ];
        let overrides = overrides.map(|text| Override::parse(text).expect("an override"));
        row.scenario_hash = reveille_lab::table::Hash(load("paper", &overrides).expect("a scenario").scenario.hash());
    }
    let tables = [("long.parquet".to_owned(), one_policy), (name, two_policies)];
    let results = Results::new(&tables, &NoFiles).expect("runs");
    let report = ClaimReport::new(&results);
    assert_eq!(report.columns[0].condition.ttis, 2000);
    assert_eq!(report.columns[1].label, "paper, K = 90000");
}

#[test]
fn the_lambda_of_a_threshold_solves_the_closed_form() {
    let results = small_results();
    let report = ClaimReport::new(&results);
    let assessment_at = |device_counts: &str, e_b: &str, policy: &str| {
        let is_row = |row: &&ClaimRow| {
            row.metric_description.ends_with(&format!("E_B = {e_b}"))
                && row.device_counts == device_counts
                && row.policy.starts_with(policy)
        };
        report.rows.iter().find(is_row).expect("a claim").assessments[0].clone()
    };
    // λ·exp(-λ) = 0.345 at 0.6831 (exp(-0.6831) = 0.5050); 5·λ·exp(-λ) = 0.345 at 0.0743 (exp(-0.0743) = 0.9284).
    let one_unit = assessment_at("N = 10", "1", "random, spends least");
    assert!(one_unit.measured.starts_with("0.68"), "{one_unit:?}");
    assert!(
        !one_unit.explanation.contains("In the paper"),
        "random also spends least here: {one_unit:?}"
    );
    let five_units = assessment_at("N = 10", "5", "random");
    assert!(
        five_units.measured.starts_with("0.0743") && five_units.verdict == Verdict::Near,
        "{five_units:?}"
    );
    for (device_counts, policy, reason) in [
        ("N = 10", "q-learning, spends most", "no such runs"),
        ("N = 250", "dt, spends least", "no such runs"),
    ] {
        let absent = assessment_at(device_counts, "1", policy);
        assert!(
            absent.verdict == Verdict::NotRun && absent.explanation.contains(reason),
            "{absent:?}"
        );
    }
    assert_eq!(assessment_at("N = 100", "1", "adjusted").verdict, Verdict::NotRun);
}

#[test]
fn claims_on_q_learning_are_judged_by_its_runs() {
    let runs: [(&str, u32, &[f64]); 2] = [("q-learning", 250, &[0.23, 0.24]), ("q-learning", 10, &[0.6, 0.62])];
    let table = fixtures::table("paper", "energy_per_device_tti", &runs);
    let results = Results::new(std::slice::from_ref(&table), &NoFiles).expect("runs");
    let report = ClaimReport::new(&results);
    let is_q_learning = |row: &&ClaimRow| row.policy.starts_with("q-learning");
    for row in report.rows.iter().filter(is_q_learning) {
        assert!(
            row.assessments
                .iter()
                .any(|assessment| assessment.verdict != Verdict::NotRun
                    || assessment.explanation.contains("no such runs")),
            "{row:?}"
        );
    }
    for stated in ["0.45 to 0.83", "≈ 0.24"] {
        let assessment = &row_with_value(&report, "Fig. 8", "q-learning", stated).assessments[0];
        assert_eq!(assessment.verdict, Verdict::Reproduced, "{assessment:?}");
    }
    let dt = &row_for(&report, "Fig. 8", "dt", "N = 10").assessments[0];
    assert!(
        dt.verdict == Verdict::NotRun && dt.explanation.contains("no such runs"),
        "{dt:?}"
    );
}

#[test]
fn a_policy_with_the_opposite_rank_is_judged() {
    let runs: [(&str, u32, &[f64]); 2] = [("adjusted", 100, &[0.13, 0.14]), ("random", 100, &[0.38, 0.39])];
    let table = fixtures::table("paper", "energy_per_device_tti", &runs);
    let results = Results::new(std::slice::from_ref(&table), &NoFiles).expect("runs");
    let report = ClaimReport::new(&results);
    let adjusted = row_for(&report, "Fig. 14", "adjusted, spends most", "N = 100");
    // 0.135 = λ·exp(-λ) at 0.1581 (exp(-0.1581) = 0.8538).
    let assessment = &adjusted.assessments[0];
    assert!(
        assessment.measured.starts_with("0.158") || assessment.measured.starts_with("0.159"),
        "{assessment:?}"
    );
    assert!(
        assessment
            .explanation
            .contains("here it spends least of all, and random spends most, 0.385"),
        "{assessment:?}"
    );
    let random = &row_for(&report, "Fig. 14", "random, spends least", "N = 100").assessments[0];
    assert!(
        random.measured == "never" && random.explanation.contains("here it spends most of all"),
        "{random:?}"
    );
}

#[test]
fn lambda_is_compared_only_for_a_harvest_by_eq_5() {
    let overrides = [
        "harvest.kind=exp-minus-lambda",
        "devices=100",
        "ttis=2000",
        "seed=1",
        "policy.name=random",
    ];
    let overrides = overrides.map(|text| Override::parse(text).expect("an override"));
    let other_harvest = load("paper", &overrides).expect("a scenario").scenario;
    let (name, mut table) = fixtures::table("paper", "energy_per_device_tti", &[("random", 100, &[0.2])]);
    table.rows[0].scenario_hash = reveille_lab::table::Hash(other_harvest.hash());
    for experiment in ["[set]\n\"harvest.kind\" = \"exp-minus-lambda\"\n", ""] {
        table.metadata.experiment = experiment.to_owned();
        let results = Results::new(&[(name.clone(), table.clone())], &NoFiles).expect("runs");
        let report = ClaimReport::new(&results);
        let assessment = &row_for(&report, "Fig. 14", "random, spends least", "N = 100").assessments[0];
        assert!(
            assessment.verdict == Verdict::NotRun && assessment.explanation.contains("Not comparable"),
            "{assessment:?}"
        );
        let text = markdown(&report, &[], "");
        assert!(
            text.contains(": 3 claims: Not comparable: the claim is about Eq. (5)"),
            "{text}"
        );
    }
}

#[test]
fn the_page_is_well_formed_and_self_contained_and_has_every_claim() {
    let results = small_results();
    let report = ClaimReport::new(&results);
    let make_page = || {
        let picture = crate::figures::svg::svg(&crate::figures::scene::Scene::new(9.0, 9.0), "x");
        page(&report, &[picture], "reveille report \"a & b\"")
    };
    let html = make_page();
    // Except for its void elements, the page is XML.
    let xml = html
        .replace("<!DOCTYPE html>\n", "")
        .replace("charset=\"utf-8\">", "charset=\"utf-8\"/>");
    let xml = xml
        .replace("initial-scale=1\">", "initial-scale=1\"/>")
        .replace("<br>", "<br/>");
    let tree = roxmltree::Document::parse(&xml).unwrap_or_else(|error| panic!("{error}"));
    let row_count = |class: Option<&str>| {
        let rows = tree.descendants().filter(|node| node.has_tag_name("tr"));
        rows.filter(|node| node.attribute("class") == class).count()
    };
    let rows_with_runs = || report.rows.iter().filter(|row| row.has_runs());
    assert_eq!(row_count(Some("claim")), rows_with_runs().count());
    assert_eq!(
        row_count(None),
        report.rows_by_figure().len() + 6,
        "heads of tables, and the rows of the tally"
    );
    let explained = rows_with_runs().filter(|row| {
        let mut assessments = row.assessments.iter();
        assessments.any(|assessment| !assessment.explanation.is_empty())
    });
    assert_eq!(row_count(Some("why")), explained.count());
    let anchors: Vec<&str> = tree.descendants().filter_map(|node| node.attribute("id")).collect();
    let targets = tree.descendants().filter_map(|node| node.attribute("href"));
    let targets: Vec<&str> = targets.map(|target| target.trim_start_matches('#')).collect();
    // The six other links: runs, claims, contradictions, interpretations, figures and origin.
    assert_eq!(targets.len(), report.rows_by_figure().len() + 6, "contents {targets:?}");
    for target in targets {
        assert!(anchors.contains(&target), "no section {target} in {anchors:?}");
    }
    for claim in tree
        .descendants()
        .filter(|node| node.attribute("class") == Some("claim"))
    {
        let unlabelled = claim
            .children()
            .filter(|cell| cell.is_element() && cell.attribute("data-label").is_none());
        assert_eq!(unlabelled.count(), 1, "only the name of the metric has no label");
    }
    for external in ["src=", "@import", "url(", "<script", "<link"] {
        assert!(!html.contains(external), "{external}");
    }
    assert!(html.contains("prefers-color-scheme: dark") && html.contains("@media print"));
    assert_eq!(html, make_page(), "the same bytes again");
}

#[test]
fn markdown_tables_have_equal_column_counts() {
    let results = small_results();
    let report = ClaimReport::new(&results);
    let text = markdown(&report, &[("A".to_owned(), "a.svg".to_owned())], "reveille report x");
    let mut rows = 0;
    for block in text.split("\n\n").filter(|block| block.starts_with('|')) {
        let column_counts: Vec<usize> = block.lines().map(|line| line.matches('|').count()).collect();
        assert!(column_counts.windows(2).all(|pair| pair[0] == pair[1]), "{block}");
        // Without the head and the line below it.
        rows += block.lines().count() - 2;
    }
    // Plus the five rows of the tally.
    assert_eq!(rows, report.rows.iter().filter(|row| row.has_runs()).count() + 5);
    let head = text
        .split("\n\n## Runs and rule\n\n")
        .nth(1)
        .expect("the head of the report");
    assert!(
        head.contains("- paper: 2 runs of 2000 TTIs for each policy and N, 10 in all, seeds 1 to 2."),
        "{head}"
    );
}

#[test]
fn a_single_n_is_named() {
    let sentence = |cells: &[(&str, u32, &[f64])]| {
        let results = Results::new(&[fixtures::table("paper", "misdetection_pct", cells)], &NoFiles).expect("runs");
        super::notes::describe_runs(&ClaimReport::new(&results)).concat()
    };
    let one_n = sentence(&[("knn", 50, &[0.5]), ("genie", 50, &[1.0])]);
    assert!(
        one_n.ends_with(" Claims on several N are judged at N = 50 alone."),
        "{one_n}"
    );
    let two_n = sentence(&[("knn", 50, &[0.5]), ("genie", 250, &[1.0])]);
    assert!(two_n.ends_with("seeds 1 to 1."), "{two_n}");
}

#[test]
fn no_miss_is_bounded_by_the_rule_of_three() {
    let table = fixtures::table(
        "paper",
        "misdetection_pct",
        &[("knn", 250, &[0.0, 0.0]), ("genie", 250, &[0.0, 1.0])],
    );
    let results = Results::new(&[table], &NoFiles).expect("runs");
    let report = ClaimReport::new(&results);
    let knn = &row_with_value(&report, "Fig. 9", "knn", "< 0.01").assessments[0];
    // 300 / 600 = 0.5 %, far above the stated 0.01 %.
    assert_eq!(
        (knn.verdict, knn.is_firm, knn.measured.as_str()),
        (Verdict::Reproduced, false, "0 in 600 events, < 0.500")
    );
    assert!(report.tally_text(0, Verdict::Reproduced).ends_with(" ?"));
    // One of two runs missed 1 % of its 300 events: 0.5 + 12.706 · 0.5, by Student's t with one degree of freedom.
    let genie = &row_with_value(&report, "Fig. 9", "genie", "≈ 0.003").assessments[0];
    assert!(
        genie.measured.starts_with("0.500, 3 in 600 events, < 6.85"),
        "{genie:?}"
    );
    for text in [markdown(&report, &[], ""), page(&report, &[], "")] {
        assert!(!text.contains(" 0 ± ") && !text.contains("0.500 ± "), "{text}");
    }
}

#[test]
fn a_value_far_below_the_other_policies_counts_as_zero() {
    for (genie, expected) in [(0.03, Verdict::Reproduced), (0.05, Verdict::NotReproduced)] {
        let runs: [(&str, u32, &[f64]); 2] = [("genie", 50, &[genie; 2]), ("knn", 50, &[4.0; 2])];
        let results =
            Results::new(&[fixtures::table("paper", "wasted_energy_per_event", &runs)], &NoFiles).expect("runs");
        let report = ClaimReport::new(&results);
        assert_eq!(
            row_with_value(&report, "Fig. 12b", "genie", "≈ 0").assessments[0].verdict,
            expected
        );
    }
}

#[test]
fn explanations_follow_from_the_runs() {
    let mut table = fixtures::table(
        "paper",
        "energy_per_device_tti",
        &[("knn", 10, &[0.2, 0.2]), ("random", 10, &[0.9, 0.9])],
    );
    let low_energy = Metrics::NAMES
        .iter()
        .position(|name| *name == "low_energy_pct")
        .expect("a metric");
    for row in &mut table.1.rows {
        row.metrics[low_energy] = if &*row.policy == "knn" { 80.0 } else { 3.0 };
    }
    let results = Results::new(&[table], &NoFiles).expect("runs");
    let report = ClaimReport::new(&results);
    let explanation = |policy: &str, stated: &str| {
        row_with_value(&report, "Fig. 8", policy, stated).assessments[0]
            .explanation
            .clone()
    };
    let [knn, random] = [explanation("knn", "0.45 to 0.83"), explanation("random", "≈ 0.34")];
    assert!(knn.contains("80.0 % of the devices are below E_Tx"), "{knn}");
    assert!(
        !knn.contains("Cause unknown") && knn.contains("Not on the paper's side of random"),
        "{knn}"
    );
    assert!(
        random.contains("2.65 times") && random.contains("Cause unknown"),
        "{random}"
    );
}

#[test]
fn a_value_near_a_range_is_not_called_reproduced() {
    let runs: [(&str, u32, &[f64]); 1] = [("knn", 10, &[0.4, 0.4])];
    let results = Results::new(&[fixtures::table("paper", "energy_per_device_tti", &runs)], &NoFiles).expect("runs");
    let report = ClaimReport::new(&results);
    let knn = &row_with_value(&report, "Fig. 8", "knn", "0.45 to 0.83").assessments[0];
    assert_eq!(knn.verdict, Verdict::Near);
    assert!(
        knn.explanation.contains("0.889 times the nearer end of the range"),
        "{knn:?}"
    );
    assert!(page(&report, &[], "").contains("within 20 %</td>"));
}

#[test]
fn an_order_uses_statements_about_one_n_before_those_about_many() {
    let runs: [(&str, u32, &[f64]); 2] = [("knn", 10, &[5.0, 5.0]), ("adjusted", 10, &[20.0, 20.0])];
    let results = Results::new(&[fixtures::table("paper", "misdetection_pct", &runs)], &NoFiles).expect("runs");
    let report = ClaimReport::new(&results);
    // 58 % against 33 %, which "above 2 %" for all N under 200 does not contradict.
    let adjusted = &row_with_value(&report, "Fig. 9", "adjusted", "≈ 58").assessments[0];
    assert_eq!(adjusted.verdict, Verdict::OrderReproduced, "{adjusted:?}");
    assert!(
        adjusted.explanation.contains("On the paper's side of knn (N = 10)"),
        "{adjusted:?}"
    );
}

#[test]
fn claims_without_runs_are_summarised_in_one_line() {
    let results = small_results();
    let report = ClaimReport::new(&results);
    let not_run = report.rows.iter().filter(|row| !row.has_runs()).count();
    // Most claims are not run; the limit is chosen freely.
    assert!(not_run > 50);
    let total = report.rows.len();
    let summary = format!("Not run and left out below: {not_run} of {total} claims (");
    for (text, cell) in [
        (markdown(&report, &[], ""), "| not run |"),
        (page(&report, &[], ""), "not run</td>"),
    ] {
        assert_eq!(text.matches(&summary).count(), 1, "{text}");
        assert_eq!(text.matches(cell).count(), 1, "the row of the tally: {text}");
        assert!(text.contains("No table of preset paper-literal was given."));
    }
}

#[test]
fn a_sweep_over_a_field_has_a_column_for_each_value() {
    let lambda = SweptValue::Float;
    let runs: [(&str, u32, SweptValue, &[f64]); 5] = [
        ("knn", 250, lambda(0.05), &[0.15, 0.151]),
        ("knn", 250, lambda(0.1), &[0.15, 0.151]),
        ("random", 30, lambda(0.05), &[0.3, 0.31]),
        ("random", 30, lambda(0.1), &[0.3, 0.31]),
        // No claim is about random with 30 devices, so this λ has no claim.
        ("random", 30, lambda(0.2), &[0.3, 0.31]),
    ];
    let table = fixtures::swept("paper", "energy_per_device_tti", "harvest.lambda", &runs);
    let results = Results::new(&[table], &NoFiles).expect("runs");
    let report = ClaimReport::new(&results);
    let labels: Vec<&str> = report.columns.iter().map(|column| column.label.as_str()).collect();
    assert_eq!(
        labels,
        ["paper", "paper, harvest.lambda = 0.05, K = 2000"],
        "λ = 0.1 is the value of the preset"
    );
    assert_eq!(
        report.conditions_without_claims,
        ["paper, harvest.lambda = 0.2, K = 2000"]
    );
    let text = markdown(&report, &[], "");
    assert!(
        text.contains("No claim is about the runs of paper, harvest.lambda = 0.2"),
        "{text}"
    );
    assert!(text.matches("not run").count() < 5, "{text}");
}

#[test]
fn conditions_that_are_not_the_papers_are_left_out_or_refused() {
    let swept = |lambdas: &[f64]| {
        let run = |lambda: &f64| ("random", 10, SweptValue::Float(*lambda), &[0.3, 0.4][..]);
        let runs: Vec<(&str, u32, SweptValue, &[f64])> = lambdas.iter().map(run).collect();
        fixtures::swept("paper", "energy_per_device_tti", "harvest.lambda", &runs)
    };
    // The preset has λ = 0.1.
    let several = Results::new(&[swept(&[0.05, 0.1, 0.2])], &NoFiles).expect("results");
    let report = ClaimReport::of_presets(&several).expect("a preset");
    assert_eq!(report.columns.len(), 1, "{:?}", report.columns);
    assert_eq!(report.conditions_left_out.describe(), "2 conditions of harvest.lambda");
    let text = markdown(&report, &[], "reveille report x");
    assert!(
        text.contains("Left out: 2 conditions of harvest.lambda, on which the paper"),
        "{text}"
    );
    assert_eq!(ClaimReport::new(&several).columns.len(), 3);
    let one = Results::new(&[swept(&[0.1, 0.2])], &NoFiles).expect("results");
    assert_eq!(ClaimReport::of_presets(&one).expect("a preset").columns.len(), 2);
    let none = Results::new(&[swept(&[0.05, 0.2])], &NoFiles).expect("results");
    let error = ClaimReport::of_presets(&none).expect_err("no preset").to_string();
    assert!(
        error.starts_with("the tables hold 2 conditions of harvest.lambda and no runs of an"),
        "{error}"
    );
}

#[test]
fn the_summary_counts_the_verdicts() {
    let results = small_results();
    let report = ClaimReport::new(&results);
    let text = markdown(&report, &[], "reveille report x");
    for (index, column) in report.columns.iter().enumerate() {
        let by_verdict = |verdict| {
            report
                .rows
                .iter()
                .filter(|row| row.assessments[index].verdict == verdict)
                .count()
        };
        let judged = report.rows.len() - by_verdict(Verdict::NotRun);
        let start = format!(
            "- {}: {} of {judged} claims reproduced",
            column.label,
            by_verdict(Verdict::Reproduced)
        );
        assert!(text.contains(&start), "{start}: {text}");
    }
}

#[test]
fn a_contradiction_in_the_paper_names_both_sentences() {
    let results = small_results();
    let report = ClaimReport::new(&results);
    for text in [markdown(&report, &[], ""), page(&report, &[], "")] {
        let text = text.replace('\u{a0}', " ");
        for part in [
            "Sec. VI-A, on Fig. 12, 7th sentence, against Sec. VI-A, on Fig. 12, 6th sentence: Half of adjusted",
            "Sec. VI-A, on Fig. 8, 4th sentence, against Sec. VI-A, on Fig. 8, 3rd sentence: 0.18 is 24 % more than \
                0.145",
            "Sec. VI-B, on Fig. 13, 6th sentence, against Sec. VI-A, on Fig. 8, 2nd sentence: Under Eq. (5)",
        ] {
            assert_eq!(text.matches(part).count(), 1, "{part}");
        }
    }
}

#[test]
fn each_ranking_has_a_column_and_the_preset_column_has_p42() {
    let ranking = |name: &str| SweptValue::Text(name.to_owned());
    let runs: [(&str, u32, SweptValue, &[f64]); 4] = [
        ("knn", 250, ranking("p42"), &[0.15, 0.151]),
        ("knn", 250, ranking("posterior"), &[0.3, 0.31]),
        ("random", 250, ranking("p42"), &[0.4, 0.41]),
        ("random", 250, ranking("posterior"), &[0.4, 0.41]),
    ];
    let table = fixtures::swept("paper", "energy_per_device_tti", "bs.ranking", &runs);
    let results = Results::new(&[table], &NoFiles).expect("runs");
    let report = ClaimReport::new(&results);
    let labels: Vec<&str> = report.columns.iter().map(|column| column.label.as_str()).collect();
    assert_eq!(labels, ["paper", "paper, bs.ranking = posterior, K = 2000"]);
    let knn = row_with_value(&report, "Fig. 8", "knn", "≈ 0.145");
    let verdicts: Vec<Verdict> = knn.assessments.iter().map(|assessment| assessment.verdict).collect();
    assert_eq!(verdicts, [Verdict::Reproduced, Verdict::OrderReproduced]);
    let drawn_policies: Vec<Vec<&str>> = report.conditions_to_draw().map(RunCondition::policies).collect();
    assert_eq!(
        drawn_policies,
        [["knn", "knn+posterior", "random"]],
        "one figure with both rankings"
    );
}

#[test]
fn page_sections_have_every_claim_with_runs() {
    let results = small_results();
    let report = ClaimReport::new(&results);
    let sections = super::markdown::report_sections(&report, "command");
    let body = |name: &str| {
        let section = sections.iter().find(|section| section.name == name);
        &section.expect("a section").body
    };
    let rows = body("claims")
        .lines()
        .filter(|line| line.starts_with("| ") && !line.starts_with("| |"));
    assert_eq!(rows.count(), report.rows.iter().filter(|row| row.has_runs()).count());
    assert!(body("claims").contains("\n### Fig. 8\n") && body("runs").contains("paper: 2 runs"));
    assert!(body("made").contains("`command`") && body("why").contains("E_WuR"));
}
