//! Runs a scenario in memory on the emulator and returns its results, for comparison with the reference, closed forms
//! or other options. `tests/tests/` compares. States have the form of the reference; its results are in
//! [`ReferenceRun`](crate::reference::ReferenceRun). The scenarios have built-in policies: a run with policy `external`
//! would not reach its end here.

use reveille_bs::cycle::RunOutcome;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::Scenario;
use reveille_common::event::EventRecord;
use reveille_common::ids::Tti;
use reveille_common::message::OperatorAction;
use reveille_common::state::DeviceState;
use reveille_common::totals::Ledger;
use reveille_device::machine::Machine;
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::preparation::start;
use reveille_lab::run::RunOptions;

use crate::reference::ReferenceState;

/// Options for one TTI per grant, and no windows.
pub const ONE_TTI_PER_GRANT: RunOptions = RunOptions {
    lookahead: false,
    window: u64::MAX,
};

/// Observer that keeps every ended event.
#[derive(Clone, Debug, Default)]
pub struct EventCollector {
    /// Recorded events, in order.
    pub events: Vec<EventRecord>,
}

impl Observer for EventCollector {
    fn notify(&mut self, notification: &Notification<'_>) {
        if let Notification::EventEnded(event) = notification {
            self.events.push(**event);
        }
    }
}

/// Runs `scenario` and returns its outcome and its ended events.
pub fn outcome(scenario: &Scenario, options: RunOptions) -> (RunOutcome, Vec<EventRecord>) {
    let mut collector = EventCollector::default();
    let run_outcome = start(scenario, options).finish(&mut collector);
    (run_outcome, collector.events)
}

/// Runs `scenario` and returns the ledger of each device at its end.
pub fn ledgers(scenario: &Scenario, options: RunOptions) -> Vec<Ledger> {
    let mut run = start(scenario, options);
    while run.cycle().next_tti() < Tti(scenario.run.ttis) {
        run.run_grant(&mut ());
    }
    let ledger_at_end = |machine: &Machine| {
        // Advances a copy: a run advances its machines only when it needs them.
        let mut machine_copy = machine.clone();
        machine_copy.advance_to(Tti(scenario.run.ttis));
        machine_copy.ledger()
    };
    run.machines().iter().map(ledger_at_end).collect()
}

/// Runs `scenario` with the `actions` of operators, and returns, by TTI and device, the state and the battery,
/// micro-units, at the end of the TTI. The field `trace` of `ReferenceRun` has the same form.
pub fn trace(scenario: &Scenario, actions: &[OperatorAction]) -> Vec<Vec<(ReferenceState, u64)>> {
    let mut run = start(scenario, ONE_TTI_PER_GRANT);
    run.schedule_inputs(&ExternalInputs::from_actions(actions));
    let mut rows = Vec::new();
    for k in (0..scenario.run.ttis).map(Tti) {
        run.run_grant(&mut ());
        let state_and_battery = |machine: &Machine| {
            // Advances a copy: a run advances its machines only when it needs them.
            let mut machine_copy = machine.clone();
            machine_copy.begin(k);
            (reference_state(machine_copy.state()), machine_copy.battery().micro())
        };
        rows.push(run.machines().iter().map(state_and_battery).collect());
    }
    rows
}

/// Converts a device state to the reference's `ReferenceState`.
///
/// # Panics
/// If the state is S2, in which no device is at the end of a step.
pub fn reference_state(state: DeviceState) -> ReferenceState {
    match state {
        DeviceState::Idle => ReferenceState::Idle,
        DeviceState::Transmission => ReferenceState::Transmission,
        DeviceState::Sleep { powered: true } => ReferenceState::Asleep,
        DeviceState::Sleep { powered: false } => ReferenceState::Unpowered,
        DeviceState::Failed => ReferenceState::Failed,
        DeviceState::Active => panic!("S2 is left within the TTI"),
    }
}
