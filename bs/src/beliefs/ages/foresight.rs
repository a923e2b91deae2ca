//! What batteries are expected to come to.
//!
//! A battery that will be full in a while loses what it harvests then, so its energy is cheap now; one that has a night
//! before it is to spare. Both follow from the mean harvest of a device, and where that is known from the time of the
//! day.

use reveille_common::ids::DeviceId;
use reveille_common::units::Energy;

use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// Looks a while ahead.
#[derive(Clone, Debug)]
pub struct Foresight {
    ttis: u64,
    /// By device.
    expected: Vec<Energy>,
}

impl Foresight {
    /// For the devices in `known`, `ttis` TTIs ahead.
    pub fn new(known: &Knowledge, ttis: u64) -> Self {
        Self {
            ttis,
            expected: vec![Energy::ZERO; known.n()],
        }
    }

    /// The battery levels of all devices in the order of ids, if all of them sleep for so long and harvest as much as is
    /// to be expected: no lower than empty, and no higher than E_max.
    pub fn of(&mut self, seen: &Observation<'_>) -> &[Energy] {
        let end = seen.now.saturating_add(self.ttis);
        for (j, (expected, &level)) in (0..).zip(self.expected.iter_mut().zip(seen.batteries)) {
            let energy = &seen.known.devices[j as usize].energy;
            let income = seen.known.expected_harvest(DeviceId(j), seen.now, end);
            let asleep = Energy::from_micro(energy.e_wur.micro().saturating_mul(self.ttis));
            *expected = (level + income).saturating_sub(asleep).min(energy.e_max);
        }
        &self.expected
    }
}
