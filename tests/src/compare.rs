//! The emulator's run of a scenario in the form in which the reference gives its own.

use reveille_bs::outcome::{EventRecord, Outcome, Watcher, WindowRecord};
use reveille_common::ids::Tti;
use reveille_common::metrics::DeviceTotals;
use reveille_common::scenario::Scenario;
use reveille_device::machine::{Machine, State as MachineState};
use reveille_lab::run::{Options, Run};

use crate::reference::State;

/// A watcher that keeps every event.
#[derive(Clone, Debug, Default)]
pub struct Collected {
    /// The events.
    pub events: Vec<EventRecord>,
}

impl Watcher for Collected {
    fn window(&mut self, _: &WindowRecord, events: &[EventRecord]) -> bool {
        self.events.extend_from_slice(events);
        true
    }
}

/// The whole run: its outcome and its ended events.
pub fn outcome(scenario: &Scenario, lookahead: bool, window: u64) -> (Outcome, Vec<EventRecord>) {
    let mut collected = Collected::default();
    let options = Options {
        lookahead,
        window,
        keep_records: true,
    };
    let outcome = Run::new(scenario, options).finish(&mut collected);
    (outcome, collected.events)
}

/// The ledger of each device at the end of the run.
pub fn ledgers(scenario: &Scenario, lookahead: bool) -> Vec<DeviceTotals> {
    let mut run = Run::new(
        scenario,
        Options {
            lookahead,
            ..Options::default()
        },
    );
    while run.cycle().next_tti() < Tti(scenario.ttis) {
        run.grant();
    }
    let settled = |machine: &Machine| {
        let mut machine = machine.clone();
        machine.settle(Tti(scenario.ttis));
        machine.totals()
    };
    run.machines().iter().map(settled).collect()
}

/// State and battery of each device at the end of each TTI.
pub fn trace(scenario: &Scenario) -> Vec<Vec<(State, u64)>> {
    let options = Options {
        lookahead: false,
        ..Options::default()
    };
    let mut run = Run::new(scenario, options);
    let mut trace = Vec::new();
    for k in (0..scenario.ttis).map(Tti) {
        run.grant();
        let now = |machine: &Machine| {
            let mut machine = machine.clone();
            machine.begin(k);
            (translated(machine.state()), machine.battery().micro())
        };
        trace.push(run.machines().iter().map(now).collect());
    }
    trace
}

/// A state in the reference's words.
///
/// # Panics
/// In S2, which no device is in at the end of a step.
pub fn translated(state: MachineState) -> State {
    match state {
        MachineState::Idle => State::Idle,
        MachineState::Transmission => State::Transmission,
        MachineState::Sleep { powered: true } => State::Asleep,
        MachineState::Sleep { powered: false } => State::Dark,
        MachineState::Active => panic!("S2 is left within the TTI"),
    }
}
