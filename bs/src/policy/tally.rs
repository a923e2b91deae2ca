//! How many devices a policy that decides anew in each TTI tells to sense.

use reveille_common::ids::DeviceId;
use reveille_common::plan::Plan;

/// Decisions so far, and the devices told to sense in all of them.
#[derive(Clone, Copy, Debug, Default)]
pub struct Tally {
    decisions: u64,
    sensing: u64,
}

impl Tally {
    /// The plan for `devices` devices in which those of `chosen`, by rising number, sense; it is counted.
    pub fn plan(&mut self, devices: usize, chosen: &[DeviceId]) -> Plan {
        self.decisions += 1;
        self.sensing += chosen.len() as u64;
        Plan::from_chosen(devices, chosen)
    }

    /// What the summary shows: devices told to sense per TTI.
    pub fn fact(&self) -> (&'static str, f64) {
        ("sensing_per_tti", self.sensing as f64 / self.decisions.max(1) as f64)
    }
}
