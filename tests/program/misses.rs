//! `inspect misses` and `figures misses` on the folders of runs: their numbers equal an independent count of
//! `events.csv` and the totals of `summary.json`. One test removes the last columns of `events.csv` by their number, so
//! it depends on the order of `EVENT_COLUMNS` in `deploy/src/run_tables.rs`.

use std::collections::BTreeMap;

use reveille_tests::process::{TestFolder, assert_refused, unique_run};
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
        "\n  - lower radio.uplink_loss\n",
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
