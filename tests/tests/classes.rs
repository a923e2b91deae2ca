//! Device classes: a field of energy or harvest affects only the devices of its class, in the base station's knowledge,
//! the ledgers and the digest. Traces and the fields of single kinds of harvest are not varied. The assignment of
//! devices to classes is checked against the scenario's text.

use std::path::Path;

use reveille_bs::cycle::PreparedRun;
use reveille_bs::knowledge::Knowledge;
use reveille_bs::scenario::{Loaded, Scenario, parse};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::scenario::assign_classes;
use reveille_common::score::Digest;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::compare;
use reveille_tests::scenarios::overrides;

/// Ten devices of class `few` (index 0), the others of class `rest` (index 1).
const TWO_CLASSES: &str = "preset = \"paper\"\ndevices = 40\nttis = 1500\nwarm_up = 0\npolicy.name = \"random\"\n\
                           [[class]]\nname = \"few\"\ndevices = [0, 3, 5, 8, 13, 20, 21, 34, 38, 39]\n\
                           [[class]]\nname = \"rest\"\nshare = 1\n";

/// Loads `text` with `fields` overridden.
fn load(text: &str, fields: &[&str]) -> Scenario {
    load_with_warnings(text, fields).scenario
}

fn load_with_warnings(text: &str, fields: &[&str]) -> Loaded {
    parse(text, "test", Path::new(""), &overrides(fields)).unwrap_or_else(|error| panic!("{error}"))
}

fn digest(prepared: &PreparedRun) -> Digest {
    Run::new(prepared, RunOptions::default()).finish(&mut ()).digest
}

#[test]
fn a_field_of_a_class_affects_only_its_devices() {
    let unchanged = prepare(&load(TWO_CLASSES, &[]));
    let (unchanged_digest, unchanged_knowledge) = (digest(&unchanged), unchanged.knowledge());
    for field in [
        "energy.e_max=60",
        "energy.e_idle=1.5",
        "energy.e_wur=0.2",
        "energy.e_tx=7",
        "energy.initial=20",
        "harvest.lambda=0.3",
        "harvest.e_b=2",
        "harvest.kind=exp-minus-lambda",
        "harvest.kind=mpp",
        "harvest.kind=diurnal",
    ] {
        let changed = prepare(&load(TWO_CLASSES, &[&format!("class.few.{field}")]));
        assert_ne!(changed.scenario.hash(), unchanged.scenario.hash(), "{field}");
        assert_ne!(digest(&changed), unchanged_digest, "{field}");
        let changed_knowledge = changed.knowledge();
        let devices = unchanged_knowledge.devices.iter().zip(&changed_knowledge.devices);
        for (j, (unchanged_device, changed_device)) in (0..).zip(devices) {
            let expected_harvest = |knowledge: &Knowledge| knowledge.expected_harvest(DeviceId(j), Tti(100), Tti(150));
            let is_same = unchanged_device.energy == changed_device.energy
                && unchanged_device.mean_harvest == changed_device.mean_harvest
                && expected_harvest(&unchanged_knowledge) == expected_harvest(&changed_knowledge);
            // mpp is on for the same share of time as eq5; only its draws differ.
            let must_differ = unchanged_device.class == 0 && field != "harvest.kind=mpp";
            assert_eq!(is_same, !must_differ, "{field}, device {j}");
        }
    }
}

/// Compares the ledgers of devices with the costs of their class, in micro-units. The two classes share no setting.
/// Under `random` no device is woken, so S4 costs only E_WuR.
#[test]
fn devices_pay_the_costs_of_their_class() {
    let fields = [
        "class.few.energy.e_max=40",
        "class.few.energy.e_idle=0.25",
        "class.few.energy.e_wur=0.03",
        "class.few.energy.e_tx=3",
        "class.few.energy.initial=30",
        "class.few.harvest.lambda=1",
        "class.few.harvest.e_b=7",
        "energy.e_idle=0.5",
    ];
    let scenario = load(TWO_CLASSES, &fields);
    let classes = assign_classes(&scenario);
    let ledgers = compare::ledgers(&scenario, RunOptions::default());
    let (mut reports_by_class, mut overflow_by_class) = ([0; 2], [0; 2]);
    for (j, (ledger, &class)) in ledgers.iter().zip(&classes).enumerate() {
        let (class, totals) = (usize::from(class), ledger.whole);
        // Class `few` as above, and class `rest` as in the preset with the changed e_idle.
        let [e_max, e_idle, e_wur, e_tx, initial, e_b] = [
            [40_000_000, 250_000, 30_000, 3_000_000, 30_000_000, 7_000_000],
            [100_000_000, 500_000, 71_429, 10_000_000, 50_000_000, 5_000_000],
        ][class];
        assert_eq!(totals.initial.micro(), initial, "device {j}");
        assert_eq!(totals.harvested.micro() % e_b, 0, "device {j}");
        assert!(totals.battery.micro() <= e_max, "device {j}");
        overflow_by_class[class] += totals.overflow.micro();
        // A failed action costs the remaining charge, not the full cost.
        if totals.failed_ttis + totals.unpowered_ttis > 0 {
            continue;
        }
        let sleeping_ttis = scenario.run.ttis - totals.sensing_ttis;
        assert_eq!(totals.spent.sensing.micro(), e_idle * totals.sensing_ttis, "device {j}");
        assert_eq!(totals.spent.sleep.micro(), e_wur * sleeping_ttis, "device {j}");
        reports_by_class[class] += totals.spent.report.micro() / e_tx;
    }
    assert!(
        reports_by_class.iter().all(|&reports| reports > 10),
        "{reports_by_class:?}"
    );
    assert!(
        overflow_by_class[0] > 0,
        "no overflow of a small battery: {overflow_by_class:?}"
    );
}

#[test]
fn classes_select_devices_by_id_then_zone_then_share() {
    let text = "preset = \"paper\"\ndevices = 200\n\
                [[class]]\nname = \"west\"\neast = 8\n\
                [[class]]\nname = \"south\"\nnorth = 5.0\nwest = 2\n\
                [[class]]\nname = \"listed\"\ndevices = [7, 100]\n\
                [[class]]\nname = \"a\"\nshare = 0.75\n[[class]]\nname = \"b\"\nshare = 0.25\n";
    // Indices: west 0, south 1, listed 2, a 3, b 4. `east = 8` is the east edge of a zone.
    let scenario = load(text, &[]);
    let prepared = prepare(&scenario);
    let (classes, mut counts) = (assign_classes(&scenario), [0_usize; 5]);
    for (j, (device, &class)) in prepared.knowledge().devices.iter().zip(&classes).enumerate() {
        let position = device.position;
        let selected_class = match j {
            7 | 100 => Some(2),
            _ if position.x <= 8.0 => Some(0),
            _ if position.y <= 5.0 => Some(1),
            _ => None,
        };
        assert!(
            selected_class.map_or(class == 3 || class == 4, |selected| selected == class),
            "device {j} at {position:?} has class {class}"
        );
        counts[usize::from(class)] += 1;
    }
    let devices_by_share = counts[3] + counts[4];
    assert!(
        (counts[3] as f64 - 0.75 * devices_by_share as f64).abs() < 1.0,
        "{counts:?}"
    );
    assert!(counts.iter().all(|&count| count > 0), "{counts:?}");
    for (class, &count) in scenario.classes.iter().zip(&counts) {
        assert!((class.share - count as f64 / 200.0).abs() < 1e-12, "{}", class.name);
    }
    let reloaded = load(&scenario.to_toml(), &[]);
    assert_eq!(reloaded, scenario);
    assert_eq!(reloaded.hash(), scenario.hash());
}

#[test]
fn an_invalid_selection_of_devices_is_refused_with_the_reason() {
    let class = |name: &str, fields: &str| format!("[[class]]\nname = \"{name}\"\n{fields}\n");
    let error_message = |text: &str| {
        let text = format!("devices = 10\n{text}");
        parse(&text, "my.toml", Path::new(""), &[])
            .expect_err("not valid")
            .to_string()
    };
    // The messages are defined in `common/src/scenario/`: `classes.rs`, `class_members.rs` and `validate.rs`.
    for (text, expected) in [
        (
            class("a", "devices = [0, 10]"),
            "class.a.devices = 10: must be below 10, the number of devices",
        ),
        (class("a", "devices = [1, 1]"), "class.a.devices = 1: is listed twice"),
        (
            class("a", "devices = [1]") + &class("b", "devices = [1]"),
            "class.b.devices = 1: is listed twice",
        ),
        (class("a", "devices = [1]"), "device 0 has no class; set class.share"),
        (
            class("a", "devices = [1]\nshare = 1"),
            "selects its devices in several ways",
        ),
        (class("a", "west = 5\nshare = 1"), "selects its devices in several ways"),
        (
            class("a", "west = 5\neast = 4"),
            "class.a.west = 5: must be at most 4, the east edge of the zone",
        ),
        (
            class("a", "south = 21"),
            "class.a.south = 21: must be at most 20, the north edge of the zone",
        ),
        (
            class("a", "devices = [1]") + &class("b", "share = 0.5"),
            "must add up to 1, not to 0.5",
        ),
    ] {
        let message = error_message(&text);
        assert!(message.contains(expected), "{message:?} does not contain {expected:?}");
    }
    let empty_class = load_with_warnings(
        "devices = 10\n[[class]]\nname = \"a\"\nnorth = 0\n[[class]]\nname = \"b\"\nshare = 1\n",
        &[],
    );
    assert!(
        empty_class
            .warnings
            .iter()
            .any(|warning| warning.starts_with("no device has the class `a`"))
    );
}
