//! The battery and the energy costs of a device, per class of a scenario. `device/src/battery/` applies them. Names are
//! part of scenario files and of the scenario hash, the order of fields also of the wire format. Doc comments of fields
//! appear in `docs/scenario.md`.

use serde::{Deserialize, Serialize};

use crate::declare::{FieldReader, ScenarioError, energy, positive_energy};
use crate::units::Energy;

crate::declare! {
    /// Battery and energy costs of a device.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
    pub struct EnergyModel in "energy" {
        /// Battery capacity `E_max`.
        pub e_max: Energy = positive_energy(100.0).unit("units").source("Table II"),
        /// Cost `E_idle` of a TTI in S1, at most `e_max`.
        pub e_idle: Energy = energy(1.0).unit("units per TTI").source("Table II"),
        /// Cost `E_WuR` of a TTI in S4 with the wake-up radio on, at most `e_max`.
        pub e_wur: Energy = energy(1.0 / 14.0).unit("units per TTI").source("Table II"),
        /// Cost `E_Tx` of a transmission, at most `e_max`.
        pub e_tx: Energy = energy(10.0).unit("units").source("Table II"),
        /// Initial battery level, at most `e_max`.
        pub initial: Energy = energy(0.0).unit("units").derived("half of `e_max`")
            => Energy::from_micro(e_max.micro() / 2),
    }
}

impl EnergyModel {
    /// Reads the settings from `reader`.
    ///
    /// # Errors
    /// If a value is invalid: no cost and no level may exceed the capacity of the battery.
    pub fn from_fields(reader: &FieldReader<'_>) -> Result<Self, ScenarioError> {
        let model = Self::read(reader)?;
        let unpayable = ", or it can never be paid";
        for (path, amount, consequence) in [
            ("energy.e_idle", model.e_idle, unpayable),
            ("energy.e_wur", model.e_wur, unpayable),
            ("energy.e_tx", model.e_tx, unpayable),
            ("energy.initial", model.initial, ""),
        ] {
            if amount > model.e_max {
                let (limit, _) = reader.locate("energy.e_max");
                let allowed = format!("must be at most {} units ({limit}){consequence}", model.e_max.units());
                return Err(reader.invalid_value(path, amount.units(), allowed));
            }
        }
        Ok(model)
    }
}
