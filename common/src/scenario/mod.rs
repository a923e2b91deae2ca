//! Scenario files: presets, TOML, overrides, validation.
//!
//! A scenario consists of layers: the declared defaults, the preset that the file names, the file, and the command
//! line. [`load()`] merges them field by field, keeps the origin of each value, and validates the result once. The
//! result is a [`Scenario`] without optional parts, with its warnings ([`LoadedScenario`]). Each concept declares its
//! own fields ([`mod@crate::declare`]); [`declaration()`] combines them. `bs/src/scenario/` adds the policies; most
//! tests are there.

mod class_assignment;
mod class_members;
mod classes;
mod declaration;
mod load;
mod model;
mod policy;
mod run;
mod site;
#[cfg(test)]
pub(crate) mod testing;
mod toml_text;
mod validate;

pub use class_assignment::assign_classes;
pub use class_members::{Members, Zone};
pub use classes::DeviceClass;
pub use declaration::declaration;
pub use load::{load, parse};
pub use model::{LoadedScenario, Scenario};
pub use policy::{Policies, PolicyChoice, PolicyKind};
pub use run::{BatteryKnowledge, BsSettings, PRESETS, RunSettings, WakeUpRanking};
pub use site::{ClassKnowledge, Site};

pub use crate::declare::{Declaration, Override, Preset, ScenarioError, ValueOrigin};
pub use crate::energy::EnergyModel;
pub use crate::event::event_settings::EventSettings;
pub use crate::harvest::{Harvest, HarvestTrace, TraceColumns, TraceEnd};
pub use crate::ids::{MAX_DEVICES, MAX_TTIS};
