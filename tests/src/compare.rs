//! Runs a scenario on the emulator and returns the results in the form that the reference uses.

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

/// Returns the outcome and the ended events of the whole run.
pub fn outcome(scenario: &Scenario, options: RunOptions) -> (RunOutcome, Vec<EventRecord>) {
    let mut collector = EventCollector::default();
    let outcome = start(scenario, options).finish(&mut collector);
    (outcome, collector.events)
}

/// Returns the ledger of each device at the end of the run.
pub fn ledgers(scenario: &Scenario, options: RunOptions) -> Vec<Ledger> {
    let mut run = start(scenario, options);
    while run.cycle().next_tti() < Tti(scenario.run.ttis) {
        run.run_grant(&mut ());
    }
    let ledger_at_end = |machine: &Machine| {
        // Advances a copy: the run advances its own machines later.
        let mut machine = machine.clone();
        machine.advance_to(Tti(scenario.run.ttis));
        machine.ledger()
    };
    run.machines().iter().map(ledger_at_end).collect()
}

/// Returns the state and the battery, micro-units, of each device at the end of each TTI, with the `actions` of
/// operators.
pub fn trace(scenario: &Scenario, actions: &[OperatorAction]) -> Vec<Vec<(ReferenceState, u64)>> {
    let mut run = start(scenario, ONE_TTI_PER_GRANT);
    run.schedule_inputs(&ExternalInputs::from_actions(actions));
    let mut trace = Vec::new();
    for k in (0..scenario.run.ttis).map(Tti) {
        run.run_grant(&mut ());
        let state_and_battery = |machine: &Machine| {
            // Advances a copy: the run advances its own machines later.
            let mut machine = machine.clone();
            machine.begin(k);
            (reference_state(machine.state()), machine.battery().micro())
        };
        trace.push(run.machines().iter().map(state_and_battery).collect());
    }
    trace
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
