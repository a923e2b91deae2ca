//! `compare` on runs and recordings: metrics equal `summary.json`, half-widths a second computation from `windows.csv`,
//! and the first difference a comparison of `events.csv`. Two tests at the end belong to other commands: a run folder
//! in place of its recording, and the refusal of a list of policies. `compare_sweeps.rs` compares sweeps. The tests
//! depend on JSON keys and texts of `deploy/src/commands/compare/` and `deploy/src/action_text.rs`.

use reveille_tests::process::{TestFolder, assert_refused};
use serde_json::Value;

/// Runs 3000 TTIs of the preset `quick` with these options into the run folder `out`; returns its `summary.json`.
fn run(folder: &TestFolder, out: &str, args: &str) -> Value {
    let finished = folder.run(&format!("run -s quick -k 3000 --quiet --out {out} {args}"));
    assert!(finished.is_success(), "{finished}");
    serde_json::from_slice(&folder.bytes(&format!("{out}/summary.json"))).expect("a summary")
}

/// Half the width of the 95 % interval of the information per TTI over α, from ten parts of `windows.csv` (`PARTS` in
/// `deploy/src/commands/compare/run.rs`): Student's t with nine degrees of freedom times the standard error of the
/// means. In `quick`, α is 0.2, and [`run`] has a warm-up of 300 TTIs and windows of 30, so each part has 270 TTIs.
fn half_width_of_p1(folder: &TestFolder, out: &str) -> f64 {
    let text = String::from_utf8(folder.bytes(&format!("{out}/windows.csv"))).expect("text");
    let mut lines = text.lines();
    let column = lines
        .next()
        .expect("a header")
        .split(',')
        .position(|name| name == "information");
    let windows: Vec<f64> = lines
        .filter_map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            let information = cells[column.expect("a column")].parse::<f64>().expect("a number");
            (cells[0].parse::<u64>().expect("a TTI") >= 300).then_some(information)
        })
        .collect();
    assert_eq!(windows.len(), 90, "windows of 30 TTIs after the warm-up");
    let means: Vec<f64> = windows
        .chunks(9)
        .map(|part| part.iter().sum::<f64>() / (0.2 * 270.0))
        .collect();
    let mean = means.iter().sum::<f64>() / 10.0;
    let deviation = (means.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / 9.0).sqrt();
    2.262_157 * deviation / 10_f64.sqrt()
}

#[test]
fn runs_are_compared_by_fields_metrics_and_first_difference() {
    let folder = TestFolder::new();
    let summaries = [
        run(&folder, "a", "--policy random"),
        run(&folder, "b", "--policy age-index"),
        run(&folder, "c", "--policy random --set radio.uplink_loss=0.4"),
        run(&folder, "d", "--policy random"),
    ];
    let finished = folder.run("compare a b c d --json");
    assert!(finished.is_success(), "{finished}");
    let report: Value = serde_json::from_str(&finished.stdout).expect("JSON");
    for (compared, summary) in report["runs"].as_array().expect("runs").iter().zip(&summaries) {
        assert_eq!(
            (&compared["digest"], &compared["metrics"]),
            (&summary["digest"], &summary["metrics"])
        );
    }
    for (index, out) in ["a", "b", "c"].into_iter().enumerate() {
        let reported = report["runs"][index]["half_widths"]["info_p1"]
            .as_f64()
            .expect("a half-width");
        let expected = half_width_of_p1(&folder, out);
        assert!(
            (reported / expected - 1.0).abs() < 1e-5,
            "{out}: {reported}, {expected}"
        );
    }
    let fields = report["fields"].as_object().expect("fields");
    assert_eq!(
        fields["policy.name"],
        serde_json::json!(["\"random\"", "\"age-index\"", "\"random\"", "\"random\""])
    );
    assert_eq!(
        fields["radio.uplink_loss"],
        serde_json::json!(["0.0", "0.0", "0.4", "0.0"])
    );
    // Differences of runs 2, 3 and 4 from run 1.
    let equal: Vec<bool> = (0..3)
        .map(|index| report["differences"][index]["equal"] == true)
        .collect();
    assert_eq!(equal, [false, false, true], "{report}");
    // Up to the first lost report, the two event tables are equal.
    let [table_a, table_c] =
        ["a", "c"].map(|out| String::from_utf8(folder.bytes(&format!("{out}/events.csv"))).expect("text"));
    let differing_rows = table_a
        .lines()
        .zip(table_c.lines())
        .find(|(row_a, row_c)| row_a != row_c)
        .expect("a difference");
    let event = differing_rows.0.split(',').next().expect("a number");
    let first = report["differences"][1]["first"].as_str().expect("text");
    assert!(
        first.starts_with(&format!("first difference in event {event} of TTI ")),
        "{first}: {differing_rows:?}"
    );

    let finished = folder.run("compare a b c d");
    let [random, age_index] = [0, 1].map(|index| {
        summaries[index]["metrics"]["energy_per_device_tti"]
            .as_f64()
            .expect("energy")
    });
    let share = format!("({:+.0} %)", 100.0 * (age_index - random) / random);
    for part in [
        "run 1: a  (digest ",
        "energy_per_device_tti",
        &share,
        "run 1 and run 4: equal digests",
    ] {
        assert!(finished.stdout.contains(part), "no {part:?}: {finished}");
    }
    // A metric outside `MAIN_METRICS` of `deploy/src/results_table.rs`.
    assert!(!finished.stdout.contains("overflow_per_device_tti"), "{finished}");
    let metric_lines = finished
        .stdout
        .lines()
        .skip_while(|line| !line.starts_with("metric"))
        .take_while(|line| !line.starts_with("run 1 and"));
    assert!(
        metric_lines.map(|line| line.chars().count()).max() <= Some(80),
        "{finished}"
    );
    assert!(
        folder
            .run("compare a b --all-metrics")
            .stdout
            .contains("overflow_per_device_tti")
    );
}

#[test]
fn causes_of_missed_events_are_shown_and_few_of_them_have_no_interval() {
    let folder = TestFolder::new();
    let summaries = [
        run(&folder, "few", "-n 50 --policy age-index"),
        run(&folder, "many", "-n 50 --policy age-index --set radio.uplink_loss=0.4"),
    ];
    let missed = |summary: &Value| summary["totals"]["events"]["misdetected"].as_u64().expect("a count");
    assert!((1..10).contains(&missed(&summaries[0])), "{}", summaries[0]);
    assert!(missed(&summaries[1]) >= 10, "{}", summaries[1]);
    let finished = folder.run("compare few many");
    let lines: Vec<&str> = finished.stdout.lines().collect();
    let row = lines
        .iter()
        .position(|line| line.starts_with("misdetection_pct "))
        .expect("a row");
    // The columns of a run have 17 columns, after 28 of the name.
    let cells = |line: &str| {
        let characters: Vec<char> = line.chars().collect();
        [&characters[28..45], &characters[45..]].map(|cell| cell.iter().collect::<String>())
    };
    let [few, many] = cells(lines[row]);
    assert!(!few.contains('±') && many.contains('±'), "{finished}");
    assert!(
        lines[row + 1].contains('+') && !lines[row + 1].contains('%'),
        "{finished}"
    );
    let causes: Vec<&str> = finished
        .stdout
        .lines()
        .filter_map(|line| {
            line.strip_prefix("  missed_")?
                .split_once("_pct ")
                .map(|(cause, _)| cause)
        })
        .collect();
    let nonzero = |cause: &&str| {
        summaries
            .iter()
            .any(|summary| summary["metrics"][format!("missed_{cause}_pct")] != 0.0)
    };
    assert!(causes.contains(&"lost") && causes.iter().all(nonzero), "{finished}");
    let all_causes = summaries[0]["totals"]["missed"].as_object().expect("causes");
    let nonzero_count = all_causes.keys().filter(|cause| nonzero(&cause.as_str())).count();
    assert_eq!(causes.len(), nonzero_count, "{finished}");
    // No name touches its value.
    assert!(
        lines
            .iter()
            .any(|line| line.starts_with("wrong_activations_per_event ")),
        "{finished}"
    );
    let report: Value = serde_json::from_str(&folder.run("compare few many --json").stdout).expect("JSON");
    assert_eq!(report["runs"][0]["half_widths"]["misdetection_pct"], Value::Null);
    assert!(
        report["runs"][1]["half_widths"]["misdetection_pct"].is_number(),
        "{report}"
    );
}

#[test]
fn actions_and_the_sides_of_a_difference_are_named() {
    let folder = TestFolder::new();
    folder.write(
        "script",
        "500 fail all for 400\n600 energy 0-3 2.5\n700 set events.alpha 0.05\n",
    );
    run(&folder, "plain", "--record plain.mcap");
    run(&folder, "acted", "--actions script --record acted.mcap");
    // `for 400` adds a fourth action, the revival in TTI 900; the text shows the first three.
    let actions = "  4 actions: TTI 500 devices 0 to 19 fail, TTI 600 devices 0 to 3 receive 2.5\n  \
                   units each, TTI 700 events.alpha is set to 0.05, …\n";
    for (args, parts) in [
        (
            "plain acted",
            ["run 1 and run 2: first difference in event ", " in run 1, "],
        ),
        (
            "plain.mcap acted.mcap",
            ["first difference: action in TTI 500", "\n    run 2: "],
        ),
    ] {
        let finished = folder.run(&format!("compare {args}"));
        for part in parts.into_iter().chain([actions]) {
            assert!(finished.stdout.contains(part), "no {part:?}: {finished}");
        }
        assert!(
            finished.stdout.lines().all(|line| line.chars().count() <= 80),
            "{finished}"
        );
        assert!(
            !finished.stdout.contains("other:") && finished.stdout.matches("actions:").count() == 1,
            "{finished}"
        );
    }
    let finished = folder.run("compare plain acted");
    assert!(
        finished.stdout.lines().all(|line| line.chars().count() <= 80),
        "{finished}"
    );
    assert!(
        finished
            .stdout
            .replace('\n', " ")
            .contains("folders show events only; record both runs with --record"),
        "{finished}"
    );
    let report: Value = serde_json::from_str(&folder.run("compare acted plain --json").stdout).expect("JSON");
    assert_eq!(
        (&report["runs"][0]["actions"], &report["runs"][1]["actions"]),
        (&4.into(), &0.into())
    );
}

#[test]
fn the_exit_code_tells_differences_and_runs_without_results_are_refused() {
    let folder = TestFolder::new();
    run(&folder, "a", "--record a.mcap");
    run(&folder, "b", "--seed 2 --record b.mcap");
    for (args, code) in [
        ("a a --exit-code", 0),
        ("a b", 0),
        ("a b --exit-code", 1),
        ("a.mcap a --exit-code", 0),
        ("a.mcap b.mcap --exit-code", 1),
    ] {
        let finished = folder.run(&format!("compare {args}"));
        assert_eq!(finished.code(), Some(code), "{args}: {finished}");
    }
    std::fs::remove_file(folder.join("b/summary.json")).expect("removed");
    assert_refused(&folder.run("compare a b"), 1, &["b: ", "no results", "resume"]);
    assert_refused(
        &folder.run("compare a"),
        2,
        &["a: one run has nothing to be compared with"],
    );
    assert_refused(
        &folder.run("compare a nowhere"),
        1,
        &["nowhere: no such file or folder", "or a recording"],
    );
}

#[test]
fn a_recording_is_found_in_its_run_folder() {
    let folder = TestFolder::new();
    run(&folder, "a", "");
    assert_refused(
        &folder.run("inspect verify a"),
        1,
        &["a: the folder holds no recording", "--record a/run.mcap"],
    );
    for name in ["events.csv", "scenario.toml"] {
        let refused = folder.run(&format!("run -k 100 --out new --record new/{name}"));
        assert_refused(&refused, 1, &["--record new/", "the run folder has its own"]);
    }
    run(&folder, "b", "--record a/run.mcap");
    for command in ["verify a", "stats a", "tail a -c 1", "export a --to csv"] {
        let finished = folder.run(&format!("inspect {command}"));
        assert!(finished.is_success(), "{command}: {finished}");
    }
    assert!(folder.join("a/run.csv").is_file(), "named after the recording");
    let finished = folder.run("inspect stats --from a/run.mcap");
    assert!(
        finished.is_success() && finished.stderr.contains("--from FILE is now the argument FILE"),
        "{finished}"
    );
    for figure in ["timeline a --length 50", "deployment a"] {
        let finished = folder.run(&format!("figures {figure} --format svg"));
        assert!(
            finished.is_success() && finished.stdout.contains("-n20-s1-"),
            "{figure}: {finished}"
        );
    }
    assert_refused(&folder.run("figures timeline ."), 1, &["holds no run", "scenario file"]);
    assert_refused(&folder.run("figures timeline a --scenario quick"), 2, &["--scenario"]);
    for figure in ["timeline", "deployment"] {
        let [former, current] = ["--scenario quick --out former", "quick --out current"]
            .map(|preset| folder.run(&format!("figures {figure} {preset} --format svg")));
        let note = "--scenario NAME is now the argument RUN";
        assert!(former.is_success() && former.stderr.contains(note), "{former}");
        assert!(current.is_success() && !current.stderr.contains(note), "{current}");
    }
    assert_eq!(folder.list("former"), folder.list("current"));
}

#[test]
fn a_list_of_policies_needs_a_command_with_several_runs() {
    let folder = TestFolder::new();
    for command in ["run", "up", "figures timeline"] {
        let finished = folder.run(&format!("{command} --policy knn,random"));
        assert_refused(
            &finished,
            1,
            &["--policy knn,random", "`reveille sweep --policies knn,random`"],
        );
    }
    // A former name of a field causes a warning here too.
    let former = "--set radio.false_wake=0.1";
    let finished = folder.run(&format!("sweep --policy knn --seeds 1 -s quick --dry-run {former}"));
    let warning = "radio.false_wake is now called radio.false_wake_up (set by --set radio.false_wake=0.1)";
    assert!(finished.is_success() && finished.stderr.contains(warning), "{finished}");
    let finished = folder.run("sweep --policy knn,random --seeds 1 -s quick --dry-run");
    assert!(finished.is_success() && finished.stdout.contains("knn"), "{finished}");
}
