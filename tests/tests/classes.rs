//! Device classes: each field of energy and harvest affects only the devices of its class, in the base station's
//! knowledge, the ledgers and the digest. Devices get the class that the scenario assigns.

use std::path::Path;

use reveille_bs::cycle::PreparedRun;
use reveille_bs::scenario::{Loaded, Override, Scenario, parse};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::scenario::assign_classes;
use reveille_common::score::Digest;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::compare;

/// Ten devices of class `few`, the others of class `rest`.
const TWO: &str = "preset = \"paper\"\ndevices = 40\nttis = 1500\nwarm_up = 0\npolicy.name = \"random\"\n\
                   [[class]]\nname = \"few\"\ndevices = [0, 3, 5, 8, 13, 20, 21, 34, 38, 39]\n\
                   [[class]]\nname = \"rest\"\nshare = 1\n";

fn load(text: &str, set: &[&str]) -> Scenario {
    loaded(text, set).scenario
}

fn loaded(text: &str, set: &[&str]) -> Loaded {
    let set: Vec<Override> = set
        .iter()
        .map(|set| Override::parse(set).expect("an override"))
        .collect();
    parse(text, "test", Path::new(""), &set).unwrap_or_else(|error| panic!("{error}"))
}

fn digest(prepared: &PreparedRun) -> Digest {
    Run::new(prepared, RunOptions::default()).finish(&mut ()).digest
}

#[test]
fn every_override_acts_on_its_class_alone() {
    let plain = prepare(&load(TWO, &[]));
    let (before, known) = (digest(&plain), plain.knowledge());
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
        let changed = prepare(&load(TWO, &[&format!("class.few.{field}")]));
        assert_ne!(changed.scenario.hash(), plain.scenario.hash(), "{field}");
        assert_ne!(digest(&changed), before, "{field}");
        let others = changed.knowledge();
        for (j, (device, other)) in (0..).zip(known.devices.iter().zip(&others.devices)) {
            let is_known =
                |of: &reveille_bs::knowledge::Knowledge| of.expected_harvest(DeviceId(j), Tti(100), Tti(150));
            let is_same = (device.energy, device.mean_harvest) == (other.energy, other.mean_harvest)
                && is_known(&known) == is_known(&others);
            // mpp is on for the same share of time as eq5; only its draws differ.
            let differs = device.class == 0 && field != "harvest.kind=mpp";
            assert_eq!(is_same, !differs, "{field}, device {j}");
        }
    }
}

/// Compares the ledgers of two classes that share no setting.
#[test]
fn each_class_is_billed_by_its_own_costs() {
    let set = [
        "class.few.energy.e_max=40",
        "class.few.energy.e_idle=0.25",
        "class.few.energy.e_wur=0.03",
        "class.few.energy.e_tx=3",
        "class.few.energy.initial=30",
        "class.few.harvest.lambda=1",
        "class.few.harvest.e_b=7",
        "energy.e_idle=0.5",
    ];
    let scenario = load(TWO, &set);
    let (classes, ledgers) = (assign_classes(&scenario), compare::ledgers(&scenario, true));
    let (mut reports, mut overflow) = ([0; 2], [0; 2]);
    for (j, (ledger, &class)) in ledgers.iter().zip(&classes).enumerate() {
        let (class, sums) = (usize::from(class), ledger.whole);
        let [e_max, e_idle, e_wur, e_tx, initial, e_b] = [
            [40_000_000, 250_000, 30_000, 3_000_000, 30_000_000, 7_000_000],
            [100_000_000, 500_000, 71_429, 10_000_000, 50_000_000, 5_000_000],
        ][class];
        assert_eq!(sums.initial.micro(), initial, "device {j}");
        assert_eq!(sums.harvested.micro() % e_b, 0, "device {j}");
        assert!(sums.battery.micro() <= e_max, "device {j}");
        overflow[class] += sums.overflow.micro();
        if sums.failed_ttis + sums.unpowered_ttis > 0 {
            continue;
        }
        let asleep = scenario.run.ttis - sums.sensing_ttis;
        assert_eq!(sums.spent.sensing.micro(), e_idle * sums.sensing_ttis, "device {j}");
        assert_eq!(sums.spent.sleep.micro(), e_wur * asleep, "device {j}");
        reports[class] += sums.spent.report.micro() / e_tx;
    }
    assert!(reports.iter().all(|&reports| reports > 10), "{reports:?}");
    assert!(
        overflow[0] > 0,
        "a small battery under much sun overflows: {overflow:?}"
    );
}

#[test]
fn devices_are_of_the_class_that_names_them_or_their_place_and_the_rest_by_share() {
    let text = "preset = \"paper\"\ndevices = 200\n\
                [[class]]\nname = \"west\"\neast = 8\n\
                [[class]]\nname = \"south\"\nnorth = 5.0\nwest = 2\n\
                [[class]]\nname = \"listed\"\ndevices = [7, 100]\n\
                [[class]]\nname = \"a\"\nshare = 0.75\n[[class]]\nname = \"b\"\nshare = 0.25\n";
    let scenario = load(text, &[]);
    let prepared = prepare(&scenario);
    let (classes, mut counts) = (assign_classes(&scenario), [0_usize; 5]);
    for (j, (device, &class)) in prepared.knowledge().devices.iter().zip(&classes).enumerate() {
        let at = device.position;
        let expected = match j {
            7 | 100 => Some(2),
            _ if at.x <= 8.0 => Some(0),
            _ if at.y <= 5.0 => Some(1),
            _ => None,
        };
        assert!(
            expected.map_or(class == 3 || class == 4, |of| of == class),
            "device {j} at {at:?}: {class}"
        );
        counts[usize::from(class)] += 1;
    }
    let left = counts[3] + counts[4];
    assert!((counts[3] as f64 - 0.75 * left as f64).abs() < 1.0, "{counts:?}");
    assert!(counts.iter().all(|&count| count > 0), "{counts:?}");
    for (class, &count) in scenario.classes.iter().zip(&counts) {
        assert!((class.share - count as f64 / 200.0).abs() < 1e-12, "{}", class.name);
    }
    let again = load(&scenario.to_toml(), &[]);
    assert_eq!(again, scenario);
    assert_eq!(again.hash(), scenario.hash());
}

#[test]
fn errors_of_members_name_a_fix() {
    let class = |name: &str, fields: &str| format!("[[class]]\nname = \"{name}\"\n{fields}\n");
    let message = |text: &str| {
        let text = format!("devices = 10\n{text}");
        parse(&text, "my.toml", Path::new(""), &[])
            .expect_err("not valid")
            .to_string()
    };
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
        let found = message(&text);
        assert!(found.contains(expected), "{found}, not {expected}");
    }
    let empty_class = loaded(
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
