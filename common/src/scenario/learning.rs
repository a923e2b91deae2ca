//! Settings of the policy that learns, and what a base station may be given to decide with.

use std::path::PathBuf;
use std::sync::Arc;

use super::check::{ABOVE_ZERO, BELOW_ONE, Checker, NOT_NEGATIVE, Range, Section};
use super::error::ScenarioError;
use super::model::Scenario;
use super::raw::RawQLearning;
use crate::learned::{Entry, Learned, Schedule, Setting, Weights};

/// How wake-up candidates are ranked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WakeUpRanking {
    /// By `P_4,2`, the probability that a device senses what another has reported (Sec. III).
    P42,
    /// By the expected gain of information under a belief over the epicentre, which every report and every silent device
    /// in S1 narrows down.
    Posterior,
}

impl WakeUpRanking {
    /// Its name, as in `bs.ranking` of a scenario.
    pub const fn name(self) -> &'static str {
        match self {
            Self::P42 => "p42",
            Self::Posterior => "posterior",
        }
    }
}

/// What the BS knows of batteries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BatteryKnowledge {
    /// The true levels, as in the paper's state 𝒯(k).
    Oracle,
    /// The level that each report carries, carried forward by what was commanded and the mean harvest.
    Reported,
}

impl BatteryKnowledge {
    /// Its name, as in `bs.battery_knowledge` of a scenario.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Oracle => "oracle",
            Self::Reported => "reported",
        }
    }
}

/// Where learned tables come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TableSource {
    /// The program.
    Shipped,
    /// Nowhere: the policy begins with the optimistic start.
    Nothing,
    /// A file that `reveille train` wrote.
    File(PathBuf),
}

/// Settings of the `q-learning` policy (Sec. V-B).
#[derive(Clone, Debug, PartialEq)]
pub struct QLearningSettings {
    /// μ1, μ2 and ζ. Those of the tables, unless the policy learns.
    pub weights: Weights,
    /// TTIs within which the area is to be covered once, `1 ..= `[`LONGEST_WINDOW`]; by default that of the tables, or the
    /// duration of an event. With 1 the area is to be covered in every TTI.
    pub window: u32,
    /// Where the tables come from.
    pub source: TableSource,
    /// Whether the policy goes on learning in the run.
    pub learn: bool,
    /// Probability that a decision is made at random while the policy learns, in the first TTI and in the last, `[0, 1)`; in
    /// between it changes evenly.
    pub epsilon: (f64, f64),
    /// How it learns.
    pub schedule: Schedule,
    /// The tables at the start of the run.
    pub start: Arc<Entry>,
    /// What the tables are, in words; nothing for the optimistic start.
    pub begun_from: Option<String>,
    /// Where the tables were learned on another setting, a phrase each.
    pub foreign: Vec<String>,
}

/// The longest [`QLearningSettings::window`], TTIs.
pub const LONGEST_WINDOW: u32 = 1000;
/// Cells of the raster on which `q-learning` counts the covered area, along d_max.
pub const CELLS_PER_RANGE: f64 = 10.0;
/// The most cells of that raster.
const MOST_CELLS: f64 = 16_777_216.0;

/// Beyond it Q-values take too long to learn.
const DISCOUNT: Range = ("must be at least 0 and at most 0.999", |x| (0.0..=0.999).contains(&x));

/// The weights where neither the scenario nor a table says otherwise.
const DEFAULT: Weights = Weights {
    mu1: 14.0,
    mu2: 1.6,
    zeta: 0.95,
};

/// The settings of `raw` for `scenario`, which is complete but for its policy.
pub(super) fn q_learning(
    check: &Checker<'_>,
    raw: &RawQLearning,
    scenario: &Scenario,
) -> Result<QLearningSettings, ScenarioError> {
    let section = Section::top("policy.q-learning");
    let (area, d_max) = (scenario.area, scenario.sensing.d_max);
    let cells = (area.width / d_max * CELLS_PER_RANGE).ceil() * (area.height / d_max * CELLS_PER_RANGE).ceil();
    if cells > MOST_CELLS {
        let allowed = format!(
            "is so small against the area that q-learning would count coverage on {cells:.0} cells, more than {MOST_CELLS}"
        );
        return Err(check.refuse(&Section::top("sensing"), "d_max", d_max, allowed));
    }
    let learn = Checker::set(&section, "learn", raw.learn)?;
    let name = Checker::set(&section, "table", raw.table.as_deref())?;
    let setting = Setting::of(scenario);
    let (source, learned) = tables(check, &section, name, &setting)?;
    if learned.is_none() && !learn {
        let allowed = "needs policy.q-learning.learn = true, or nothing is ever known; or name a table";
        return Err(check.refuse(&section, "table", name, allowed));
    }
    let trained = learned.as_ref().map(|tables| tables.weights);
    let weight = |name: &'static str, given: Option<f64>, of: fn(&Weights) -> f64, range: Range| {
        let known = trained.as_ref().map(of);
        let value = check.number(&section, name, given.or(known).or(Some(of(&DEFAULT))), range)?;
        match known {
            Some(known) if (known - value).abs() > 1e-9 && !learn => {
                let allowed = format!(
                    "must be {known}, for which its table was learned, unless policy.q-learning.learn = true; for a table of \
                     your own: reveille train q-learning --set policy.q-learning.{name}={value} --out FILE"
                );
                Err(check.refuse(&section, name, value, allowed))
            }
            Some(_) | None => Ok(value),
        }
    };
    let weights = Weights {
        mu1: weight("mu1", raw.mu1, |w| w.mu1, NOT_NEGATIVE)?,
        mu2: weight("mu2", raw.mu2, |w| w.mu2, NOT_NEGATIVE)?,
        zeta: weight("zeta", raw.zeta, |w| w.zeta, DISCOUNT)?,
    };
    let window = window(
        check,
        &section,
        raw,
        scenario,
        learned.as_ref().map(|tables| tables.window),
    )?;
    if let Some(known) = learned
        .as_ref()
        .map(|tables| tables.window)
        .filter(|known| *known != window && !learn)
    {
        let allowed = format!(
            "must be {known}, for which its table was learned, unless policy.q-learning.learn = true; for a table of your own: \
             reveille train q-learning --set policy.q-learning.window={window} --out FILE"
        );
        return Err(check.refuse(&section, "window", window, allowed));
    }
    let usual = Schedule::default();
    let of = |name, given: Option<f64>, usual, range| check.number(&section, name, given.or(Some(usual)), range);
    let schedule = Schedule {
        rate_decay: of("rate_decay", raw.rate_decay, usual.rate_decay, ABOVE_ZERO)?,
        rate_floor: of("rate_floor", raw.rate_floor, usual.rate_floor, ABOVE_ZERO)?,
        optimism: of("optimism", raw.optimism, usual.optimism, NOT_NEGATIVE)?,
    };
    let epsilon = check.number(&section, "epsilon", raw.epsilon, BELOW_ONE)?;
    let start = match &learned {
        None => Arc::new(Entry::optimistic(scenario, &weights, window, schedule.optimism)),
        Some(tables) => Arc::new(entry(check, &section, name, tables, scenario)?),
    };
    Ok(QLearningSettings {
        weights,
        window,
        source,
        learn,
        epsilon: (
            epsilon,
            check.number(&section, "epsilon_last", raw.epsilon_last.or(Some(epsilon)), BELOW_ONE)?,
        ),
        schedule,
        begun_from: learned.as_ref().map(|tables| tables.in_words(&start)),
        start,
        foreign: learned.map_or_else(Vec::new, |tables| tables.setting.differences(&setting)),
    })
}

/// The window: that of the scenario, of the tables, or the duration of an event.
fn window(
    check: &Checker<'_>,
    section: &Section,
    raw: &RawQLearning,
    scenario: &Scenario,
    known: Option<u32>,
) -> Result<u32, ScenarioError> {
    let longest = u64::from(LONGEST_WINDOW);
    let usual = known.map_or(scenario.events.duration.min(longest), u64::from);
    let window = check.whole(section, "window", raw.window.or(Some(usual)), (1, longest))?;
    Ok(window as u32)
}

fn tables(
    check: &Checker<'_>,
    section: &Section,
    name: &str,
    setting: &Setting,
) -> Result<(TableSource, Option<Arc<Learned>>), ScenarioError> {
    Ok(match name {
        "shipped" => (TableSource::Shipped, Some(Learned::shipped(setting))),
        "nothing" => (TableSource::Nothing, None),
        file => {
            let path = check.file(section, "table", file)?;
            match Learned::read(&path) {
                Ok(tables) if tables.is_cut_short() => {
                    let why = "is the checkpoint of a training that was cut short: go on with that".to_owned();
                    return Err(check.data(section, "table", path, why));
                }
                Ok(tables) => (TableSource::File(path), Some(Arc::new(tables))),
                Err(error) => return Err(check.data(section, "table", path, error.to_string())),
            }
        }
    })
}

/// The entry of `tables` for the scenario's density.
fn entry(
    check: &Checker<'_>,
    section: &Section,
    name: &str,
    tables: &Learned,
    scenario: &Scenario,
) -> Result<Entry, ScenarioError> {
    let surface = scenario.area.surface();
    tables.closest(scenario.devices, surface).cloned().ok_or_else(|| {
        let (least, most) = tables.range(surface);
        let allowed = format!(
            "serves {least} to {most} devices on {surface} m², not {n}; train for yours: reveille train q-learning --devices {n} \
             --out FILE, with the same --scenario and --set",
            n = scenario.devices
        );
        check.refuse(section, "table", name, allowed)
    })
}
