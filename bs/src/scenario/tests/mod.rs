//! Tests of loading complete scenarios: presets, precedence, classes, files, and the fields that the hash covers.
//! `messages` and `hostile` load invalid scenarios; `pages` tests generated pages.

mod hostile;
mod messages;
mod pages;

use std::path::{Path, PathBuf};

use reveille_common::event::{DurationKind, EventBursts, ProcessSettings};
use reveille_common::geometry::Layout;
use reveille_common::harvest::OnOff;
use reveille_common::sensing::DetectionKind;
use reveille_common::units::Energy;

use super::*;

/// Parses overrides such as `devices=9`.
pub(crate) fn overrides(fields: &[&str]) -> Vec<Override> {
    fields
        .iter()
        .map(|field| Override::parse(field).expect("well-formed"))
        .collect()
}

/// Loads the preset `paper` with `fields` overridden.
pub(crate) fn load_paper(fields: &[&str]) -> Scenario {
    load("paper", &overrides(fields)).expect("a valid scenario").scenario
}

/// Loads a scenario from the text of a file `my.toml`.
fn load_text(text: &str) -> Result<Scenario, ScenarioError> {
    parse(text, "my.toml", Path::new("/nonexistent"), &[]).map(|loaded| loaded.scenario)
}

fn examples_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/scenarios")
}

/// Creates a temporary folder with the data files of one test, which removes it. `name` must be unique among the tests.
fn create_folder(name: &str, files: &[(&str, &str)]) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("reveille-scenario-{}-{name}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    for (file, text) in files {
        std::fs::write(folder.join(file), text).expect("a file");
    }
    folder
}

#[test]
fn the_paper_preset_has_the_values_of_table_ii() {
    let scenario = load_paper(&[]);
    let energy = scenario.classes[0].energy;
    assert_eq!(energy.e_wur, Energy::from_micro(71_429));
    assert_eq!(energy.initial, Energy::from_micro(50_000_000));
    assert_eq!(
        (scenario.run.devices, scenario.run.ttis, scenario.run.seed),
        (50, 10_000, 1)
    );
    assert_eq!(scenario.layout, Layout::JitteredGrid);
    assert_eq!(
        scenario.events,
        EventSettings {
            alpha: 0.2,
            duration: 4,
            duration_kind: DurationKind::Fixed,
            process: ProcessSettings::Uniform,
        }
    );
    assert_eq!(scenario.classes[0].name, "default");
}

#[test]
fn every_preset_loads_under_its_name() {
    for Preset { name, .. } in PRESETS {
        assert_eq!(load(name, &[]).expect(name).scenario.run.preset, *name);
    }
    let literal = load("paper-literal", &[]).expect("a preset").scenario;
    assert_eq!(literal.sensing.kind, DetectionKind::Probabilistic);
    assert_eq!((literal.layout, literal.run.devices), (Layout::Uniform, 50));
}

#[test]
fn later_layers_take_precedence() {
    let text = "preset = \"quick\"\nseed = 7\n[sensing]\nd_max = 5\n";
    let scenario = parse(
        text,
        "my.toml",
        Path::new(""),
        &overrides(&["sensing.d_max=6", "sensing.d_max=6.5"]),
    );
    let scenario = scenario.expect("valid").scenario;
    assert_eq!((scenario.run.devices, scenario.run.seed), (20, 7));
    assert!((scenario.sensing.d_max - 6.5).abs() < f64::EPSILON);
    let quick = load_paper(&["preset=quick"]);
    assert_eq!((quick.run.preset.as_str(), quick.run.devices), ("quick", 20));
}

#[test]
fn a_class_inherits_field_by_field() {
    let text = "[energy]\ne_idle = 2\n[[class]]\nname = \"a\"\nshare = 0.25\n[class.energy]\ne_tx = 3\n\
                [[class]]\nname = \"b\"\nshare = 0.75\n[class.harvest]\nkind = \"mpp\"\n";
    let scenario = parse(
        text,
        "t",
        Path::new(""),
        &overrides(&["class.b.energy.e_max=80", "energy.e_wur=0.5"]),
    );
    let classes = scenario.expect("valid").scenario.classes;
    let micro_by_class = |field: fn(&EnergyModel) -> Energy| [0, 1].map(|i: usize| field(&classes[i].energy).micro());
    assert_eq!(micro_by_class(|energy| energy.e_tx), [3_000_000, 10_000_000]);
    assert_eq!(micro_by_class(|energy| energy.e_max), [100_000_000, 80_000_000]);
    assert_eq!(micro_by_class(|energy| energy.initial), [50_000_000, 40_000_000]);
    assert_eq!(micro_by_class(|energy| energy.e_wur), [500_000, 500_000]);
    let Harvest::Mpp(OnOff { lambda, off_mean, .. }) = classes[1].harvest else {
        panic!("{:?}", classes[1].harvest);
    };
    let on_share = (1.0 / lambda) / (1.0 / lambda + off_mean);
    assert!((on_share - 0.1 * libm::exp(-0.1)).abs() < 1e-12, "{on_share}");
}

#[test]
fn the_examples_load_and_round_trip() {
    for name in [
        "solar.toml",
        "solar-panel.toml",
        "day-and-night.toml",
        "two-classes.toml",
        "rush-hours.toml",
    ] {
        let path = examples_folder().join(name);
        let scenario = load(path.to_str().expect("UTF-8"), &[]).expect(name).scenario;
        let reloaded = load_text(&scenario.to_toml()).expect(name);
        assert_eq!(scenario, reloaded, "{}", scenario.to_toml());
        assert_eq!(scenario.hash(), reloaded.hash());
    }
    let solar_scenario = load(examples_folder().join("solar.toml").to_str().expect("UTF-8"), &[])
        .expect("valid")
        .scenario;
    let Harvest::Trace(trace) = &solar_scenario.classes[0].harvest else {
        panic!("{:?}", solar_scenario.classes[0].harvest);
    };
    assert_eq!((trace.values.len(), trace.values[0].len()), (1, 14 * 24));
}

#[test]
fn alpha_of_bursts_is_the_mean_of_both_phases() {
    let path = examples_folder().join("rush-hours.toml");
    let events = load(path.to_str().expect("UTF-8"), &[]).expect("valid").scenario.events;
    let ProcessSettings::Bursts(EventBursts {
        busy_alpha,
        quiet_alpha,
        ..
    }) = events.process
    else {
        panic!("{events:?}");
    };
    // 60 of the 300 TTIs are busy.
    assert!(
        (events.alpha - (busy_alpha + 4.0 * quiet_alpha) / 5.0).abs() < 1e-15,
        "{events:?}"
    );
    let with_defaults = load("paper", &overrides(&["events.process=bursts"]))
        .expect("valid")
        .scenario
        .events;
    // The defaults: 0.8 in 40 busy TTIs, 0.02 in 160 quiet ones.
    assert!((with_defaults.alpha - 0.176).abs() < 1e-15, "{with_defaults:?}");
}

#[test]
fn an_override_replaces_the_shared_column() {
    let path = examples_folder().join("solar.toml");
    let columns = overrides(&[
        "harvest.trace.columns=[\"hour\", \"ghi_w_m2\"]",
        "harvest.trace.scale=0.001",
    ]);
    let scenario = load(path.to_str().expect("UTF-8"), &columns).expect("valid").scenario;
    let Harvest::Trace(trace) = &scenario.classes[0].harvest else {
        panic!("{:?}", scenario.classes[0].harvest);
    };
    assert_eq!(trace.values.len(), 2);
    assert_eq!(load_text(&scenario.to_toml()).expect("valid"), scenario);
}

#[test]
fn the_hash_covers_exactly_the_fields_that_affect_a_run() {
    let hash = |fields: &[&str]| load_paper(fields).hash_hex();
    let quick = load("quick", &overrides(&["devices=50", "ttis=10000"]))
        .expect("valid")
        .scenario;
    assert_eq!(hash(&[]), quick.hash_hex());
    assert_ne!(load_paper(&[]), quick, "the name of the preset differs");
    for changed in [
        "seed=2",
        "energy.e_wur=0.071428",
        "policy.name=random",
        "harvest.lambda=0.2",
        "layout.kind=hex",
        "tau=2",
        "events.process=bursts",
        "events.duration_kind=geometric",
        "harvest.kind=diurnal",
    ] {
        assert_ne!(hash(&[]), hash(&[changed]), "{changed}");
    }
    for (process, changed) in [
        ("hot-spots", "events.hot-spots.sigma=1.4"),
        ("aftershocks", "events.aftershocks.radius=3"),
        ("bursts", "events.bursts.quiet_ttis=80"),
    ] {
        let process = format!("events.process={process}");
        assert_ne!(hash(&[&process]), hash(&[&process, changed]), "{changed}");
        assert_eq!(hash(&[]), hash(&[changed]), "{changed} has no effect");
    }
    let bursts = "events.process=bursts";
    assert_eq!(hash(&[bursts]), hash(&[bursts, "events.alpha=0.9"]));
    let folder = create_folder(
        "hash",
        &[("a.csv", "w\n1\n2\n"), ("b.csv", "w\n1\n2\n"), ("c.csv", "w\n1\n3\n")],
    );
    let hash_of_trace = |file: &str| {
        let text = format!("[harvest]\nkind = \"trace\"\ntrace = {{ file = \"{file}\", column = \"w\" }}");
        parse(&text, "my.toml", &folder, &[]).expect("valid").scenario.hash()
    };
    assert_eq!(hash_of_trace("a.csv"), hash_of_trace("b.csv"));
    assert_ne!(hash_of_trace("a.csv"), hash_of_trace("c.csv"));
    std::fs::remove_dir_all(&folder).expect("its own folder");
}

/// The name `default` also marks the only class of a scenario without classes.
#[test]
fn a_class_may_be_called_default() {
    let folder = create_folder("default", &[("p.csv", "x,y,class\n1,2,default\n3,4,default\n")]);
    let header = "devices = 2\nlayout.kind = \"file\"\nlayout.file = \"p.csv\"\n[[class]]\nname = \"default\"\n";
    for members in ["", "share = 1.0\n", "devices = [0, 1]\n"] {
        let text = format!("{header}{members}harvest.e_b = 3\n");
        let scenario = parse(&text, "my.toml", &folder, &[]).expect("valid").scenario;
        let reloaded = parse(&scenario.to_toml(), "again.toml", &folder, &[]).expect("valid");
        assert_eq!(reloaded.scenario, scenario, "{members:?}");
        assert_eq!(reloaded.warnings, [""; 0], "{members:?}");
    }
    let zone = "devices = 2\n[[class]]\nname = \"default\"\nwest = 0.0\n";
    let scenario = parse(zone, "my.toml", &folder, &[]).expect("valid").scenario;
    let reloaded = parse(&scenario.to_toml(), "again.toml", &folder, &[]).expect("valid");
    assert_eq!(reloaded.scenario, scenario);
    // A declared class that equals the undeclared one is the same scenario.
    let declared = parse("[[class]]\nname = \"default\"\nshare = 1.0\n", "my.toml", &folder, &[]).expect("valid");
    assert_eq!(declared.scenario.hash(), load_paper(&[]).hash());
}

#[test]
fn a_layout_file_can_set_the_class_of_each_device() {
    let layout_with_classes = "x,y,class\n1,2,weak\n3,4,strong\n5,6,weak\n";
    let files = [
        ("good.csv", layout_with_classes),
        ("bad.csv", "x,y,class\n1,2,weak\n3,4,stron\n"),
        ("plain.csv", "x,y\n1,2\n3,4\n"),
    ];
    let folder = create_folder("classes", &files);
    let text = |file: &str, share: &str| {
        format!(
            "devices = 2\nlayout.kind = \"file\"\nlayout.file = \"{file}\"\n[[class]]\nname = \"strong\"\n{share}\n\
             [[class]]\nname = \"weak\"\n{share}\n"
        )
    };
    let load_layout = |file: &str, share: &str| parse(&text(file, share), "my.toml", &folder, &[]);
    let Loaded {
        scenario: classes_by_layout,
        warnings,
    } = load_layout("good.csv", "").expect("valid");
    assert_eq!(assign_classes(&classes_by_layout), [1, 0]);
    assert!((classes_by_layout.classes[0].share - 0.5).abs() < 1e-12);
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    assert!(warnings[0].contains("good.csv has 3 positions; the first 2 are used"));
    assert_eq!(
        load_text(&classes_by_layout.to_toml()).expect("valid"),
        classes_by_layout
    );
    let with_shares = load_layout("good.csv", "share = 0.5").expect("valid");
    assert!(
        with_shares
            .warnings
            .iter()
            .any(|w| w.starts_with("class.share, class.devices and zones have no effect"))
    );
    assert_eq!(with_shares.scenario.hash(), classes_by_layout.hash());
    let unknown_class = load_layout("bad.csv", "").expect_err("no such class").to_string();
    assert!(
        unknown_class.contains("line 3, column `class`: the scenario has no class \"stron\"")
            && unknown_class.contains("did you mean `strong`?"),
        "{unknown_class}"
    );
    let missing_shares = load_layout("plain.csv", "").expect_err("no shares").to_string();
    assert!(
        missing_shares.contains("class.strong.share: required because of class.strong.name"),
        "{missing_shares}"
    );
    std::fs::remove_dir_all(&folder).expect("its own folder");
}
