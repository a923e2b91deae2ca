//! `inspect misses` and `figures misses` on the folders of runs: their numbers equal an independent count of
//! `events.csv` and the totals of `summary.json`. One test removes the last columns of `events.csv` by their number, so
//! it depends on the order of `EVENT_COLUMNS` in `deploy/src/run_tables.rs`.

use std::collections::BTreeMap;
use std::fs;
use std::process::Command;
use std::time::Duration;

use reveille_tests::process::{Process, TestFolder, assert_refused, reveille, unique_run};
use rustix::process::Signal;
use serde_json::Value;

/// Returns the missed events of a run folder, without the warm-up: cause, x and y in metres, and start TTI.
fn missed_events(folder: &TestFolder, run: &str) -> Vec<(String, f64, f64, u64)> {
    let text = String::from_utf8(folder.bytes(&format!("{run}/events.csv"))).expect("text");
    let mut lines = text.lines();
    let header: Vec<&str> = lines.next().expect("a header").split(',').collect();
    let column = |name: &str| header.iter().position(|known| *known == name).expect(name);
    let rows = lines.map(|line| line.split(',').collect::<Vec<_>>());
    let missed = rows.filter(|row| row[column("counted")] == "1" && row[column("reports")] == "0");
    missed
        .map(|row| {
            let number = |name: &str| row[column(name)].parse::<f64>().expect(name);
            let cause = row[column("miss_cause")].to_owned();
            (cause, number("x_m"), number("y_m"), number("start_tti") as u64)
        })
        .collect()
}

/// Runs `inspect misses --json` on a run folder and returns the report.
fn misses_report(folder: &TestFolder, run: &str) -> Value {
    let finished = folder.run(&format!("inspect misses {run} --json"));
    assert!(finished.is_success(), "{finished}");
    serde_json::from_str(&finished.stdout).expect("a report is JSON")
}

/// Returns the sum of all numbers in a nested list.
fn sum_nested(value: &Value) -> u64 {
    value.as_array().map_or_else(
        || value.as_u64().expect("a number"),
        |items| items.iter().map(sum_nested).sum(),
    )
}

#[test]
fn the_report_equals_a_count_of_the_table_and_the_summary() {
    let folder = TestFolder::new();
    let command = "run --quiet -n 20 -k 3000 --policy random --set radio.uplink_loss=0.3 --out r";
    assert!(folder.run(command).is_success());
    let (report, missed) = (misses_report(&folder, "r"), missed_events(&folder, "r"));
    let summary: Value = serde_json::from_slice(&folder.bytes("r/summary.json")).expect("a summary");
    assert!(missed.len() > 50, "{} missed events", missed.len());
    assert_eq!(report["missed"], missed.len());
    assert_eq!(report["missed"], summary["totals"]["events"]["misdetected"]);
    assert_eq!(report["events"], summary["totals"]["events"]["events"]);
    let mut causes: BTreeMap<&str, u64> = BTreeMap::new();
    for (cause, ..) in &missed {
        *causes.entry(cause).or_default() += 1;
    }
    assert!(causes.len() > 2, "{causes:?}");
    assert_eq!(report["causes"], serde_json::json!(causes));
    for (cause, count) in &causes {
        assert_eq!(summary["totals"]["missed"][cause], *count, "{cause}");
    }
    let map = &report["map"];
    assert_eq!(
        (sum_nested(&map["missed"]), sum_nested(&map["devices"])),
        (missed.len() as u64, 20)
    );
    // The area has 20 m × 20 m and cells of 2 m; the 2700 TTIs after the warm-up make ten bins.
    let north_east = missed.iter().filter(|(_, x, y, _)| *x >= 18.0 && *y >= 18.0).count();
    assert_eq!(map["missed"][9][9], north_east, "{map}");
    let in_first_bin = missed.iter().filter(|(.., start)| (300..570).contains(start)).count();
    assert_eq!(
        (&report["bins"][0]["missed"], &report["bins"][0]["end_tti"]),
        (&in_first_bin.into(), &570.into())
    );

    let finished = folder.run("inspect misses r");
    let missed_line = format!("{} of {} events missed", missed.len(), report["events"]);
    for part in [
        &missed_line,
        "\n  - lower radio.uplink_loss = 0.3: try 0.15, 0.075\n",
        "\nAdd --try to run the suggested values",
        " no sense no radio  outage\n",
        "lost",
        "Causes over time",
        "Nearest devices",
    ] {
        assert!(finished.stdout.contains(part), "no {part:?}: {finished}");
    }
    let widest = finished.stdout.lines().map(|line| line.chars().count()).max();
    assert!(widest <= Some(80), "{widest:?}: {finished}");
    let finished = folder.run("figures misses r --format svg");
    assert_eq!(finished.stdout, "figures/misses-random-n20-s1.svg\n");
    let svg = String::from_utf8(folder.bytes("figures/misses-random-n20-s1.svg")).expect("text");
    assert!(svg.contains(&format!("{} of {} events were missed", missed.len(), report["events"])));
}

#[test]
fn a_run_without_misses_and_tables_of_other_versions_are_reported() {
    let folder = TestFolder::new();
    assert!(
        folder
            .run("run --quiet -n 100 -k 300 --policy genie --out g")
            .is_success()
    );
    let finished = folder.run("inspect misses g");
    assert!(
        finished.is_success() && finished.stdout.contains("\n0 of ") && finished.stdout.lines().count() == 2,
        "{finished}"
    );
    assert_eq!(misses_report(&folder, "g")["advice"], Value::Null);

    assert!(
        folder
            .run("run --quiet -n 20 -k 1000 --policy random --out r")
            .is_success()
    );
    let text = String::from_utf8(folder.bytes("r/events.csv")).expect("text");
    let without_last = |columns: usize| {
        let cut = |line: &str| line.rsplitn(columns + 1, ',').last().unwrap_or_default().to_owned() + "\n";
        text.lines().map(cut).collect::<String>()
    };
    let with_causes = misses_report(&folder, "r");
    // Run folders of earlier versions have no causes and no nearest devices.
    folder.write("r/events.csv", &without_last(3));
    let without_causes = misses_report(&folder, "r");
    assert_eq!(
        without_causes["causes"],
        serde_json::json!({ "unknown": with_causes["missed"] })
    );
    assert_eq!(
        (&without_causes["map"], &without_causes["missed_in_warm_up"]),
        (&with_causes["map"], &with_causes["missed_in_warm_up"])
    );
    assert!(
        without_causes["advice"]
            .as_str()
            .is_some_and(|text| text.contains("no causes")),
        "{without_causes}"
    );
    // `reports` is the first of the last eight columns.
    folder.write("r/events.csv", &without_last(8));
    assert_refused(&folder.run("inspect misses r"), 1, &["events.csv", "no column reports"]);
    folder.write("r/events.csv", &text.replace("asleep", "tired"));
    assert_refused(
        &folder.run("inspect misses r"),
        1,
        &["events.csv, line ", "miss_cause", "`tired`"],
    );
    assert_refused(&folder.run("inspect misses nowhere"), 1, &["nowhere: no such folder"]);
    assert_refused(&folder.run("figures misses ."), 1, &["holds no run", "runs/"]);
}

#[test]
fn an_active_run_is_reported_so_far() {
    let (folder, run) = (TestFolder::new(), unique_run("misses"));
    let up = folder.start(&format!(
        "up -n 10 -k 400 -P 1 --paused --run {run} --policy random --quiet --out out"
    ));
    folder.wait_for_tti(&run, 0);
    let finished = folder.run("inspect misses out");
    assert!(
        finished.is_success() && finished.stdout.contains("no counted event so far"),
        "{finished}"
    );
    assert!(finished.stderr.contains("out: the run is still active"), "{finished}");
    folder.clock(&run, "resume");
    assert!(up.finish().is_success());
    assert_eq!(
        misses_report(&folder, "out")["missed"],
        missed_events(&folder, "out").len()
    );
}

#[test]
fn a_table_without_the_columns_is_refused_also_without_rows() {
    let folder = TestFolder::new();
    assert!(folder.run("run -p random -n 10 -k 300 --quiet --out r").is_success());
    folder.write("r/events.csv", "garbage\n");
    let cause = "r/events.csv: has no column event; repeat the run";
    assert_refused(&folder.run("inspect misses r"), 1, &[cause]);
    assert_refused(&folder.run("figures misses r --out f"), 1, &[cause]);
}

#[test]
fn failed_devices_are_a_cause_with_its_own_advice() {
    let folder = TestFolder::new();
    folder.write("a.txt", "300 fail all\n");
    let command = "run --quiet -n 20 -k 3000 -p age-index --actions a.txt --out r";
    assert!(folder.run(command).is_success());
    let count = missed_events(&folder, "r")
        .iter()
        .filter(|(cause, ..)| cause == "failed")
        .count();
    assert!(count > 50, "{count} events missed by failed devices");
    let summary: Value = serde_json::from_slice(&folder.bytes("r/summary.json")).expect("a summary");
    let report = misses_report(&folder, "r");
    assert_eq!(
        (&report["causes"]["failed"], &summary["totals"]["missed"]["failed"]),
        (&count.into(), &count.into())
    );
    let suggestions = report["suggestions"].as_array().expect("a list");
    assert!(
        suggestions
            .iter()
            .any(|text| text.as_str().is_some_and(|text| text.starts_with("revive")))
            && suggestions.iter().all(|text| !text.to_string().contains("policy")),
        "{suggestions:?}"
    );
    let text = folder.run("inspect misses r").stdout.replace('\n', " ");
    assert!(
        text.contains("  failed       an operator had failed the devices with δ = 1")
            && !text.contains("slept by plan"),
        "{text}"
    );
}

#[test]
fn the_actions_of_a_run_are_named() {
    let folder = TestFolder::new();
    folder.write("a.txt", "1200 fail 0-9\n2500 revive 0-9\n");
    let command = "run --quiet -n 20 -k 3000 --policy random --actions a.txt --out r";
    assert!(folder.run(command).is_success());
    let missed_after_action = missed_events(&folder, "r")
        .iter()
        .filter(|(.., start)| *start >= 1200)
        .count();
    let report = misses_report(&folder, "r");
    assert_eq!(report["missed_after_first_action"], missed_after_action);
    assert_eq!(
        report["first_actions"],
        serde_json::json!(["TTI 1200 devices 0 to 9 fail", "TTI 2500 devices 0 to 9 are revived"])
    );
    let text = folder.run("inspect misses r").stdout.replace('\n', " ");
    assert!(
        text.contains("2 actions: TTI 1200 devices 0 to 9 fail, TTI 2500 devices 0 to 9 are revived;"),
        "{text}"
    );
    assert!(text.contains(&format!("{missed_after_action} of the missed")), "{text}");
}

#[test]
fn failed_devices_and_phases_are_reported() {
    let folder = TestFolder::new();
    folder.write("a.txt", "1200 fail 0-9\n2500 revive 0-8\n");
    let command = "run --quiet -n 20 -k 3000 --policy random --actions a.txt --out r";
    assert!(folder.run(command).is_success());
    let missed = missed_events(&folder, "r");
    let missed_in = |first: u64, end: u64| missed.iter().filter(|(.., start)| (first..end).contains(start)).count();
    let report = misses_report(&folder, "r");
    let phases = report["phases"].as_array().expect("phases");
    // The warm-up has 300 TTIs.
    for (phase, (first, end, failed)) in phases.iter().zip([(300, 1200, 0), (1200, 2500, 10), (2500, 3000, 1)]) {
        assert_eq!(
            (&phase["first_tti"], &phase["end_tti"], &phase["failed_devices"]),
            (&first.into(), &end.into(), &failed.into()),
            "{report}"
        );
        assert_eq!(phase["missed"], missed_in(first, end), "{phase}");
        assert!(phase["energy_per_device_tti"].as_f64() > Some(0.0), "{phase}");
    }
    assert_eq!(phases.len(), 3);
    // Failed devices spend nothing.
    let energy = |phase: usize| phases[phase]["energy_per_device_tti"].as_f64().expect("a number");
    assert!(energy(1) < 0.7 * energy(0), "{report}");
    let failed = report["failed_devices"].as_array().expect("a list");
    assert_eq!(failed.len(), 10);
    assert_eq!(
        failed[9],
        serde_json::json!({ "device": 9, "first_tti": 1200, "ttis": 1800, "failed_at_end": true })
    );
    assert_eq!(
        (sum_nested(&report["map"]["failed"]), &failed[0]["ttis"]),
        (10, &1300.into())
    );
    for device in report["devices"].as_array().expect("devices") {
        let is_failed = device["device"].as_u64() < Some(10);
        assert_eq!(
            device["failed_by_action_ttis"].as_u64() > Some(0),
            is_failed,
            "{device}"
        );
    }

    let finished = folder.run("inspect misses r --devices 20");
    for part in [
        "\nPhases between actions\n",
        "\n     1200      2499      10 ",
        " ×1",
        "\n×: cells with devices that actions failed\n",
        "\n    ×9 ",
        "\n    10 ",
        "\n×: actions failed the device\n",
        "over all devices (failed ones spend nothing,",
    ] {
        assert!(finished.stdout.contains(part), "no {part:?}: {finished}");
    }
    let widest = finished.stdout.lines().map(|line| line.chars().count()).max();
    assert!(widest <= Some(80), "{widest:?}: {finished}");
    assert!(folder.run("figures misses r --format svg").is_success());
    let svg = String::from_utf8(folder.bytes("figures/misses-random-n20-s1.svg")).expect("text");
    assert!(svg.contains("Crosses mark the devices that actions failed."));
}

/// Runs a command line in a shell, with the program of this build in the path.
fn run_in_shell(folder: &TestFolder, command: &str) -> String {
    let program_folder = reveille().parent().expect("a folder");
    let path = format!(
        "{}:{}",
        program_folder.display(),
        std::env::var("PATH").expect("a path")
    );
    let output = Command::new("sh")
        .args(["-c", command])
        .env("PATH", path)
        .current_dir(folder.path())
        .output()
        .expect("a shell");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "{command}: {}", text(&output.stderr));
    text(&output.stdout)
}

/// Runs `command`, which must have the results that `trial` reports.
fn assert_repeats(folder: &TestFolder, command: &str, trial: &Value) {
    let repeated: Value = serde_json::from_str(&run_in_shell(folder, command)).expect("a summary");
    for (key, metric) in [
        ("missed_pct", "misdetection_pct"),
        ("energy_per_device_tti", "energy_per_device_tti"),
        ("info_p1", "info_p1"),
    ] {
        assert_eq!(repeated["metrics"][metric], trial[key], "{command}: {metric}");
    }
}

#[test]
fn suggested_values_are_tried_and_the_best_command_repeats_its_result() {
    let folder = TestFolder::new();
    folder.write("a.txt", "800 fail 0-4\n1500 revive 0-4\n1600 energy all 1\n");
    for (out, options) in [
        ("a", "-n 20 --policy knn"),
        ("b", "-n 20 --policy random --actions a.txt"),
        ("c", "-n 20 --policy random --set radio.uplink_loss=0.9"),
        ("f", "-n 50 --policy knn --set harvest.e_b=2"),
        ("d", "-n 50 --policy adjusted --set harvest.e_b=20"),
        ("e e", "-n 6 --policy age-index --actions a.txt"),
    ] {
        let mut command = folder.command(&format!("run --quiet -k 2000 {options}"));
        assert!(Process::start(command.args(["--out", out])).finish().is_success());
        let try_changes = |json: &[&str]| {
            let mut command = folder.command("inspect misses --try");
            let finished = Process::start(command.args(json).arg(out)).finish();
            assert!(finished.is_success(), "{finished}");
            finished
        };
        let finished = try_changes(&["--json"]);
        let report: Value = serde_json::from_str(&finished.stdout).expect("a report is JSON");
        let tried = &report["tried"];
        // The unchanged run is the run itself.
        assert_eq!(tried["unchanged"]["missed_pct"], report["missed_pct"], "{tried}");
        let trials = tried["trials"].as_array().expect("a list");
        let missed_pct = |trial: &Value| trial["missed_pct"].as_f64().expect("a number");
        assert!(!trials.is_empty() && trials.is_sorted_by_key(missed_pct), "{tried}");
        assert!(
            missed_pct(&trials[0]) < missed_pct(&tried["unchanged"]),
            "no change helps: {tried}"
        );
        assert_trials_are_suggested(&report);

        let finished = try_changes(&[]);
        let best_command = tried["best_command"].as_str().expect("a command");
        assert!(
            finished
                .stdout
                .contains(&format!("\nFewest missed events:\n  {best_command}\n"))
                && finished.stdout.contains(" (unchanged)\n"),
            "{finished}"
        );
        // Settings of the base station need no other hardware.
        let is_setting = |trial: &&Value| {
            let changes = trial["changes"].as_object().expect("an object");
            changes.keys().all(|field| field.starts_with("policy."))
        };
        let best_setting = trials.iter().find(is_setting);
        let best_setting = best_setting.filter(|trial| missed_pct(trial) < missed_pct(&tried["unchanged"]));
        let command = tried["same_hardware_command"].as_str();
        assert_eq!(command.is_some(), best_setting.is_some(), "{tried}");
        for (field, value) in best_setting
            .iter()
            .flat_map(|trial| trial["changes"].as_object().expect("an object"))
        {
            let change = format!("{field}={}", value.as_str().expect("text"));
            assert!(command.is_some_and(|command| command.contains(&change)), "{tried}");
        }
        let line = "\nFewest missed events with the same hardware:\n  ";
        let other_command = command.filter(|command| *command != best_command);
        assert_eq!(
            finished.stdout.contains(line),
            other_command.is_some_and(|command| finished.stdout.contains(&format!("{line}{command}\n"))),
            "{finished}"
        );
        assert!(out != "f" || other_command.is_some(), "{tried}");
        assert!(finished.stderr.contains(" of 2000 TTIs"), "{finished}");
        let repeated_command = format!("{best_command} --quiet --json --out best-{}", &out[..1]);
        assert_repeats(&folder, &repeated_command, &trials[0]);
        let best_row = format!("{:>8.2} ", missed_pct(&trials[0]));
        let first_row = finished
            .stdout
            .lines()
            .skip_while(|line| !line.starts_with("missed %"))
            .nth(1);
        assert!(first_row.is_some_and(|row| row.starts_with(&best_row)), "{finished}");
    }
}

/// Checks that every trial is a suggested change, or the combination of the best setting and the best other change.
fn assert_trials_are_suggested(report: &Value) {
    let tried = &report["tried"];
    let trials = tried["trials"].as_array().expect("a list");
    let missed_pct = |trial: &Value| trial["missed_pct"].as_f64().expect("a number");
    let suggested: Vec<&Value> = report["suggested_changes"]
        .as_array()
        .expect("a list")
        .iter()
        .flat_map(|trials| trials.as_array().expect("a list"))
        .collect();
    let find_best = |is_setting: bool| {
        let is_better = |trial: &&Value| missed_pct(trial) < missed_pct(&tried["unchanged"]);
        let mut changes = trials.iter().filter(is_better).map(|trial| &trial["changes"]);
        changes.find(|changes| {
            let mut fields = changes.as_object().expect("an object").keys();
            suggested.contains(changes) && fields.all(|field| field.starts_with("policy.") == is_setting)
        })
    };
    let combination = find_best(true).zip(find_best(false)).map(|(setting, other)| {
        let [mut all, other] = [setting, other].map(|changes| changes.as_object().expect("an object").clone());
        all.extend(other);
        Value::Object(all)
    });
    let changes = trials.iter().map(|trial| &trial["changes"]);
    let others = changes.filter(|changes| !suggested.contains(changes));
    assert!(others.eq(&combination), "{report}");
}

#[test]
fn suggestions_without_possible_values_are_not_tried() {
    let folder = TestFolder::new();
    // All devices are in the south-west.
    folder.write("p.csv", "x,y\n1,1\n2,2\n3,3\n4,4\n5,5\n6,6\n");
    let command = "run --quiet -n 6 -k 2000 --policy knn --set layout.kind=file --set layout.file=p.csv --out r";
    assert!(folder.run(command).is_success());
    let finished = folder.run("inspect misses r --try");
    for listed in ["\nNot tried:\n  - place ", " with layout.file\n  - devices=12: "] {
        assert!(finished.is_success() && finished.stdout.contains(listed), "{finished}");
    }
}

#[test]
fn a_table_that_was_cut_is_refused_with_its_line() {
    let folder = TestFolder::new();
    assert!(folder.run("run -s quick --quiet -k 500 --out r").is_success());
    let table = String::from_utf8(folder.bytes("r/events.csv")).expect("text");
    let whole_rows: Vec<&str> = table.lines().take(3).collect();
    let columns = whole_rows[0].split(',').count();
    folder.write("r/events.csv", &format!("{}\n7,1,2\n", whole_rows.join("\n")));
    let cause = format!("r/events.csv: line 4: 3 of {columns} columns; the file was cut or edited");
    for command in ["inspect misses r", "figures misses r"] {
        assert_refused(&folder.run(command), 1, &[&cause, "run the scenario again"]);
    }
    // A cut between two rows leaves a valid table, with fewer events than the summary.
    folder.write("r/events.csv", &format!("{}\n", whole_rows.join("\n")));
    let cause = "the table is truncated or changed";
    assert_refused(
        &folder.run("inspect misses r"),
        1,
        &["r: events.csv has ", "summary.json ", cause],
    );
}

#[test]
fn a_folder_with_only_a_broken_summary_is_refused_with_both_causes() {
    let folder = TestFolder::new();
    fs::create_dir(folder.join("r")).expect("created");
    folder.write("r/summary.json", "{\"digest\": ");
    assert_refused(
        &folder.run("inspect misses r"),
        1,
        &[
            "r: the folder holds no run",
            "no scenario.toml",
            "summary.json is not readable",
        ],
    );
}

#[test]
fn a_signal_ends_the_trials() {
    let folder = TestFolder::new();
    assert!(
        folder
            .run("run --quiet -n 20 -k 2000 --policy random --out r")
            .is_success()
    );
    let scenario = String::from_utf8(folder.bytes("r/scenario.toml")).expect("text");
    let long = scenario.replace("\nttis = 2000", "\nttis = 1000000000");
    assert_ne!(long, scenario);
    folder.write("r/scenario.toml", &long);
    let trials = folder.start("inspect misses r --try");
    trials.wait_for_stderr(" of 1000000000 TTIs");
    trials.signal(Signal::INT);
    let finished = trials.finish_within(Duration::from_secs(10));
    assert!(!finished.is_success() && finished.stdout.is_empty(), "{finished}");
}

#[test]
fn a_run_warns_if_its_harvest_does_not_pay_for_sleeping() {
    let folder = TestFolder::new();
    for (e_b, warns) in [("0.5", true), ("10", false)] {
        for command in ["run", "up -P 1"] {
            let finished = folder.run(&format!(
                "{command} --quiet -n 8 -k 300 --force --out o --set harvest.e_b={e_b}"
            ));
            let has_warning = finished.stderr.contains("WARN the harvest of")
                && finished.stderr.contains("does not pay for sleeping");
            assert!(finished.is_success() && has_warning == warns, "{command}: {finished}");
        }
    }
}
