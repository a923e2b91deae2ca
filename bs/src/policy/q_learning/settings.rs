//! Settings of the policy `q-learning` (Sec. V-B): reads them with the tables that they name, and checks that the
//! tables serve the scenario. The hash of a scenario covers the tables and depends on the order of the fields and of
//! the calls in `visit`.

use std::path::PathBuf;
use std::sync::Arc;

use reveille_common::declare;
use reveille_common::declare::{
    Alternative, FieldReader, FieldSink, FieldValue, NOT_NEGATIVE, Range, SHARE_ABOVE_ZERO, SHARE_BELOW_ONE,
    ScenarioError, Section, Visit, number, switch, whole, word_or_file,
};
use reveille_common::scenario::Site;

use super::learned::{
    AREA_BUCKETS, FIRST_ABLE_BUCKET, LearnedTables, Lookback, MAX_WINDOW, QWeights, Schedule, TableSet, TrainingSite,
};
use crate::beliefs::grid::MAX_CELLS;
use crate::beliefs::{ages, coverage};

/// Range of the discount ζ. Beyond it Q-values take too long to learn.
const DISCOUNT_RANGE: Range = Range::closed(0.0, 0.999);

/// Named sources of tables, other than files. `load_tables`, `visit` and two defaults below repeat the names.
const TABLES: &[Alternative] = &[
    Alternative {
        name: "shipped",
        about: "The tables shipped with the program, trained on the setting most similar to the scenario.",
    },
    Alternative {
        name: "nothing",
        about: "No tables: the policy starts with optimistic values and must learn.",
    },
];

// The texts repeat `DEFAULT_WEIGHTS`, the windows of the shipped tables and the rule of `Schedule::rate_decay`.
declare! {
    /// Settings of the policy `q-learning` (Sec. V-B).
    #[derive(Clone, Debug)]
    struct Fields in "policy.q-learning" {
        /// Source of the tables; a file must be written by `reveille train`.
        table: Option<String> = word_or_file(TABLES, "shipped"),
        /// Weight μ1 of misdetections in the reward. Unless the policy learns, it is the weight of the tables.
        mu1: Option<f64> = number(NOT_NEGATIVE, DEFAULT_WEIGHTS.mu1)
            .derived("value of the tables, or 14 (1 with `ages`)")
            .source("Sec. V-B, 0.5 to 20"),
        /// Weight μ2 of information in the reward of a wake-up. Unless the policy learns, it is the weight of the
        /// tables.
        mu2: Option<f64> = number(NOT_NEGATIVE, DEFAULT_WEIGHTS.mu2)
            .derived("value of the tables, or 1")
            .source("Sec. V-B, 1 to 5"),
        /// Discount ζ of duty cycling. Unless the policy learns, it is the discount of the tables.
        zeta: Option<f64> = number(DISCOUNT_RANGE, DEFAULT_WEIGHTS.zeta)
            .derived("value of the tables, or 0.95")
            .source("Sec. V-B"),
        /// Delay budget of the application: the area is covered once within this time, or in every TTI with 1.
        /// Unless the policy learns, it needs tables for this window; `shipped` has 1, 2 and 4.
        window: u32 = whole(1, MAX_WINDOW as u64, 1).unit("TTIs"),
        /// Whether places that a device would newly cover are weighted by their age, as under `age-index`. The tables
        /// then determine how long a place may wait, and the window is 1.
        ages: bool = switch(false),
        /// Whether the policy continues to learn in the run.
        learn: bool = switch(false),
        /// Probability of a random decision in the first TTI, while the policy learns.
        epsilon: f64 = number(SHARE_BELOW_ONE, 0.02).source("Sec. V-B"),
        /// Probability of a random decision in the last TTI. It changes linearly in between.
        epsilon_last: f64 = number(SHARE_BELOW_ONE, 0.02).derived("value of `epsilon`") => epsilon,
        /// Exponent ω of the learning rate max((n + 4)^−ω, `rate_floor`) at the n-th visit of a value.
        rate_decay: f64 = number(SHARE_ABOVE_ZERO, Schedule::DEFAULT.rate_decay),
        /// Minimum learning rate.
        rate_floor: f64 = number(SHARE_ABOVE_ZERO, Schedule::DEFAULT.rate_floor),
        /// Factor of the initial values. With 1, an action starts at its largest immediate reward.
        optimism: f64 = number(NOT_NEGATIVE, Schedule::DEFAULT.optimism),
    }
}

impl Fields {
    const fn lookback(&self) -> Lookback {
        if self.ages {
            Lookback::Ages
        } else {
            Lookback::Window(self.window)
        }
    }

    /// Returns the default weights, used where neither the scenario nor a table sets them. With ages μ1 is smaller,
    /// because the worth of ages already includes the cost of each TTI in which an event waits.
    const fn default_weights(&self) -> QWeights {
        if self.ages {
            QWeights {
                mu1: 1.0,
                ..DEFAULT_WEIGHTS
            }
        } else {
            DEFAULT_WEIGHTS
        }
    }
}

/// Default weights. The `derived` texts above repeat them; `beliefs/reward.rs` has the same defaults of μ1 and μ2.
const DEFAULT_WEIGHTS: QWeights = QWeights {
    mu1: 14.0,
    mu2: 1.0,
    zeta: 0.95,
};

/// Source of learned tables.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TableSource {
    /// The tables that come with the program.
    Shipped,
    /// No tables: the policy begins with the optimistic start.
    Nothing,
    /// A file that `reveille train` wrote.
    File(PathBuf),
}

/// Settings of the `q-learning` policy (Sec. V-B).
#[derive(Clone, Debug, PartialEq)]
pub struct QLearningSettings {
    /// Weights μ1, μ2 and ζ. Unless the policy learns, they are the weights of the tables.
    pub weights: QWeights,
    /// Rule for how long a covered place counts as covered: a window in TTIs, or ages. The window is the delay budget
    /// of the application; with 1 the area is covered in every TTI.
    pub lookback: Lookback,
    /// Source of the tables.
    pub table_source: TableSource,
    /// Whether the policy continues to learn in the run.
    pub learn: bool,
    /// Exploration probability while the policy learns, `[0, 1)`: in the first TTI and in the last. It changes linearly
    /// in between.
    pub epsilon: (f64, f64),
    /// Learning schedule.
    pub schedule: Schedule,
    /// Tables at the start of the run.
    pub initial_tables: Arc<TableSet>,
    /// Description of the tables; `None` for the optimistic start.
    pub begun_from: Option<String>,
}

impl QLearningSettings {
    /// The declared fields of the section.
    pub const SECTION: &'static Section = Fields::SECTION;

    /// Reads the settings for a base station that knows `site`.
    ///
    /// # Errors
    /// A value is out of range, or the tables cannot be used.
    pub fn from_fields(reader: &FieldReader<'_>, site: &Site<'_>) -> Result<Self, ScenarioError> {
        from_fields(reader, site)
    }
}

impl Visit for QLearningSettings {
    fn visit(&self, sink: &mut dyn FieldSink) {
        let table = match &self.table_source {
            TableSource::Shipped => "shipped".into(),
            TableSource::Nothing => "nothing".into(),
            TableSource::File(path) => path.to_string_lossy(),
        };
        if let Some(field) = Fields::SECTION.field("table") {
            sink.field(Fields::SECTION, field, FieldValue::Path(&table));
            // Other tables under the same path make another scenario.
            sink.content(&self.initial_tables.fingerprint());
        }
        let fields = Fields {
            // Visited above, with the content of the tables.
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
}

/// Checks that the raster of cells for coverage or ages is not too fine. The cell size follows from d_max.
fn check_raster(reader: &FieldReader<'_>, site: &Site<'_>, lookback: Lookback) -> Result<(), ScenarioError> {
    let d_max = site.sensing.d_max;
    let (cells, purpose) = match lookback {
        Lookback::Window(_) => (coverage::count_cells(site.area, site.sensing), "count coverage on"),
        Lookback::Ages => (ages::count_cells(site.area, d_max), "keep the ages of"),
    };
    if cells <= MAX_CELLS {
        return Ok(());
    }
    let allowed =
        format!("is too small for the area: q-learning would {purpose} {cells:.0} cells, more than {MAX_CELLS}");
    Err(reader.invalid_value("sensing.d_max", d_max, allowed))
}

/// Warns if no device ever senses under `tables`, because even the largest gain is worth less than sleep.
fn warn_of_sleep(reader: &FieldReader<'_>, site: &Site<'_>, weights: &QWeights, tables: &TableSet) {
    let lookback = tables.lookback;
    let disc = std::f64::consts::PI * site.sensing.d_max * site.sensing.d_max;
    let max_gain = ages::effective_area(site.sensing) / disc * lookback.max_gain();
    let advantages = tables.duty.advantages();
    let is_worth_it = |row: &[f64; AREA_BUCKETS]| lookback.advantage_start(row).is_some_and(|start| start < max_gain);
    // Below `FIRST_ABLE_BUCKET` no device senses, whatever its values are.
    if !advantages.iter().skip(usize::from(FIRST_ABLE_BUCKET)).any(is_worth_it) {
        reader.warn(format!(
            "with these tables of q-learning no device ever senses, and every event is missed: with μ1 = {mu1}, α = \
             {alpha} and the tables' N = {n}, the area of a device is worth less than sleep; raise \
             policy.q-learning.mu1 and train: reveille train q-learning --devices {devices} --windows {lookback} --out \
             FILE, with the same --scenario and --set",
            mu1 = weights.mu1,
            alpha = site.alpha,
            n = tables.devices,
            devices = site.devices,
        ));
    }
}

/// Warns if the tables were learned on another setting; `differences` holds one phrase per difference.
fn warn_of_differences(reader: &FieldReader<'_>, differences: &[String], devices: u32, lookback: Lookback) {
    if !differences.is_empty() {
        reader.warn(format!(
            "the tables of q-learning were learned on another setting and may decide badly here ({}); compare with \
             policy random, or train tables for this setting: reveille train q-learning --devices {devices} --windows \
             {lookback} --out FILE, with the same --scenario and --set",
            differences.join("; ")
        ));
    }
}

fn from_fields(reader: &FieldReader<'_>, site: &Site<'_>) -> Result<QLearningSettings, ScenarioError> {
    let fields = Fields::read(reader)?;
    let table_name = fields.table.as_deref().unwrap_or("shipped");
    let run_site = TrainingSite::from_site(site);
    let (table_source, learned) = load_tables(reader, &fields, table_name, &run_site)?;
    if learned.is_none() && !fields.learn {
        let allowed = "needs policy.q-learning.learn = true, because the policy starts without tables; or name a table";
        return Err(reader.invalid_value("policy.q-learning.table", table_name, allowed));
    }
    let (window, ages) = (fields.window, fields.ages);
    let lookback = fields.lookback();
    check_raster(reader, site, lookback)?;
    if ages && window > 1 {
        let allowed = "must be 1 with policy.q-learning.ages = true, which uses the age of each place instead";
        return Err(reader.invalid_value("policy.q-learning.window", window, allowed));
    }
    let weights = resolve_weights(reader, &fields, learned.as_deref())?;
    let schedule = Schedule {
        rate_decay: fields.rate_decay,
        rate_floor: fields.rate_floor,
        optimism: fields.optimism,
    };
    let initial_tables = match &learned {
        None => Arc::new(TableSet::optimistic(site, &weights, lookback, schedule.optimism)),
        Some(tables) => Arc::new(select_entry(reader, &fields, tables, site)?),
    };
    if !fields.learn {
        warn_of_sleep(reader, site, &weights, &initial_tables);
    }
    if let Some(tables) = &learned {
        warn_of_differences(reader, &tables.site.differences(&run_site), site.devices, lookback);
    }
    Ok(QLearningSettings {
        weights,
        lookback,
        table_source,
        learn: fields.learn,
        epsilon: (fields.epsilon, fields.epsilon_last),
        schedule,
        begun_from: learned.as_ref().map(|tables| tables.describe(&initial_tables)),
        initial_tables,
    })
}

/// Returns the weights of the scenario, of the tables, or the defaults, in this order of preference.
///
/// # Errors
/// The policy does not learn, and the scenario sets other weights than its tables.
fn resolve_weights(
    reader: &FieldReader<'_>,
    fields: &Fields,
    learned: Option<&LearnedTables>,
) -> Result<QWeights, ScenarioError> {
    let table_weights = learned.map(|tables| tables.weights);
    let check_weight = |name: &str, table_weight: Option<f64>, value: f64| match table_weight {
        Some(learned) if (learned - value).abs() > 1e-9 && !fields.learn => {
            let allowed = format!(
                "must be {learned}, for which its table was learned, unless policy.q-learning.learn = true; to train \
                 another: reveille train q-learning --windows {} --set policy.q-learning.{name}={value} --out FILE",
                fields.lookback()
            );
            Err(reader.invalid_value(&format!("policy.q-learning.{name}"), value, allowed))
        }
        Some(_) | None => Ok(value),
    };
    let weight = |name: &str, given: Option<f64>, get: fn(&QWeights) -> f64| {
        let table_weight = table_weights.as_ref().map(get);
        let value = given.or(table_weight).unwrap_or(get(&fields.default_weights()));
        check_weight(name, table_weight, value)
    };
    Ok(QWeights {
        mu1: weight("mu1", fields.mu1, |w| w.mu1)?,
        mu2: weight("mu2", fields.mu2, |w| w.mu2)?,
        zeta: weight("zeta", fields.zeta, |w| w.zeta)?,
    })
}

/// Returns the tables that `table_name` names, a source or a file; no tables for `nothing`.
///
/// # Errors
/// The file cannot be read, or is the checkpoint of an unfinished training.
fn load_tables(
    reader: &FieldReader<'_>,
    fields: &Fields,
    table_name: &str,
    run_site: &TrainingSite,
) -> Result<(TableSource, Option<Arc<LearnedTables>>), ScenarioError> {
    let field = "policy.q-learning.table";
    Ok(match table_name {
        "shipped" => (
            TableSource::Shipped,
            Some(Arc::new(LearnedTables::shipped(run_site, fields.ages))),
        ),
        "nothing" => (TableSource::Nothing, None),
        file => {
            let path = reader.absolute_path(field, file)?;
            match LearnedTables::read(reader.files(), &path) {
                Ok(tables) if tables.is_unfinished() => {
                    let why = "is the checkpoint of an unfinished training; repeat its command to finish it";
                    return Err(reader.file_error(field, path, why));
                }
                Ok(tables) => (TableSource::File(path), Some(Arc::new(tables))),
                Err(error) => return Err(reader.file_error(field, path, error.to_string())),
            }
        }
    })
}

/// Returns the entry of `tables` for the lookback and density of the scenario. A policy that learns can start from the
/// entry of another window.
///
/// # Errors
/// No entry serves the lookback, or the density.
fn select_entry(
    reader: &FieldReader<'_>,
    fields: &Fields,
    tables: &LearnedTables,
    site: &Site<'_>,
) -> Result<TableSet, ScenarioError> {
    let (table_name, surface) = (fields.table.as_deref().unwrap_or("shipped"), site.area.surface());
    let requested = fields.lookback();
    let trained = tables.lookbacks();
    let lookback = if trained.contains(&requested) {
        requested
    // With ages the buckets measure another quantity, so the table of a window cannot serve as their start.
    } else if fields.learn
        && requested != Lookback::Ages
        && let Some(nearest) = tables.nearest_window(requested.window())
    {
        Lookback::Window(nearest)
    } else {
        let as_field = |lookback: &Lookback| match lookback {
            Lookback::Window(window) => format!("policy.q-learning.window = {window}"),
            Lookback::Ages => "policy.q-learning.ages = true".to_owned(),
        };
        let trained: Vec<String> = trained.iter().map(as_field).collect();
        let allowed = format!(
            "has no tables in {table_name}, which has tables for {trained}; set one of these, or train others: \
             reveille train q-learning --windows {requested} --out FILE, with the same --scenario and --set",
            trained = trained.join(", "),
        );
        return Err(match requested {
            Lookback::Window(window) => reader.invalid_value("policy.q-learning.window", window, allowed),
            Lookback::Ages => reader.invalid_value("policy.q-learning.ages", true, allowed),
        });
    };
    tables
        .closest_entry(lookback, site.devices, surface)
        .cloned()
        .ok_or_else(|| {
            let (fewest, most) = tables.served_devices(lookback, surface);
            let allowed = format!(
                "serves {fewest} to {most} devices on {surface} m² with {}, not {n}; train others: reveille train \
                 q-learning --devices {n} --windows {requested} --out FILE, with the same --scenario and --set",
                lookback.describe(),
                n = site.devices,
            );
            reader.invalid_value("policy.q-learning.table", table_name, allowed)
        })
}
