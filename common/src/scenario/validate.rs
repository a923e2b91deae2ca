//! Validation: turns the merged layers (preset, file, command line) into a [`Scenario`] on which all parts of a run
//! rely. `bs/src/scenario/tests/` expects the texts of errors and warnings. A missing check can make a run panic.

use std::cell::RefCell;
use std::collections::BTreeSet;

use super::class_assignment::try_assign_classes;
use super::class_members::Members;
use super::classes::{DeviceClass, resolve_members};
use super::model::{LoadedScenario, Scenario};
use super::policy::{Policies, PolicyChoice, PolicyKind};
use super::run::{BsSettings, PolicyName, RunSettings};
use crate::declare::{Declaration, FieldReader, FileContext, Merged, ScenarioError};
use crate::digits::{count_noun, format_significant};
use crate::event::DurationKind;
use crate::event::event_settings::EventSettings;
use crate::geometry::{Area, Layout};
use crate::radio::RadioSettings;
use crate::sensing::Sensing;
use crate::units::{Energy, MICRO_PER_UNIT};

/// Builds the scenario that `merged` describes, with its warnings; `preset` names the preset from which it started.
pub(super) fn validate<K: PolicyKind>(
    preset: &str,
    declaration: &Declaration,
    merged: &Merged<'_>,
    policies: Policies<'_, K>,
    file_context: FileContext<'_>,
) -> Result<LoadedScenario<PolicyChoice<K>>, ScenarioError> {
    let warnings = RefCell::new(merged.warnings.clone());
    let reader = &FieldReader::new(declaration, merged, file_context, &warnings);
    reader.reject_unused_fields()?;
    let run = RunSettings {
        preset: preset.to_owned(),
        ..RunSettings::read(reader)?
    };
    let area = Area::read(reader)?;
    let sensing = Sensing::from_fields(reader, area)?;
    let events = EventSettings::from_fields(reader)?;
    let radio = RadioSettings::from_fields(reader)?;
    let bs = BsSettings::read(reader)?;
    let (mut classes, specify_members) = DeviceClass::read_all(reader, &run, area)?;
    // The items are the tables `[[class]]` of the scenario file.
    let has_classes = !reader.items().is_empty();
    let names: Vec<&str> = classes
        .iter()
        .filter(|_| has_classes)
        .map(|class| class.name.as_str())
        .collect();
    let layout = Layout::from_fields(reader, area, run.devices, &names)?;
    resolve_members(reader, &mut classes, &specify_members, layout.classes().is_some())?;
    let name = PolicyName::read(reader)?.name;
    let Some(&kind) = policies.iter().find(|policy| policy.name() == name) else {
        return Err(reader.invalid_value("policy.name", name, "must be the name of a policy"));
    };
    let mut scenario = Scenario {
        run,
        area,
        layout,
        classes,
        sensing,
        events,
        radio,
        bs,
        // The policy's settings depend on the `Site`, which is taken from the rest of the scenario.
        policy: (),
    };
    // Before the policy, because it reads the share of each class from the scenario's `Site`.
    set_class_shares(reader, &mut scenario)?;
    let policy = PolicyChoice::new(
        kind,
        kind.read_settings(&reader.for_policy(kind.name()), &scenario.site())?,
    );
    let scenario = scenario.with_policy(policy);
    check_energy_sums(reader, &scenario)?;
    let mut warnings = warnings.take();
    warnings.extend(undetected_events_warning(&scenario));
    Ok(LoadedScenario { scenario, warnings })
}

/// Checks the lists of devices, and that each device has a class; sets the share of each class.
fn set_class_shares(reader: &FieldReader<'_>, scenario: &mut Scenario<()>) -> Result<(), ScenarioError> {
    let n = scenario.run.devices;
    let mut listed = BTreeSet::new();
    for (item, class) in reader.items().into_iter().zip(&scenario.classes) {
        let Members::Devices(devices) = &class.members else {
            continue;
        };
        let item = item.with_name(&class.name);
        if let Some(j) = devices.iter().find(|&&j| j >= n) {
            return Err(item.invalid_value("class.devices", j, format!("must be below {n}, the number of devices")));
        }
        if let Some(j) = devices.iter().find(|&&j| !listed.insert(j)) {
            return Err(item.invalid_value("class.devices", j, "is listed twice; a device has one class"));
        }
    }
    let is_by_share = |class: &DeviceClass| matches!(class.members, Members::Share(_));
    if scenario.classes.iter().all(is_by_share) {
        let copy_declared_share = |class: &mut DeviceClass| {
            if let Members::Share(declared) = class.members {
                class.share = declared;
            }
        };
        scenario.classes.iter_mut().for_each(copy_declared_share);
        return Ok(());
    }
    let assigned = try_assign_classes(scenario).map_err(|j| {
        let complaint = format!("device {j} has no class; set class.share in a class, for the remaining devices");
        reader.invalid_value("class", format!("{} classes", scenario.classes.len()), complaint)
    })?;
    let is_set_by_layout = scenario.layout.classes().is_some();
    for (index, class) in scenario.classes.iter_mut().enumerate() {
        let devices = assigned.iter().filter(|&&class| usize::from(class) == index).count();
        class.share = devices as f64 / assigned.len() as f64;
        if devices == 0 {
            let source = if is_set_by_layout { " of layout.file" } else { "" };
            reader.warn(format!("no device{source} has the class `{}`", class.name));
        }
    }
    Ok(())
}

/// Returns a warning if events can end before the policy senses their places. The policy does not know their duration.
fn undetected_events_warning<K: PolicyKind>(scenario: &Scenario<PolicyChoice<K>>) -> Option<String> {
    let (path, budget) = scenario.policy.delay_budget()?;
    let missed_pct = 100.0 * scenario.events.missed_share(budget);
    let length = count_noun(scenario.events.duration, "TTI");
    (missed_pct >= 1.0).then(|| {
        format!(
            "{path} = {budget} leaves a place unsensed for up to {budget} TTIs, and events last {length}{}: up to \
             {missed_pct:.0} % of them can end undetected; set a smaller {path}",
            match scenario.events.duration_kind {
                DurationKind::Fixed => "",
                DurationKind::Geometric => " on average",
            }
        )
    })
}

/// Checks that energy sums over all devices and TTIs fit in 64 bits, also in the pilot runs of the policy.
fn check_energy_sums<K: PolicyKind>(
    reader: &FieldReader<'_>,
    scenario: &Scenario<PolicyChoice<K>>,
) -> Result<(), ScenarioError> {
    let max_ttis = scenario.max_ttis();
    let devices = scenario.run.devices;
    if max_ttis == 0 {
        // Half of 64 bits for the full batteries, so that the other half is left for harvest and consumption.
        let most = Energy::from_micro(u64::MAX / 2 / u64::from(devices));
        let allowed = format!("must be at most {most} with {devices} devices, or sums of energy overflow");
        return Err(reader.invalid_value("energy.e_max", scenario.largest_level(), allowed));
    }
    let lengths = std::iter::once(("ttis", scenario.run.ttis)).chain(scenario.policy.pilot_ttis());
    let Some((path, ttis)) = lengths.into_iter().find(|(_, ttis)| *ttis > max_ttis) else {
        return Ok(());
    };
    let allowed = format!(
        "must be at most {max_ttis} with {devices} devices that hold up to {} and harvest or spend up to {} units in a \
         TTI, or sums of energy overflow",
        scenario.largest_level(),
        format_significant(scenario.largest_turnover() as f64 / MICRO_PER_UNIT as f64, 4)
    );
    Err(reader.invalid_value(path, ttis, allowed))
}
