//! Tests of the errors for invalid scenarios and of the warnings: field, value, allowed values and place. The texts are
//! in `common/src/declare/`, `common/src/scenario/` and the modules of layouts, harvests and policies.

use std::path::Path;

use reveille_common::declare::{FORMER_NAME_NOTICE, quoted_list};
use reveille_common::geometry::Layout;

use super::*;

#[test]
fn messages_name_field_value_range_and_line() {
    let error = load_text("\n\n[sensing]\nd_max = 50\n").expect_err("too far");
    assert_eq!(
        error.to_string(),
        "sensing.d_max = 50: must be greater than 0 and at most 28.28 (the area's diagonal in metres); set in my.toml, \
         line 4"
    );
    for (text, start, place) in [
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
            "energy.e_idle = -1: must be at least 0 and at most 1e9 units",
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
            // (2⁶⁴ micro-units / 10⁶ devices − 100 units) / (5 + 1 + 1/14 + 10 units), rounded down.
            "ttis = 1000000000: must be at most 1147791",
            "line 2",
        ),
        ("seed = = 1", "my.toml, line 1: not valid TOML", ""),
    ] {
        let message = load_text(text).expect_err(text).to_string();
        assert!(message.starts_with(start), "{text}: {message}");
        assert!(message.contains(place), "{text}: {message}");
        assert!(!message.contains('\n'), "{text}: several lines: {message}");
    }
}

#[test]
fn text_without_quotes_has_a_hint() {
    for text in ["layout.kind = two", "layout.kind = file"] {
        let message = load_text(text).expect_err(text).to_string();
        assert!(message.starts_with("my.toml, line 1: not valid TOML"), "{message}");
        assert!(message.contains("put text in quotes"), "{message}");
    }
}

#[test]
fn pilot_runs_have_the_limits_of_runs() {
    let text = "devices = 1_000_000\nttis = 1000\npolicy.name = \"adjusted\"\npolicy.adjusted.pilot_ttis = 1_000_000\n\
                harvest.e_b = 100";
    let message = load_text(text).expect_err("too long").to_string();
    // (2⁶⁴ micro-units / 10⁶ devices − 100 units) / (100 + 1 + 1/14 + 10 units), rounded down.
    let expected = "policy.adjusted.pilot_ttis = 1000000: must be at most 166079 with 1000000 devices that hold up to \
                    100 units and harvest or spend up to 111.1 units in a TTI";
    assert!(
        message.starts_with(expected) && message.ends_with("line 4"),
        "{message}"
    );
}

#[test]
fn full_batteries_of_all_devices_must_fit_in_64_bits() {
    let text = |devices: u32| format!("devices = {devices}\nttis = 10\n[energy]\ne_max = 1_000_000_000");
    load_text(&text(18_000)).expect("their batteries fit");
    let message = load_text(&text(20_000)).expect_err("too much energy").to_string();
    // 2⁶³ micro-units / 20000 devices: half of the energy that fits, so that some TTIs remain.
    assert_eq!(
        message,
        "energy.e_max = 1000000000 units: must be at most 461168601.842738 units with 20000 devices, or sums of energy \
         overflow; set in my.toml, line 4"
    );
}

#[test]
fn t_on_must_not_exceed_the_shortest_t_drx() {
    let message = load_text("policy.name = \"random\"\npolicy.random.t_on = [1, 4]").expect_err("too long");
    assert_eq!(
        message.to_string(),
        "policy.random.t_on = [1, 4]: must not exceed 2, the shortest of policy.random.t_drx; set in my.toml, line 2"
    );
}

#[test]
fn messages_on_a_class_name_the_class() {
    let two_classes = |extra: &str| format!("[[class]]\nname = \"a\"\nshare = 0.5\n[[class]]\nname = \"b\"\n{extra}\n");
    for (text, expected) in [
        (
            two_classes("share = 0.4"),
            "class = shares 0.5 + 0.4: the shares of all classes must add up to 1, not to 0.9",
        ),
        (
            two_classes(""),
            "class.b.share: required because of class.b.name, set in my.toml, line 5",
        ),
        (
            two_classes("share = 0.5\nenergy.e_tx = 200"),
            "class.b.energy.e_tx = 200: must be at most 100 units",
        ),
        (
            two_classes("share = 0.5\nenergy.e_max = 5"),
            "energy.e_tx = 10: must be at most 5 units (class.b.energy.e_max)",
        ),
        (
            two_classes("share = 0.5\nenergy.e_tx = \"x\""),
            "class.b.energy.e_tx = \"x\": must be a number; set in my.toml, line 7",
        ),
        (
            two_classes("share = 0.5\nenergy.etx = 2"),
            "unknown field `class.b.energy.etx`; did you mean `class.b.energy.e_tx`?",
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
        let message = load_text(&text).expect_err(&text).to_string();
        assert!(message.contains(expected), "{text}: {message}");
    }
}

#[test]
fn tables_in_place_of_values_are_refused() {
    let message = |text: &str| load_text(text).expect_err(text).to_string();
    let number_error = message("[devices]\nn = 3");
    assert!(number_error.starts_with("devices = {…}: must be"), "{number_error}");
    let list_error = message("[class.a]\nshare = 1");
    let expected = "class = {…}: must be a list: write [[class]] for each item";
    assert!(list_error.starts_with(expected), "{list_error}");
}

#[test]
fn unknown_fields_are_refused_with_a_suggestion() {
    let without_fields = load_text("[policy.genie]\nx = 1\n")
        .expect_err("genie has no fields")
        .to_string();
    assert!(
        without_fields.starts_with("unknown field `policy.genie`; the policy `genie` has no fields; set in my.toml"),
        "{without_fields}"
    );
    let folder_error = load(env!("CARGO_MANIFEST_DIR"), &[]).expect_err("a folder");
    assert!(
        std::error::Error::source(&folder_error).is_none(),
        "the message already contains the source"
    );
    for (text, message) in [
        (
            "[bs]\nsync = 5",
            "unknown field `bs.sync`; set in my.toml, line 2; the fields there are `sync_interval`, `ranking`, \
             `battery_knowledge`",
        ),
        (
            "[events]\nalhpa = 0.1",
            "unknown field `events.alhpa`; did you mean `events.alpha`?; set in my.toml, line 2; the fields there \
             are `process`, `alpha`, `duration`, `duration_kind`, `hot-spots`, `aftershocks`, `bursts`",
        ),
    ] {
        assert_eq!(load_text(text).expect_err(text).to_string(), message);
    }
    let wrong_section = load_text("seed = 1\nd_max = 3").expect_err("wrong section").to_string();
    assert!(
        wrong_section.starts_with("unknown field `d_max`; did you mean `sensing.d_max`?; set in my.toml, line 2"),
        "{wrong_section}"
    );
}

#[test]
fn overrides_are_checked_as_files_are() {
    for (text, expected) in [
        (
            "sensing.d_max=50",
            "(the area's diagonal in metres); set by --set sensing.d_max=50",
        ),
        (
            "sensing.dmax=5",
            "unknown field `sensing.dmax`; did you mean `sensing.d_max`?; set by --set sensing.dmax=5",
        ),
        ("sense.d_max=5", "unknown field `sense`"),
        (
            "area={widht=3}",
            "unknown field `area.widht`; did you mean `area.width`?",
        ),
        (
            "policy.name=nkn",
            &format!(
                "policy.name = nkn: must be one of {}; did you mean `knn`?",
                quoted_list(registry::names())
            ),
        ),
        ("ttis=1.5", "ttis = 1.5: must be a whole number"),
        (
            "class.x.share=1",
            "class = x: must be the name of a class; there are (none); set by --set",
        ),
    ] {
        let message = load("paper", &overrides(&[text])).expect_err(text).to_string();
        assert!(message.contains(expected), "{message}");
    }
    let from_flag = Override::from_flag("--devices", "devices", "0").expect("well-formed");
    let message = load("paper", &[from_flag]).expect_err("no devices").to_string();
    assert!(message.ends_with("; set by --devices"), "{message}");
    let unknown_preset = load("qiuck", &[]).expect_err("no such file").to_string();
    assert!(unknown_preset.contains("did you mean `quick`?"), "{unknown_preset}");
}

#[test]
fn errors_in_data_files_name_row_and_column() {
    let files = [
        ("p.csv", "x,y\n1,2\n3,4\n"),
        ("out.csv", "x,y\n1,2\n30,4\n"),
        ("t.csv", "hour,w\n0,1\n1,-2\n"),
        ("empty.csv", "hour,w\n"),
        ("t.parquet", "PAR1"),
    ];
    let folder = create_folder("rows", &files);
    let layout = |file: &str| format!("devices = 2\n[layout]\nkind = \"file\"\nfile = \"{file}\"\n");
    let trace = |file: &str, column: &str| {
        format!("[harvest]\nkind = \"trace\"\ntrace.file = \"{file}\"\ntrace.column = \"{column}\"\n")
    };
    for (text, expected) in [
        (
            layout("p.csv").replace('2', "3"),
            "p.csv\": has 2 points, too few for 3 devices; set in my.toml, line 4",
        ),
        (
            layout("out.csv"),
            "line 3: the point (30, 4) lies outside the area of 20 by 20 metres",
        ),
        (layout("none.csv"), "none.csv\": no such file; correct the path"),
        (layout("t.csv"), "has no column `x`; its columns are `hour`, `w`"),
        (
            trace("t.csv", "v"),
            "has no column `v`; its columns are `hour`, `w`; set in my.toml, line 3",
        ),
        (trace("t.csv", "w"), "line 3, column `w`: -2 times"),
        (trace("empty.csv", "w"), "has no rows"),
        // Without the cargo feature `parquet` the message is another one.
        (trace("t.parquet", "w"), "arquet"),
        (trace("", "w"), "harvest.trace.file = \"\": must be the path"),
        (
            trace("t.csv", "w") + "trace.columns = [\"w\"]",
            "excludes harvest.trace.columns",
        ),
    ] {
        let message = parse(&text, "my.toml", &folder, &[]).expect_err(&text).to_string();
        assert!(message.contains(expected), "{message}");
    }
    let scenario = parse(&layout("p.csv"), "my.toml", &folder, &[])
        .expect("valid")
        .scenario;
    assert!(matches!(&scenario.layout, Layout::File(file) if file.points.len() == 2));
    assert_eq!(load_text(&scenario.to_toml()).expect("valid"), scenario);
    std::fs::remove_dir_all(folder).expect("its own folder");
}

#[test]
fn fields_without_effect_are_warned_of() {
    let classes = "[[class]]\nname = \"a\"\nshare = 0.5\nharvest.lambda = 0.3\n\
                   [[class]]\nname = \"b\"\nshare = 0.5\nharvest.lambda = 0.2\n";
    let lambda = overrides(&["harvest.lambda=0.7"]);
    let warnings = parse(classes, "t", Path::new(""), &lambda).expect("valid").warnings;
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    assert!(
        warnings[0].starts_with("harvest.lambda = 0.7 has no effect on any class"),
        "{warnings:?}"
    );
    assert!(warnings[0].ends_with("set by --set harvest.lambda=0.7"), "{warnings:?}");
    let b_without_lambda = classes.replace("harvest.lambda = 0.2\n", "");
    assert!(
        parse(&b_without_lambda, "t", Path::new(""), &lambda)
            .expect("valid")
            .warnings
            .is_empty()
    );
    let scale_warnings = load("paper", &overrides(&["harvest.trace.scale=2"]))
        .expect("valid")
        .warnings;
    assert!(
        scale_warnings[0].contains("has an effect only with harvest.kind = \"trace\""),
        "{scale_warnings:?}"
    );
    let solar = examples_folder().join("solar.toml");
    let solar_warnings = load(solar.to_str().expect("UTF-8"), &lambda).expect("valid").warnings;
    assert!(
        solar_warnings[0].starts_with("harvest.lambda = 0.7 has an effect only with"),
        "{solar_warnings:?}"
    );
    let without_effect = [
        (
            "bursts",
            "events.alpha=0.5",
            "only with events.process = \"uniform\" or \"hot-spots\" or \"aftershocks\"",
        ),
        (
            "uniform",
            "events.bursts.quiet_ttis=5",
            "only with events.process = \"bursts\"",
        ),
        (
            "bursts",
            "events.hot-spots.share=0.5",
            "only with events.process = \"hot-spots\"",
        ),
        (
            "hot-spots",
            "events.aftershocks.radius=1",
            "only with events.process = \"aftershocks\"",
        ),
    ];
    for (process, field, expected) in without_effect {
        let process = format!("events.process={process}");
        let warnings = load("paper", &overrides(&[&process, field])).expect("valid").warnings;
        assert!(
            matches!(&warnings[..], [warning] if warning.contains(expected)),
            "{process} {field}: {warnings:?}"
        );
    }
    for preset in PRESETS {
        assert!(load(preset.name, &[]).expect("a preset").warnings.is_empty());
    }
}

#[test]
fn former_field_names_are_accepted_with_a_warning() {
    let dt = "policy.name=dt";
    let hash = |fields: &[&str]| load("paper", &overrides(fields)).expect("valid").scenario.hash();
    for (former, current) in [
        (vec!["radio.false_wake=0.1"], vec!["radio.false_wake_up=0.1"]),
        (vec![dt, "policy.dt.in_vain=0.2"], vec![dt, "policy.dt.miss_cost=0.2"]),
    ] {
        let warnings = load("paper", &overrides(&former)).expect("valid").warnings;
        let (former_override, current_override) = (former.last().expect("one"), current.last().expect("one"));
        let name = |field: &str| field.split('=').next().unwrap_or_default().to_owned();
        let expected = format!(
            "{} is now called {} (set by --set {former_override})",
            name(former_override),
            name(current_override)
        );
        assert!(
            matches!(
                &warnings[..],
                [warning] if warning.starts_with(&expected) && warning.ends_with(FORMER_NAME_NOTICE)
            ),
            "{warnings:?}"
        );
        assert_eq!(hash(&former), hash(&current));
        let former_then_current: Vec<&str> = former.iter().chain(&current).copied().collect();
        assert_eq!(hash(&former_then_current), hash(&current), "the later override applies");
    }
    let file = parse("[radio]\nfalse_wake = 0.1\n", "my.toml", Path::new(""), &[]).expect("valid");
    assert!(
        file.warnings[0].contains("(set in my.toml, line 2)"),
        "{:?}",
        file.warnings
    );
}

#[test]
fn a_former_name_next_to_the_current_one_is_refused() {
    let file = "[radio]\nfalse_wake = 0.1\nfalse_wake_up = 0.2\n";
    let error = parse(file, "my.toml", Path::new(""), &[]).expect_err("two values");
    let expected = "radio.false_wake is the former name of radio.false_wake_up, and the file sets both: remove \
                    radio.false_wake; set in my.toml, line 2";
    assert_eq!(error.to_string(), expected);
    let option = overrides(&["radio={ false_wake = 0.1, false_wake_up = 0.2 }"]);
    let message = load("paper", &option).expect_err("two values").to_string();
    assert!(
        message.contains("and the option sets both: remove radio.false_wake; set by --set"),
        "{message}"
    );
}
