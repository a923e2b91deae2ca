//! Runs of the lab as pictures need them: what happened in which TTI, read off the machines as they are.

use reveille_bs::observe::{Happening, Observer};
use reveille_common::event::EventRecord;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Failure, Report, WakeOutcome};
use reveille_common::scenario::Scenario;
use reveille_common::state::DeviceState;
use reveille_common::units::Energy;

use reveille_lab::preparation::start;
use reveille_lab::run::{Options, Run};

/// All events of a run of `scenario`, in order, including events of the warm-up and events that no device reported.
pub fn events(scenario: &Scenario) -> Vec<EventRecord> {
    struct Collect(Vec<EventRecord>);
    impl Observer for Collect {
        fn see(&mut self, happening: &Happening<'_>) {
            if let Happening::EventEnded(event) = happening {
                self.0.push(**event);
            }
        }
    }
    let mut collect = Collect(Vec::new());
    start(scenario, Options::default()).finish(&mut collect);
    collect.0
}

/// What happened in one TTI.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Happened {
    /// Reports of devices that had δ = 1.
    pub reports: Vec<Report>,
    /// Devices with δ = 1 that detected the event and could not transmit.
    pub failures: Vec<Failure>,
    /// Wake-ups in their order, with what came of each.
    pub woken: Vec<(DeviceId, WakeOutcome)>,
}

impl Observer for Happened {
    fn see(&mut self, happening: &Happening<'_>) {
        match happening {
            Happening::Granted(_) => *self = Self::default(),
            Happening::Reported(report) => self.reports.push(**report),
            Happening::Failed { failure, .. } => self.failures.push(**failure),
            Happening::Woken { device, outcome, .. } => self.woken.push((*device, **outcome)),
            Happening::Plan { .. }
            | Happening::EventStarted(_)
            | Happening::Lost(_)
            | Happening::Gone(_)
            | Happening::WakeUp { .. }
            | Happening::Believed { .. }
            | Happening::EventEnded(_)
            | Happening::Closed(_)
            | Happening::States(_) => {}
        }
    }
}

/// A run that is gone through TTI by TTI.
pub struct Walk {
    run: Run,
}

impl Walk {
    /// A run of `scenario` before TTI 0.
    pub fn new(scenario: &Scenario) -> Self {
        let options = Options {
            lookahead: false,
            ..Options::default()
        };
        Self {
            run: start(scenario, options),
        }
    }

    /// The group that each device is in, where the policy groups them.
    pub fn groups(&self) -> Option<&[u32]> {
        self.run.cycle().groups()
    }

    /// Goes through the next TTI.
    pub fn step(&mut self) -> (Tti, Happened) {
        let k = self.run.cycle().next_tti();
        let mut happened = Happened::default();
        self.run.grant(&mut happened);
        (k, happened)
    }

    /// Goes through all TTIs up to and including `k`; what happened in that one.
    pub fn reach(&mut self, k: Tti) -> Happened {
        loop {
            let (at, happened) = self.step();
            if at >= k {
                return happened;
            }
        }
    }

    /// The state of `device` in TTI `k`, the last gone through, and its battery at the end of it.
    pub fn state(&self, device: DeviceId, k: Tti) -> (DeviceState, Energy) {
        // The machine of the run stays as lazy as it is.
        let mut machine = self.run.machines()[device.index()].clone();
        machine.begin(k);
        let state = machine.state();
        machine.settle(k + 1);
        (state, machine.battery())
    }

    /// δ of `device` in TTI `k`.
    pub fn is_on(&self, device: DeviceId, k: Tti) -> bool {
        self.run.cycle().plan().duty_cycle(device).is_on(k)
    }
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    #[test]
    fn a_walk_is_the_run_and_its_states_are_those_of_the_ledgers() {
        let overrides = ["devices=30", "ttis=400", "warm_up=0"].map(|o| Override::parse(o).expect("an override"));
        let scenario = load("paper", &overrides).expect("a scenario");
        let outcome = start(&scenario, Options::default()).finish(&mut ());
        let mut walk = Walk::new(&scenario);
        let (mut reports, mut wake_ups, mut battery, mut low) = (0, 0, 0_u128, 0);
        for _ in 0..400 {
            let (k, happened) = walk.step();
            let from_wake_ups = happened
                .woken
                .iter()
                .filter(|(_, o)| matches!(o, WakeOutcome::Reported(_)));
            reports += (happened.reports.len() + from_wake_ups.count()) as u64;
            wake_ups += happened.woken.len() as u64;
            for j in 0..30 {
                let (state, level) = walk.state(DeviceId(j), k);
                battery += u128::from(level.micro());
                low += u64::from(level < Energy::from_micro(10_000_000));
                assert_eq!(
                    happened.reports.iter().any(|r| r.device == DeviceId(j)),
                    state == DeviceState::Transmission && walk.is_on(DeviceId(j), k)
                );
            }
        }
        assert_eq!(battery, outcome.totals.energy.battery_sum);
        assert_eq!(low, outcome.totals.energy.low_ttis);
        let all = events(&scenario);
        assert_eq!(all.len() as u64, outcome.totals.events.events);
        assert_eq!(all.iter().map(|e| e.tally.reports).sum::<u64>(), reports);
        assert_eq!(all.iter().map(|e| e.tally.wake_ups).sum::<u64>(), wake_ups);
    }
}
