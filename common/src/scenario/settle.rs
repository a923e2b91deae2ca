//! From the merged layers to a [`Scenario`] that every part of a run may rely on.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::sync::Arc;

use super::assignment::try_assign;
use super::bs::BsSettings;
use super::classes::{DeviceClass, check_shares};
use super::members::Members;
use super::model::{Policies, PolicyChoice, Scenario};
use super::policy::NoSettings;
use super::run::{PolicyName, Run};
use crate::declare::{Declaration, Ground, Merged, Reader, ScenarioError};
use crate::event::DurationKind;
use crate::event::settings::Events;
use crate::geometry::{Area, Layout};
use crate::radio::Radio;
use crate::sensing::Sensing;

/// The scenario that `merged` describes; `preset` is the name of the one that it started from.
pub(super) fn settle(
    preset: &str,
    declaration: &Declaration,
    merged: &Merged<'_>,
    policies: Policies<'_>,
    ground: Ground<'_>,
) -> Result<Scenario, ScenarioError> {
    let warnings = RefCell::new(Vec::new());
    let reader = &Reader::new(declaration, merged, ground, &warnings);
    reader.check_idle()?;
    let run = Run::read(reader)?;
    let area = Area::read(reader)?;
    let sensing = Sensing::settle(reader, area)?;
    let events = Events::settle(reader)?;
    let radio = Radio::settle(reader)?;
    let bs = BsSettings::read(reader)?;
    let (mut classes, are_told) = DeviceClass::settle_all(reader, run.tau, area)?;
    let has_classes = !reader.items().is_empty();
    let names: Vec<&str> = classes
        .iter()
        .filter(|_| has_classes)
        .map(|class| class.name.as_str())
        .collect();
    let layout = Layout::settle(reader, area, run.devices, &names)?;
    check_shares(reader, &mut classes, &are_told, layout.classes().is_some())?;
    let name = PolicyName::read(reader)?.name;
    let Some(&kind) = policies.iter().find(|policy| policy.name() == name) else {
        return Err(reader.refuse("policy.name", name, "must be the name of a policy"));
    };
    let mut scenario = Scenario {
        preset: preset.to_owned(),
        devices: run.devices,
        ttis: run.ttis,
        seed: run.seed,
        warm_up: run.warm_up,
        tau: run.tau,
        area,
        layout,
        classes,
        sensing,
        events,
        radio,
        bs,
        policy: PolicyChoice::new(kind, Arc::new(NoSettings)),
        warnings: Vec::new(),
    };
    settle_members(reader, &mut scenario)?;
    scenario.policy = PolicyChoice::new(kind, kind.settle(&reader.of_policy(kind.name()), &scenario.site())?);
    bounded(reader, &scenario)?;
    scenario.warnings = warnings.take();
    scenario.warnings.extend(over_before_a_look(&scenario));
    scenario.warnings.extend(scenario.policy.warnings());
    Ok(scenario)
}

/// Settles how many devices each class has.
fn settle_members(reader: &Reader<'_>, scenario: &mut Scenario) -> Result<(), ScenarioError> {
    let n = scenario.devices;
    let mut is_named = BTreeSet::new();
    for (item, class) in reader.items().into_iter().zip(&scenario.classes) {
        let Members::Devices(devices) = &class.members else {
            continue;
        };
        let item = item.known_as(&class.name);
        if let Some(j) = devices.iter().find(|&&j| j >= n) {
            return Err(item.refuse("class.devices", j, format!("must be below {n}, the number of devices")));
        }
        if let Some(j) = devices.iter().find(|&&j| !is_named.insert(j)) {
            return Err(item.refuse("class.devices", j, "is named already: a device is of one class"));
        }
    }
    let is_by_share = |class: &DeviceClass| matches!(class.members, Members::Share(_));
    if scenario.classes.iter().all(is_by_share) {
        let share = |class: &mut DeviceClass| {
            if let Members::Share(share) = class.members {
                class.share = share;
            }
        };
        scenario.classes.iter_mut().for_each(share);
        return Ok(());
    }
    let assigned = try_assign(scenario).map_err(|j| {
        let allowed = format!("device {j} is of none of them; give one of them a share, of the devices that are left");
        reader.refuse("class", format!("{} classes", scenario.classes.len()), allowed)
    })?;
    let by_layout = scenario.layout.classes().is_some();
    for (index, class) in scenario.classes.iter_mut().enumerate() {
        let devices = assigned.iter().filter(|&&of| usize::from(of) == index).count();
        class.share = devices as f64 / assigned.len() as f64;
        if devices == 0 {
            let of = if by_layout { " of layout.file" } else { "" };
            reader.warn(format!("no device{of} is of the class `{}`", class.name));
        }
    }
    Ok(())
}

/// What a policy cannot know and its user should: that events end before the policy is to look for them.
fn over_before_a_look(scenario: &Scenario) -> Option<String> {
    let (path, budget) = scenario.policy.delay_budget()?;
    let share = 100.0 * scenario.events.over_before_a_look(budget);
    let lasts = match scenario.events.duration {
        1 => "1 TTI".to_owned(),
        several => format!("{several} TTIs"),
    };
    (share >= 1.0).then(|| {
        format!(
            "{path} = {budget} lets {budget} TTIs pass between two looks at a place, and events last {lasts}{}: up to \
             {share:.0} % of them can be over before anybody looks, and are missed",
            match scenario.events.duration_kind {
                DurationKind::Fixed => "",
                DurationKind::Geometric => " in the mean",
            }
        )
    })
}

/// Energy sums over all devices and TTIs have to fit in 64 bits, those of runs that the policy makes for itself too.
fn bounded(reader: &Reader<'_>, scenario: &Scenario) -> Result<(), ScenarioError> {
    let most = scenario.longest();
    let lengths = std::iter::once(("ttis", scenario.ttis)).chain(scenario.policy.own_runs());
    let Some((path, ttis)) = lengths.into_iter().find(|(_, ttis)| *ttis > most) else {
        return Ok(());
    };
    let allowed = format!(
        "must be at most {most} with {} devices that hold or harvest up to {}, or sums of energy overflow",
        scenario.devices,
        scenario.largest_energy()
    );
    Err(reader.refuse(path, ttis, allowed))
}
