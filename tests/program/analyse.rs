//! The command `reveille analyse`: the battery chain against simulated devices; I_min, crossings of the harvest and
//! run-time exponents against closed forms computed here; CSV files and refusals. `tests/tests/analysis.rs` tests the
//! analysis itself. Sheets, columns and words such as `set-up` are keys of `--json`, which programs of users read.

use std::fs;
use std::os::unix::fs::symlink;

use reveille_tests::process::{FinishedProcess, TestFolder, assert_refused};
use serde_json::Value;

/// Runs `reveille analyse ARGS --json` and parses its output.
fn analyse(folder: &TestFolder, args: &str) -> Value {
    let finished = folder.run(&format!("analyse {args} --json"));
    assert!(finished.is_success(), "{finished}");
    serde_json::from_str(&finished.stdout).expect("--json prints JSON")
}

/// Returns the rows of a sheet in the output of [`analyse`].
fn rows<'a>(findings: &'a Value, sheet: &str) -> &'a Vec<Value> {
    findings[sheet].as_array().expect("rows")
}

fn number(row: &Value, column: &str) -> f64 {
    row[column].as_f64().unwrap_or_else(|| panic!("{column} of {row}"))
}

/// Checks a refusal that prints no output that could be mistaken for a finding.
fn assert_no_finding(finished: &FinishedProcess, code: i32, parts: &[&str]) {
    assert_refused(finished, code, parts);
    assert!(finished.stdout.is_empty(), "{finished}");
}

#[test]
fn the_battery_chain_agrees_with_simulated_devices() {
    let folder = TestFolder::new();
    let findings = analyse(
        &folder,
        "battery --duty 1/2,1/8 --e-b 1,5,10 --activation 0,0.02 --devices 8 --ttis 100000",
    );
    // Two duty cycles, three mean harvests and two activation probabilities.
    assert_eq!(rows(&findings, "chain").len(), 12);
    // 0.02 is the limit in docs/analysis.md and in `study/src/analysis/battery/mod.rs`; the other limits allow for
    // rounding.
    for row in rows(&findings, "chain") {
        assert!(number(row, "total_variation") <= 0.02, "{row}");
        assert!(number(row, "residual") <= 1e-10, "{row}");
    }
    for row in rows(&findings, "availability") {
        assert!((number(row, "chain") - number(row, "measured")).abs() <= 0.02, "{row}");
        assert!(
            (number(row, "eq8_printed") - number(row, "eq8_sum_by_beta")).abs() <= 1e-9,
            "{row}"
        );
    }
    let notes = findings["notes"].to_string();
    assert!(notes.contains("falls with a larger harvest"), "{notes}");
}

#[test]
fn the_distribution_of_one_battery_is_written_to_csv() {
    let folder = TestFolder::new();
    let finished = folder
        .run("analyse battery --duty 1/4 --e-b 5 --activation 0 --devices 4 --ttis 20000 --bin 10 --csv levels.csv");
    assert!(finished.is_success(), "{finished}");
    let text = fs::read_to_string(folder.join("levels.csv")).expect("written");
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines[0], "e_b,duty,activation,battery_from,chain,measured");
    let share = |line: &&str| {
        line.split(',')
            .nth(4)
            .and_then(|x| x.parse::<f64>().ok())
            .expect("a number")
    };
    let sum: f64 = lines[1..].iter().map(share).sum();
    // The header, ten bins of 10 units and the bin of E_max = 100.
    assert!(lines.len() == 12 && (sum - 1.0).abs() < 1e-9, "{text}");
}

#[test]
fn transitions_note_printed_forms_that_are_not_probabilities() {
    let folder = TestFolder::new();
    let findings = analyse(
        &folder,
        "transitions --policy random --devices 100 --ttis 400 --seeds 3",
    );
    // The ten transitions of Sec. IV.
    assert_eq!(rows(&findings, "transitions").len(), 10);
    let s1_probability_sum: f64 = rows(&findings, "transitions")
        .iter()
        .filter(|row| row["transition"].as_str().is_some_and(|name| name.starts_with("P_1,")))
        .map(|row| number(row, "count") / number(row, "visits"))
        .sum();
    assert!((s1_probability_sum - 1.0).abs() < 1e-12, "{s1_probability_sum}");
    let notes = findings["notes"].to_string();
    assert!(notes.contains("P_1,1 as printed is not a probability for"), "{notes}");
}

#[test]
fn i_min_on_a_grid_equals_the_papers_formula() {
    let folder = TestFolder::new();
    let findings = analyse(&folder, "imin --layouts grid,uniform --devices 25,100 --seeds 20");
    for row in rows(&findings, "imin") {
        let deviation = number(row, "mean") - number(row, "grid_formula");
        if row["layout"] == "grid" {
            assert!(deviation.abs() < 1e-12, "{row}");
        } else {
            assert!(deviation < 0.0 && number(row, "sd") > 0.0, "{row}");
        }
    }
}

#[test]
#[expect(clippy::disallowed_methods, reason = "checked to nine digits, not to the last bit")]
fn crossings_of_harvest_and_consumption_equal_the_closed_form() {
    let folder = TestFolder::new();
    let findings = analyse(
        &folder,
        "harvest --lambda 0.1 --policies random --devices 10 --seeds 3 --ttis 500 --readings eq5",
    );
    assert_eq!(rows(&findings, "points").len(), 3);
    for row in rows(&findings, "crossings") {
        if let Some(lambda) = row["net_positive_from"].as_f64() {
            let harvest = number(row, "e_b") * lambda * (-lambda).exp();
            assert!(
                (harvest - number(row, "units")).abs() < 1e-9,
                "harvest {harvest}: {row}"
            );
        }
    }
}

#[test]
#[expect(clippy::disallowed_methods, reason = "checked to nine digits, not to the last bit")]
fn run_time_exponents_equal_the_least_squares_slope() {
    let folder = TestFolder::new();
    let findings = analyse(
        &folder,
        "runtime --policies knn,random,q-learning --devices 10,40,160 --ttis 200 --events 50 --repeat 2",
    );
    // Three policies with three sizes; three kinds of time for each policy, and for q-learning, which alone plans in
    // every TTI, the time of a plan.
    assert_eq!((rows(&findings, "times").len(), rows(&findings, "fits").len()), (9, 10));
    for row in rows(&findings, "fits") {
        let column = match row["what"].as_str().expect("a word") {
            "set-up" => "set_up_ms",
            "run, per TTI" => "run_us_per_tti",
            "decision" => "decision_us",
            "plan" => "plan_us",
            other => panic!("no column has the time of {other}"),
        };
        let times: Vec<f64> = rows(&findings, "times")
            .iter()
            .filter(|times| times["policy"] == row["policy"])
            .map(|times| number(times, column))
            .collect();
        // For three points with four times as many devices each, the least-squares slope equals the slope from the
        // first to the last.
        let exponent = (times[2] / times[0]).ln() / 16f64.ln();
        assert!(
            (number(row, "exponent") - exponent).abs() < 1e-9,
            "{row}, expected exponent {exponent}"
        );
        // Deviation of the middle point, with the 97.5 % point of Student's t for one degree of freedom.
        let curvature = (times[1] * times[1] / (times[0] * times[2])).ln() / 6f64.sqrt();
        let expected_half_width = 12.706 * curvature.abs() / (2f64.sqrt() * 4f64.ln());
        let half_width = number(row, "half_width");
        assert!(
            (half_width - expected_half_width).abs() < 1e-3 * expected_half_width + 1e-12,
            "{row}, expected half-width {expected_half_width}"
        );
    }
}

#[test]
fn a_csv_file_replaces_a_file_and_follows_a_link() {
    let folder = TestFolder::new();
    let analyse_to_csv = |name: &str| folder.run(&format!("analyse imin --devices 10 --csv {name}"));
    folder.write("sheet.csv", "before");
    fs::hard_link(folder.join("sheet.csv"), folder.join("before.csv")).expect("possible");
    assert!(analyse_to_csv("sheet.csv").is_success());
    let read = |name: &str| fs::read_to_string(folder.join(name)).expect("there");
    assert_eq!(
        read("before.csv"),
        "before",
        "the old file was not replaced but overwritten"
    );
    symlink("/dev/stdout", folder.join("shown.csv")).expect("possible");
    let finished = analyse_to_csv("shown.csv");
    assert!(
        finished.is_success() && finished.stdout.starts_with(&read("sheet.csv")),
        "{finished}"
    );
    assert!(folder.join("shown.csv").is_symlink());
}

#[test]
fn invalid_studies_are_refused() {
    let folder = TestFolder::new();
    for (args, parts) in [
        ("harvest --lambda ,", &["--lambda", "the list is empty"][..]),
        ("harvest --lambda 0.1,-1", &["lambda = -1", "must be a rate"]),
        ("harvest --lambda -0.1,0.2", &["lambda = -0.1", "must be a rate"]),
        ("harvest --e-b -1,5", &["--e-b -1,5", "must be above 0"]),
        ("harvest --readings eq6", &["`eq6`", "must be eq5 or exp-minus-lambda"]),
        ("harvest --seeds 0", &["seeds = 0"]),
        (
            "transitions --set radio.false_wake_up=0.1",
            &["radio = impaired: must have no losses"],
        ),
        ("transitions --devices 0", &["devices = 0", "--devices"]),
        ("imin --devices 0", &["devices = 0", "--devices"]),
        ("imin --layouts hexx", &["layout.kind", "hexx", "--layouts"]),
        ("battery --duty 9/8", &["t_on = 9 must be at most t_DRX = 8"]),
        ("battery --e-b 0", &["--e-b 0", "above 0"]),
        ("battery --activation 2", &["activation = 2"]),
        ("battery --bin 0", &["bin = 0", "at least a quantum"]),
        ("battery --set harvest.kind=mpp", &["needs independent arrivals"]),
        ("battery --set energy.e_wur=0.0712345", &["common quantum"]),
        ("runtime --policies knn,unknown", &["unknown"]),
        (
            "transitions --ttis 100 --devices 5 --csv no/such/folder.csv",
            &["no/such/folder.csv"],
        ),
    ] {
        assert_no_finding(&folder.run(&format!("analyse {args}")), 1, parts);
    }
    assert_no_finding(&folder.run("analyse"), 2, &["Usage"]);
    assert_no_finding(&folder.run("analyse runtime --repeat 0"), 2, &["--repeat"]);
}
