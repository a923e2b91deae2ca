//! Whole scenarios: presets, precedence, messages, and the way there and back.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use proptest::prelude::*;

use super::*;
use reveille_common::declare::{Form, listed};
use reveille_common::geometry::Layout;
use reveille_common::harvest::Mpp;
use reveille_common::sensing::DetectionKind;
use reveille_common::units::Energy;

fn set(texts: &[&str]) -> Vec<Override> {
    texts
        .iter()
        .map(|text| Override::parse(text).expect("well-formed"))
        .collect()
}

fn from(text: &str) -> Result<Scenario, ScenarioError> {
    parse(text, "my.toml", Path::new("/nonexistent"), &[])
}

fn examples() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/scenarios")
}

/// A folder of its own for the data files of one test.
fn folder(name: &str, files: &[(&str, &str)]) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("reveille-scenario-{}-{name}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    for (file, text) in files {
        std::fs::write(folder.join(file), text).expect("a file");
    }
    folder
}

#[test]
fn the_paper_preset_is_table_ii() {
    let scenario = load("paper", &[]).expect("a preset");
    let energy = scenario.classes[0].energy;
    assert_eq!(energy.e_wur, Energy::from_micro(71_429));
    assert_eq!(energy.initial, Energy::from_micro(50_000_000));
    assert_eq!((scenario.devices, scenario.ttis, scenario.seed), (50, 10_000, 1));
    assert_eq!(scenario.layout, Layout::JitteredGrid);
    assert_eq!(
        scenario.events,
        Events {
            alpha: 0.2,
            duration: 4
        }
    );
    assert_eq!(scenario.classes[0].name, "default");
}

#[test]
fn every_preset_loads_under_its_name() {
    for Preset { name, .. } in PRESETS {
        assert_eq!(load(name, &[]).expect(name).preset, *name);
    }
    let literal = load("paper-literal", &[]).expect("a preset");
    assert_eq!(literal.sensing.kind, DetectionKind::Probabilistic);
    assert_eq!((literal.layout, literal.devices), (Layout::Uniform, 50));
}

#[test]
fn later_layers_win() {
    let text = "preset = \"quick\"\nseed = 7\n[sensing]\nd_max = 5\n";
    let scenario = parse(
        text,
        "my.toml",
        Path::new(""),
        &set(&["sensing.d_max=6", "sensing.d_max=6.5"]),
    );
    let scenario = scenario.expect("valid");
    assert_eq!((scenario.devices, scenario.seed), (20, 7));
    assert!((scenario.sensing.d_max - 6.5).abs() < f64::EPSILON);
    assert_eq!(load("paper", &set(&["preset=quick"])).expect("valid").devices, 20);
}

#[test]
fn a_class_inherits_field_by_field() {
    let text = "[energy]\ne_idle = 2\n[[class]]\nname = \"a\"\nshare = 0.25\n[class.energy]\ne_tx = 3\n\
                [[class]]\nname = \"b\"\nshare = 0.75\n[class.harvest]\nkind = \"mpp\"\n";
    let scenario = parse(
        text,
        "t",
        Path::new(""),
        &set(&["class.b.energy.e_max=80", "energy.e_wur=0.5"]),
    );
    let classes = scenario.expect("valid").classes;
    let both = |field: fn(&EnergyModel) -> Energy| [0, 1].map(|i: usize| field(&classes[i].energy).micro());
    assert_eq!(both(|energy| energy.e_tx), [3_000_000, 10_000_000]);
    assert_eq!(both(|energy| energy.e_max), [100_000_000, 80_000_000]);
    assert_eq!(both(|energy| energy.initial), [50_000_000, 40_000_000]);
    assert_eq!(both(|energy| energy.e_wur), [500_000, 500_000]);
    let Harvest::Mpp(Mpp { lambda, off_mean, .. }) = classes[1].harvest else {
        panic!("{:?}", classes[1].harvest);
    };
    let on_share = (1.0 / lambda) / (1.0 / lambda + off_mean);
    assert!((on_share - 0.1 * libm::exp(-0.1)).abs() < 1e-12, "{on_share}");
}

#[test]
fn messages_name_field_value_range_and_line() {
    let diagonal = from("\n\n[sensing]\nd_max = 50\n").expect_err("too far").to_string();
    assert_eq!(
        diagonal,
        "sensing.d_max = 50: must be greater than 0 and at most 28.28 (the area's diagonal in metres); set in my.toml, \
         line 4"
    );
    for (text, start, end) in [
        ("devices = 0", "devices = 0: must be at least 1", "line 1"),
        ("devices = 2_000_000", "devices = 2000000: must be", "line 1"),
        (
            "devices = -3",
            "devices = -3: must be a whole number that is not negative",
            "line 1",
        ),
        ("devices = \"ten\"", "devices = \"ten\": must be", "line 1"),
        ("ttis = 0", "ttis = 0:", "line 1"),
        (
            "warm_up = 1",
            "warm_up = 1: must be at least 0 and less than 1",
            "line 1",
        ),
        ("tau = 0", "tau = 0: must be greater than 0", "line 1"),
        ("tau = nan", "tau = NaN: must be greater than 0", "line 1"),
        ("[area]\nwidth = -1", "area.width = -1:", "line 2"),
        ("[sensing]\neta = 0", "sensing.eta = 0:", "line 2"),
        (
            "[sensing]\neta = 200",
            "sensing.eta = 200: must be at most 175",
            "line 2",
        ),
        ("[sensing]\npsi = -1", "sensing.psi = -1:", "line 2"),
        (
            "[sensing]\nkind = \"rang\"",
            "sensing.kind = \"rang\": must be one of `range`, `probabilistic`; did you mean `range`?",
            "line 2",
        ),
        ("[energy]\ne_max = 0", "energy.e_max = 0:", "line 2"),
        (
            "[energy]\ne_tx = 101",
            "energy.e_tx = 101: must be at most 100 units (energy.e_max), or it can never",
            "line 2",
        ),
        (
            "[energy]\ne_idle = -1",
            "energy.e_idle = -1: must be at least 0 and at most 10000 units",
            "line 2",
        ),
        ("[energy]\ninitial = 100.5", "energy.initial = 100.5:", "line 2"),
        (
            "[events]\nalpha = 0",
            "events.alpha = 0: must be greater than 0 and at most 1",
            "line 2",
        ),
        ("[events]\nduration = 0", "events.duration = 0:", "line 2"),
        ("[harvest]\nlambda = inf", "harvest.lambda = inf:", "line 2"),
        (
            "[harvest]\nkind = \"mpp\"\nlambda = 0",
            "harvest.lambda = 0: must be greater than 0",
            "line 3",
        ),
        ("[bs]\nsync_interval = 0", "bs.sync_interval = 0:", "line 2"),
        ("[policy.knn]\nneighbours = 0", "policy.knn.neighbours = 0:", "line 2"),
        (
            "preset = \"papr\"",
            "preset = papr: must be one of `paper`, `paper-literal`, `quick`; did you mean `paper`?",
            "line 1",
        ),
        (
            "[harvest]\nkind = \"trace\"",
            "harvest.trace.file: required because of harvest.kind, set in my.toml, line 2",
            "",
        ),
        (
            "layout.kind = \"file\"",
            "layout.file: required because of layout.kind, set in my.toml, line 1",
            "",
        ),
        (
            "devices = 1_000_000\nttis = 1_000_000_000",
            "ttis = 1000000000: must be at most 184467",
            "line 2",
        ),
        ("seed = = 1", "my.toml, line 1: not valid TOML", ""),
    ] {
        let message = from(text).expect_err(text).to_string();
        assert!(message.starts_with(start), "{text}: {message}");
        assert!(message.contains(end), "{text}: {message}");
        assert!(!message.contains('\n'), "one paragraph: {message}");
    }
}

#[test]
fn class_messages_name_the_class() {
    let two = |extra: &str| format!("[[class]]\nname = \"a\"\nshare = 0.5\n[[class]]\nname = \"b\"\n{extra}\n");
    for (text, part) in [
        (
            two("share = 0.4"),
            "class = shares 0.5 + 0.4: the shares of all classes must add up to 1, not to 0.9",
        ),
        (
            two(""),
            "class.b.share: required because of class.b.name, set in my.toml, line 5",
        ),
        (
            two("share = 0.5\nenergy.e_tx = 200"),
            "class.b.energy.e_tx = 200: must be at most 100 units",
        ),
        (
            two("share = 0.5\nenergy.e_max = 5"),
            "energy.e_tx = 10: must be at most 5 units (class.b.energy.e_max)",
        ),
        (
            two("share = 0.5\nenergy.e_tx = \"x\""),
            "class.b.energy.e_tx = \"x\": must be a number; set in my.toml, line 7",
        ),
        (
            two("share = 0.5\nenergy.etx = 2"),
            "unknown field `class.b.energy.etx`; did you mean `e",
        ),
        (
            "[[class]]\nname = \"a\"\nshare = 0.5\n[[class]]\nname = \"a\"\nshare = 0.5".to_owned(),
            "class.a.name = a: must differ",
        ),
        (
            "[[class]]\nname = \"\"\nshare = 1".to_owned(),
            "class.1.name = \"\": must be",
        ),
        (
            "\n[[class]]\nshare = 1".to_owned(),
            "class.1.name: required for every class (set in my.toml, line 2)",
        ),
    ] {
        let message = from(&text).expect_err(&text).to_string();
        assert!(message.contains(part), "{message}");
    }
}

#[test]
fn tables_in_the_wrong_place_are_explained() {
    let message = |text: &str| from(text).expect_err("it must not be").to_string();
    let number = message("[devices]\nn = 3");
    assert!(number.starts_with("devices = {…}: must be"), "{number}");
    let list = message("[class.a]\nshare = 1");
    let expected = "class = {…}: must be a list: write [[class]] for each item";
    assert!(list.starts_with(expected), "{list}");
}

#[test]
fn unknown_fields_come_with_a_suggestion() {
    let settings = from("[policy.random]\nx = 1\n").expect_err("it has none").to_string();
    assert!(
        settings.starts_with("unknown field `policy.random`; `random` has no fields of its own; set in my.toml"),
        "{settings}"
    );
    let folder = load(env!("CARGO_MANIFEST_DIR"), &[]).expect_err("a folder");
    assert!(
        std::error::Error::source(&folder).is_none(),
        "said once, in the message"
    );
    for (text, message) in [
        (
            "[bs]\nsync = 5",
            "unknown field `bs.sync`; set in my.toml, line 2; the fields there are `sync_interval`, `ranking`, \
             `battery_knowledge`",
        ),
        (
            "[events]\nalhpa = 0.1",
            "unknown field `events.alhpa`; did you mean `alpha`?; set in my.toml, line 2; the fields there \
             are `alpha`, `duration`",
        ),
    ] {
        assert_eq!(from(text).expect_err(text).to_string(), message);
    }
    let top = from("seed = 1\nd_max = 3").expect_err("wrong section").to_string();
    assert!(
        top.starts_with("unknown field `d_max`; did you mean `sensing.d_max`?; set in my.toml, line 2"),
        "{top}"
    );
}

#[test]
fn overrides_are_checked_like_files() {
    for (text, part) in [
        (
            "sensing.d_max=50",
            "(the area's diagonal in metres); set by --set sensing.d_max=50",
        ),
        (
            "sensing.dmax=5",
            "unknown field `sensing.dmax`; did you mean `d_max`?; set by --set sensing.dmax=5",
        ),
        ("sense.d_max=5", "unknown field `sense`"),
        ("area={widht=3}", "unknown field `area.widht`; did you mean `width`?"),
        (
            "policy.name=nkn",
            &format!(
                "policy.name = nkn: must be one of {}; did you mean `knn`?",
                listed(registry::names())
            ),
        ),
        ("ttis=1.5", "ttis = 1.5: must be a whole number"),
        (
            "class.x.share=1",
            "class = x: must be the name of a class; there are (none); set by --set",
        ),
    ] {
        let message = load("paper", &set(&[text])).expect_err(text).to_string();
        assert!(message.contains(part), "{message}");
    }
    let flag = Override::flag("--devices", "devices", "0").expect("well-formed");
    let message = load("paper", &[flag]).expect_err("no devices").to_string();
    assert!(message.ends_with("; set by --devices"), "{message}");
    let unknown = load("qiuck", &[]).expect_err("no such file").to_string();
    assert!(unknown.contains("did you mean `quick`?"), "{unknown}");
}

#[test]
fn data_files_are_checked_row_by_row() {
    let files = [
        ("p.csv", "x,y\n1,2\n3,4\n"),
        ("out.csv", "x,y\n1,2\n30,4\n"),
        ("t.csv", "hour,w\n0,1\n1,-2\n"),
        ("empty.csv", "hour,w\n"),
        ("t.parquet", "PAR1"),
    ];
    let folder = folder("rows", &files);
    let layout = |file: &str| format!("devices = 2\n[layout]\nkind = \"file\"\nfile = \"{file}\"\n");
    let trace = |file: &str, column: &str| {
        format!("[harvest]\nkind = \"trace\"\ntrace.file = \"{file}\"\ntrace.column = \"{column}\"\n")
    };
    for (text, part) in [
        (
            layout("p.csv").replace('2', "3"),
            "p.csv\": has 2 points, too few for 3 devices; set in my.toml, line 4",
        ),
        (
            layout("out.csv"),
            "line 3: the point (30, 4) lies outside the area of 20 by 20 metres",
        ),
        (layout("none.csv"), "none.csv\": cannot be read: No such file"),
        (layout("t.csv"), "has no column `x`; its columns are `hour`, `w`"),
        (
            trace("t.csv", "v"),
            "has no column `v`; its columns are `hour`, `w`; set in my.toml, line 3",
        ),
        (trace("t.csv", "w"), "line 3, column `w`: -2 times"),
        (trace("empty.csv", "w"), "has no rows"),
        (trace("t.parquet", "w"), "arquet"),
        (trace("", "w"), "harvest.trace.file = \"\": must be the path"),
        (
            trace("t.csv", "w") + "trace.columns = [\"w\"]",
            "cannot be set together with",
        ),
    ] {
        let message = parse(&text, "my.toml", &folder, &[]).expect_err(&text).to_string();
        assert!(message.contains(part), "{message}");
    }
    let placed = parse(&layout("p.csv"), "my.toml", &folder, &[]).expect("valid");
    assert!(matches!(&placed.layout, Layout::File(file) if file.points.len() == 2));
    assert_eq!(from(&placed.to_toml()).expect("valid"), placed);
    std::fs::remove_dir_all(folder).expect("its own folder");
}

#[test]
fn the_examples_load_and_come_back() {
    for name in ["solar.toml", "two-classes.toml"] {
        let path = examples().join(name);
        let scenario = load(path.to_str().expect("UTF-8"), &[]).expect(name);
        let again = from(&scenario.to_toml()).expect(name);
        assert_eq!(scenario, again, "{}", scenario.to_toml());
        assert_eq!(scenario.hash(), again.hash());
    }
    let solar = load(examples().join("solar.toml").to_str().expect("UTF-8"), &[]).expect("valid");
    let Harvest::Trace(trace) = &solar.classes[0].harvest else {
        panic!("{:?}", solar.classes[0].harvest);
    };
    assert_eq!((trace.values.len(), trace.values[0].len()), (1, 14 * 24));
}

#[test]
fn an_override_replaces_the_shared_column() {
    let path = examples().join("solar.toml");
    let columns = set(&[
        "harvest.trace.columns=[\"hour\", \"ghi_w_m2\"]",
        "harvest.trace.scale=0.001",
    ]);
    let scenario = load(path.to_str().expect("UTF-8"), &columns).expect("valid");
    let Harvest::Trace(trace) = &scenario.classes[0].harvest else {
        panic!("{:?}", scenario.classes[0].harvest);
    };
    assert_eq!(trace.values.len(), 2);
    assert_eq!(from(&scenario.to_toml()).expect("valid"), scenario);
}

#[test]
fn the_hash_follows_what_decides_a_run_and_nothing_else() {
    let hash = |overrides: &[&str]| load("paper", &set(overrides)).expect("valid").hash_hex();
    let quick = load("quick", &set(&["devices=50", "ttis=10000"])).expect("valid");
    assert_eq!(hash(&[]), quick.hash_hex());
    for changed in [
        "seed=2",
        "energy.e_wur=0.071428",
        "policy.name=random",
        "harvest.lambda=0.2",
        "layout.kind=hex",
        "tau=2",
    ] {
        assert_ne!(hash(&[]), hash(&[changed]), "{changed}");
    }
    let folder = folder(
        "hash",
        &[("a.csv", "w\n1\n2\n"), ("b.csv", "w\n1\n2\n"), ("c.csv", "w\n1\n3\n")],
    );
    let traced = |file: &str| {
        let text = format!("[harvest]\nkind = \"trace\"\ntrace = {{ file = \"{file}\", column = \"w\" }}");
        parse(&text, "my.toml", &folder, &[]).expect("valid").hash()
    };
    assert_eq!(traced("a.csv"), traced("b.csv"));
    assert_ne!(traced("a.csv"), traced("c.csv"));
    std::fs::remove_dir_all(&folder).expect("its own folder");
}

#[test]
fn the_reference_page_is_current() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/scenario.md");
    let page = std::fs::read_to_string(path).expect("the page");
    assert!(
        page == reference(),
        "docs/scenario.md is not what the declarations say: reveille scenario reference --out docs/scenario.md"
    );
}

#[test]
fn schema_and_full_page_have_every_field() {
    let schema: serde_json::Value = serde_json::from_str(&schema()).expect("JSON");
    let page = load("paper", &[]).expect("a preset").to_full_toml(&registry::kinds());
    for path in declaration().paths() {
        let pointer = path
            .split('.')
            .fold(String::new(), |at, name| format!("{at}/properties/{name}"));
        assert!(schema.pointer(&pointer).is_some(), "{path}");
        let name = path.rsplit('.').next().expect("a name");
        let has_it = |line: &str| line.trim_start_matches("# ").starts_with(&format!("{name} = "));
        assert!(page.lines().any(has_it), "{path}");
    }
    assert_eq!(
        from(&page).expect("what is shown loads"),
        load("paper", &[]).expect("a preset")
    );
    let lambda = schema
        .pointer("/properties/harvest/properties/lambda")
        .expect("a field");
    assert_eq!(lambda["minimum"], 0.0);
    assert_eq!(schema["properties"]["sensing"]["additionalProperties"], false);
    assert_eq!(schema["properties"]["devices"]["default"], 50);
}

#[test]
fn words_of_the_fuzz_dictionary_are_those_of_the_declaration() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fuzz/scenario.dict");
    let dictionary = std::fs::read_to_string(path).expect("the dictionary");
    let tail = "# Syntax and values, which no declaration has.\n";
    let (head, _) = dictionary.split_once(tail).expect("a tail");
    let held: Vec<&str> = head.lines().filter(|line| !line.starts_with('#')).collect();

    let declaration = declaration();
    let mut words: BTreeSet<&str> = declaration.registered.iter().map(|policy| policy.name).collect();
    words.extend(declaration.presets.iter().map(|preset| preset.name));
    words.extend(declaration.sections.iter().flat_map(|section| section.path.split('.')));
    words.insert(declaration.list.name());
    let own = std::iter::once(&declaration.list.section);
    for field in declaration
        .sections
        .iter()
        .chain(own)
        .flat_map(|section| section.fields)
    {
        words.insert(field.name);
        if let Form::Choice(alternatives) | Form::Source(alternatives) = field.form {
            words.extend(alternatives.iter().map(|alternative| alternative.name));
        }
    }
    let expected: Vec<String> = words
        .into_iter()
        .filter(|word| !word.is_empty())
        .map(|word| format!("\"{word}\""))
        .collect();
    assert_eq!(held, expected, "words of tests/fuzz/scenario.dict, in their order");
}

#[test]
fn a_layout_file_may_say_the_class_of_each_device() {
    let good = "x,y,class\n1,2,weak\n3,4,strong\n5,6,weak\n";
    let files = [
        ("good.csv", good),
        ("bad.csv", "x,y,class\n1,2,weak\n3,4,stron\n"),
        ("plain.csv", "x,y\n1,2\n3,4\n"),
    ];
    let folder = folder("classes", &files);
    let text = |file: &str, share: &str| {
        format!(
            "devices = 2\nlayout.kind = \"file\"\nlayout.file = \"{file}\"\n[[class]]\nname = \"strong\"\n{share}\n\
             [[class]]\nname = \"weak\"\n{share}\n"
        )
    };
    let load = |file: &str, share: &str| parse(&text(file, share), "my.toml", &folder, &[]);
    let placed = load("good.csv", "").expect("valid");
    assert_eq!(assign_classes(&placed), [1, 0]);
    assert!((placed.classes[0].share - 0.5).abs() < 1e-12);
    assert_eq!(placed.warnings.len(), 1, "{:?}", placed.warnings);
    assert!(placed.warnings[0].contains("good.csv has 3 positions; the first 2 are used"));
    assert_eq!(from(&placed.to_toml()).expect("valid"), placed);
    let shared = load("good.csv", "share = 0.5").expect("valid");
    assert!(
        shared
            .warnings
            .iter()
            .any(|w| w.starts_with("class.share has no effect"))
    );
    assert_eq!(shared.hash(), placed.hash());
    let unknown = load("bad.csv", "").expect_err("no such class").to_string();
    assert!(
        unknown.contains("line 3, column `class`: \"stron\" is no class") && unknown.contains("did you mean `strong`?"),
        "{unknown}"
    );
    let missing = load("plain.csv", "").expect_err("no shares").to_string();
    assert!(
        missing.contains("class.strong.share: required because of class.strong.name"),
        "{missing}"
    );
    std::fs::remove_dir_all(&folder).expect("its own folder");
}

#[test]
fn what_has_no_effect_is_warned_of() {
    let classes = "[[class]]\nname = \"a\"\nshare = 0.5\nharvest.lambda = 0.3\n\
                   [[class]]\nname = \"b\"\nshare = 0.5\nharvest.lambda = 0.2\n";
    let lambda = set(&["harvest.lambda=0.7"]);
    let silent = parse(classes, "t", Path::new(""), &lambda).expect("valid").warnings;
    assert_eq!(silent.len(), 1, "{silent:?}");
    assert!(
        silent[0].starts_with("harvest.lambda = 0.7 has no effect on any class"),
        "{silent:?}"
    );
    assert!(silent[0].ends_with("set by --set harvest.lambda=0.7"), "{silent:?}");
    let one = classes.replace("harvest.lambda = 0.2\n", "");
    assert!(
        parse(&one, "t", Path::new(""), &lambda)
            .expect("valid")
            .warnings
            .is_empty()
    );
    let scale = load("paper", &set(&["harvest.trace.scale=2"])).expect("valid").warnings;
    assert!(
        scale[0].contains("has an effect only with harvest.kind = \"trace\""),
        "{scale:?}"
    );
    let solar = examples().join("solar.toml");
    let solar = load(solar.to_str().expect("UTF-8"), &lambda).expect("valid").warnings;
    assert!(
        solar[0].starts_with("harvest.lambda = 0.7 has an effect only with"),
        "{solar:?}"
    );
    for preset in PRESETS {
        assert!(load(preset.name, &[]).expect("a preset").warnings.is_empty());
    }
}

#[test]
fn hostile_texts_are_refused_in_time() {
    let deep = |piece: &str, end: &str| format!("{}{end}", piece.repeat(100_000));
    for text in [
        deep("a.", "a = 1"),
        deep("area.", "a = 1"),
        format!("area = {}", deep("[", "")),
        format!("[{}]", deep("policy.", "knn")),
        "[[class]]\nharvest.trace.columns=[]\n".repeat(25_000),
        "\n".repeat(2_000_000),
    ] {
        let message = from(&text).expect_err("hostile").to_string();
        assert!(message.len() < 1000, "{message}");
    }
}

/// A preset's text with a piece of it replaced.
fn mutated() -> impl Strategy<Value = String> {
    let paper = load("paper", &[]).expect("a preset").to_toml();
    let source = format!("{paper}\n[[class]]\nname = \"a\"\nshare = 1\n");
    let length = source.chars().count();
    (0..length, 0..12usize, "[-0-9a-z.=\"\\[\\]{}#\n _+\u{e4}]{0,8}").prop_map(move |(at, cut, new)| {
        let head = source.chars().take(at);
        head.chain(new.chars()).chain(source.chars().skip(at + cut)).collect()
    })
}

/// What comes back is the same scenario.
fn there_and_back(scenario: &Scenario) -> Result<(), TestCaseError> {
    let text = scenario.to_toml();
    let again = from(&text).map_err(|error| TestCaseError::fail(format!("{error}\n{text}")))?;
    prop_assert_eq!(&again, scenario, "{}", text);
    prop_assert_eq!(again.hash(), scenario.hash());
    Ok(())
}

proptest! {
    #[test]
    fn arbitrary_text_never_panics(text in any::<String>()) {
        let _ = from(&text);
        let _ = Override::parse(&text).map(|given| load("quick", &[given]));
    }

    #[test]
    fn a_mutated_preset_never_panics(text in mutated()) {
        if let Ok(scenario) = from(&text) {
            there_and_back(&scenario)?;
        }
    }

    #[test]
    fn to_toml_loads_back(
        (devices, seed, tau) in (1u32..=1000, any::<u64>(), 1e-3..1e3f64),
        (e_max, lambda, e_b, share) in (10.0..1e4f64, 1e-3..10.0f64, 0.0..1e4f64, 0.01..0.99f64),
        kind in prop::sample::select(vec!["eq5", "exp-minus-lambda", "mpp"]),
        policy in prop::sample::select(vec!["knn", "random", "genie"]),
        name in "\\PC{0,6}[a-z\"'\\\\]",
    ) {
        let text = format!(
            "devices = {devices}\nseed = {seed}\ntau = {tau}\nharvest.off_mean = 3.5\npolicy.name = \"{policy}\"\n\
             [[class]]\nname = {}\nshare = {share}\nenergy.e_max = {e_max}\nharvest.kind = \"{kind}\"\n\
             harvest.lambda = {lambda}\n[[class]]\nname = \"rest of all\"\nshare = {}\nharvest.e_b = {e_b}\n",
            toml::Value::String(name),
            1.0 - share,
        );
        let scenario = from(&text).map_err(|error| TestCaseError::fail(format!("{error}\n{text}")))?;
        prop_assert_eq!(scenario.seed, seed);
        there_and_back(&scenario)?;
    }
}
