//! `testbed.toml`, the description of a testbed that users edit. `testbed init` writes it from its options, and every
//! other command reads it. `docs/testbeds.md` lists the fields.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, anyhow, bail, ensure};
use reveille_bs::scenario::Scenario;
use reveille_common::declare::{TomlError, describe_read_error, parse_toml};
use reveille_common::keys::RunName;
use serde::Deserialize;

use super::placement::distribute;
use crate::cli::{TestbedInitArgs, parse_duration, parse_loss, parse_pace};

/// The name of the file in the folder of a testbed.
pub(super) const CONFIG_FILE: &str = "testbed.toml";
/// Containers of a new testbed, if its scenario has no more classes.
const DEFAULT_CONTAINERS: usize = 5;

/// Fewest bytes of a container's memory that Docker accepts.
const MIN_MEMORY: u64 = 6 << 20;

/// The content of `testbed.toml`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TestbedConfig {
    /// The name of the compose project and of the run.
    pub name: String,
    /// The image of all containers.
    pub image: String,
    /// `max`, or the real time of a TTI.
    pub pace: String,
    /// Whether the containers use mutual TLS.
    #[serde(default = "default_tls")]
    pub tls: bool,
    /// Whether one container serves the dashboard.
    #[serde(default)]
    pub dashboard: bool,
    /// The lines of the schedule of faults.
    #[serde(default)]
    pub faults: Vec<String>,
    /// The number of each line of `faults` in the file that has it.
    #[serde(skip)]
    pub fault_lines: Vec<usize>,
    /// The containers of each class with devices.
    #[serde(rename = "class")]
    pub classes: Vec<ClassConfig>,
}

/// The containers of a class.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ClassConfig {
    /// The class; `default` in a scenario without classes.
    pub name: String,
    /// Number of containers.
    pub containers: usize,
    /// Most processor cores of a container.
    pub cpus: Option<f64>,
    /// Most memory of a container, as Docker writes it: `32m`.
    pub memory: Option<String>,
    /// One-way delay of its link, such as `20ms`.
    pub delay: Option<String>,
    /// Share of lost segments of its link, such as `1%`.
    pub loss: Option<String>,
}

/// A description without the field `tls` is of a former version. Its containers use TLS from the next `up` on.
const fn default_tls() -> bool {
    true
}

impl ClassConfig {
    /// Whether its containers reach the base station over a link with delay or loss.
    pub(super) const fn has_link(&self) -> bool {
        self.delay.is_some() || self.loss.is_some()
    }
}

impl TestbedConfig {
    /// Creates the description that the options ask for. `class_sizes` are the numbers of devices of the scenario's
    /// classes, `schedule` the text of `--faults`.
    ///
    /// # Errors
    /// If an option names an unknown class, or its value is invalid.
    pub(super) fn new(
        args: &TestbedInitArgs,
        scenario: &Scenario,
        class_sizes: &[usize],
        schedule: &str,
    ) -> anyhow::Result<Self> {
        let names: Vec<&str> = scenario.classes.iter().map(|class| class.name.as_str()).collect();
        let options = |option, items: &[String]| values_by_class(option, items, &names);
        let (cpus, memory) = (options("--cpus", &args.cpus)?, options("--memory", &args.memory)?);
        let (delay, loss) = (options("--delay", &args.delay)?, options("--loss", &args.loss)?);
        let containers = containers_by_class(&args.containers, &names, class_sizes)?;
        let mut classes = Vec::new();
        for (index, name) in names.iter().enumerate().filter(|(index, _)| class_sizes[*index] > 0) {
            let cpus = cpus[index].as_deref().map(|text| {
                text.parse()
                    .map_err(|_| anyhow!("--cpus {text}: must be a number of cores, such as 0.5"))
            });
            classes.push(ClassConfig {
                name: (*name).to_owned(),
                containers: containers[index],
                cpus: cpus.transpose()?,
                memory: memory[index].clone(),
                delay: delay[index].clone(),
                loss: loss[index].clone(),
            });
        }
        let lines = (1..).zip(schedule.lines().map(str::trim));
        let lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
        let (fault_lines, faults) = lines.map(|(number, line)| (number, line.to_owned())).unzip();
        let folder_name = std::path::absolute(&args.out)?;
        let config = Self {
            name: project_name(&folder_name.file_name().unwrap_or_default().to_string_lossy()),
            image: args.image.clone(),
            pace: args.pace.to_string(),
            tls: !args.no_tls,
            dashboard: args.dashboard,
            faults,
            fault_lines,
            classes,
        };
        config.check(scenario, class_sizes)?;
        Ok(config)
    }

    /// Reads the description in `folder`. [`Self::check`] compares it with the scenario.
    ///
    /// # Errors
    /// If the file is missing or invalid.
    pub(super) fn read(folder: &Path) -> anyhow::Result<Self> {
        let path = folder.join(CONFIG_FILE);
        let text = std::fs::read_to_string(&path).map_err(|error| {
            let hint = "name the folder of a testbed, which `reveille testbed init` writes";
            anyhow!("{}: {}", path.display(), describe_read_error(&error, hint))
        })?;
        let invalid = |error| anyhow!("{}, {error}", path.display());
        let mut config: Self = parse_toml(&text).map_err(invalid)?;
        config.fault_lines = find_fault_lines(&text).map_err(invalid)?;
        let is_valid = config.name.parse::<RunName>().is_ok() && project_name(&config.name) == config.name;
        ensure!(
            is_valid,
            "{}: name {:?} must have 1 to 64 lower-case letters, digits, `-` and `_`, and start with a letter or digit",
            path.display(),
            config.name
        );
        Ok(config)
    }

    /// Checks the values against `scenario`, whose classes have these numbers of devices.
    ///
    /// # Errors
    /// If a value is invalid, a class has too many containers or none, or is unknown.
    pub(super) fn check(&self, scenario: &Scenario, class_sizes: &[usize]) -> anyhow::Result<()> {
        let is_image_char = |c: char| c.is_ascii_alphanumeric() || "._/:@-".contains(c);
        let is_image = !self.image.is_empty() && self.image.chars().all(is_image_char);
        ensure!(
            is_image,
            "image {:?}: not the name of an image, such as reveille:local",
            self.image
        );
        parse_pace(&self.pace).map_err(|cause| anyhow!("pace {}: {cause}", self.pace))?;
        for class in &self.classes {
            let names: Vec<&str> = scenario.classes.iter().map(|class| class.name.as_str()).collect();
            ensure!(
                names.contains(&class.name.as_str()),
                "class {}: the scenario has no such class; its classes are {}",
                class.name,
                names.join(", ")
            );
        }
        for (class, size) in scenario.classes.iter().zip(class_sizes) {
            let entries = self.classes.iter().filter(|entry| entry.name == class.name).count();
            ensure!(
                entries == usize::from(*size > 0),
                "class {}: {entries} entries for {size} devices; keep one for each class with devices",
                class.name
            );
        }
        for (declared, size) in scenario.classes.iter().zip(class_sizes) {
            for class in self.classes.iter().filter(|class| class.name == declared.name) {
                class
                    .check(*size)
                    .map_err(|cause| anyhow!("class {}: {cause}", class.name))?;
            }
        }
        Ok(())
    }

    /// Formats the file, with a comment for each field.
    pub(super) fn to_toml(&self) -> String {
        let quote = |text: &str| toml::Value::from(text).to_string();
        let mut text = format!(
            "\
# A testbed of containers. Edit this file, then `reveille testbed up` follows it.

# Name of the run and of the compose project; remove the testbed before you change it.
name = {}
# Image of all containers.
image = {}
# `max`, or the real time of a TTI, such as 10ms.
pace = {}
# Whether the containers use mutual TLS, which needs an image with TLS.
tls = {}
# Whether a container serves the dashboard; `reveille testbed status` prints its address.
dashboard = {}
# Faults, each before a TTI, such as \"700 disconnect weak-1 for 5s\". The kinds are kill, pause, disconnect, slow, stop
# and restore; `reveille testbed status` lists the containers.
faults = [
",
            quote(&self.name),
            quote(&self.image),
            quote(&self.pace),
            self.tls,
            self.dashboard,
        );
        for fault in &self.faults {
            let _infallible = writeln!(text, "    {},", quote(fault));
        }
        text += "\
]

# The containers of each class of devices. Uncomment a line to limit a container, or to delay and lose segments between
# it and the base station.
";
        let optional = |name, value: Option<String>, example: &str| match value {
            Some(value) => format!("{name} = {value}\n"),
            None => format!("# {name} = {example}\n"),
        };
        for class in &self.classes {
            let quoted = |value: &Option<String>| value.as_deref().map(quote);
            let name = quote(&class.name);
            let _infallible = writeln!(text, "[[class]]\nname = {name}\ncontainers = {}", class.containers);
            text += &optional("cpus", class.cpus.map(|cpus| format!("{cpus:?}")), "0.5");
            text += &optional("memory", quoted(&class.memory), "\"64m\"");
            text += &optional("delay", quoted(&class.delay), "\"20ms\"");
            text += &optional("loss", quoted(&class.loss), "\"1%\"");
            text.push('\n');
        }
        text.truncate(text.trim_end().len() + 1);
        text
    }
}

impl ClassConfig {
    /// Checks the values for a class of `devices` devices.
    fn check(&self, devices: usize) -> Result<(), String> {
        if !(1..=devices).contains(&self.containers) {
            let containers = self.containers;
            return Err(format!(
                "containers {containers}: must be from 1 to {devices}, its number of devices"
            ));
        }
        if let Some(cpus) = self.cpus.filter(|cpus| !(0.01..=1024.0).contains(cpus)) {
            return Err(format!("cpus {cpus}: must be a number of cores from 0.01"));
        }
        if let Some(memory) = &self.memory {
            let digits = memory.trim_end_matches(['b', 'k', 'm', 'g']);
            let is_size = memory.len() - digits.len() <= 1 && digits.parse::<u64>().is_ok();
            if !is_size {
                return Err(format!("memory {memory}: must be a number of bytes, such as 64m or 1g"));
            }
            let unit = match memory.as_bytes().last() {
                Some(b'k') => 1 << 10,
                Some(b'm') => 1 << 20,
                Some(b'g') => 1 << 30,
                _ => 1,
            };
            let bytes = digits
                .parse::<u64>()
                .map_or(u64::MAX, |number| number.saturating_mul(unit));
            if bytes < MIN_MEMORY {
                return Err(format!(
                    "memory {memory}: must be at least 6m, which the engine demands"
                ));
            }
        }
        if let Some(delay) = &self.delay {
            parse_duration(delay).map_err(|cause| format!("delay {delay}: {cause}"))?;
        }
        if let Some(loss) = &self.loss {
            parse_loss(loss).map_err(|cause| format!("loss {loss}: {cause}"))?;
        }
        Ok(())
    }
}

/// Returns the number of the line of each fault in the text of a description.
fn find_fault_lines(text: &str) -> Result<Vec<usize>, TomlError> {
    #[derive(Deserialize)]
    struct Schedule {
        #[serde(default)]
        faults: Vec<toml::Spanned<String>>,
    }
    let Schedule { faults } = parse_toml(text)?;
    let line = |fault: &toml::Spanned<String>| text[..fault.span().start].matches('\n').count() + 1;
    Ok(faults.iter().map(line).collect())
}

/// Returns the value of each class in the items of an option: VALUE for all classes, CLASS=VALUE for one.
fn values_by_class(option: &str, items: &[String], classes: &[&str]) -> anyhow::Result<Vec<Option<String>>> {
    let mut values = vec![None; classes.len()];
    for item in items {
        let Some((class, value)) = item.rsplit_once('=') else {
            values.fill(Some(item.to_owned()));
            continue;
        };
        let index = classes.iter().position(|known| *known == class);
        let index = index.with_context(|| {
            let known = classes.join(", ");
            format!("{option} {item}: the scenario has no class {class}; its classes are {known}")
        })?;
        values[index] = Some(value.to_owned());
    }
    Ok(values)
}

/// Returns the number of containers of each class: NUMBER distributes this number over all, CLASS=NUMBER sets one.
fn containers_by_class(items: &[String], names: &[&str], class_sizes: &[usize]) -> anyhow::Result<Vec<usize>> {
    let parse = |text: &str| {
        let number = text.trim().parse().ok().filter(|number| *number >= 1);
        number.with_context(|| format!("--containers {text}: must be a number of containers from 1"))
    };
    let (by_class, totals): (Vec<_>, Vec<_>) = items.iter().cloned().partition(|item| item.contains('='));
    let total = match totals.as_slice() {
        [] => DEFAULT_CONTAINERS,
        [total] => parse(total)?,
        [_, other, ..] => bail!("--containers {other}: a second number for all classes; use CLASS=NUMBER"),
    };
    let devices: usize = class_sizes.iter().sum();
    ensure!(
        totals.is_empty() || total <= devices,
        "--containers {total}: must be at most {devices}, the number of devices"
    );
    let mut containers = distribute(total, class_sizes);
    let given = values_by_class("--containers", &by_class, names)?;
    for (number, text) in containers.iter_mut().zip(&given) {
        if let Some(text) = text {
            *number = parse(text)?;
        }
    }
    Ok(containers)
}

/// Returns the name of a compose project for `name`, as compose itself does for a folder.
fn project_name(name: &str) -> String {
    let lower = name.to_lowercase();
    let allowed: String = lower
        .chars()
        .filter(|c| c.is_ascii_alphanumeric() || *c == '-' || *c == '_')
        .take(64)
        .collect();
    match allowed.trim_start_matches(['-', '_']) {
        "" => "testbed".to_owned(),
        name => name.to_owned(),
    }
}
