//! The emulator's run of a scenario in the form in which the reference gives its own.

use reveille_bs::observe::{Happening, Observer};
use reveille_bs::outcome::Outcome;
use reveille_common::event::EventRecord;
use reveille_common::ids::Tti;
use reveille_common::scenario::Scenario;
use reveille_common::state::DeviceState;
use reveille_common::totals::Ledger;
use reveille_device::machine::Machine;
use reveille_lab::preparation::start;
use reveille_lab::run::Options;

use crate::reference::State;

/// An observer that keeps every event.
#[derive(Clone, Debug, Default)]
pub struct Collected {
    /// The events.
    pub events: Vec<EventRecord>,
}

impl Observer for Collected {
    fn see(&mut self, happening: &Happening<'_>) {
        if let Happening::EventEnded(event) = happening {
            self.events.push(**event);
        }
    }
}

/// The whole run: its outcome and its ended events.
pub fn outcome(scenario: &Scenario, lookahead: bool, window: u64) -> (Outcome, Vec<EventRecord>) {
    let mut collected = Collected::default();
    let options = Options { lookahead, window };
    let outcome = start(scenario, options).finish(&mut collected);
    (outcome, collected.events)
}

/// The ledger of each device at the end of the run.
pub fn ledgers(scenario: &Scenario, lookahead: bool) -> Vec<Ledger> {
    let mut run = start(
        scenario,
        Options {
            lookahead,
            ..Options::default()
        },
    );
    while run.cycle().next_tti() < Tti(scenario.ttis) {
        run.grant(&mut ());
    }
    let settled = |machine: &Machine| {
        let mut machine = machine.clone();
        machine.settle(Tti(scenario.ttis));
        machine.ledger()
    };
    run.machines().iter().map(settled).collect()
}

/// State and battery of each device at the end of each TTI.
pub fn trace(scenario: &Scenario) -> Vec<Vec<(State, u64)>> {
    let options = Options {
        lookahead: false,
        ..Options::default()
    };
    let mut run = start(scenario, options);
    let mut trace = Vec::new();
    for k in (0..scenario.ttis).map(Tti) {
        run.grant(&mut ());
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
pub fn translated(state: DeviceState) -> State {
    match state {
        DeviceState::Idle => State::Idle,
        DeviceState::Transmission => State::Transmission,
        DeviceState::Sleep { powered: true } => State::Asleep,
        DeviceState::Sleep { powered: false } => State::Dark,
        DeviceState::Active => panic!("S2 is left within the TTI"),
    }
}
