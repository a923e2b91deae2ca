//! Settings of the `q-learning` policy (Sec. V-B).

use std::path::PathBuf;
use std::sync::Arc;

use reveille_common::declare;
use reveille_common::declare::{
    ABOVE_ZERO, Alternative, BELOW_ONE, NOT_NEGATIVE, Range, Reader, ScenarioError, Section, Sink, Value, number,
    source, switch, whole,
};
use reveille_common::scenario::{PolicySettings, Site};

use super::learned::{ABLE, AREAS, Entry, LONGEST_WINDOW, Learned, Lookback, Schedule, Setting, Weights};
use crate::beliefs::raster::MOST_CELLS;
use crate::beliefs::{ages, coverage};

/// Beyond it Q-values take too long to learn.
const DISCOUNT: Range = Range::closed(0.0, 0.999);

/// Where tables come from, but for files.
const TABLES: &[Alternative] = &[
    Alternative {
        name: "shipped",
        about: "The tables that come with the program, learned on what is most like the scenario.",
    },
    Alternative {
        name: "nothing",
        about: "No tables: the policy begins with the optimistic start, and has to learn.",
    },
];

declare! {
    /// Settings of the policy `q-learning` (Sec. V-B).
    #[derive(Clone, Debug)]
    struct Fields in "policy.q-learning" {
        /// Where the tables come from; a file is one that `reveille train` wrote.
        table: Option<String> = source(TABLES, "shipped"),
        /// Weight μ1 of misdetections in the reward. Unless the policy learns, that of the tables.
        mu1: Option<f64> = number(NOT_NEGATIVE, DEFAULT.mu1)
            .derived("that of the tables, or 14, with `ages` 1")
            .source("Sec. V-B, 0.5 to 20"),
        /// Weight μ2 of information in the reward of a wake-up. Unless the policy learns, that of the tables.
        mu2: Option<f64> = number(NOT_NEGATIVE, DEFAULT.mu2)
            .derived("that of the tables, or 1")
            .source("Sec. V-B, 1 to 5"),
        /// Discount ζ of the duty cycling. Unless the policy learns, that of the tables.
        zeta: Option<f64> = number(DISCOUNT, DEFAULT.zeta).derived("that of the tables, or 0.95").source("Sec. V-B"),
        /// Delay budget of the application: the area is to be covered once within this time, with 1 in every TTI.
        /// Unless the policy learns, there must be tables for it; `shipped` ones are for 1, 2 and 4.
        window: u32 = whole(1, LONGEST_WINDOW as u64, 1).unit("TTIs"),
        /// Whether what a device would newly look at is weighed by the age of its places, as under `age-index`, so that
        /// the table says what a place may wait for. The window is then 1.
        ages: bool = switch(false),
        /// Whether the policy goes on learning in the run.
        learn: bool = switch(false),
        /// Probability that a decision is made at random while the policy learns, in the first TTI.
        epsilon: f64 = number(BELOW_ONE, 0.02).source("Sec. V-B"),
        /// The same in the last TTI; in between it changes evenly.
        epsilon_last: f64 = number(BELOW_ONE, 0.02).derived("that of `epsilon`") => epsilon,
        /// Exponent of the learning rate: it falls with the visits of a value to the power of this.
        rate_decay: f64 = number(ABOVE_ZERO, Schedule::USUAL.rate_decay),
        /// The least learning rate.
        rate_floor: f64 = number(ABOVE_ZERO, Schedule::USUAL.rate_floor),
        /// Optimism of the start, 1 for the most that an action brings at once.
        optimism: f64 = number(NOT_NEGATIVE, Schedule::USUAL.optimism),
    }
}

impl Fields {
    /// What a look at a place counts for later.
    const fn lookback(&self) -> Lookback {
        if self.ages {
            Lookback::Ages
        } else {
            Lookback::Window(self.window)
        }
    }

    /// The weights where neither the scenario nor a table says otherwise. With ages a misdetection weighs less: what an
    /// event costs in each TTI that it waits is in the worth of ages.
    const fn usual(&self) -> Weights {
        if self.ages {
            Weights { mu1: 1.0, ..DEFAULT }
        } else {
            DEFAULT
        }
    }
}

/// The usual weights for windows.
const DEFAULT: Weights = Weights {
    mu1: 14.0,
    mu2: 1.0,
    zeta: 0.95,
};

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
    /// What a look at a place counts for later: for the window that is the delay budget of the application, 1 for the
    /// area to be covered in every TTI; or places have ages.
    pub lookback: Lookback,
    /// Where the tables come from.
    pub source: TableSource,
    /// Whether the policy goes on learning in the run.
    pub learn: bool,
    /// Probability that a decision is made at random while the policy learns, in the first TTI and in the last, `[0,
    /// 1)`; in between it changes evenly.
    pub epsilon: (f64, f64),
    /// How values are learned.
    pub schedule: Schedule,
    /// The tables at the start of the run.
    pub start: Arc<Entry>,
    /// What the tables are, in words; nothing for the optimistic start.
    pub begun_from: Option<String>,
    /// Where the tables were learned on another setting, a phrase each.
    pub foreign: Vec<String>,
}

impl QLearningSettings {
    /// Its fields as they are declared.
    pub const SECTION: &'static Section = Fields::SECTION;

    /// The settings that `reader` has, for a base station that knows `site`.
    ///
    /// # Errors
    /// A value that may not be, or tables that cannot be used.
    pub fn settle(reader: &Reader<'_>, site: &Site<'_>) -> Result<Self, ScenarioError> {
        settle(reader, site)
    }
}

impl PolicySettings for QLearningSettings {
    fn visit(&self, sink: &mut dyn Sink) {
        let table = match &self.source {
            TableSource::Shipped => "shipped".into(),
            TableSource::Nothing => "nothing".into(),
            TableSource::File(path) => path.to_string_lossy(),
        };
        if let Some(field) = Fields::SECTION.field("table") {
            sink.field(Fields::SECTION, field, Value::Path(&table));
            sink.content(&self.start.fingerprint());
        }
        let fields = Fields {
            table: None,
            mu1: Some(self.weights.mu1),
            mu2: Some(self.weights.mu2),
            zeta: Some(self.weights.zeta),
            window: self.lookback.window(),
            ages: self.lookback == Lookback::Ages,
            learn: self.learn,
            epsilon: self.epsilon.0,
            epsilon_last: self.epsilon.1,
            rate_decay: self.schedule.rate_decay,
            rate_floor: self.schedule.rate_floor,
            optimism: self.schedule.optimism,
        };
        fields.visit(sink);
    }

    fn delay_budget(&self) -> Option<(&'static str, u64)> {
        // Ages promise nothing: how long a place waits depends on what looking at it costs.
        match self.lookback {
            Lookback::Window(window) => Some(("policy.q-learning.window", u64::from(window))),
            Lookback::Ages => None,
        }
    }

    fn warnings(&self) -> Vec<String> {
        if self.foreign.is_empty() {
            return Vec::new();
        }
        vec![format!(
            "the tables of q-learning were learned on another setting, and what is worth doing there may not be worth \
             it here ({}); for tables of its own: reveille train q-learning --out FILE, with the same --scenario and \
             --set",
            self.foreign.join("; ")
        )]
    }
}

/// What is looked at is counted on cells of a size that follows from d_max; there may be too many.
fn check_raster(reader: &Reader<'_>, site: &Site<'_>, lookback: Lookback) -> Result<(), ScenarioError> {
    let d_max = site.sensing.d_max;
    let (cells, what) = match lookback {
        Lookback::Window(_) => (coverage::cells(site.area, site.sensing), "count coverage on"),
        Lookback::Ages => (ages::cells(site.area, d_max), "keep the ages of"),
    };
    if cells <= MOST_CELLS {
        return Ok(());
    }
    let allowed =
        format!("is so small against the area that q-learning would {what} {cells:.0} cells, more than {MOST_CELLS}");
    Err(reader.refuse("sensing.d_max", d_max, allowed))
}

/// Says so if under the tables of `start` nobody ever senses: nothing that a device can look at is worth it.
fn warn_of_sleep(reader: &Reader<'_>, site: &Site<'_>, weights: &Weights, start: &Entry) {
    let lookback = start.lookback;
    let disc = std::f64::consts::PI * site.sensing.d_max * site.sensing.d_max;
    let most = ages::reach(site.sensing) / disc * lookback.most();
    let advantages = start.duty.advantages();
    let is_worth_it = |row: &[f64; AREAS]| lookback.begin(row).is_some_and(|begin| begin < most);
    if !advantages.iter().skip(usize::from(ABLE)).any(is_worth_it) {
        reader.warn(format!(
            "under these tables of q-learning no device is ever told to sense, and every event is missed: with μ1 = \
             {mu1}, α = {alpha} and the tables' N = {n}, all that one device can look at is worth less than sleep; \
             raise policy.q-learning.mu1 and train: reveille train q-learning --windows {lookback} --out FILE, with \
             the same --scenario and --set",
            mu1 = weights.mu1,
            alpha = site.alpha,
            n = start.devices,
        ));
    }
}

fn settle(reader: &Reader<'_>, site: &Site<'_>) -> Result<QLearningSettings, ScenarioError> {
    let fields = Fields::read(reader)?;
    let name = fields.table.as_deref().unwrap_or("shipped");
    let setting = Setting::of(site);
    let (source, learned) = tables(reader, &fields, name, &setting)?;
    if learned.is_none() && !fields.learn {
        let allowed = "needs policy.q-learning.learn = true, or nothing is ever known; or name a table";
        return Err(reader.refuse("policy.q-learning.table", name, allowed));
    }
    let (window, ages) = (fields.window, fields.ages);
    let lookback = fields.lookback();
    check_raster(reader, site, lookback)?;
    if ages && window > 1 {
        let allowed = "must be 1 with policy.q-learning.ages = true: a place's age says how long it has waited";
        return Err(reader.refuse("policy.q-learning.window", window, allowed));
    }
    let weights = weights(reader, &fields, learned.as_deref())?;
    let schedule = Schedule {
        rate_decay: fields.rate_decay,
        rate_floor: fields.rate_floor,
        optimism: fields.optimism,
    };
    let start = match &learned {
        None => Arc::new(Entry::optimistic(site, &weights, lookback, schedule.optimism)),
        Some(tables) => Arc::new(entry(reader, &fields, tables, site)?),
    };
    if !fields.learn {
        warn_of_sleep(reader, site, &weights, &start);
    }
    Ok(QLearningSettings {
        weights,
        lookback,
        source,
        learn: fields.learn,
        epsilon: (fields.epsilon, fields.epsilon_last),
        schedule,
        begun_from: learned.as_ref().map(|tables| tables.in_words(&start)),
        start,
        foreign: learned.map_or_else(Vec::new, |tables| tables.setting.differences(&setting)),
    })
}

/// The weights: those of the scenario, of the tables, or the usual ones. A policy that does not learn has to take those
/// of its tables.
fn weights(reader: &Reader<'_>, fields: &Fields, learned: Option<&Learned>) -> Result<Weights, ScenarioError> {
    let known = learned.map(|tables| tables.weights);
    let as_learned = |name: &str, known: Option<f64>, value: f64| match known {
        Some(known) if (known - value).abs() > 1e-9 && !fields.learn => {
            let allowed = format!(
                "must be {known}, for which its table was learned, unless policy.q-learning.learn = true; for a table \
                 of your own: reveille train q-learning --windows {} --set policy.q-learning.{name}={value} --out FILE",
                fields.lookback()
            );
            Err(reader.refuse(&format!("policy.q-learning.{name}"), value, allowed))
        }
        Some(_) | None => Ok(value),
    };
    let weight = |name: &str, given: Option<f64>, of: fn(&Weights) -> f64| {
        let known = known.as_ref().map(of);
        as_learned(name, known, given.or(known).unwrap_or(of(&fields.usual())))
    };
    Ok(Weights {
        mu1: weight("mu1", fields.mu1, |w| w.mu1)?,
        mu2: weight("mu2", fields.mu2, |w| w.mu2)?,
        zeta: weight("zeta", fields.zeta, |w| w.zeta)?,
    })
}

fn tables(
    reader: &Reader<'_>,
    fields: &Fields,
    name: &str,
    setting: &Setting,
) -> Result<(TableSource, Option<Arc<Learned>>), ScenarioError> {
    let field = "policy.q-learning.table";
    Ok(match name {
        "shipped" => (
            TableSource::Shipped,
            Some(Arc::new(Learned::shipped(setting, fields.ages))),
        ),
        "nothing" => (TableSource::Nothing, None),
        file => {
            let path = reader.file(field, file)?;
            match Learned::read(reader.files(), &path) {
                Ok(tables) if tables.is_cut_short() => {
                    let why = "is the checkpoint of a training that was cut short: go on with that";
                    return Err(reader.data(field, path, why));
                }
                Ok(tables) => (TableSource::File(path), Some(Arc::new(tables))),
                Err(error) => return Err(reader.data(field, path, error.to_string())),
            }
        }
    })
}

/// The entry of `tables` for what the scenario asks for and its density. A policy that learns may go on from another
/// window's.
fn entry(reader: &Reader<'_>, fields: &Fields, tables: &Learned, site: &Site<'_>) -> Result<Entry, ScenarioError> {
    let (name, surface) = (fields.table.as_deref().unwrap_or("shipped"), site.area.surface());
    let own = fields.lookback();
    let known = tables.lookbacks();
    let lookback = if known.contains(&own) {
        own
    } else if fields.learn
        && own != Lookback::Ages
        && let Some(nearest) = tables.nearest_window(own.window())
    {
        Lookback::Window(nearest)
    } else {
        let set = |lookback: &Lookback| match lookback {
            Lookback::Window(window) => format!("policy.q-learning.window = {window}"),
            Lookback::Ages => "policy.q-learning.ages = true".to_owned(),
        };
        let known: Vec<String> = known.iter().map(set).collect();
        let allowed = format!(
            "has no tables in {name}, which has those for {known}; set one of these, or train for yours: reveille \
             train q-learning --windows {own} --out FILE, with the same --scenario and --set",
            known = known.join(", "),
        );
        return Err(match own {
            Lookback::Window(window) => reader.refuse("policy.q-learning.window", window, allowed),
            Lookback::Ages => reader.refuse("policy.q-learning.ages", true, allowed),
        });
    };
    tables.closest(lookback, site.devices, surface).cloned().ok_or_else(|| {
        let (least, most) = tables.range(lookback, surface);
        let allowed = format!(
            "serves {least} to {most} devices on {surface} m² with {}, not {n}; train for yours: reveille train \
             q-learning --devices {n} --windows {own} --out FILE, with the same --scenario and --set",
            lookback.in_words(),
            n = site.devices,
        );
        reader.refuse("policy.q-learning.table", name, allowed)
    })
}
