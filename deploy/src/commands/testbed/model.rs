//! A testbed: the content of its folder, with the containers that follow from it.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use reveille_bs::scenario::{Scenario, assign_classes, load};
use reveille_common::ids::DeviceId;
use reveille_common::message::DeviceRange;

use super::config::{CONFIG_FILE, TestbedConfig};
use super::faults::{ScheduledFault, parse_schedule};
use super::placement::{BS_SERVICE, DASHBOARD_SERVICE, link_name, name_prefixes, split_devices};
use crate::run_folder::SCENARIO_FILE;

/// A container with devices.
pub(super) struct DeviceContainer {
    /// The name of its service.
    pub service: String,
    /// Index of its class in [`TestbedConfig::classes`].
    pub class: usize,
    /// Its devices.
    pub ranges: Vec<DeviceRange>,
}

/// A testbed: the content of its folder.
pub(super) struct Testbed {
    pub folder: PathBuf,
    pub config: TestbedConfig,
    pub scenario: Scenario,
    /// The prefix of the container names of each class in `config`.
    pub prefixes: Vec<String>,
    /// The containers with devices, by class.
    pub containers: Vec<DeviceContainer>,
    /// The schedule of faults, by TTI.
    pub faults: Vec<ScheduledFault>,
}

/// Returns the devices of each class of `scenario`.
pub(super) fn devices_by_class(scenario: &Scenario) -> Vec<Vec<DeviceId>> {
    let mut devices = vec![Vec::new(); scenario.classes.len()];
    for (device, class) in (0..).map(DeviceId).zip(assign_classes(scenario)) {
        devices[usize::from(class)].push(device);
    }
    devices
}

impl Testbed {
    /// Creates the testbed of `config`, without its schedule.
    ///
    /// # Errors
    /// If the description does not fit the scenario.
    pub(super) fn new(folder: &Path, config: TestbedConfig, scenario: Scenario) -> anyhow::Result<Self> {
        let devices = devices_by_class(&scenario);
        config.check(&scenario, &devices.iter().map(Vec::len).collect::<Vec<_>>())?;
        let prefixes = name_prefixes(config.classes.iter().map(|class| class.name.as_str()));
        let mut containers = Vec::new();
        for (class, (entry, prefix)) in config.classes.iter().zip(&prefixes).enumerate() {
            let index = scenario.classes.iter().position(|other| other.name == entry.name);
            // `check` has found each class.
            let own_devices = index.map(|index| devices[index].as_slice()).unwrap_or_default();
            let split = split_devices(own_devices, entry.containers);
            containers.extend((1..).zip(split).map(|(number, ranges)| DeviceContainer {
                service: format!("{prefix}-{number}"),
                class,
                ranges,
            }));
        }
        Ok(Self {
            folder: folder.to_owned(),
            config,
            scenario,
            prefixes,
            containers,
            faults: Vec::new(),
        })
    }

    /// Adds the schedule of the description, which is in the file `source`.
    ///
    /// # Errors
    /// If a line of it does not fit the scenario.
    pub(super) fn with_schedule(mut self, source: &Path) -> anyhow::Result<Self> {
        let lines = self.config.faults.iter().map(String::as_str);
        let lines = self.config.fault_lines.iter().copied().zip(lines);
        let faults = parse_schedule(lines, self.scenario.run.ttis, &self.services());
        self.faults = faults.map_err(|cause| anyhow!("{}, {cause}", source.display()))?;
        Ok(self)
    }

    /// Reads the testbed in `folder`.
    ///
    /// # Errors
    /// If a file is missing or invalid, or they do not fit.
    pub(super) fn load(folder: &Path) -> anyhow::Result<Self> {
        let config = TestbedConfig::read(folder)?;
        let scenario = load(&folder.join(SCENARIO_FILE).to_string_lossy(), &[])?.scenario;
        let path = folder.join(CONFIG_FILE);
        let testbed = Self::new(folder, config, scenario).with_context(|| path.display().to_string())?;
        testbed.with_schedule(&path)
    }

    /// The declared limit of processor cores of a container; `None` without one.
    pub(super) fn declared_cpus(&self, service: &str) -> Option<f64> {
        let own = self.containers.iter().find(|own| own.service == service)?;
        self.config.classes[own.class].cpus
    }

    /// The names of all containers that last as long as the run: the base station, the dashboard, and the link and the
    /// containers of each class.
    pub(super) fn services(&self) -> Vec<String> {
        let mut services = vec![BS_SERVICE.to_owned()];
        services.extend(self.config.dashboard.then(|| DASHBOARD_SERVICE.to_owned()));
        for (class, (entry, prefix)) in self.config.classes.iter().zip(&self.prefixes).enumerate() {
            services.extend(entry.has_link().then(|| link_name(prefix)));
            let own = self.containers.iter().filter(|container| container.class == class);
            services.extend(own.map(|container| container.service.clone()));
        }
        services
    }
}
