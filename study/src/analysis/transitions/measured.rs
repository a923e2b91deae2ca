//! Transitions between S1 … S4, counted in a run with a perfect radio. `tests/tests/analysis.rs` counts them
//! independently in runs whose devices can pay for every action; the unit test here has the other paths.
//!
//! Within a TTI a device starts in S1 (δ = 1, paid) or S4 (δ = 0, or δ = 1 that it could not pay). A detection or a
//! wake-up takes it to S2. It leaves S2 to S3, or to S4 if it cannot pay for the report. The last state of a TTI leads
//! to the first of the next. Each visit but the last has exactly one successor.

use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::ids::Tti;
use reveille_common::plan::DutyCycle;
use reveille_common::state::DeviceState;
use reveille_common::units::Energy;

use reveille_lab::preparation::start;
use reveille_lab::run::RunOptions;

/// Transition counts by state: entry `[m - 1][n - 1]` counts S_m → S_n.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TransitionCounts(pub [[u64; 4]; 4]);

impl TransitionCounts {
    /// Number of transitions S_m → S_n, with m and n in 1 ..= 4.
    pub const fn get(&self, m: usize, n: usize) -> u64 {
        self.0[m - 1][n - 1]
    }

    /// Number of visits of S_m that have a successor.
    pub fn visits(&self, m: usize) -> u64 {
        self.0[m - 1].iter().sum()
    }

    /// Adds `other`.
    pub fn add(&mut self, other: &Self) {
        for (row, more) in self.0.iter_mut().zip(&other.0) {
            row.iter_mut().zip(more).for_each(|(sum, n)| *sum += n);
        }
    }

    fn record(&mut self, from: usize, to: usize) {
        self.0[from - 1][to - 1] += 1;
    }
}

const S1: usize = 1;
const S2: usize = 2;
const S3: usize = 3;
const S4: usize = 4;

/// Path of a device through one TTI.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct TtiPath {
    first_state: usize,
    /// State after S2, if S2 was entered.
    state_after_active: Option<usize>,
}

impl TtiPath {
    /// Derives the path of a device from its `state` at the end of a TTI and the energy `spent` in the TTI. `cost` is
    /// the energy of S1 if δ = 1 (`is_on`), and of the wake-up radio otherwise.
    fn new(state: DeviceState, is_on: bool, spent: Energy, cost: Energy) -> Self {
        let initial_state = if is_on { S1 } else { S4 };
        let (first_state, state_after_active) = match state {
            // Paid for δ, without a detection or a wake-up. With a perfect radio no wake-up ends in S4 paid.
            DeviceState::Idle | DeviceState::Sleep { powered: true } => (initial_state, None),
            DeviceState::Transmission => (initial_state, Some(S3)),
            // A device that could not pay for δ has spent less than its cost; otherwise the transmission failed.
            DeviceState::Sleep { powered: false } if spent < cost => (S4, None),
            DeviceState::Sleep { powered: false } => (initial_state, Some(S4)),
            DeviceState::Active | DeviceState::Failed => {
                unreachable!("S2 is left within the TTI, and the run has no operator")
            }
        };
        Self {
            first_state,
            state_after_active,
        }
    }

    fn last_state(self) -> usize {
        self.state_after_active.unwrap_or(self.first_state)
    }
}

/// Counts the transitions of all devices of `deployment` in the measured part of a run of its `scenario`. Also returns
/// the duty cycles in the first TTI, for the closed forms.
pub(super) fn count_run(scenario: &Scenario, deployment: &Deployment) -> (TransitionCounts, Vec<DutyCycle>) {
    let options = RunOptions {
        // Devices are counted after every TTI, so each grant covers one.
        lookahead: false,
        ..RunOptions::default()
    };
    let mut run = start(scenario, options);
    let mut counts = TransitionCounts::default();
    let mut duties = Vec::new();
    let mut previous = vec![(S4, Energy::ZERO); deployment.devices.len()];
    let first_measured = scenario.warm_up_end().0;
    for k in 0..scenario.run.ttis {
        run.run_grant(&mut ());
        let plan = run.cycle().plan();
        let duties_now: Vec<DutyCycle> = deployment.devices.iter().map(|d| plan.duty_cycle(d.id)).collect();
        for (j, machine) in run.advance_machines().iter().enumerate() {
            let (last_state, spent_before) = previous[j];
            let spent = machine.totals().spent.total();
            let (is_on, costs) = (duties_now[j].is_on(Tti(k)), &deployment.devices[j].energy);
            let cost = if is_on { costs.e_idle } else { costs.e_wur };
            let path = TtiPath::new(machine.state(), is_on, spent - spent_before, cost);
            // The transition into the first measured TTI begins in the warm-up.
            if k > first_measured {
                counts.record(last_state, path.first_state);
            }
            if let (true, Some(state_after_active)) = (k >= first_measured, path.state_after_active) {
                counts.record(path.first_state, S2);
                counts.record(S2, state_after_active);
            }
            previous[j] = (path.last_state(), spent);
        }
        if k == 0 {
            duties = duties_now;
        }
    }
    (counts, duties)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_path_through_a_tti_follows_from_its_end() {
        let (idle_cost, wur_cost, nothing) = (Energy::from_micro(10), Energy::from_micro(3), Energy::ZERO);
        let report_cost = Energy::from_micro(20);
        let unpowered = DeviceState::Sleep { powered: false };
        let path_of = |state, is_on, spent, cost| {
            let path = TtiPath::new(state, is_on, spent, cost);
            (path.first_state, path.state_after_active)
        };
        assert_eq!(path_of(DeviceState::Idle, true, idle_cost, idle_cost), (S1, None));
        assert_eq!(
            path_of(DeviceState::Sleep { powered: true }, false, wur_cost, wur_cost),
            (S4, None)
        );
        assert_eq!(
            path_of(DeviceState::Transmission, true, idle_cost + report_cost, idle_cost),
            (S1, Some(S3))
        );
        assert_eq!(
            path_of(DeviceState::Transmission, false, wur_cost + report_cost, wur_cost),
            (S4, Some(S3))
        );
        // The device could not pay for the transmission, or not even for δ.
        assert_eq!(path_of(unpowered, true, idle_cost, idle_cost), (S1, Some(S4)));
        assert_eq!(
            path_of(unpowered, false, Energy::from_micro(5), wur_cost),
            (S4, Some(S4))
        );
        assert_eq!(path_of(unpowered, true, wur_cost, idle_cost), (S4, None));
        assert_eq!(path_of(unpowered, false, nothing, wur_cost), (S4, None));
    }
}
