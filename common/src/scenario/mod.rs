//! Scenario files: presets, TOML, overrides, validation.
//!
//! A scenario is put together from layers: the declared defaults, the preset that the file asks for, the file, and what
//! the command line sets. [`load()`] lays them over one another field by field, remembers where each value came from,
//! and checks the whole once. What comes out is a [`Scenario`] without anything optional in it. Each concept declares
//! its own fields ([`mod@crate::declare`]); [`declaration()`] puts them together.

mod assignment;
mod bs;
mod classes;
mod declaration;
mod load;
mod members;
mod model;
mod page;
mod policy;
mod run;
mod settle;
mod site;
#[cfg(test)]
pub(crate) mod testing;

pub use assignment::assign_classes;
pub use bs::{BatteryKnowledge, BsSettings, WakeUpRanking};
pub use classes::{DeviceClass, MAX_CLASSES};
pub use declaration::declaration;
pub use load::{load, parse};
pub use members::{Members, Zone};
pub use model::{Policies, PolicyChoice, PolicyKind, Scenario};
pub use policy::{NoSettings, PolicySettings};
pub use run::PRESETS;
pub use site::{ClassKnowledge, Site};

pub use crate::declare::{Declaration, Override, Place, Preset, ScenarioError};
pub use crate::energy::EnergyModel;
pub use crate::event::settings::Events;
pub use crate::harvest::{Harvest, Trace, TraceColumns, TraceEnd};
pub use crate::ids::{MAX_DEVICES, MAX_TTIS};
