//! `compose.yml` of a testbed, for docker-compose 1.29 and docker compose v2. It needs no variables. `docker` relies on
//! the names of services, networks and volumes.

use std::fmt::Write as _;
use std::fs;
use std::io;
use std::os::unix::fs::PermissionsExt;

use super::config::ClassConfig;
use super::model::Testbed;
use super::placement::{BS_SERVICE, format_ranges, link_name};
use crate::display::count_noun;
use crate::run_folder::SCENARIO_FILE;
use crate::scenario_files;

/// The name of the file in the folder of a testbed.
pub(super) const COMPOSE_FILE: &str = "compose.yml";
/// The name of the network in the file.
pub(super) const NETWORK: &str = "testbed";
/// The folder with the run folder, in the container of the base station.
pub(super) const RESULTS_FOLDER: &str = "/results";

/// The fields of all containers. As in all texts below, words in capitals stand for values, and [`without_tls`] removes
/// the lines for TLS. `docker-compose.yml` explains the settings; a test compares them.
const COMMON: &str = "\
x-reveille: &reveille
  image: IMAGE
  init: true
  read_only: true
  tmpfs: [/tmp]
  cap_drop: [ALL]
  security_opt: [\"no-new-privileges:true\"]
  networks: [testbed]
";

/// The fields of all containers of a class.
const CLASS: &str = "
x-PREFIX: &class-PREFIX
  depends_on: {bs: {condition: service_healthy}}
  restart: on-failure:10
  volumes:
    - key:/key:ro
    - tls-device:/tls/device:ro
";

/// The container that makes the certificates, before all others.
const CERTIFICATES: &str = "  certificates:
    <<: *reveille
    command: [tls, init, /tls, --renew, --name=bsNAMES]
    volumes:
      - tls:/tls
      - tls-bs:/tls/bs
      - tls-device:/tls/device
      - tls-operator:/tls/operator

";

/// The base station.
const BS: &str = "  bs:
    <<: *reveille
    hostname: bs
    depends_on: {certificates: {condition: service_completed_successfully}}
    command:
      - bs
      - --listen=tls/0.0.0.0:7447
      - --tls=/tls
      - --run=RUN
      - --scenario=/testbed/scenario.toml
      - --pace=PACE
      - --loss-timeout=10min
      - --join-timeout=2min
      - --key-file=/key/run.key
      - --out=/results/RUN
      - --continue
    restart: on-failure:5
    healthcheck:
      test: [CMD, reveille, clock, status]
      interval: 1s
      timeout: 5s
      start_period: 10m
    stop_grace_period: 30s
    volumes:
      - .:/testbed:ro
      - results:/results
      - key:/key
      - tls-bs:/tls/bs:ro
      - tls-operator:/tls/operator:ro
";

/// The port of the base station without TLS: any free one of this machine, only for programs on it. With TLS, they
/// would need a certificate.
const BS_PORT: &str = "    ports: [\"127.0.0.1::7447\"]
";

/// The dashboard.
const DASHBOARD: &str = "
  dashboard:
    <<: *reveille
    hostname: dashboard
    depends_on: {bs: {condition: service_healthy}}
    command:
      - dashboard
      - --connect=tls/bs:7447
      - --tls=/tls
      - --run=RUN
      - --key-file=/key/run.key
      - --listen=0.0.0.0:8464
    restart: on-failure:5
    volumes:
      - key:/key:ro
      - tls-operator:/tls/operator:ro
    ports: [\"127.0.0.1::8464\"]
";

/// The container that delays and loses segments between a class and the base station. It relays TLS without decrypting.
const LINK: &str = "  LINK:
    <<: *reveille
    hostname: LINK
    command:
      - link
      - --listen=tcp/0.0.0.0:7447
      - --connect=tcp/bs:7447
OPTIONS    restart: on-failure:10
";

/// A container with devices.
const DEVICE: &str = "  SERVICE:
    <<: [*reveille, *class-PREFIX]
    hostname: SERVICE
    command:
      - device
      - --connect=tls/TARGET:7447
      - --tls=/tls
      - --run=RUN
      - --key-file=/key/run.key
      - --range=RANGES
";

/// The networks and volumes. The volume `tls` has the key of the CA, which only `certificates` sees.
const VOLUMES: &str = "
networks:
  testbed: {}

volumes:
  results: {}
  key: {}
  tls: {}
  tls-bs: {}
  tls-device: {}
  tls-operator: {}
";

/// Returns one of the texts above for a testbed without TLS.
fn without_tls(text: &str) -> String {
    let text = text.replace("=tls/", "=tcp/");
    let is_for_tls = |line: &&str| {
        ["tls:", "tls-", "--tls=", "certificates"]
            .iter()
            .any(|word| line.contains(word))
    };
    text.split_inclusive('\n').filter(|line| !is_for_tls(line)).collect()
}

/// Writes `compose.yml`, and lets the user of the containers read the scenario and its files.
///
/// # Errors
/// If the files cannot be written or changed.
pub(super) fn write_compose(testbed: &Testbed) -> io::Result<()> {
    let path = testbed.folder.join(COMPOSE_FILE);
    fs::write(&path, compose_text(testbed))?;
    let scenario_files = testbed.folder.join(scenario_files::FOLDER);
    let mut readable = vec![
        (testbed.folder.clone(), 0o755),
        (testbed.folder.join(SCENARIO_FILE), 0o644),
    ];
    if scenario_files.is_dir() {
        for entry in fs::read_dir(&scenario_files)? {
            readable.push((entry?.path(), 0o644));
        }
        readable.push((scenario_files, 0o755));
    }
    readable.into_iter().try_for_each(|(path, mode)| {
        let own = fs::metadata(&path)?.permissions().mode();
        fs::set_permissions(path, fs::Permissions::from_mode(own | mode))
    })
}

/// Returns the text of `compose.yml`.
pub(super) fn compose_text(testbed: &Testbed) -> String {
    let Testbed { config, scenario, .. } = testbed;
    let settings = &scenario.run;
    let fill = |template: &str, values: &[(&str, &str)]| {
        let text = if config.tls {
            template.to_owned()
        } else {
            without_tls(template)
        };
        // Values of users come last: they can have capitals.
        let text = text.replace("RUN", &config.name);
        values
            .iter()
            .fold(text, |text, (name, value)| text.replace(name, value))
    };
    let mut text = format!(
        "# The testbed {}: policy {}, {} in {}, {}, seed {}.\n\
         # `reveille testbed` writes this file from testbed.toml, so a change here does not last.\n#\n\
         #   reveille testbed up .        # runs it, with the faults of testbed.toml\n\
         #   docker compose up --detach   # starts it without faults\n\n",
        config.name,
        scenario.policy.name(),
        count_noun(settings.devices, "device"),
        count_noun(testbed.containers.len(), "container"),
        count_noun(settings.ttis, "TTI"),
        settings.seed,
    );
    text += &fill(COMMON, &[("IMAGE", &config.image)]);
    let classes = || config.classes.iter().zip(&testbed.prefixes);
    for (class, prefix) in classes() {
        text += &fill(CLASS, &[("PREFIX", prefix)]);
        if let Some(cpus) = class.cpus {
            let _infallible = writeln!(text, "  cpus: {cpus:?}");
        }
        if let Some(memory) = &class.memory {
            let _infallible = writeln!(text, "  mem_limit: {memory}");
        }
    }
    text += "\nservices:\n";
    if config.tls {
        // The base station is reached under the names of the links too.
        let links = classes().filter(|(class, _)| class.has_link());
        let names: Vec<String> = links
            .map(|(_, prefix)| format!(", --name={}", link_name(prefix)))
            .collect();
        text += &fill(CERTIFICATES, &[("NAMES", &names.concat())]);
    }
    text += &fill(BS, &[("PACE", &config.pace)]);
    if !config.tls {
        text += BS_PORT;
    }
    if config.dashboard {
        text += &fill(DASHBOARD, &[]);
    }
    for (index, (class, prefix)) in classes().enumerate() {
        text += &class_services(testbed, index, class, prefix, fill);
    }
    text + &fill(VOLUMES, &[])
}

/// Returns the containers of the class at `index`, and its link if it has one.
fn class_services(
    testbed: &Testbed,
    index: usize,
    class: &ClassConfig,
    prefix: &str,
    fill: impl Fn(&str, &[(&str, &str)]) -> String,
) -> String {
    let own = || testbed.containers.iter().filter(|container| container.class == index);
    let devices: u32 = own()
        .flat_map(|container| &container.ranges)
        .map(|range| range.count)
        .sum();
    let mut text = format!(
        "\n  # Class {}: {} in {}.\n",
        class.name,
        count_noun(devices, "device"),
        count_noun(class.containers, "container")
    );
    let mut target = BS_SERVICE.to_owned();
    if class.has_link() {
        target = link_name(prefix);
        let options = [("delay", &class.delay), ("loss", &class.loss)];
        let options = options
            .into_iter()
            .filter_map(|(name, value)| Some(format!("      - --{name}={}\n", value.as_ref()?)));
        text += &fill(LINK, &[("OPTIONS", &options.collect::<String>()), ("LINK", &target)]);
    }
    for container in own() {
        let values = [
            ("SERVICE", container.service.as_str()),
            ("PREFIX", prefix),
            ("TARGET", &target),
            ("RANGES", &format_ranges(&container.ranges)),
        ];
        text += &fill(DEVICE, &values);
    }
    text
}
