//! Scenario files: presets, TOML, overrides, validation.

mod model;

pub use model::{
    BsSettings, DeviceClass, EnergyModel, Events, Harvest, KnnSettings, PolicyConfig, Scenario, Trace, TraceColumns,
    TraceEnd,
};
mod classes;
pub use classes::assign_classes;
