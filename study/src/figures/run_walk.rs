//! Lab runs for the figures of deployments and timelines, with the outcome of each TTI and the states of devices. A
//! walk only observes: it must equal the run of the same scenario, as a test checks. Operator actions, removals and
//! decisions of policy processes are not repeated.

use reveille_bs::cycle::RunOutcome;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::Scenario;
use reveille_common::event::EventRecord;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{FailedTransmission, Report, WakeOutcome};
use reveille_common::state::DeviceState;
use reveille_common::units::Energy;

use reveille_lab::preparation::start;
use reveille_lab::run::{Run, RunOptions};

/// Collects all events of a run of `scenario`, in order, including warm-up events and misdetections.
pub fn collect_events(scenario: &Scenario) -> Vec<EventRecord> {
    run_to_end(scenario).0
}

/// Runs `scenario` to its end. Returns its events as [`collect_events`] does, and its outcome.
pub(crate) fn run_to_end(scenario: &Scenario) -> (Vec<EventRecord>, RunOutcome) {
    struct EventCollector(Vec<EventRecord>);
    impl Observer for EventCollector {
        fn notify(&mut self, notification: &Notification<'_>) {
            if let Notification::EventEnded(event) = notification {
                self.0.push(**event);
            }
        }
    }
    let mut collector = EventCollector(Vec::new());
    let outcome = start(scenario, RunOptions::default()).finish(&mut collector);
    (collector.0, outcome)
}

/// Outcome of one TTI. As an observer it begins again with each grant, so a grant must be a single TTI.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct TtiOutcome {
    /// Reports of devices with δ = 1 that arrived; the reports of woken devices are in `wake_ups`.
    pub duty_reports: Vec<Report>,
    /// Devices with δ = 1 that detected the event but could not transmit.
    pub duty_failures: Vec<FailedTransmission>,
    /// Wake-ups in order, with their outcomes.
    pub wake_ups: Vec<(DeviceId, WakeOutcome)>,
}

impl Observer for TtiOutcome {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::TtisGranted(_) => *self = Self::default(),
            Notification::ReportReceived(report) => self.duty_reports.push(**report),
            Notification::ReportFailed { failure, .. } => self.duty_failures.push(**failure),
            Notification::WakeUpCompleted { device, outcome, .. } => self.wake_ups.push((*device, **outcome)),
            Notification::PlanSent { .. }
            | Notification::EventStarted(_)
            | Notification::ReportLost(_)
            | Notification::DevicesRemoved(_)
            | Notification::ActionTaken(_)
            | Notification::WakeUpSent { .. }
            | Notification::BeliefUpdated { .. }
            | Notification::EventEnded(_)
            | Notification::TtiClosed(_)
            | Notification::DeviceStates(_) => {}
        }
    }
}

/// A run that advances TTI by TTI.
pub(crate) struct RunWalk {
    run: Run,
}

impl RunWalk {
    /// Starts a run of `scenario` before TTI 0.
    pub(crate) fn new(scenario: &Scenario) -> Self {
        let options = RunOptions {
            // Each grant is one TTI, so that every TTI can be observed.
            lookahead: false,
            ..RunOptions::default()
        };
        Self {
            run: start(scenario, options),
        }
    }

    /// Group of each device, such as the cluster under `knn`; `None` if the policy has no groups.
    pub(crate) fn groups(&self) -> Option<&[u32]> {
        self.run.cycle().groups()
    }

    /// Runs the next TTI. Returns it with its outcome. After the last TTI the outcome is empty.
    pub(crate) fn step(&mut self) -> (Tti, TtiOutcome) {
        let k = self.run.cycle().next_tti();
        let mut outcome = TtiOutcome::default();
        self.run.run_grant(&mut outcome);
        (k, outcome)
    }

    /// Runs all TTIs up to and including `k`, or one more if `k` has already run. Returns the outcome of the last one.
    /// `k` must be in the run, or it may loop for ever.
    pub(crate) fn run_through(&mut self, k: Tti) -> TtiOutcome {
        loop {
            let (tti, outcome) = self.step();
            if tti >= k {
                return outcome;
            }
        }
    }

    /// Returns the state of `device` in TTI `k`, which must be the last TTI run, and its battery level at its end.
    pub(crate) fn state_and_battery(&self, device: DeviceId, k: Tti) -> (DeviceState, Energy) {
        // On a copy, since advancing a machine changes it, and the run is only observed.
        let mut machine = self.run.machines()[device.index()].clone();
        machine.begin(k);
        let state = machine.state();
        machine.advance_to(k + 1);
        (state, machine.battery())
    }

    /// Returns whether δ of `device` is 1 in TTI `k`.
    #[cfg(test)]
    pub(crate) fn is_on(&self, device: DeviceId, k: Tti) -> bool {
        self.run.cycle().plan().duty_cycle(device).is_on(k)
    }
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    #[test]
    fn a_walk_has_the_totals_of_the_run() {
        let overrides = ["devices=30", "ttis=400", "warm_up=0"].map(|text| Override::parse(text).expect("an override"));
        let scenario = load("paper", &overrides).expect("a scenario").scenario;
        let outcome = start(&scenario, RunOptions::default()).finish(&mut ());
        let mut walk = RunWalk::new(&scenario);
        let (mut reports, mut wake_ups, mut battery_sum, mut low_ttis) = (0, 0, 0_u128, 0);
        for _ in 0..400 {
            let (k, tti_outcome) = walk.step();
            let from_wake_ups = tti_outcome
                .wake_ups
                .iter()
                .filter(|(_, outcome)| matches!(outcome, WakeOutcome::Reported(_)));
            reports += (tti_outcome.duty_reports.len() + from_wake_ups.count()) as u64;
            wake_ups += tti_outcome.wake_ups.len() as u64;
            for j in 0..30 {
                let (state, level) = walk.state_and_battery(DeviceId(j), k);
                battery_sum += u128::from(level.micro());
                low_ttis += u64::from(level < scenario.classes[0].energy.e_tx);
                assert_eq!(
                    tti_outcome
                        .duty_reports
                        .iter()
                        .any(|report| report.device == DeviceId(j)),
                    state == DeviceState::Transmission && walk.is_on(DeviceId(j), k)
                );
            }
        }
        assert_eq!(battery_sum, outcome.totals.energy.battery_sum);
        assert_eq!(low_ttis, outcome.totals.energy.low_ttis);
        let events = collect_events(&scenario);
        assert_eq!(events.len() as u64, outcome.totals.events.events);
        assert_eq!(events.iter().map(|event| event.tally.reports).sum::<u64>(), reports);
        assert_eq!(events.iter().map(|event| event.tally.wake_ups).sum::<u64>(), wake_ups);
    }
}
