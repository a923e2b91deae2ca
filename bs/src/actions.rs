//! Checks of the changes that operators ask for, before a run accepts them: over the bus (`server/actions.rs`), in an
//! input log (`lab/src/external_inputs/`), or in a file of timed actions (`lab/src/action_script/`). The callers put
//! file and line before an error. Tests and docs/actions.md quote the errors.

use reveille_common::message::{Change, Setting};
use reveille_common::units::{Energy, MAX_UNITS};

use crate::scenario::Scenario;

/// Checks that `change` is possible in a run of `scenario`.
///
/// # Errors
/// If it is not; describes the cause and the fix.
pub fn check_change(change: &Change, scenario: &Scenario) -> Result<(), String> {
    let devices = scenario.run.devices;
    if let Some(range) = change.devices()
        && !range.is_valid(devices)
    {
        return Err(format!(
            "{range}: not in the run; use `all`, or devices from 0 to {}",
            devices - 1
        ));
    }
    match *change {
        Change::AddEnergy(_, energy) if energy == Energy::ZERO => {
            Err("an energy of 0 units has no effect; use a larger amount".to_owned())
        }
        Change::AddEnergy(_, energy) if energy.units() > MAX_UNITS => {
            Err(format!("an energy of {energy} must be at most {MAX_UNITS} units"))
        }
        Change::Set(setting, value) => check_setting(setting, value, scenario),
        Change::Fail(_) | Change::Revive(_) | Change::AddEnergy(..) => Ok(()),
    }
}

/// Checks the value of `setting`. Only `age-index` implements `Policy::set_price`; others would ignore the price. The
/// ranges repeat the declarations of `events.alpha` and `policy.age-index.price`.
fn check_setting(setting: Setting, value: f64, scenario: &Scenario) -> Result<(), String> {
    let field = setting.field();
    match setting {
        Setting::EventRate if !scenario.events.has_constant_rate() => Err(format!(
            "{field}: the events of this run have no constant rate; use it with another events.process"
        )),
        Setting::EventRate if !(value > 0.0 && value <= 1.0) => {
            Err(format!("{field} {value}: must be above 0, and at most 1"))
        }
        Setting::Price if scenario.policy.name() != "age-index" => Err(format!(
            "{field}: policy {} does not use it; choose policy age-index",
            scenario.policy.name()
        )),
        Setting::Price if !(value >= 0.0 && value.is_finite()) => Err(format!("{field} {value}: must be at least 0")),
        Setting::EventRate | Setting::Price => Ok(()),
    }
}
