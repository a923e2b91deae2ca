//! Scenario files: presets, TOML, overrides, validation.
//!
//! A scenario is put together from layers: the preset `paper`, the preset that the file asks for, the file, and what the
//! command line sets. [`load()`] lays them over one another field by field, remembers where each value came from, and
//! checks the whole once. What comes out is a [`Scenario`] without anything optional in it.

mod check;
mod classes;
mod error;
mod explain;
mod hash;
mod layers;
mod learning;
mod load;
mod model;
mod overrides;
#[cfg(feature = "parquet")]
mod parquet;
mod raw;
mod table;
#[cfg(test)]
mod tests;
mod trace;
mod validate;
mod write;

pub use classes::assign_classes;
pub use error::{Place, ScenarioError};
pub use learning::{BatteryKnowledge, CELLS_PER_RANGE, LONGEST_WINDOW, QLearningSettings, TableSource, WakeUpRanking};
pub use load::{PRESETS, load, parse};
pub use model::{
    AdjustedSettings, BsSettings, DeviceClass, DutyChoice, EnergyModel, Events, Harvest, KnnSettings, MAX_CLASSES,
    MAX_DEVICES, MAX_TTIS, PolicyConfig, Scenario, Trace, TraceColumns, TraceEnd,
};
pub use overrides::Override;
