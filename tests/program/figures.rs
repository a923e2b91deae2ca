//! The commands `figures`, `report` and `report search`: complete pictures and pages, the same bytes from the same
//! input, and refusals. `study/src/figures/` and `study/src/report/` test the contents.
//!
//! A new kind of figure, file or preset changes the numbers of files here, and a new picture of `docs/figures/make.sh`
//! the list of its test. New versions of result tables and learned tables change the texts with a version.

use std::fs;
use std::path::Path;
use std::process::Command;

use reveille_tests::process::{PATIENCE, Process, TestFolder, assert_refused, reveille};

/// Runs a small sweep of 16 runs, if `options` adds no grid, into the subfolder `name`.
fn run_sweep(folder: &TestFolder, name: &str, options: &str) {
    let finished = folder.run(&format!(
        "sweep --policies knn,adjusted,random,genie --devices 10,100 --seeds 2 --ttis 300 --quiet \
         --out {name} {options}"
    ));
    assert_eq!(finished.code(), Some(0), "{finished}");
}

/// Checks that the folders `a` and `b` hold the same file `name`: each test draws its pictures into both.
#[track_caller]
fn assert_same(folder: &TestFolder, name: &str) {
    let [a, b] = ["a", "b"].map(|out| folder.bytes(&format!("{out}/{name}")));
    assert!(a == b, "{name} differs");
}

#[test]
fn pictures_of_one_run_are_reproducible() {
    let folder = TestFolder::new();
    for out in ["a", "b"] {
        for picture in [
            "deployment -n 30 -k 500",
            "deployment -n 30 -k 500 --event none",
            "attention -n 30 -k 500 --tti 200 --show 3,4",
            "timeline -n 30 -k 500 --show 3,7 --from 100 --length 60",
        ] {
            let finished = folder.run(&format!("figures {picture} --out {out}"));
            assert_eq!(finished.code(), Some(0), "{finished}");
        }
    }
    let names = folder.list("a");
    // An SVG and a PNG file for each picture, and the table of the attention.
    assert_eq!(names.len(), 9, "{names:?}");
    for name in names {
        assert_same(&folder, &name);
    }
}

#[test]
fn invalid_figure_requests_are_refused() {
    let folder = TestFolder::new();
    let refused = |args: &str, parts: &[&str]| {
        assert_refused(&folder.run(&format!("figures {args} --out out")), 1, parts);
        assert!(!folder.join("out").exists(), "{args} left files");
    };
    refused(
        "deployment -k 100 --event 999",
        &["event 999", "events, numbered from 0", "--ttis"],
    );
    refused(
        "deployment -k 10 -n 2000",
        &["2000 devices", "at most 1000", "--devices"],
    );
    refused("attention --tti 99 -k 100", &["TTI 99", "must be at most 98"]);
    refused("attention -p knn", &["--policy knn", "for policy dt only"]);
    refused("attention --show 50", &["device 50", "numbered 0 to 49"]);
    refused(
        "attention --set policy.dt.model=shipped",
        &["no attention over time", "policy.dt.model=attention"],
    );
    refused("timeline -k 500 --show 50", &["device 50", "numbered 0 to 49"]);
    refused("timeline -k 500 --from 450 --length 100", &["450 to 549", "0 to 499"]);
    refused("timeline -k 500 --from 0 --length 5", &["10 to 2000"]);
    refused("timeline -k 500 --show 0,1,2,3,4,5,6,7,8", &["9 devices", "at most 8"]);
    refused("deployment -n 0", &["devices = 0"]);
    for (args, part) in [
        ("timeline --show -1", "a whole number from 0"),
        ("timeline --show 3,-1", "a whole number from 0"),
        ("timeline --from -1", "a whole number from 0"),
        ("deployment --event -1", "none or a whole number from 0"),
    ] {
        let finished = folder.run(&format!("figures {args} --out out"));
        assert_eq!(finished.code(), Some(2), "{finished}");
        assert!(
            finished.stderr.contains("'-1'") && finished.stderr.contains(part),
            "{finished}"
        );
    }
}

#[test]
fn files_that_are_not_result_tables_are_refused() {
    let folder = TestFolder::new();
    folder.write("junk.parquet", "PAR1 not a table PAR1");
    folder.write("junk.csv", "a,b\n1,2\n");
    for command in ["figures", "report"] {
        let refused = |args: &str, parts: &[&str]| {
            assert_refused(&folder.run(&format!("{command} {args} --out out")), 1, parts);
            assert!(!folder.join("out").exists(), "{command} {args} left files");
        };
        refused("nowhere.parquet", &["nowhere.parquet"]);
        refused("junk.parquet", &["junk.parquet"]);
        refused("junk.csv", &["junk.csv"]);
    }
    let finished = folder.run("figures junk.parquet --only energy,speed");
    assert_refused(
        &finished,
        2,
        &[
            "'speed' for '--only",
            "information, information-per-event, energy, misdetection",
            "harvest, net, pareto, delay, front",
        ],
    );
    let finished = folder.run("figures");
    assert_eq!(finished.code(), Some(2), "{finished}");
}

#[test]
fn pictures_of_learned_tables_are_reproducible() {
    let folder = TestFolder::new();
    let finished = folder.run("train q-learning --out mine.json -n 10,30 --episodes 2 --episode-ttis 300 --quiet");
    assert_eq!(finished.code(), Some(0), "{finished}");
    for out in ["a", "b"] {
        for picture in [
            "learning mine.json",
            "q-table mine.json -n 10,30",
            "q-table mine.json -n 10 --wake posterior",
            "q-table mine.json -n 10 --wake p42",
        ] {
            let finished = folder.run(&format!("figures {picture} --out {out}"));
            assert_eq!(finished.code(), Some(0), "{finished}");
        }
    }
    let names = folder.list("a");
    let stems = [
        "learning-mine",
        "q-table-mine-n10",
        "q-table-mine-n30",
        "q-table-mine-n10-wake-posterior",
        "q-table-mine-n10-wake-p42",
    ];
    for name in stems
        .iter()
        .flat_map(|stem| ["svg", "png", "csv"].map(|ending| format!("{stem}.{ending}")))
    {
        assert!(names.contains(&name), "{name} in {names:?}");
    }
    assert!(names.contains(&"q-table-mine-n10-value.csv".to_owned()));
    // The files of `stems`, and `-value.csv` for each number of devices.
    assert_eq!(names.len(), 17, "{names:?}");
    for name in names {
        assert_same(&folder, &name);
    }
}

#[test]
fn invalid_or_incomplete_learned_tables_are_refused() {
    let folder = TestFolder::new();
    let finished = folder.run("train q-learning --out mine.json -n 10,30 --episodes 1 --episode-ttis 100 --quiet");
    assert_eq!(finished.code(), Some(0), "{finished}");
    let text = String::from_utf8(folder.bytes("mine.json")).expect("text");
    // The version after `VERSION` in `bs/src/policy/q_learning/learned/file.rs`.
    folder.write("later.json", &text.replacen("\"version\":3", "\"version\":4", 1));
    folder.write("short.json", &text[..text.len() / 2]);
    folder.write("junk.json", "{\"rows\": []}");
    let refused = |args: &str, parts: &[&str]| {
        assert_refused(&folder.run(&format!("figures {args} --out out")), 1, parts);
        assert!(!folder.join("out").exists(), "{args} left files");
    };
    for command in ["learning", "q-table -n 10"] {
        refused(
            &format!("{command} junk.json"),
            &["junk.json: is not a file of learned tables"],
        );
        refused(
            &format!("{command} later.json"),
            &["later.json: has version 4", "reveille train q-learning"],
        );
        refused(&format!("{command} short.json"), &["short.json: is damaged"]);
        refused(&format!("{command} nowhere.json"), &["nowhere.json: no such file"]);
    }
    refused("learning mine.json junk.json", &["junk.json"]);
    refused(
        "q-table mine.json -n 10,50",
        &["N = 50: mine.json has tables for 10, 30 devices", "--devices 50"],
    );
    for (name, n) in [("shipped", 2500), ("shipped-paper-literal", 250)] {
        let finished = folder.run(&format!("figures q-table {name} -n {n} --format svg --out {name}"));
        assert_eq!(finished.code(), Some(0), "{finished}");
        assert_eq!(folder.list(name).len(), 3, "a picture and two CSV files");
    }
    for args in ["learning", "q-table mine.json", "q-table mine.json -n 10 --wake best"] {
        let finished = folder.run(&format!("figures {args}"));
        assert_eq!(finished.code(), Some(2), "{finished}");
    }
}

#[test]
fn figures_and_report_of_a_sweep_are_complete_and_figures_are_reproducible() {
    let folder = TestFolder::new();
    run_sweep(&folder, "paper", "--scenario paper");
    run_sweep(&folder, "literal", "--scenario paper-literal");
    let tables = "paper/results.parquet literal/results.parquet";
    for out in ["a", "b"] {
        let finished = folder.run(&format!(
            "figures {tables} --only misdetection,energy,net,pareto --out {out}"
        ));
        assert_eq!(finished.code(), Some(0), "{finished}");
    }
    let finished = folder.run("figures paper literal --only misdetection,energy,net,pareto --out c");
    assert_eq!(finished.code(), Some(0), "a folder stands for its table: {finished}");
    assert_eq!(folder.list("c"), folder.list("a"));
    let names = folder.list("a");
    for figure in ["misdetection", "energy", "net", "pareto"] {
        for preset in ["paper", "paper-literal"] {
            for ending in ["svg", "png", "csv"] {
                let name = format!("{figure}-{preset}.{ending}");
                assert!(names.contains(&name), "{name} in {names:?}");
            }
        }
    }
    assert_eq!(names.len(), 24, "{names:?}");
    for name in names {
        assert_same(&folder, &name);
    }
    for _ in 0..2 {
        let finished = folder.run(&format!("report {tables} --out report"));
        assert_eq!(finished.code(), Some(0), "{finished}");
    }
    let html = String::from_utf8(folder.bytes("report/report.html")).expect("text");
    assert_eq!(html.matches("<svg").count(), 24, "two presets with twelve figures each");
    // The page loads no files.
    assert!(!html.contains("src=") && html.contains("Not run and left out below") && html.contains("seeds 1 to 2"));
    let markdown = String::from_utf8(folder.bytes("report/report.md")).expect("text");
    for file in folder.list("report").iter().filter(|name| name.contains(".svg")) {
        assert!(markdown.contains(&format!("]({file})")), "{file} is not shown");
    }
}

#[test]
fn a_search_judges_every_condition_reproducibly() {
    let folder = TestFolder::new();
    run_sweep(&folder, "unstated", "--grid events.alpha=0.1,0.2,0.4");
    run_sweep(&folder, "literal", "--scenario paper-literal");
    let search = |out: &str| {
        let finished = folder.run(&format!("report search unstated literal --top 1 --out {out}"));
        assert_eq!(finished.code(), Some(0), "{finished}");
        finished.stdout
    };
    let ranking = search("a");
    assert!(
        // Three values of the grid and one preset, with the 16 runs of `run_sweep` each.
        ranking.contains("4 conditions, 64 runs") && ranking.contains("events.alpha"),
        "{ranking}"
    );
    assert_eq!(
        ranking.replace("a/search.md", ""),
        search("b").replace("b/search.md", "")
    );
    let pages = ["a", "b"].map(|out| String::from_utf8(folder.bytes(&format!("{out}/search.md"))).expect("text"));
    assert_eq!(pages[0].replace("--out a", ""), pages[1].replace("--out b", ""));
    for part in [
        "| paper |",
        "| paper-literal |",
        "## Claims that no condition meets",
        "## Claim by claim",
    ] {
        assert!(pages[0].contains(part), "{part}");
    }
    folder.write(
        "page.md",
        "Ours.\n<!-- report search-settings -->\n<!-- /report search-settings -->\nThe end.\n",
    );
    folder.write("bare.md", "Ours.\n");
    let finished = folder.run("report search unstated literal --out a --page page.md");
    assert_eq!(finished.code(), Some(0), "{finished}");
    let page = String::from_utf8(folder.bytes("page.md")).expect("text");
    assert!(
        page.starts_with("Ours.\n") && page.ends_with("The end.\n") && page.contains("| paper |"),
        "{page}"
    );
    let finished = folder.run("report search unstated literal --out a --page bare.md");
    assert_refused(&finished, 1, &["bare.md", "<!-- report NAME -->", "search-settings"]);
    let finished = folder.run("report search unstated --top 0");
    assert_eq!(finished.code(), Some(2), "{finished}");
    assert_refused(&folder.run("report search nowhere --out c"), 1, &["nowhere"]);
    assert!(!folder.join("c").exists());
}

#[test]
fn a_user_sweep_is_drawn_against_its_field() {
    let folder = TestFolder::new();
    run_sweep(&folder, "mine", "--grid harvest.lambda=0.05,0.1");
    for out in ["a", "b"] {
        let finished = folder.run(&format!(
            "figures sweep mine --x harvest.lambda --y energy_per_device_tti --log x --out {out}"
        ));
        assert_eq!(finished.code(), Some(0), "{finished}");
        assert!(
            finished.stderr.contains("also differ in devices: 2 figures"),
            "{finished}"
        );
    }
    let names = folder.list("a");
    // SVG, PNG and CSV for each of the two numbers of devices.
    assert_eq!(names.len(), 6, "{names:?}");
    assert!(names.contains(&"sweep-energy_per_device_tti-harvest.lambda-devices-10.svg".to_owned()));
    for name in names {
        assert_same(&folder, &name);
    }
    let finished = folder
        .run("figures sweep mine --x harvest.lambda --where devices=10 --y info_p1,mean_battery --format svg --out e");
    assert_eq!(finished.code(), Some(0), "{finished}");
    let [battery, information] = ["mean_battery", "info_p1"].map(|metric| format!("sweep-{metric}-harvest.lambda.svg"));
    let names = folder.list("e");
    assert!(
        names.len() == 4 && names.contains(&battery) && names.contains(&information),
        "{names:?}"
    );
    // Without `sweep`, the field has figures of two metrics, for each N. The paper's figures of the preset's own value
    // are drawn only with --only.
    let finished = folder.run("figures mine --format svg --out d");
    assert_eq!(finished.code(), Some(0), "{finished}");
    let names = folder.list("d");
    for metric in ["info_p1", "energy_per_device_tti"] {
        for n in [10, 100] {
            let name = format!("sweep-{metric}-harvest.lambda-devices-{n}.svg");
            assert!(names.contains(&name), "{name}: {names:?}");
        }
    }
    assert_eq!(
        names.iter().filter(|name| name.starts_with("sweep-")).count(),
        8,
        "{names:?}"
    );
    let is_swept = |name: &String| name.starts_with("sweep-") || name.starts_with("front-");
    assert!(names.iter().all(is_swept), "{names:?}");
    assert!(finished.stderr.contains("choose some with --only"), "{finished}");
    let finished = folder.run("figures mine --only information --format svg --out f");
    assert_eq!(finished.code(), Some(0), "{finished}");
    let names = folder.list("f");
    assert!(
        names.len() == 6 && names.contains(&"information-paper-harvest.lambda-0.1.svg".to_owned()),
        "{names:?}"
    );
    let refused = |args: &str, parts: &[&str]| {
        assert_refused(&folder.run(&format!("figures sweep mine {args} --out c")), 1, parts);
        assert!(!folder.join("c").exists(), "{args} left files");
    };
    refused("--x colour", &["`colour`", "devices, ttis, harvest.lambda"]);
    refused(
        "--x harvest.lamda",
        &["`harvest.lamda`", "did you mean `harvest.lambda`?"],
    );
    refused(
        "--x harvest.lambda --by device",
        &["`device`", "did you mean `devices`?"],
    );
    refused("--x harvest.lambda --where n=20", &["devices = 20", "10, 100"]);
    for (args, parts) in [
        ("--where devices", &["FIELD=VALUE"][..]),
        ("--y speed", &["'speed'", "info_p1"]),
        ("--y info", &["a similar value exists: 'info_p1'"]),
        ("--y info_p1,speed", &["'speed'", "info_p1"]),
    ] {
        let finished = folder.run(&format!("figures sweep mine --x harvest.lambda {args}"));
        assert_refused(&finished, 2, parts);
    }
}

#[test]
fn a_swept_text_has_a_line_for_each_value() {
    let folder = TestFolder::new();
    run_sweep(&folder, "mine", "--grid events.duration_kind=fixed,geometric");
    let finished = folder.run("figures mine --out a");
    assert_eq!(finished.code(), Some(0), "{finished}");
    let names = folder.list("a");
    // SVG, PNG and CSV of information and energy for each of four policies.
    assert_eq!(
        names.iter().filter(|name| name.starts_with("sweep-")).count(),
        24,
        "{names:?}"
    );
    assert!(!names.iter().any(|name| name.starts_with("information")), "{names:?}");
    let csv = String::from_utf8(folder.bytes("a/sweep-info_p1-devices-by-events.duration_kind-policy-knn.csv"))
        .expect("text");
    for value in ["fixed", "geometric"] {
        assert!(csv.contains(value), "{csv}");
    }
}

#[test]
fn a_picture_replaces_an_earlier_one() {
    let folder = TestFolder::new();
    let command = "figures timeline --devices 5 --ttis 300 --show 3 --length 50 --format svg --out out";
    assert_eq!(folder.run(command).code(), Some(0));
    let name = folder.list("out").pop().expect("a picture");
    let (picture, old_link) = (folder.join(&format!("out/{name}")), folder.join("before.svg"));
    fs::write(&picture, "before").expect("ours");
    // A file that is overwritten in place would change under its second name too.
    fs::hard_link(&picture, &old_link).expect("possible");
    assert_eq!(folder.run(command).code(), Some(0));
    assert_eq!(fs::read_to_string(&old_link).expect("there"), "before");
    assert_eq!(folder.list("out"), [name]);
}

#[test]
fn tables_with_equal_file_names_give_separate_pictures() {
    let folder = TestFolder::new();
    // Tables do not hold scenario files, so they cannot identify a field that names one.
    for (name, trace) in [("mine", "1\n3"), ("other", "2\n1")] {
        folder.write(&format!("{name}.csv"), &format!("a\n{trace}\n"));
        let harvest = format!("[harvest]\nkind = \"trace\"\ntrace = {{ file = \"{name}.csv\", column = \"a\" }}\n");
        folder.write(&format!("{name}.toml"), &harvest);
    }
    run_sweep(&folder, "a", "--scenario mine.toml");
    run_sweep(&folder, "b", "--scenario other.toml");
    let finished = folder.run("figures a/results.parquet b/results.parquet --only energy --out out");
    assert_eq!(finished.code(), Some(0), "{finished}");
    let names = folder.list("out");
    assert_eq!(names.len(), 6, "{names:?}");
    assert!(names.contains(&"energy-paper-b-results.svg".to_owned()), "{names:?}");
}

#[test]
fn a_report_without_runs_for_any_claim_prints_the_sweep_to_run() {
    let folder = TestFolder::new();
    for policies in ["age-index", "random,age-index"] {
        let finished = folder.run(&format!(
            "sweep -p {policies} -n 33 -k 300 --seeds 2 --quiet --out {policies}"
        ));
        assert!(finished.is_success(), "{finished}");
        let finished = folder.run(&format!("report {policies} --out report"));
        assert!(finished.is_success(), "{finished}");
        let markdown = String::from_utf8(folder.bytes("report/report.md")).expect("text");
        let (_, claims) = markdown
            .split_once("left out below: ")
            .expect("the claims without runs");
        let (count, _) = claims.split_once(" of ").expect("a count");
        let note = finished.stderr.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(
            note.contains(&format!(
                "the tables lack runs for all {count} claims of the paper; sweep"
            )),
            "{finished}"
        );
        assert!(
            markdown.contains("o claim could be judged.") && !markdown.contains("0 of 0 claims"),
            "{markdown}"
        );
    }
}

#[test]
fn a_report_needs_one_table_and_refuses_empty_and_newer_ones() {
    let folder = TestFolder::new();
    run_sweep(&folder, "paper", "--format csv --set events.alpha=0.3");
    let finished = folder.run("report paper/results.csv --out report");
    assert_eq!(finished.code(), Some(0), "{finished}");
    assert!(
        finished
            .stderr
            .contains("the tables hold no runs of preset paper-literal"),
        "{finished}"
    );
    let markdown = String::from_utf8(folder.bytes("report/report.md")).expect("text");
    assert!(
        markdown.contains("paper, events.alpha = 0.3, K = 300"),
        "a changed preset is not the preset"
    );

    let text = String::from_utf8(folder.bytes("paper/results.csv")).expect("text");
    let sidecar = String::from_utf8(folder.bytes("paper/results.csv.toml")).expect("text");
    let header = text.lines().next().expect("a header");
    folder.write("empty.csv", &format!("{header}\n"));
    let empty_sidecar: String = sidecar
        .lines()
        .map(|line| match line.split_once(" = ") {
            Some(("\"reveille.rows\"", _)) => "\"reveille.rows\" = \"0\"\n".to_owned(),
            Some(_) | None => format!("{line}\n"),
        })
        .collect();
    folder.write("empty.csv.toml", &empty_sidecar);
    folder.write("later.csv", &text);
    // The version after `TABLE_VERSION` in `lab/src/table/error.rs`.
    let later_sidecar = sidecar.replace("\"reveille.table\" = \"5\"", "\"reveille.table\" = \"6\"");
    assert_ne!(later_sidecar, sidecar);
    folder.write("later.csv.toml", &later_sidecar);
    for command in ["figures", "report"] {
        let finished = folder.run(&format!("{command} empty.csv --out out"));
        assert_refused(&finished, 1, &["empty.csv", "no runs to draw", "reveille sweep"]);
        let finished = folder.run(&format!("{command} paper/results.csv later.csv --out out"));
        assert_refused(&finished, 1, &["later.csv", "version 6"]);
        assert!(!folder.join("out").exists());
    }
}

#[test]
fn the_script_of_the_pages_draws_every_picture() {
    let folder = TestFolder::new();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/figures/make.sh");
    let mut command = Command::new("bash");
    command
        .arg(script)
        .arg(reveille())
        .arg(folder.join("pictures"))
        .args(["1000", "2"]);
    // The runs have 1000 TTIs, and each point 2 seeds. The script makes about three hundred runs, on machines that run
    // other tests at the same time.
    let finished = Process::start(&mut command).finish_within(PATIENCE * 5);
    assert_eq!(finished.code(), Some(0), "{finished}");
    for name in [
        "run",
        "result",
        "front",
        "attention",
        "target-info",
        "target-energy",
        "wake-latency",
    ] {
        let text = fs::read_to_string(folder.join(&format!("pictures/{name}.svg"))).expect("a picture");
        // The script adds a white background before the line `<defs>`, which `study/src/figures/svg.rs` writes.
        assert!(
            text.starts_with("<svg ") && text.contains("fill=\"#fff\"/>\n<defs>"),
            "{name}"
        );
    }
}

#[test]
fn a_table_with_an_impossible_value_is_refused() {
    let folder = TestFolder::new();
    run_sweep(&folder, "paper", "--format csv");
    let text = String::from_utf8(folder.bytes("paper/results.csv")).expect("text");
    let sidecar = folder.bytes("paper/results.csv.toml");
    let header: Vec<&str> = text.lines().next().expect("a header").split(',').collect();
    let column = header
        .iter()
        .position(|name| *name == "energy_per_device_tti")
        .expect("a metric");
    for value in ["1e300", "-2e15", "inf"] {
        let rows = text.lines().enumerate().map(|(row, line)| {
            let mut fields: Vec<&str> = line.split(',').collect();
            // The header is row 0.
            if row == 2 {
                fields[column] = value;
            }
            fields.join(",") + "\n"
        });
        folder.write("odd.csv", &rows.collect::<String>());
        fs::write(folder.join("odd.csv.toml"), &sidecar).expect("a side-car");
        for command in ["figures", "report", "merge"] {
            let finished = folder.run(&format!("{command} odd.csv --out odd-{command}.csv"));
            assert_refused(&finished, 1, &["odd.csv", "row 2", "energy_per_device_tti"]);
        }
    }
}
