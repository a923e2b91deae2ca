//! The command `train q-learning` and the use of its tables: the same bytes with any threads and after kills, no
//! overwriting without `--force`, and refusals of invalid files and options. The tests repeat the version, the JSON and
//! the checksum of `bs/src/policy/q_learning/learned/file.rs`. A checkpoint is written after every episode.

use std::fmt::Write as _;
use std::fs;
use std::time::Duration;

use reveille_tests::process::{PATIENCE, TestFolder, assert_refused, wait_until};
use rustix::process::Signal;
use sha2::{Digest, Sha256};

/// Options of a training of some seconds, with weights that have no exact decimal form.
const TRAINING: &str = "train q-learning --quiet --devices 8,15,30 --windows 1,3 --episodes 4 --episode-ttis 1500 \
    --set policy.q-learning.zeta=0.97 --set policy.q-learning.mu1=11.3 --set area.width=17.3";
/// Options of a training that takes hours.
const ENDLESS: &str = "train q-learning --quiet --devices 20 --episodes 100000 --episode-ttis 300";

/// Reads a file; empty if it does not exist, unlike [`TestFolder::bytes`].
fn bytes_or_empty(folder: &TestFolder, name: &str) -> Vec<u8> {
    fs::read(folder.join(name)).unwrap_or_default()
}

/// Trains tables for 10 and 50 devices minimally into `good.json`, and returns their text. They are valid for 5 to 100
/// devices.
fn train_minimal_tables(folder: &TestFolder) -> String {
    let args = "train q-learning --quiet --devices 10,50 --episodes 1 --episode-ttis 50 --out good.json";
    let finished = folder.run(args);
    assert!(finished.is_success(), "{finished}");
    fs::read_to_string(folder.join("good.json")).expect("a table")
}

#[test]
fn threads_and_kills_do_not_change_the_tables() {
    let folder = TestFolder::new();
    let finished = folder.run(&format!("{TRAINING} --threads 1 --out one.json"));
    assert!(finished.is_success(), "{finished}");
    let expected = bytes_or_empty(&folder, "one.json");
    assert!(expected.len() > 10_000);
    let finished = folder.run(&format!("{TRAINING} --threads 2 --out two.json"));
    assert!(finished.is_success(), "{finished}");
    assert!(bytes_or_empty(&folder, "two.json") == expected, "2 threads");

    let mut kills = 0;
    // Delays in ms, from 0 to about the length of an episode.
    for (threads, delay) in [(1, 3), (2, 21), (2, 60), (1, 37), (1, 0)] {
        let checkpoint_before = bytes_or_empty(&folder, "cut.json.checkpoint");
        let training = folder.start(&format!("{TRAINING} --threads {threads} --out cut.json"));
        let is_done = || folder.join("cut.json").exists();
        wait_until("an episode", PATIENCE, || {
            (is_done() || bytes_or_empty(&folder, "cut.json.checkpoint") != checkpoint_before).then_some(())
        });
        std::thread::sleep(Duration::from_millis(delay));
        training.signal(Signal::KILL);
        training.finish();
        if is_done() {
            break;
        }
        kills += 1;
    }
    // On a fast machine the training may end before the last kills.
    assert!(kills >= 3, "only {kills} kills");
    if !folder.join("cut.json").exists() {
        let finished = folder.run(
            &TRAINING
                .replace("--quiet ", "")
                .replace("q-learning ", "q-learning --out cut.json "),
        );
        assert!(finished.is_success(), "{finished}");
        assert!(
            finished
                .stderr
                .contains("resuming the training from the checkpoint cut.json.checkpoint: "),
            "{finished}"
        );
    }
    assert!(bytes_or_empty(&folder, "cut.json") == expected, "after kills");
    assert_eq!(folder.list("."), ["cut.json", "one.json", "runtime", "two.json"]);
}

#[test]
fn an_existing_file_is_replaced_only_with_force() {
    let folder = TestFolder::new();
    folder.write("mine.json", "mine");
    let args = "train q-learning --quiet --devices 5 --episodes 1 --episode-ttis 20 --out mine.json";
    assert_refused(&folder.run(args), 1, &["mine.json", "file exists", "--force"]);
    assert_eq!(bytes_or_empty(&folder, "mine.json"), b"mine");
    assert_eq!(folder.list("."), ["mine.json", "runtime"]);
    let finished = folder.run(&format!("{args} --force"));
    assert!(finished.is_success(), "{finished}");
    let with_tables = folder.run("run -n 6 -k 50 --policy q-learning --set policy.q-learning.table=mine.json --out r");
    assert!(with_tables.is_success(), "{with_tables}");
}

#[test]
fn an_interrupted_training_keeps_its_checkpoint() {
    let folder = TestFolder::new();
    for signal in [Signal::INT, Signal::TERM] {
        let checkpoint_before = bytes_or_empty(&folder, "t.json.checkpoint");
        let training = folder.start(&format!("{ENDLESS} --out t.json"));
        wait_until("an episode", PATIENCE, || {
            (bytes_or_empty(&folder, "t.json.checkpoint") != checkpoint_before).then_some(())
        });
        training.signal(signal);
        let finished = training.finish();
        assert_refused(
            &finished,
            130,
            &[
                "reveille: interrupted",
                "kept in t.json.checkpoint",
                "give the same command again",
            ],
        );
        assert_eq!(folder.list("."), ["runtime", "t.json.checkpoint"]);
    }
    let finished =
        folder.run("run -n 20 -k 60 --policy q-learning --set policy.q-learning.table=t.json.checkpoint --out r");
    assert_refused(&finished, 1, &["t.json.checkpoint", "unfinished"]);
    // Before the end of the first episode there is nothing to save.
    let training = folder.start(&format!(
        "{} --out u.json",
        ENDLESS.replace("-ttis 300", "-ttis 100000000")
    ));
    training.wait_for_handlers();
    training.signal(Signal::INT);
    assert_refused(&training.finish(), 130, &["interrupted before the first checkpoint"]);
    assert_eq!(folder.list("."), ["runtime", "t.json.checkpoint"]);
}

#[test]
fn the_checkpoint_of_another_training_is_refused() {
    let folder = TestFolder::new();
    let training = folder.start(&format!("{ENDLESS} --out t.json"));
    wait_until("an episode", PATIENCE, || {
        folder.join("t.json.checkpoint").exists().then_some(())
    });
    training.signal(Signal::INT);
    assert_eq!(training.finish().code(), Some(130));
    let checkpoint = bytes_or_empty(&folder, "t.json.checkpoint");
    for (other_options, why) in [
        ("--seed 2", "seed"),
        ("--epsilon 0.1,0.05", "epsilon"),
        ("--set policy.q-learning.mu1=3", "other weights"),
        ("--windows 2", "other windows"),
        ("--set policy.q-learning.window=3", "other windows"),
        ("--set policy.q-learning.rate_floor=0.01", "another learning rate"),
        (
            "--set policy.q-learning.optimism=0",
            "another learning rate or optimism",
        ),
        ("--set events.alpha=0.3", "events.alpha"),
        ("--set bs.sync_interval=77", "another scenario"),
    ] {
        let finished = folder.run(&format!("{ENDLESS} --out t.json {other_options}"));
        assert_refused(
            &finished,
            1,
            &["t.json.checkpoint", "of another training", why, "--out"],
        );
    }
    let finished = folder.run(&format!(
        "{} --out t.json",
        ENDLESS.replace("--devices 20", "--devices 20,21")
    ));
    assert_refused(&finished, 1, &["t.json.checkpoint", "numbers of devices"]);
    assert!(
        bytes_or_empty(&folder, "t.json.checkpoint") == checkpoint,
        "the checkpoint has changed"
    );
    fs::write(folder.join("t.json.checkpoint"), &checkpoint[..checkpoint.len() / 2]).expect("a test's folder");
    let finished = folder.run(&format!("{ENDLESS} --out t.json"));
    assert_refused(&finished, 1, &["t.json.checkpoint", "damaged"]);
}

/// Applies `change` to the body of a table file, and returns the file with a matching checksum.
fn with_changed_body(text: &str, change: impl Fn(&str) -> String) -> String {
    let (_, body_and_end) = text.split_once(",\"body\":").expect("a body");
    let body = body_and_end.trim_end().strip_suffix('}').expect("an end");
    let changed = change(body);
    let hash = Sha256::digest(changed.as_bytes());
    let checksum = hash.iter().fold(String::new(), |mut hex, byte| {
        let _infallible = write!(hex, "{byte:02x}");
        hex
    });
    format!("{{\"format\":\"reveille-q-table\",\"version\":3,\"sha256\":\"{checksum}\",\"body\":{changed}}}\n")
}

/// Replaces the first value of the first table by `value`, which may be invalid JSON.
fn with_first_value(text: &str, value: &str) -> String {
    with_changed_body(text, |body| {
        let (before, after) = body.split_once("\"q\":[[").expect("a table");
        let (_, after) = after.split_once(',').expect("a cell");
        format!("{before}\"q\":[[{value},{after}")
    })
}

#[test]
fn invalid_table_files_are_refused() {
    let folder = TestFolder::new();
    let text = train_minimal_tables(&folder);
    assert!(
        with_changed_body(&text, str::to_owned) == text,
        "this test and the program write files alike"
    );
    let run_with_table = |name: &str| {
        folder.run(&format!(
            "run -n 20 -k 60 --policy q-learning --out run --force --set policy.q-learning.table={name}"
        ))
    };
    let finished = run_with_table("good.json");
    assert!(finished.is_success(), "{finished}");
    folder.write("other-value.json", &with_first_value(&text, "20.5"));
    let finished = run_with_table("other-value.json");
    assert!(finished.is_success(), "another valid value: {finished}");
    fs::remove_dir_all(folder.join("run")).expect("the run");

    let train = "reveille train q-learning";
    let cases: [(&str, String, &[&str]); 12] = [
        (
            "other-version",
            text.replacen("\"version\":3", "\"version\":2", 1),
            &["version 2", "reads 3", train],
        ),
        ("truncated", text[..text.len() * 2 / 3].to_owned(), &["damaged", train]),
        ("nearly-whole", text[..text.len() - 3].to_owned(), &["damaged", train]),
        ("head-only", text[..60].to_owned(), &["damaged", train]),
        ("empty", String::new(), &["not a file of learned tables", train]),
        (
            "text",
            "devices = 50\n".to_owned(),
            &["not a file of learned tables", train],
        ),
        (
            "other-json",
            "{\"devices\": 50}\n".to_owned(),
            &["not a file of learned tables", train],
        ),
        ("nan", with_first_value(&text, "NaN"), &["damaged", train]),
        ("null", with_first_value(&text, "null"), &["damaged", train]),
        ("infinite", with_first_value(&text, "1e999"), &["damaged", train]),
        ("changed", text.replacen("[1", "[2", 1), &["damaged", "checksum", train]),
        (
            "no-entry",
            with_changed_body(&text, |body| {
                let (before, _) = body.split_once("\"entries\":[").expect("entries");
                format!("{before}\"entries\":[]}}")
            }),
            &["damaged", "no tables", train],
        ),
    ];
    for (name, content, parts) in &cases {
        let name = format!("{name}.json");
        folder.write(&name, content);
        let finished = run_with_table(&name);
        assert_refused(&finished, 1, &["policy.q-learning.table", &name]);
        assert_refused(&finished, 1, parts);
    }
    fs::write(folder.join("bytes.json"), [0xFF, 0xFE, 0, 1, 2]).expect("a test's folder");
    let finished = run_with_table("bytes.json");
    assert_refused(
        &finished,
        1,
        &["policy.q-learning.table", "bytes.json", "not a file of learned tables"],
    );
    let finished = run_with_table("nowhere.json");
    assert_refused(
        &finished,
        1,
        &["policy.q-learning.table", "nowhere.json", "no such file", train],
    );
    let finished = run_with_table(".");
    assert_refused(&finished, 1, &["policy.q-learning.table", "cannot be read"]);
    assert!(!folder.join("run").exists(), "a refused run left a folder");
}

#[test]
fn a_table_for_other_densities_or_weights_is_refused() {
    let folder = TestFolder::new();
    train_minimal_tables(&folder);
    let base = "run -k 60 --policy q-learning --set policy.q-learning.table=good.json --out run";
    for n in [700, 101, 4] {
        let finished = folder.run(&format!("{base} -n {n}"));
        let hint = format!("reveille train q-learning --devices {n}");
        assert_refused(
            &finished,
            1,
            &["policy.q-learning.table", "5 to 100 devices", &n.to_string(), &hint],
        );
    }
    for (name, value) in [("mu1", "3.5"), ("mu2", "4"), ("zeta", "0.5"), ("window", "3")] {
        let finished = folder.run(&format!("{base} -n 20 --set policy.q-learning.{name}={value}"));
        let field = format!("policy.q-learning.{name}");
        assert_refused(&finished, 1, &[&field, value, "reveille train q-learning"]);
        let reasons = if name == "window" {
            ["which has tables for policy.q-learning.window = 1;", "--windows 3"]
        } else {
            ["its table was learned", "policy.q-learning.learn = true"]
        };
        assert_refused(&finished, 1, &reasons);
        assert!(!folder.join("run").exists(), "a refused run left a folder");
        let out = format!("learns-{name}");
        let finished = folder.run(&format!(
            "run -k 60 -n 20 --policy q-learning --set policy.q-learning.table=good.json --set {field}={value} \
             --set policy.q-learning.learn=true --out {out}"
        ));
        assert!(
            finished.is_success(),
            "a policy that learns may have other weights: {finished}"
        );
        // The written tables name the tables that they started from.
        let learned = fs::read_to_string(folder.join(&format!("{out}/learned.json"))).expect("a table");
        let origin = "\"begun_from\":\"tables for N = 10, μ1 = 14, μ2 = 1, ζ = 0.95 and a window of 1 TTI, \
            learned in 50 TTIs\"";
        assert!(learned.contains(origin), "{learned:.600}");
    }
    let finished = folder.run("run -k 60 -n 20 --policy q-learning --set policy.q-learning.table=nothing --out run");
    assert_refused(&finished, 1, &["policy.q-learning.table", "learn = true"]);
}

#[test]
fn a_window_without_tables_lists_the_available_ones() {
    let folder = TestFolder::new();
    let run_with = |set: &str| folder.run(&format!("run -n 20 -k 60 --policy q-learning {set} --out run --force"));
    // The shipped tables have the windows 1, 2 and 4, and ages.
    for window in [1, 2, 4] {
        let finished = run_with(&format!("--set policy.q-learning.window={window}"));
        assert!(finished.is_success() && finished.stderr.is_empty(), "{finished}");
    }
    // Tables are not chosen by the duration of events, so there is no warning about it.
    let finished = run_with("--set events.duration=9");
    assert!(finished.is_success() && finished.stderr.is_empty(), "{finished}");
    // The operator should learn a fact that no base station can know: three of four events end before a device senses.
    let finished = run_with("--set policy.q-learning.window=4 --set events.duration=1");
    assert!(finished.is_success(), "{finished}");
    let warning_parts = ["policy.q-learning.window = 4", "events last 1 TTI: up to 75 %"];
    assert!(
        warning_parts.iter().all(|part| finished.stderr.contains(part)),
        "{finished}"
    );
    let finished = run_with("--set events.alpha=0.3");
    assert!(finished.stderr.contains("events.alpha 0.2, here 0.3"), "{finished}");
    let finished = run_with("--set policy.q-learning.window=3");
    let hint = "reveille train q-learning --windows 3";
    assert_refused(
        &finished,
        1,
        &[
            "policy.q-learning.window = 3",
            "policy.q-learning.window = 4; set one of these",
            hint,
        ],
    );
    let finished = run_with("--set policy.q-learning.ages=true");
    assert!(finished.is_success() && finished.stderr.is_empty(), "{finished}");
    let finished = run_with("--set policy.q-learning.ages=true --set policy.q-learning.window=2");
    assert_refused(
        &finished,
        1,
        &["policy.q-learning.window = 2", "policy.q-learning.ages = true"],
    );
    let train = "train q-learning --quiet --episode-ttis 50 --episodes 1 -n 20";
    for (windows, set, expected_part) in [
        ("ages", "window=1", "tables for policy.q-learning.ages = true;"),
        (
            "4,2",
            "ages=true",
            "tables for policy.q-learning.window = 2, policy.q-learning.window = 4;",
        ),
    ] {
        let finished = folder.run(&format!("{train} --windows {windows} --out one.json --force"));
        assert!(finished.is_success(), "{finished}");
        let finished = run_with(&format!(
            "--set policy.q-learning.table=one.json --set policy.q-learning.{set}"
        ));
        let (field, value) = set.split_once('=').expect("a field");
        assert_refused(
            &finished,
            1,
            &[
                &format!("policy.q-learning.{field} = {value}"),
                expected_part,
                "--windows",
            ],
        );
    }
    for args in [
        "--windows 1,ages --out no.json",
        "--windows 2 --set policy.q-learning.ages=true --out no.json",
    ] {
        let finished = folder.run(&format!("{train} {args}"));
        assert_refused(&finished, 1, &["--windows", "ages"]);
    }
    // The weight of misdetections differs between ages and windows; with ages it is the value of the tables.
    let finished = folder.run(&format!("{train} --windows ages --out ages.json"));
    let learned = fs::read_to_string(folder.join("ages.json")).expect("tables");
    assert!(finished.is_success() && learned.contains("\"mu1\":1.0"), "{finished}");
    let finished = run_with("--set policy.q-learning.ages=true --set policy.q-learning.mu1=14");
    assert_refused(
        &finished,
        1,
        &["policy.q-learning.mu1 = 14", "must be 1", "--windows ages --set"],
    );
    // A warning if sensing is never worthwhile: with the literal settings a device alone gains less than by sleep.
    let finished = folder.run("run -s paper-literal -n 20 -k 200 --policy q-learning");
    assert!(
        finished.is_success() && finished.stderr.contains("no device ever senses"),
        "{finished}"
    );
    for windows in ["0", "1001", "age"] {
        let finished = folder.run(&format!("{train} --windows 1,{windows} --out no.json"));
        assert_refused(&finished, 2, &[windows, "from 1 to 1000, or ages"]);
    }
}

#[test]
fn an_unknown_ranking_or_knowledge_lists_the_available_ones() {
    let folder = TestFolder::new();
    for (field, available) in [
        ("bs.ranking", ["p42", "posterior"]),
        ("bs.battery_knowledge", ["oracle", "reported"]),
    ] {
        let finished = folder.run(&format!(
            "run -n 20 -k 60 --policy q-learning --set {field}=guess --out run"
        ));
        assert_refused(&finished, 1, &[field, "guess", available[0], available[1]]);
        for value in available {
            let finished = folder.run(&format!(
                "run -n 20 -k 60 --policy q-learning --set {field}={value} --out {value}"
            ));
            assert!(finished.is_success(), "{finished}");
        }
    }
    assert!(!folder.join("run").exists(), "a refused run left a folder");
}

#[test]
fn invalid_options_are_refused_before_training() {
    let folder = TestFolder::new();
    for (args, parts) in [
        (
            "--devices 5 --windows 1 --set policy.q-learning.window=2",
            &["policy.q-learning.window=2", "from --windows"][..],
        ),
        (
            "--devices 5 --episodes 0",
            &["episodes = 0", "must be from 1 to 100000"],
        ),
        (
            "--devices 5 --episode-ttis 9",
            &["episode-ttis = 9", "must be from 10 to"],
        ),
        (
            "--devices 5,1000000 --episode-ttis 2000 --set harvest.e_b=10000",
            &["--episode-ttis 2000", "at most 1842", "1000000 devices", "overflow"],
        ),
        ("--devices 5 --epsilon 0.1", &["--epsilon", "0.1,0.03"]),
        ("--devices 5 --epsilon 0.1,1", &["epsilon = 1", "less than 1"]),
        ("--devices 5 --epsilon NaN,0.1", &["epsilon", "less than 1"]),
        ("--devices 5 --set policy.name=knn", &["knn", "q-learning"]),
        ("--devices 5 --set seed=3", &["--set seed=3", "from --seed"]),
        ("--devices 5 --set policy.q-learning.epsilon=0.5", &["from --epsilon"]),
        (
            "--devices 5 --set policy.q-learning.epsilon_last=0.5",
            &["from --epsilon"],
        ),
        (
            "--devices 5 --set policy.q-learning.table=a.json",
            &["starts without tables"],
        ),
        (
            "--devices 5 --set policy.q-learning.rate_floor=0",
            &["policy.q-learning.rate_floor = 0", "greater than 0"],
        ),
        (
            "--devices 5 --set policy.q-learning.optimism=NaN",
            &["policy.q-learning.optimism = NaN", "must be a number"],
        ),
        (
            "--devices 5 --set policy.q-learning.zeta=1",
            &["policy.q-learning.zeta = 1", "at most 0.999"],
        ),
        (
            "--devices 5 --set policy.q-learning.mu1=-1",
            &["policy.q-learning.mu1 = -1", "at least 0"],
        ),
    ] {
        assert_refused(
            &folder.run(&format!("train q-learning --quiet {args} --out t.json")),
            1,
            parts,
        );
        assert_eq!(folder.list("."), ["runtime"], "{args}");
    }
    assert_refused(
        &folder.run("train q-learning --quiet --devices 5 --out nowhere/t.json"),
        1,
        &["nowhere/t.json: the folder nowhere does not exist"],
    );
}
