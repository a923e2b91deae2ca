//! Air: the plan δ.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;
use crate::ids::{DeviceId, Tti};
use crate::plan::Plan;

/// How many devices a line of text names.
const NAMED: usize = 8;

/// Air, BS → all devices: δ from a TTI on, when it changes and for synchronisation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlanUpdate {
    /// The first TTI it holds for.
    pub from: Tti,
    /// δ.
    pub plan: Plan,
}

impl Concerns for PlanUpdate {
    fn concerns(&self, _number: Option<u32>, _device: DeviceId) -> bool {
        true
    }
}

impl fmt::Display for PlanUpdate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { from, plan } = self;
        let (places, form) = match plan {
            Plan::Bits { bits } => (bits.len() * 8, ""),
            Plan::Periodic(cycles) => (cycles.len(), "periodic, "),
        };
        let on = || (0..places as u32).filter(|&j| plan.duty_cycle(DeviceId(j)).is_on(*from));
        let count = on().count();
        write!(f, "δ from TTI {from}: {form}")?;
        match plan {
            Plan::Bits { .. } => write!(f, "{count} devices sense")?,
            Plan::Periodic(_) => write!(f, "{count} of {places} devices sense first")?,
        }
        for (nth, device) in on().take(NAMED).enumerate() {
            write!(f, "{} {device}", if nth == 0 { ":" } else { "," })?;
        }
        f.write_str(if count > NAMED { " …" } else { "" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::DutyCycle;

    #[test]
    fn a_plan_says_who_senses() {
        let line = |plan| PlanUpdate { from: Tti(5), plan }.to_string();
        let chosen =
            |devices: &[u32]| Plan::from_chosen(50, &devices.iter().copied().map(DeviceId).collect::<Vec<_>>());
        assert_eq!(line(chosen(&[])), "δ from TTI 5: 0 devices sense");
        assert_eq!(line(chosen(&[3, 7, 49])), "δ from TTI 5: 3 devices sense: 3, 7, 49");
        let many: Vec<u32> = (0..20).map(|j| 2 * j).collect();
        assert_eq!(
            line(chosen(&many)),
            "δ from TTI 5: 20 devices sense: 0, 2, 4, 6, 8, 10, 12, 14 …"
        );
        let impossible = DutyCycle {
            t_on: 1,
            t_drx: 0,
            offset: 0,
        };
        let cycles = vec![DutyCycle::SENSING, DutyCycle::ASLEEP, impossible];
        assert_eq!(
            line(Plan::Periodic(cycles)),
            "δ from TTI 5: periodic, 1 of 3 devices sense first: 0"
        );
    }
}
