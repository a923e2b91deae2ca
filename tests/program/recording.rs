//! Recordings (`--record`, `inspect record`) of runs in memory and over the bus, complete and truncated: `inspect
//! verify` reconstructs the digest, `tail` filters and `stats` counts as computed here, and `export` writes every
//! message. JSON keys are from `view/src/frame_line.rs` and `deploy/src/commands/inspect/stats.rs`. `tests/recordings/`
//! reads recordings and exports with other programs.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::time::Duration;

use reveille_tests::process::{SummaryJson, TestFolder, assert_refused, free_endpoint, unique_run};
use rustix::process::Signal;
use serde_json::Value;

/// Returns the messages that `tail --json` shows for a recording; `args` begins with its file.
fn shown_messages(folder: &TestFolder, args: &str) -> Vec<Value> {
    let finished = folder.run(&format!("inspect tail --json {args}"));
    assert!(finished.is_success(), "{finished}");
    finished
        .stdout
        .lines()
        .map(|line| serde_json::from_str(line).expect("JSON"))
        .collect()
}

/// Counts the messages that `tail` shows for a truncated recording, and checks that it fails.
fn count_in_truncated(folder: &TestFolder, file: &str) -> usize {
    let finished = folder.run(&format!("inspect tail --json {file}"));
    assert_eq!(finished.code(), Some(1), "{finished}");
    finished.stdout.lines().count()
}

/// In this run sums of squares exceed 64 bits.
#[test]
fn a_long_run_is_verified() {
    let folder = TestFolder::new();
    let finished = folder.run("run -p knn -n 50 -k 10000 --record r.mcap --quiet --out o");
    assert!(finished.is_success(), "{finished}");
    let finished = folder.run("inspect verify r.mcap");
    assert!(
        finished.is_success() && finished.stdout.contains("TTIs 0 to 9999"),
        "{finished}"
    );
}

#[test]
fn memory_and_bus_record_the_same_messages() {
    assert_same_recordings("-p knn -n 20 -k 400 --set events.alpha=0.4 --record-states 60 --quiet");
    // Also with radio faults: the recordings contain lost messages too.
    assert_same_recordings(
        "-p knn -n 20 -k 400 --set events.alpha=0.4 --record-states 60 --quiet --set radio.wake_miss=0.2 \
         --set radio.uplink_loss=0.3 --set radio.false_wake_up=0.02 --set radio.plan_loss=0.3 \
         --set radio.wake_latency=1 --set bs.sync_interval=50",
    );
}

#[test]
fn states_are_recorded_at_equal_intervals_also_in_long_grants() {
    let folder = TestFolder::new();
    // Few events, so that grants are longer than the interval.
    let options = "-p age-index -n 20 -k 300 --set events.alpha=0.01 --record-states 7 --quiet";
    let expected: Vec<u64> = (0..300).step_by(7).collect();
    for (file, command) in [("memory.mcap", "run"), ("bus.mcap", "up -P 2")] {
        let finished = folder.run(&format!("{command} {options} --record {file}"));
        assert!(finished.is_success(), "{finished}");
        let states = shown_messages(&folder, &format!("--kind states {file}"));
        let ttis: Vec<u64> = states.iter().filter_map(|message| message["tti"].as_u64()).collect();
        assert_eq!(ttis, expected, "{command}");
    }
}

/// Checks that `run` and `up` with these options record the same `air` and `truth` messages, and that their recordings
/// can be verified. The options contain `--quiet`, so that the output is the digest.
fn assert_same_recordings(options: &str) {
    let folder = TestFolder::new();
    let mut printed_digests = Vec::new();
    for (name, command) in [
        ("memory", "run"),
        ("bus", "up -P 3"),
        ("one-process", "up -P 0 --no-lookahead"),
    ] {
        let finished = folder.run(&format!("{command} {options} --record {name}.mcap --out {name}"));
        assert!(finished.is_success(), "{finished}");
        printed_digests.push(finished.stdout);
        let finished = folder.run(&format!("inspect verify {name}.mcap"));
        assert!(
            finished.is_success() && finished.stdout.contains("as in the summary"),
            "{finished}"
        );
    }
    assert!(printed_digests.windows(2).all(|pair| pair[0] == pair[1]));
    for plane in ["air", "truth"] {
        let shown = |name: &str| shown_messages(&folder, &format!("{name}.mcap --plane {plane}"));
        let [memory, bus] = ["memory", "bus"].map(shown);
        assert!(
            memory == bus && memory.len() > 20,
            "{plane}: {} and {}",
            memory.len(),
            bus.len()
        );
    }
    // The last exchange of a run over the bus is no TTI.
    for name in ["memory", "bus", "one-process"] {
        let stats: Value =
            serde_json::from_str(&folder.run(&format!("inspect stats {name}.mcap --json")).stdout).expect("JSON");
        assert_eq!(
            stats["ttis"],
            SummaryJson::read(&folder.join(name)).number("ttis_done"),
            "{name}"
        );
    }
    let without_lookahead = shown_messages(&folder, "one-process.mcap --plane air");
    assert!(
        without_lookahead == shown_messages(&folder, "memory.mcap --plane air"),
        "the messages differ with and without lookahead"
    );
    assert!(shown_messages(&folder, "memory.mcap --plane emu").is_empty());
    assert!(shown_messages(&folder, "bus.mcap --kind clock").len() > 20);
}

#[test]
fn tail_filters_messages_and_pairs_wake_ups() {
    let folder = TestFolder::new();
    let finished = folder
        .run("run -p knn -n 60 -k 600 --set events.alpha=0.5 --set harvest.e_b=3 --record r.mcap --quiet --out o");
    assert!(finished.is_success(), "{finished}");
    let all_messages = shown_messages(&folder, "r.mcap");
    let assert_filtered = |args: &str, passes: &dyn Fn(&Value) -> bool| {
        let expected: Vec<Value> = all_messages.iter().filter(|line| passes(line)).cloned().collect();
        assert!(
            !expected.is_empty() && shown_messages(&folder, &format!("r.mcap {args}")) == expected,
            "{args}"
        );
    };
    let tti = |line: &Value| line["tti"].as_u64().expect("a TTI");
    assert_filtered("--since 100 --until 199", &|line| (100..200).contains(&tti(line)));
    assert_filtered("--kind report", &|line| line["kind"] == "report");
    let reporter = all_messages
        .iter()
        .find(|line| line["kind"] == "report")
        .expect("a report")["number"]
        .clone();
    assert_filtered(&format!("--kind report --device {reporter}"), &|line| {
        line["kind"] == "report" && line["number"] == reporter
    });
    assert_eq!(shown_messages(&folder, "r.mcap -c 7"), all_messages[..7]);
    let wake_up_count = all_messages.iter().filter(|line| line["kind"] == "wake").count();
    let paired = shown_messages(&folder, "r.mcap --pair-wake-ups --kind wake");
    assert_eq!(paired.len(), wake_up_count);
    assert!(paired.iter().all(|line| !line["message"]["outcome"].is_null()));
    // Without radio faults, exactly the unpowered devices do not receive wake-ups. A line of kind `woken` has the
    // outcome.
    let is_missed_wake_up = |line: &&Value| line["kind"] == "woken" && line["message"]["outcome"] == "Missed";
    let unpowered = shown_messages(&folder, "r.mcap --state unpowered --kind wake");
    assert_eq!(unpowered.len(), all_messages.iter().filter(is_missed_wake_up).count());
    // A device that is woken was asleep before, and its line shows the outcome.
    assert_eq!(
        shown_messages(&folder, "r.mcap --pair-wake-ups --state S4 --kind wake"),
        paired
    );
    // Every device is in exactly one cluster, so all clusters together have all reports. The refusal counts them.
    let refusal = folder.run("inspect tail r.mcap --cluster 999");
    assert_refused(&refusal, 1, &["--cluster 999", "clusters, 0 to"]);
    let cluster_count: usize = refusal
        .stderr
        .split("the run has ")
        .nth(1)
        .and_then(|from_count| from_count.split(' ').next()?.parse().ok())
        .expect("a number");
    let reports_in =
        |cluster: usize| shown_messages(&folder, &format!("r.mcap --kind report --cluster {cluster}")).len();
    let report_count = all_messages.iter().filter(|line| line["kind"] == "report").count();
    assert_eq!((0..cluster_count).map(reports_in).sum::<usize>(), report_count);
}

#[test]
fn statistics_equal_the_summary() {
    let folder = TestFolder::new();
    // Statistics count all TTIs, totals of a summary only TTIs after the warm-up.
    let finished = folder.run("run -p age-index -n 40 -k 500 --set warm_up=0 --record r.mcap --json --out o");
    let summary: Value = serde_json::from_str(&finished.stdout).unwrap_or_else(|_| panic!("{finished}"));
    let finished = folder.run("inspect stats r.mcap --json --devices");
    let stats: Value = serde_json::from_str(&finished.stdout).expect("JSON");
    assert_eq!(stats["control"], summary["totals"]["control"], "{stats}");
    assert_eq!(stats["uplink"], summary["totals"]["uplink"]);
    assert_eq!(stats["ttis"], 500);
    let reports: u64 = stats["devices"]
        .as_array()
        .expect("devices")
        .iter()
        .filter_map(|device| device["kinds"]["report"]["messages"].as_u64())
        .sum();
    assert_eq!(Some(reports), stats["uplink"]["messages"].as_u64());
    let text = folder.run("inspect stats r.mcap").stdout;
    assert!(text.contains("40 devices") && text.contains("control: "), "{text}");
}

#[test]
fn a_killed_run_leaves_a_readable_recording() {
    let (folder, run) = (TestFolder::new(), unique_run("truncated"));
    let up = folder.start(&format!(
        "up -P 1 -n 30 -k 100000 --run {run} --record r.mcap --quiet --out o"
    ));
    // Late enough for complete chunks of the recording on disk.
    folder.wait_for_tti(&run, 3000);
    up.signal(Signal::KILL);
    up.finish();
    let finished = folder.run("inspect verify r.mcap");
    assert_eq!(finished.code(), Some(1), "{finished}");
    assert!(
        finished.stdout.ends_with("are consistent up to the cut\n") && finished.stderr.contains("truncated"),
        "{finished}"
    );
    let finished = folder.run("inspect tail r.mcap --kind event -c 5");
    assert!(
        finished.is_success() && finished.stdout.lines().count() == 5,
        "{finished}"
    );
    // Ctrl-C ends a run, and its recording is complete up to that point.
    let up = folder.start(&format!(
        "up -P 1 -n 30 -k 100000 --run {run} --record c.mcap --quiet --out p"
    ));
    folder.wait_for_tti(&run, 1000);
    up.signal(Signal::INT);
    assert_eq!(up.finish().code(), Some(130));
    let finished = folder.run("inspect verify c.mcap");
    assert!(
        finished.is_success() && finished.stdout.contains("as in the summary"),
        "{finished}"
    );
}

#[test]
fn invalid_recordings_are_refused() {
    let folder = TestFolder::new();
    assert!(
        folder
            .run("run -n 10 -k 200 --record r.mcap --quiet --out o")
            .is_success()
    );
    let second = folder.run("run -n 10 -k 200 --record r.mcap --quiet --out p");
    assert_refused(&second, 1, &["--record r.mcap", "file exists"]);
    assert_refused(&folder.run("run -n 10 --record-states 5 --quiet"), 2, &["--record"]);
    assert_refused(
        &folder.run("run -n 10 --record nowhere/r.mcap --quiet --out q"),
        1,
        &["nowhere/r.mcap"],
    );
    // The run creates its folder, and no other one.
    let inside = folder.run("run -n 10 -k 200 --record in/r.mcap --quiet --out in");
    assert!(inside.is_success(), "{inside}");
    let stats = |file: &str| folder.run(&format!("inspect stats {file} --json")).stdout;
    assert_eq!(stats("in"), stats("in/r.mcap"));
    let again = folder.run("run -n 10 -k 200 --record in/r.mcap --quiet --out in --force");
    assert_eq!(again.stdout, inside.stdout, "{again}");
    folder.write("text.mcap", "a text");
    folder.write("empty.mcap", "");
    let bytes = folder.bytes("r.mcap");
    fs::write(folder.join("cut.mcap"), &bytes[..bytes.len() / 3]).expect("written");
    for command in ["tail", "stats", "verify", "export --to csv"] {
        for file in ["text.mcap", "empty.mcap", "none.mcap", "o"] {
            assert_refused(&folder.run(&format!("inspect {command} {file}")), 1, &[file]);
        }
        // The messages before the truncation are shown.
        let finished = folder.run(&format!("inspect {command} cut.mcap"));
        assert!(
            finished.code() == Some(1) && finished.stderr.contains("cut.mcap: the recording is truncated"),
            "{finished}"
        );
    }
    // The loop has exported `cut.mcap` to `cut.csv`. The readable part is exported in full. An existing file is
    // replaced only when the new one is complete.
    let rows = String::from_utf8_lossy(&folder.bytes("cut.csv")).lines().count();
    assert_eq!(rows, 1 + count_in_truncated(&folder, "cut.mcap"));
    let finished = folder.run("inspect export r.mcap --to csv --out r.mcap --force");
    assert_refused(&finished, 1, &["r.mcap: is the recording itself"]);
    assert_eq!(folder.bytes("r.mcap"), bytes);
    let finished = folder.run("inspect export text.mcap --to csv --out cut.csv --force");
    assert_refused(&finished, 1, &["text.mcap"]);
    assert!(folder.join("cut.csv").exists() && !folder.join("cut.csv.part").exists());
    assert!(!folder.join("runs").exists(), "a refusal leaves no folder");
    assert_refused(
        &folder.run("inspect tail r.mcap --device 10"),
        1,
        &["--device 10", "0 to 9"],
    );
    assert_refused(&folder.run("inspect tail r.mcap --state S5"), 2, &["S5", "unpowered"]);
    let random = folder.run("run -p random -n 10 -k 100 --record q.mcap --quiet --out z");
    assert!(random.is_success(), "{random}");
    assert_refused(
        &folder.run("inspect tail q.mcap --cluster 0"),
        1,
        &["random", "no clusters"],
    );
}

#[test]
fn observers_that_join_early_and_late_record_the_same_run() {
    let (folder, run) = (TestFolder::new(), unique_run("observed"));
    let up = folder.start(&format!("up -P 1 -n 20 -k 300 --paused --run {run} --quiet --out o"));
    folder.wait_for_tti(&run, 0);
    let start_recorder = |file: &str| {
        let record = folder.start(&format!("inspect record {file} --run {run}"));
        record.wait_for_stderr("connected to run");
        // Lets the subscriptions of the observer reach the base station.
        std::thread::sleep(Duration::from_millis(500));
        record
    };
    // The second observer computes the state before it joined from the scenario.
    let early = start_recorder("early.mcap");
    folder.clock(&run, "run-to 137 --wait");
    let late = start_recorder("late.mcap");
    folder.clock(&run, "resume");
    let finished = up.finish();
    assert!(finished.is_success(), "{finished}");
    let digest = folder.run("run -n 20 -k 300 --quiet --out p").stdout;
    let digest = digest.trim().trim_start_matches("digest ").to_owned();
    for (record, file) in [(early, "early.mcap"), (late, "late.mcap")] {
        let record = record.finish();
        assert!(record.is_success() && record.stderr.contains("recorded "), "{record}");
        let finished = folder.run(&format!("inspect verify {file}"));
        assert!(finished.stdout.contains(&digest), "{finished}");
        assert_refused(&finished, 1, &["no summary"]);
    }
    assert!(shown_messages(&folder, "late.mcap --plane air") == shown_messages(&folder, "early.mcap --plane air"));
}

#[test]
fn tail_names_the_duty_cycle_of_its_device_in_each_plan() {
    let folder = TestFolder::new();
    let finished = folder.run("run -p random -n 30 -k 400 --record r.mcap --quiet --out o");
    assert!(finished.is_success(), "{finished}");
    let plans = shown_messages(&folder, "r.mcap --kind plan --device 10");
    let text = folder.run("inspect tail r.mcap --kind plan --device 10").stdout;
    assert!(!plans.is_empty() && text.lines().count() == plans.len(), "{text}");
    for (plan, line) in plans.iter().zip(text.lines()) {
        let cycle = &plan["message"]["plan"]["Periodic"][10];
        let field = |name: &str| cycle[name].as_u64().expect("a number");
        let (on, ttis, offset) = (field("t_on"), field("t_drx"), field("offset"));
        let from = plan["message"]["from"].as_u64().expect("a TTI");
        let next = (from..from + ttis)
            .find(|k| (k + offset) % ttis < on)
            .expect("a TTI in S1");
        let end = format!("; device 10 senses in {on} of every {ttis} TTIs, next in TTI {next}");
        assert!(line.ends_with(&end), "{line}: {end}");
    }
}

#[test]
fn an_observer_records_the_whole_run_of_a_base_station_that_was_frozen() {
    let (folder, run) = (TestFolder::new(), unique_run("frozen"));
    let up = folder.start(&format!(
        "up -P 1 -n 20 -k 2000 --pace 2ms --paused --run {run} --quiet --out o"
    ));
    folder.wait_for_tti(&run, 0);
    let record = folder.start(&format!("inspect record r.mcap --run {run}"));
    record.wait_for_stderr("connected to run");
    folder.clock(&run, "resume");
    folder.wait_for_tti(&run, 100);
    up.signal(Signal::STOP);
    // Comes after the lease of the connection.
    record.wait_for_stderr("has left the bus");
    up.signal(Signal::CONT);
    record.wait_for_stderr("is back");
    let (up, record) = (up.finish(), record.finish());
    assert!(up.is_success(), "{up}");
    assert!(record.is_success(), "{record}");
    let digest = folder.run("run -n 20 -k 2000 --quiet --record p.mcap --out p").stdout;
    let digest = digest.trim().trim_start_matches("digest ").to_owned();
    assert_eq!(digest.len(), 64, "{digest}");
    let finished = folder.run("inspect verify r.mcap");
    assert!(finished.stdout.contains(&digest), "{finished}");
    assert!(shown_messages(&folder, "r.mcap --plane air") == shown_messages(&folder, "p.mcap --plane air"));
}

#[test]
fn an_observer_tells_another_run_of_the_same_name_from_the_first() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("other"), free_endpoint());
    let up = |out: &str| {
        let options = "-P 1 -n 10 -k 1000000 --pace 5ms --quiet";
        folder.start(&format!("up {options} --run {run} --listen {endpoint} --out {out}"))
    };
    let first = up("first");
    folder.wait_for_tti(&run, 1);
    let record = folder.start(&format!("inspect record r.mcap --run {run}"));
    record.wait_for_stderr("connected to run");
    first.signal(Signal::KILL);
    record.wait_for_stderr("has left the bus");
    let second = up("second");
    let record = record.finish();
    let names_other_run = record.stderr.contains(&format!("another run called {run} answers now"));
    assert!(record.code() == Some(1) && names_other_run, "{record}");
    second.signal(Signal::INT);
    second.finish();
}

/// Reads a CSV table: for each row the cells by column.
fn read_table(folder: &TestFolder, name: &str) -> Vec<BTreeMap<String, String>> {
    let text = String::from_utf8(folder.bytes(name)).expect("text");
    let mut lines = text.lines().map(|line| line.split(',').map(str::to_owned));
    let columns: Vec<String> = lines.next().expect("a header").collect();
    lines
        .map(|cells| columns.iter().cloned().zip(cells).collect())
        .collect()
}

#[test]
fn the_table_of_devices_agrees_with_the_tables_of_the_run() {
    const SUMS: [&str; 5] = [
        "sensing_units",
        "sleep_units",
        "report_units",
        "harvested_units",
        "overflow_units",
    ];
    const MEANS: [&str; 5] = [
        "energy_sensing_per_device_tti",
        "energy_sleep_per_device_tti",
        "energy_report_per_device_tti",
        "harvested_per_device_tti",
        "overflow_per_device_tti",
    ];
    let folder = TestFolder::new();
    folder.write("script", "150 fail 3-5 for 200\n400 energy all 2.5\n420 fail 0\n");
    let scenario = "-n 20 -k 600 -p knn --set harvest.lambda=0.05 --set radio.false_wake_up=0.01";
    for command in ["run", "up -P 2"] {
        let options = "--actions script --record o/r.mcap --out o --force --quiet";
        let finished = folder.run(&format!("{command} {scenario} {options}"));
        assert!(finished.is_success(), "{finished}");
        let finished = folder.run("inspect export o --to devices --every 1 --force");
        assert!(finished.is_success(), "{finished}");
        let rows = read_table(&folder, "o/r.devices.csv");
        assert_eq!(rows.len(), 20 * 600);
        let number = |row: &BTreeMap<String, String>, column: &str| -> f64 { row[column].parse().expect(column) };
        // The tables over the measured TTIs, which begin with TTI 60.
        for (device, row) in read_table(&folder, "o/devices.csv").iter().enumerate() {
            let [before, last] = [59, 599].map(|tti| &rows[20 * tti + device]);
            assert_eq!((&last["tti"][..], &last["device"]), ("599", &row["device"]));
            assert_eq!(last["battery_units"], row["final_battery"]);
            assert_eq!(before["battery_units"], row["start_battery"]);
            for column in SUMS {
                let difference = number(last, column) - number(before, column);
                assert!(
                    (difference - number(row, column)).abs() < 1e-6,
                    "{column} of device {device}"
                );
            }
        }
        let (mut checked, total) = (0, |tti: i64, column: &str| -> f64 {
            // Nothing is spent before TTI 0.
            usize::try_from(tti).map_or(0.0, |tti| {
                rows[20 * tti..20 * (tti + 1)]
                    .iter()
                    .map(|row| number(row, column))
                    .sum()
            })
        });
        for window in read_table(&folder, "o/windows.csv") {
            let [first, end] = ["first_tti", "end_tti"].map(|column| number(&window, column) as i64);
            let device_ttis = 20.0 * (end - first) as f64;
            let battery: f64 = (first..end).map(|tti| total(tti, "battery_units")).sum();
            assert!(
                (battery / device_ttis - number(&window, "mean_battery")).abs() < 1e-6,
                "{first}"
            );
            for (column, mean) in SUMS.into_iter().zip(MEANS) {
                let sum = total(end - 1, column) - total(first - 1, column);
                assert!(
                    (sum / device_ttis - number(&window, mean)).abs() < 1e-6,
                    "{mean} from {first}"
                );
            }
            checked += 1;
        }
        assert_eq!(checked, 100);
        let state_of = |row: &BTreeMap<String, String>| format!("{} {}", row["state"], row["powered"]);
        let states: BTreeSet<String> = rows.iter().map(state_of).collect();
        let expected = ["S1 1", "S3 1", "S4 0", "S4 1", "failed 0"].map(str::to_owned);
        assert_eq!(states, BTreeSet::from(expected));
        let failed = rows.iter().filter(|row| row["state"] == "failed").count();
        assert_eq!(failed, 3 * 200 + 180);
    }
    // By default a hundredth of the run, and always the last TTI.
    let exported = |options: &str| {
        let finished = folder.run(&format!("inspect export o --to devices {options} --force"));
        assert!(finished.is_success(), "{finished}");
        let rows = read_table(&folder, "o/r.devices.csv");
        rows.iter()
            .step_by(20)
            .map(|row| row["tti"].parse().expect("a TTI"))
            .collect::<Vec<u64>>()
    };
    assert_eq!(exported(""), (5..600).step_by(6).collect::<Vec<_>>());
    assert_eq!(exported("--every 250"), [249, 499, 599]);
    // No row is later than --until, although a grant can end after it.
    for until in 100..110 {
        let ttis = exported(&format!("--every 1 --until {until}"));
        assert!(ttis.iter().all(|tti| *tti <= until), "--until {until}: {ttis:?}");
    }
}

#[test]
fn exports_contain_every_message() {
    let folder = TestFolder::new();
    assert!(
        folder
            .run("run -n 20 -k 300 --record r.mcap --quiet --out o")
            .is_success()
    );
    let messages = shown_messages(&folder, "r.mcap").len();
    for (format, ending) in [
        ("pcapng", "pcapng"),
        ("perfetto", "perfetto-trace"),
        ("csv", "csv"),
        ("parquet", "parquet"),
    ] {
        let finished = folder.run(&format!("inspect export r.mcap --to {format}"));
        assert!(
            finished.is_success() && finished.stderr.contains(&format!("{messages} messages")),
            "{finished}"
        );
        assert!(folder.bytes(&format!("r.{ending}")).len() > 1000);
        assert_refused(
            &folder.run(&format!("inspect export r.mcap --to {format}")),
            1,
            &["--force"],
        );
    }
    let finished = folder.run("inspect export --dissector d.lua");
    assert!(finished.is_success(), "{finished}");
    assert_refused(&folder.run("inspect export r.mcap"), 2, &["--to"]);
    for (name, format) in [("a.csv", "csv"), ("a.devices.csv", "devices"), ("a.pcapng", "pcapng")] {
        for out in [format!("--out {name}"), format!("--to {format} --out b-{name}")] {
            let finished = folder.run(&format!("inspect export r.mcap {out}"));
            assert!(finished.is_success(), "{finished}");
        }
        assert!(folder.bytes(name) == folder.bytes(&format!("b-{name}")), "{name}");
    }
    assert_refused(
        &folder.run("inspect export r.mcap --out a.txt"),
        2,
        &["a.txt", "pcapng", "--to"],
    );
    assert_refused(
        &folder.run("inspect export r.mcap --to perfetto --since 5 --force"),
        1,
        &["--since"],
    );
}
