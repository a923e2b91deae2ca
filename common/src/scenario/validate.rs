//! From the merged raw form to a [`Scenario`] that every part of a run may rely on.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use super::check::{ABOVE_ZERO, BELOW_ONE, Checker, NOT_NEGATIVE, POSITIVE, Section};
use super::error::ScenarioError;
use super::layers::Places;
use super::learning::q_learning;
use super::model::{
    AdjustedSettings, BsSettings, DeviceClass, EnergyModel, Events, Harvest, KnnSettings, MAX_CLASSES, MAX_DEVICES,
    MAX_TTIS, PolicyConfig, Scenario,
};
use super::raw::{
    HarvestKind, LayoutKind, PolicyName, RawAdjusted, RawClass, RawEnergy, RawHarvest, RawLayout, RawPolicy,
    RawScenario, RawSensing,
};
use super::{table, trace};
use crate::geometry::{Area, Layout, Point};
use crate::plan::DutyCycle;
use crate::sensing::Sensing;
use crate::units::Energy;

/// The largest η · `d_max`: `p(d_max)` is still above 0 in double precision.
const MAX_DECAY: f64 = 700.0;
/// The longest list of t_on or t_DRX to search.
const MOST_CYCLES: usize = 64;
/// How far from 1 the sum of the classes' shares may be.
const SHARE_TOLERANCE: f64 = 1e-9;

/// The scenario that `raw` describes; `preset` is the name of the one that it started from.
pub(super) fn validate(
    preset: &str,
    raw: &RawScenario,
    places: &Places,
    base_dir: &Path,
) -> Result<Scenario, ScenarioError> {
    let check = Checker::new(places, base_dir);
    let top = Section::top("");
    let devices = check.whole(&top, "devices", raw.devices, (1, u64::from(MAX_DEVICES)))? as u32;
    let section = Section::top("area");
    let area = Area {
        width: check.number(&section, "width", raw.area.width, POSITIVE)?,
        height: check.number(&section, "height", raw.area.height, POSITIVE)?,
    };
    let tau = check.number(&top, "tau", raw.tau, POSITIVE)?;
    let mut scenario = Scenario {
        preset: preset.to_owned(),
        devices,
        ttis: check.whole(&top, "ttis", raw.ttis, (1, MAX_TTIS))?,
        seed: Checker::set(&top, "seed", raw.seed)?,
        warm_up: check.number(&top, "warm_up", raw.warm_up, BELOW_ONE)?,
        tau,
        area,
        sensing: sensing(&check, raw.sensing, area)?,
        events: Events {
            alpha: check.number(&Section::top("events"), "alpha", raw.events.alpha, ABOVE_ZERO)?,
            duration: check.whole(&Section::top("events"), "duration", raw.events.duration, (1, MAX_TTIS))?,
        },
        bs: BsSettings {
            sync_interval: check.whole(
                &Section::top("bs"),
                "sync_interval",
                raw.bs.sync_interval,
                (1, MAX_TTIS),
            )?,
            ranking: Checker::set(&Section::top("bs"), "ranking", raw.bs.ranking)?,
            battery_knowledge: Checker::set(&Section::top("bs"), "battery_knowledge", raw.bs.battery_knowledge)?,
        },
        policy: PolicyConfig::Genie,
        layout: layout(&check, &raw.layout, area, devices)?,
        classes: classes(&check, raw, tau)?,
    };
    scenario.policy = policy(&check, &raw.policy, &scenario)?;
    bounded(&check, &scenario)?;
    Ok(scenario)
}

fn sensing(check: &Checker<'_>, raw: RawSensing, area: Area) -> Result<Sensing, ScenarioError> {
    let section = Section::top("sensing");
    let d_max = Checker::set(&section, "d_max", raw.d_max)?;
    let eta = check.number(&section, "eta", raw.eta, POSITIVE)?;
    if !(d_max > 0.0 && d_max <= area.diagonal()) {
        let allowed = format!(
            "must be greater than 0 and at most {:.2} (the area's diagonal in metres)",
            area.diagonal()
        );
        return Err(check.refuse(&section, "d_max", d_max, allowed));
    }
    if eta * d_max > MAX_DECAY {
        let allowed = format!(
            "must be at most {} ({MAX_DECAY} / d_max), or p(d_max) is too small to count",
            MAX_DECAY / d_max
        );
        return Err(check.refuse(&section, "eta", eta, allowed));
    }
    Ok(Sensing {
        kind: Checker::set(&section, "kind", raw.kind)?,
        d_max,
        eta,
        psi: check.number(&section, "psi", raw.psi, POSITIVE)?,
        g: Checker::set(&section, "g", raw.g)?,
    })
}

/// The policy of `scenario`, which is complete but for that.
fn policy(check: &Checker<'_>, raw: &RawPolicy, scenario: &Scenario) -> Result<PolicyConfig, ScenarioError> {
    let knn = Section::top("policy.knn");
    Ok(match Checker::set(&Section::top("policy"), "name", raw.name)? {
        PolicyName::Random => PolicyConfig::Random,
        PolicyName::Genie => PolicyConfig::Genie,
        PolicyName::Knn => PolicyConfig::Knn(KnnSettings {
            neighbours: check.whole(&knn, "neighbours", raw.knn.neighbours, (1, u64::from(MAX_DEVICES)))? as u32,
            limit_radius: Checker::set(&knn, "limit_radius", raw.knn.limit_radius)?,
        }),
        PolicyName::Adjusted => PolicyConfig::Adjusted(adjusted(check, &raw.adjusted)?),
        PolicyName::QLearning => PolicyConfig::QLearning(q_learning(check, &raw.q_learning, scenario)?),
    })
}

fn adjusted(check: &Checker<'_>, raw: &RawAdjusted) -> Result<AdjustedSettings, ScenarioError> {
    let section = Section::top("policy.adjusted");
    let ttis = |name: &'static str, list: &Option<Vec<u64>>| {
        let list = Checker::set(&section, name, list.as_ref())?;
        let longest = u64::from(DutyCycle::LONGEST);
        if list.is_empty() || list.len() > MOST_CYCLES || list.iter().any(|ttis| !(1..=longest).contains(ttis)) {
            let allowed = format!("must be a list of 1 to {MOST_CYCLES} whole numbers from 1 to {longest}");
            return Err(check.refuse(&section, name, format!("{list:?}"), allowed));
        }
        Ok(list.iter().map(|&ttis| ttis as u32).collect::<Vec<u32>>())
    };
    let settings = AdjustedSettings {
        t_on: ttis("t_on", &raw.t_on)?,
        t_drx: ttis("t_drx", &raw.t_drx)?,
        pilot_ttis: check.whole(&section, "pilot_ttis", raw.pilot_ttis, (4, MAX_TTIS))?,
        found: None,
    };
    if settings.pairs().next().is_none() {
        let allowed = "must hold a value that is not longer than one of policy.adjusted.t_drx";
        return Err(check.refuse(&section, "t_on", format!("{:?}", settings.t_on), allowed));
    }
    Ok(settings)
}

fn layout(check: &Checker<'_>, raw: &RawLayout, area: Area, devices: u32) -> Result<Layout, ScenarioError> {
    let section = Section::top("layout");
    let kind = Checker::set(&section, "kind", raw.kind)?;
    if !matches!(kind, LayoutKind::File) {
        check.idle(&section, "file", "layout.kind = \"file\"")?;
    }
    Ok(match kind {
        LayoutKind::Uniform => Layout::Uniform,
        LayoutKind::JitteredGrid => Layout::JitteredGrid,
        LayoutKind::PoissonDisk => Layout::PoissonDisk,
        LayoutKind::Grid => Layout::Grid,
        LayoutKind::Hex => Layout::Hex,
        LayoutKind::File => {
            let file = check.need(&section, "file", raw.file.as_deref(), "kind")?;
            let path = check.file(&section, "file", file)?;
            match points(&path, area, devices as usize) {
                Ok(points) => Layout::File {
                    path,
                    points: Arc::new(points),
                },
                Err(reason) => return Err(check.data(&section, "file", path, reason)),
            }
        }
    })
}

/// The first `count` points of a layout file, all within `area`.
fn points(path: &Path, area: Area, count: usize) -> Result<Vec<Point>, String> {
    let columns = table::read_columns(path, &["x".to_owned(), "y".to_owned()], count)?;
    let [xs, ys] = columns.as_slice() else {
        return Err("has no columns `x` and `y`".to_owned());
    };
    if xs.len() < count {
        return Err(format!("has {} points, too few for {count} devices", xs.len()));
    }
    let points: Vec<Point> = xs.iter().zip(ys).map(|(&x, &y)| Point::new(x + 0.0, y + 0.0)).collect();
    match points.iter().position(|&point| !area.contains(point)) {
        None => Ok(points),
        Some(row) => Err(format!(
            "row {}: the point ({}, {}) lies outside the area of {} by {} metres",
            row + 1,
            points[row].x,
            points[row].y,
            area.width,
            area.height
        )),
    }
}

fn classes(check: &Checker<'_>, raw: &RawScenario, tau: f64) -> Result<Vec<DeviceClass>, ScenarioError> {
    if raw.class.is_empty() {
        return Ok(vec![DeviceClass {
            name: "default".to_owned(),
            share: 1.0,
            energy: energy(check, &Section::top("energy"), raw.energy)?,
            harvest: harvest(check, &Section::top("harvest"), &raw.harvest, tau)?,
        }]);
    }
    let top = Section::top("");
    if raw.class.len() > MAX_CLASSES {
        let found = format!("{} classes", raw.class.len());
        return Err(check.refuse(&top, "class", found, format!("must be at most {MAX_CLASSES}")));
    }
    let mut names = BTreeSet::new();
    let mut classes = Vec::with_capacity(raw.class.len());
    for (index, class) in raw.class.iter().enumerate() {
        let made = device_class(check, index, class, tau)?;
        if !names.insert(made.name.clone()) {
            let section = Section::class(index, &made.name);
            return Err(check.refuse(
                &section,
                "name",
                &made.name,
                "must differ from the other classes' names",
            ));
        }
        classes.push(made);
    }
    let sum: f64 = classes.iter().map(|class| class.share).sum();
    if (sum - 1.0).abs() > SHARE_TOLERANCE {
        let shares: Vec<String> = classes.iter().map(|class| class.share.to_string()).collect();
        let allowed = format!("the shares of all classes must add up to 1, not to {sum}");
        return Err(check.refuse(&top, "class", format!("shares {}", shares.join(" + ")), allowed));
    }
    Ok(classes)
}

fn device_class(check: &Checker<'_>, index: usize, raw: &RawClass, tau: f64) -> Result<DeviceClass, ScenarioError> {
    let numbered = Section::class(index, &(index + 1).to_string());
    let Some(name) = raw.name.clone() else {
        let (field, place) = check.locate(&numbered, "name");
        let (_, class) = check.locate(&Section::top("class"), &index.to_string());
        let why = format!(
            "for every class ({})",
            if class == super::Place::Nowhere { place } else { class }
        );
        return Err(ScenarioError::Missing { field, why });
    };
    if name.trim().is_empty() || name.chars().count() > 64 || name.contains(char::is_control) {
        let shown = format!("\"{}\"", name.escape_debug());
        let allowed = "must be 1 to 64 characters, not all blank, without control characters";
        return Err(check.refuse(&numbered, "name", shown, allowed));
    }
    let section = Section::class(index, &name);
    let share = check.need(&section, "share", raw.share, "name")?;
    Ok(DeviceClass {
        share: check.number(&section, "share", Some(share), ABOVE_ZERO)?,
        energy: energy(check, &section.within("energy"), raw.energy)?,
        harvest: harvest(check, &section.within("harvest"), &raw.harvest, tau)?,
        name,
    })
}

fn energy(check: &Checker<'_>, section: &Section, raw: RawEnergy) -> Result<EnergyModel, ScenarioError> {
    let e_max = check.energy(section, "e_max", raw.e_max)?;
    if e_max == Energy::ZERO {
        let allowed = "must be at least 0.000001 units";
        return Err(check.refuse(section, "e_max", raw.e_max.unwrap_or_default(), allowed));
    }
    let cost = |name, value: Option<f64>, consequence: &str| {
        let energy = check.energy(section, name, value)?;
        if energy <= e_max {
            return Ok(energy);
        }
        let (limit, _) = check.locate(section, "e_max");
        let allowed = format!("must be at most {} units ({limit}){consequence}", e_max.units());
        Err(check.refuse(section, name, energy.units(), allowed))
    };
    let unpayable = ", or it can never be paid";
    Ok(EnergyModel {
        e_max,
        e_idle: cost("e_idle", raw.e_idle, unpayable)?,
        e_wur: cost("e_wur", raw.e_wur, unpayable)?,
        e_tx: cost("e_tx", raw.e_tx, unpayable)?,
        initial: match raw.initial {
            None => Energy::from_micro(e_max.micro() / 2),
            given => cost("initial", given, "")?,
        },
    })
}

fn harvest(check: &Checker<'_>, section: &Section, raw: &RawHarvest, tau: f64) -> Result<Harvest, ScenarioError> {
    let arrivals = || {
        let lambda = check.number(section, "lambda", raw.lambda, NOT_NEGATIVE)?;
        Ok::<_, ScenarioError>((lambda, check.energy(section, "e_b", raw.e_b)?))
    };
    let kind = Checker::set(section, "kind", raw.kind)?;
    if !matches!(kind, HarvestKind::Mpp) {
        check.idle(section, "off_mean", "harvest.kind = \"mpp\"")?;
    }
    if !matches!(kind, HarvestKind::Trace) {
        check.idle(section, "trace.file", "harvest.kind = \"trace\"")?;
    }
    Ok(match kind {
        HarvestKind::Eq5 => {
            let (lambda, e_b) = arrivals()?;
            Harvest::Eq5 { lambda, e_b }
        }
        HarvestKind::ExpMinusLambda => {
            let (lambda, e_b) = arrivals()?;
            Harvest::ExpMinusLambda { lambda, e_b }
        }
        HarvestKind::Mpp => {
            let (lambda, e_b) = arrivals()?;
            if lambda == 0.0 {
                let allowed = "must be greater than 0 for harvest.kind = \"mpp\" (on-durations have the mean 1/lambda)";
                return Err(check.refuse(section, "lambda", lambda, allowed));
            }
            let off_mean = match raw.off_mean {
                None => default_off_mean(check, section, lambda, tau)?,
                given => check.number(
                    section,
                    "off_mean",
                    given,
                    ("must be greater than 0 and at most 1e15", |x| x > 0.0 && x <= 1e15),
                )?,
            };
            Harvest::Mpp { lambda, e_b, off_mean }
        }
        HarvestKind::Trace => Harvest::Trace(trace::trace(check, section, &raw.trace)?),
    })
}

/// The mean off-duration for which a source with on-durations of mean 1/λ is on for the share λτ·exp(-λτ) of the time.
fn default_off_mean(check: &Checker<'_>, section: &Section, lambda: f64, tau: f64) -> Result<f64, ScenarioError> {
    let on_share = lambda * tau * libm::exp(-lambda * tau);
    let off_mean = (1.0 - on_share) / (lambda * on_share);
    if off_mean > 0.0 && off_mean <= 1e15 {
        return Ok(off_mean);
    }
    let allowed = "is on for so small a share of the time that harvest.off_mean has to be set";
    Err(check.refuse(section, "lambda", lambda, allowed))
}

/// Energy sums over all devices and TTIs have to fit in 64 bits.
fn bounded(check: &Checker<'_>, scenario: &Scenario) -> Result<(), ScenarioError> {
    let largest = |class: &DeviceClass| match &class.harvest {
        Harvest::Eq5 { e_b, .. } | Harvest::ExpMinusLambda { e_b, .. } | Harvest::Mpp { e_b, .. } => {
            class.energy.e_max.max(*e_b)
        }
        Harvest::Trace(trace) => {
            let peak = trace.values.iter().flatten().max().copied().unwrap_or_default();
            class.energy.e_max.max(peak)
        }
    };
    let largest = scenario.classes.iter().map(largest).max().unwrap_or_default();
    let per_tti = u128::from(scenario.devices) * u128::from(largest.micro().max(1));
    let most = u128::from(u64::MAX) / per_tti;
    if u128::from(scenario.ttis) <= most {
        return Ok(());
    }
    let allowed = format!(
        "must be at most {most} with {} devices that hold or harvest up to {largest}, or sums of energy overflow",
        scenario.devices
    );
    Err(check.refuse(&Section::top(""), "ttis", scenario.ttis, allowed))
}
