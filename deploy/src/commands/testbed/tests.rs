//! The files of a testbed: `compose.yml` is parsed as YAML and compared with the deployment of the scenario.

use std::collections::BTreeMap;

use clap::Parser;
use reveille_common::deployment::Deployment;
use serde_yaml::Value;

use super::compose::compose_text;
use super::*;
use crate::cli::{Cli, Command};

/// A scenario with 80 devices of the class weak and 20 of the class strong, whose battery holds 200 units.
const TWO_CLASSES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios/two-classes.toml");

/// Returns the testbed that `testbed init OPTIONS` describes.
fn testbed(options: &str) -> anyhow::Result<Testbed> {
    let line = format!("reveille testbed init --out demo {options}");
    let Command::Testbed(args) = Cli::try_parse_from(line.split_whitespace())?.command else {
        unreachable!("the line names the command")
    };
    let TestbedCommand::Init(args) = args.command else {
        unreachable!("the line names the subcommand")
    };
    let scenario = resolve_with_builtin_policy(&args.scenario)?;
    let sizes: Vec<usize> = devices_by_class(&scenario).iter().map(Vec::len).collect();
    let config = TestbedConfig::new(&args, &scenario, &sizes, "")?;
    Testbed::new(&args.out, config, scenario)
}

/// Returns the services of `compose.yml`, with merged keys.
fn services(testbed: &Testbed) -> BTreeMap<String, Value> {
    let text = compose_text(testbed);
    let mut document: Value = serde_yaml::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"));
    document.apply_merge().expect("merge keys");
    serde_yaml::from_value(document["services"].clone()).expect("a map of services")
}

/// Returns the value of an option in the command of a service.
fn option<'a>(service: &'a Value, name: &str) -> Option<&'a str> {
    let mut words = service["command"]
        .as_sequence()
        .into_iter()
        .flatten()
        .filter_map(Value::as_str);
    words.find_map(|word| word.strip_prefix("--")?.strip_prefix(name)?.strip_prefix('='))
}

/// Returns the devices in the value of `--range`.
fn devices(service: &Value) -> Vec<usize> {
    let ranges = option(service, "range").unwrap_or_default().split(',');
    let number = |text: &str| text.parse::<usize>().expect("a number");
    ranges
        .flat_map(|range| match range.split_once('-') {
            Some((first, last)) => number(first)..=number(last),
            None => number(range)..=number(range),
        })
        .collect()
}

#[test]
fn each_device_is_in_one_container_of_its_class() {
    let testbed = testbed(&format!("-s {TWO_CLASSES} --containers weak=3,strong=2")).expect("valid");
    let services = services(&testbed);
    let names: Vec<&str> = services.keys().map(String::as_str).collect();
    let expected = [
        "bs",
        "certificates",
        "strong-1",
        "strong-2",
        "weak-1",
        "weak-2",
        "weak-3",
    ];
    assert_eq!(names, expected);
    let deployment = Deployment::new(&testbed.scenario);
    let mut container_count = vec![0; 100];
    for (name, service) in services.iter().filter(|(name, _)| name.contains('-')) {
        let is_strong = name.starts_with("strong");
        for device in devices(service) {
            container_count[device] += 1;
            let capacity = deployment.devices[device].energy.e_max.units();
            assert!(
                (capacity > 150.0) == is_strong,
                "device {device} of {capacity} units in {name}"
            );
        }
        let expected = match name.as_str() {
            "weak-1" | "weak-2" => 27,
            "weak-3" => 26,
            _ => 10,
        };
        assert_eq!(devices(service).len(), expected, "{name}");
    }
    assert_eq!(container_count, [1; 100]);
}

#[test]
fn limits_and_links_belong_to_their_class() {
    let options = "--containers 5 --cpus strong=0.5 --memory 64m,weak=32m --delay weak=20ms --loss weak=1% --pace 5ms";
    let testbed = testbed(&format!("-s {TWO_CLASSES} --image lab/reveille:1 {options}")).expect("valid");
    let services = services(&testbed);
    assert_eq!(services.keys().filter(|name| name.starts_with("weak-")).count(), 4 + 1);
    for (name, service) in &services {
        assert_eq!(service["image"], "lab/reveille:1", "{name}");
        assert_eq!(
            (&service["init"], &service["read_only"]),
            (&Value::from(true), &Value::from(true)),
            "{name}"
        );
        if name != "certificates" {
            assert_eq!(service["hostname"], name.as_str());
        }
        let (cpus, memory, target) = match name.split_once('-') {
            Some(("weak", "link")) | None => (None, None, None),
            Some(("weak", _)) => (None, Some("32m"), Some("tls/weak-link:7447")),
            Some(_) => (Some(0.5), Some("64m"), Some("tls/bs:7447")),
        };
        assert_eq!(service["cpus"].as_f64(), cpus, "{name}");
        assert_eq!(service["mem_limit"].as_str(), memory, "{name}");
        if target.is_some() {
            assert_eq!(option(service, "connect"), target, "{name}");
        }
    }
    let link = &services["weak-link"];
    let values = ["listen", "connect", "delay", "loss"].map(|name| option(link, name));
    assert_eq!(values, ["tcp/0.0.0.0:7447", "tcp/bs:7447", "20ms", "1%"].map(Some));
    assert_eq!(
        (link["command"][0].as_str(), option(&services["bs"], "pace")),
        (Some("link"), Some("5ms"))
    );
}

#[test]
fn commands_in_the_file_are_valid() {
    for options in ["--delay 20ms --loss 0.5% --dashboard", "--no-tls --dashboard"] {
        let testbed = testbed(&format!("-s {TWO_CLASSES} {options}")).expect("valid");
        for (name, service) in services(&testbed) {
            let words = service["command"]
                .as_sequence()
                .into_iter()
                .flatten()
                .filter_map(Value::as_str);
            // Without the feature there is no `reveille tls`.
            if cfg!(feature = "tls") || name != "certificates" {
                let error = Cli::try_parse_from(["reveille"].into_iter().chain(words)).err();
                assert!(
                    error.is_none(),
                    "{name}: {}",
                    error.map(|error| error.to_string()).unwrap_or_default()
                );
            }
        }
    }
}

/// The compose file of the repository.
const REPOSITORY_COMPOSE_FILE: &str = include_str!("../../../../docker-compose.yml");

#[test]
fn settings_equal_the_compose_file_of_the_repository() {
    let testbed = testbed(&format!("-s {TWO_CLASSES} --dashboard")).expect("valid");
    let own = services(&testbed);
    let mut repository: Value = serde_yaml::from_str(REPOSITORY_COMPOSE_FILE).expect("YAML");
    repository.apply_merge().expect("merge keys");
    for (name, other) in [
        ("bs", "bs"),
        ("certificates", "certificates"),
        ("dashboard", "dashboard"),
        ("weak-1", "device"),
    ] {
        let (own, other) = (&own[name], &repository["services"][other]);
        let keys = [
            "init",
            "read_only",
            "tmpfs",
            "cap_drop",
            "security_opt",
            "networks",
            "depends_on",
            "restart",
        ];
        for key in keys {
            assert_eq!(own[key], other[key], "{name}: {key}");
        }
        assert_eq!(own["healthcheck"]["test"], other["healthcheck"]["test"], "{name}");
        let is_secret = |volume: &&Value| {
            volume
                .as_str()
                .is_some_and(|text| text.contains("key") || text.contains("tls"))
        };
        let secrets = |service: &Value| {
            let volumes = service["volumes"].as_sequence().cloned().unwrap_or_default();
            volumes
                .iter()
                .filter(is_secret)
                .filter(|volume| *volume != "tls-router:/tls/router")
                .cloned()
                .collect::<Vec<_>>()
        };
        assert_eq!(secrets(own), secrets(other), "{name}");
        for option_name in ["tls", "key-file"] {
            assert_eq!(option(own, option_name), option(other, option_name), "{name}");
        }
    }
}

#[test]
fn the_certificate_has_the_names_of_the_links() {
    let links = testbed(&format!("-s {TWO_CLASSES} --delay weak=20ms")).expect("valid");
    let words = ["tls", "init", "/tls", "--renew", "--name=bs", "--name=weak-link"].map(Value::from);
    let services = services(&links);
    assert_eq!(services["certificates"]["command"], Value::from(words.to_vec()));
    assert_eq!(
        services["bs"].get("ports"),
        None,
        "no program outside has a certificate"
    );
}

#[test]
fn a_testbed_without_tls_has_nothing_of_it() {
    let testbed = testbed(&format!("-s {TWO_CLASSES} --no-tls --delay weak=20ms --dashboard")).expect("valid");
    let text = compose_text(&testbed);
    assert!(!text.contains("tls") && !text.contains("certificates"), "{text}");
    let services = services(&testbed);
    let targets = ["weak-1", "strong-1", "dashboard"].map(|name| option(&services[name], "connect"));
    assert_eq!(targets, ["tcp/weak-link:7447", "tcp/bs:7447", "tcp/bs:7447"].map(Some));
    assert_eq!(
        services["bs"]["ports"],
        Value::from(vec![Value::from("127.0.0.1::7447")])
    );
    assert_eq!(testbed.services()[..3], ["bs", "dashboard", "weak-link"]);
}

#[test]
fn a_description_of_a_former_version_has_tls_and_no_dashboard() {
    let config = testbed(&format!("-s {TWO_CLASSES} --no-tls --dashboard"))
        .expect("valid")
        .config;
    let text = config.to_toml();
    let text = text.replace("tls = false\n", "").replace("dashboard = true\n", "");
    let read: TestbedConfig = toml::from_str(&text).expect("valid");
    assert_eq!((config.tls, config.dashboard), (false, true));
    assert_eq!((read.tls, read.dashboard), (true, false));
}

#[test]
fn an_invalid_description_names_the_file_and_the_line() {
    let folder = std::env::temp_dir().join(format!("reveille-testbed-{}", std::process::id()));
    fs::create_dir_all(&folder).expect("a writable folder");
    let valid = testbed("-n 20 -k 400").expect("valid");
    let files = ScenarioFiles::read(&valid.scenario).expect("no files");
    fs::write(folder.join(SCENARIO_FILE), files.to_toml(&valid.scenario)).expect("a writable folder");
    let path = folder.join(CONFIG_FILE);
    for (valid_text, text, place, cause) in [
        (
            "containers = 5",
            "containers = \"5\"",
            ", line 22: ",
            "expected a whole number that is not negative",
        ),
        (
            "containers = 5",
            "containers = -5",
            ", line 22: ",
            "expected a whole number that is not negative",
        ),
        ("# cpus = 0.5", "cpus = \"all\"", ", line 23: ", "expected a number"),
        ("tls = true", "tls = \"on\"", ", line 10: ", "expected true or false"),
        (
            "containers = 5",
            "containers = 1e1",
            ", line 22: containers: ",
            "use a whole number such as 10",
        ),
        ("tls = true", "tsl = true", ", line 10: ", "did you mean `tls`?"),
        ("pace = \"max\"", "pace = two", ", line 8: ", "put text in quotes"),
        ("pace = \"max\"", "pace = 5", ", line 8: ", "expected text in quotes"),
        ("faults = [\n]", "faults = 3", ", line 15: ", "expected a list"),
        (
            "faults = [\n",
            "faults = [\n    \"7 kill bs\",\n\n    \"400 kill bs\",\n",
            ", line 18: ",
            "`400` must be a TTI",
        ),
    ] {
        let own = valid.config.to_toml();
        assert!(own.contains(valid_text), "{valid_text}: {own}");
        fs::write(&path, own.replacen(valid_text, text, 1)).expect("a writable folder");
        let error = Testbed::load(&folder)
            .err()
            .map(|error| format!("{error:#}"))
            .unwrap_or_default();
        let start = format!("{}{place}", path.display());
        assert!(error.starts_with(&start) && error.contains(cause), "{text}: {error}");
    }
    fs::remove_dir_all(&folder).expect("the folder exists");
}

#[test]
fn a_status_names_the_containers_with_lost_hosts() {
    let services = ["bs", "weak-1", "weak-10"].map(str::to_owned);
    let host = |number| format!("host {number} (devices 2 to 4, the process with pid 7 on weak-10 (172.18.0.3))");
    let line = format!("waiting at TTI 12 of 400: lost {}; {}", host(3), host(4));
    assert_eq!(
        shorten_clock(&line, &services),
        "waiting at TTI 12 of 400: lost weak-10"
    );
    assert_eq!(
        shorten_clock("running at TTI 1 of 4", &services),
        "running at TTI 1 of 4"
    );
}

#[test]
fn the_description_is_read_back_unchanged() {
    let options = "--cpus strong=0.5 --memory weak=32m --delay weak=20ms --loss strong=1%";
    let mut config = testbed(&format!("-s {TWO_CLASSES} {options}")).expect("valid").config;
    config.faults = vec![
        "500 kill weak-1".to_owned(),
        "700 pause bs for 5s # \"frozen\"".to_owned(),
    ];
    let read: TestbedConfig = toml::from_str(&config.to_toml()).expect("valid");
    assert_eq!(read, config);
    let undeclared = testbed("-n 7 --containers 7").expect("valid");
    assert_eq!(
        (undeclared.containers.len(), undeclared.containers[0].service.as_str()),
        (7, "device-1")
    );
    assert_eq!(undeclared.services().len(), 8);
}

#[test]
fn invalid_options_are_named_with_their_cause() {
    for (options, cause) in [
        (
            "--delay strnog=20ms",
            "--delay strnog=20ms: the scenario has no class strnog; its classes are weak, strong",
        ),
        ("--delay 20", "class weak: delay 20: must be a time"),
        (
            "--loss strong=60%",
            "class strong: loss 60%: must be a number from 0 to 0.5",
        ),
        ("--memory 1.5g", "class weak: memory 1.5g: must be a number of bytes"),
        ("--cpus many", "--cpus many: must be a number of cores"),
        ("--cpus 0", "class weak: cpus 0: must be a number of cores from 0.01"),
        (
            "--containers 0",
            "--containers 0: must be a number of containers from 1",
        ),
        (
            "--containers weak=81",
            "class weak: containers 81: must be from 1 to 80",
        ),
        (
            "--containers 101",
            "--containers 101: must be at most 100, the number of devices",
        ),
        (
            "--memory 6143k",
            "class weak: memory 6143k: must be at least 6m, which the engine demands",
        ),
        ("--containers 2,3", "--containers 3: a second number for all classes"),
        ("--image a$b", "image \"a$b\": not the name of an image"),
        ("-p external", "policy external: only"),
    ] {
        let error = testbed(&format!("-s {TWO_CLASSES} {options}")).err();
        let error = error.map(|error| format!("{error:#}")).unwrap_or_default();
        assert!(error.starts_with(cause), "{options}: {error:?}");
    }
}

#[test]
fn a_description_must_fit_the_scenario() {
    let whole = testbed(&format!("-s {TWO_CLASSES}")).expect("valid");
    let check = |change: &dyn Fn(&mut TestbedConfig)| {
        let mut config = whole.config.clone();
        change(&mut config);
        config.fault_lines = (4..).take(config.faults.len()).collect();
        let testbed = Testbed::new(&whole.folder, config, whole.scenario.clone());
        let error = testbed
            .and_then(|testbed| testbed.with_schedule(Path::new("faults.txt")))
            .err();
        error.map(|error| error.to_string()).unwrap_or_default()
    };
    assert_eq!(check(&|_| {}), "");
    let without_strong = check(&|config| config.classes.truncate(1));
    assert_eq!(
        without_strong,
        "class strong: 0 entries for 20 devices; keep one for each class with devices"
    );
    let unknown = check(&|config| {
        let class = config.classes[0].clone();
        config.classes.push(config::ClassConfig {
            name: "medium".to_owned(),
            ..class
        });
    });
    assert_eq!(
        unknown,
        "class medium: the scenario has no such class; its classes are weak, strong"
    );
    let fault = check(&|config| config.faults = vec!["5 kill weak-5".to_owned()]);
    assert!(
        fault.starts_with("faults.txt, line 4: weak-5: no such container; use one of bs, weak-1,"),
        "{fault}"
    );
}
