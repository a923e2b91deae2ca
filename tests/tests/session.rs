//! `Session` driven by a test shell that behaves like the shell on the bus, against the run in memory: late totals,
//! repeated actions, hosts lost during a wake-up, and a result that fits no action. Queued inputs and external policies
//! are not tested here.

use std::cell::Cell;

use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::session::{Action, ActionResult, GrantAnswers, Session};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{DeviceRemoval, UnableDetectors};
use reveille_common::radio::Air;
use reveille_common::score::WindowRecord;
use reveille_common::state::DeviceView;
use reveille_common::totals::DeviceTotals;
use reveille_device::machine::{Machine, Physics, SenseOutcome};
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::scenarios::paper;

const DEVICES: u32 = 60;
/// Number of devices of the lost host.
const LOST_DEVICES: u32 = 4;
/// Length of a window, TTIs.
const WINDOW: u64 = 7;

/// Windows, states and removals of a run.
#[derive(Debug, Default, PartialEq)]
struct RunRecorder {
    windows: Vec<WindowRecord>,
    states: Vec<Vec<DeviceView>>,
    removals: Vec<DeviceRemoval>,
}

impl Observer for RunRecorder {
    fn notify(&mut self, notification: &Notification<'_>) {
        if let Notification::DeviceStates(views) = notification {
            self.states.push(views.to_vec());
        }
        if let Notification::DevicesRemoved(removal) = notification {
            self.removals.push(**removal);
        }
    }

    fn states_due(&self) -> Tti {
        Tti::ZERO
    }

    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        self.windows.push(*window);
        true
    }
}

fn prepared(policy: &str) -> PreparedRun {
    prepare(&paper(&[
        &format!("devices={DEVICES}"),
        "ttis=500",
        "radio.plan_loss=0.2",
        "radio.uplink_loss=0.2",
        "radio.wake_latency=1",
        &format!("policy.name={policy}"),
    ]))
}

/// Loss of a host while the outcome of a wake-up is due.
#[derive(Clone, Copy)]
struct HostLoss {
    /// First of the `count` consecutive devices of the host.
    first: DeviceId,
    count: u32,
    tti: Tti,
    /// Number of the wake-up in its TTI, from 0.
    wake_up: u32,
}

/// Drives a run like the shell on the bus, `bs/src/server/run_loop.rs`, whose order of steps it repeats: it requests
/// actions without an answer twice, and the totals of a window arrive with the answers to the next grant. It stops at
/// the end of the first window that reaches TTI `stop`.
fn serve(prepared: &PreparedRun, loss: Option<HostLoss>, stop: Tti) -> (RunOutcome, RunRecorder) {
    let (scenario, deployment) = (&prepared.scenario, &prepared.deployment);
    let physics = Physics::new(
        scenario.run.seed,
        scenario.warm_up_end(),
        scenario.sensing.clone(),
        scenario.radio,
        &deployment.devices,
        deployment.traces.clone(),
    );
    let setups = deployment.devices.iter();
    let mut machines: Vec<Machine> = setups.map(|setup| Machine::new(setup, &physics)).collect();
    let mut air = Air::new(scenario.run.seed, &scenario.radio);
    let mut session = Session::new(prepared, WINDOW);
    let mut recorder = RunRecorder::default();
    let advance = |machines: &mut [Machine], k| machines.iter_mut().for_each(|machine| machine.advance_to(k));
    let finish = |session: Session, mut machines: Vec<Machine>, mut recorder: RunRecorder| {
        advance(&mut machines, session.next_tti());
        let ledgers: Vec<_> = machines.iter().map(Machine::ledger).collect();
        (session.finish(&ledgers, &mut recorder), recorder)
    };
    loop {
        let action = session.next_action(Tti::NEVER, &mut recorder);
        if let Action::Gather | Action::Wake(_) | Action::CollectTotals(_) | Action::Finish(_) = action {
            let repeated = session.next_action(Tti::NEVER, &mut recorder);
            assert_eq!(format!("{action:?}"), format!("{repeated:?}"));
        }
        match action {
            Action::CollectTotals(k) => {
                session.apply_result(ActionResult::TotalsFollow, &mut recorder);
                if k >= stop {
                    return finish(session, machines, recorder);
                }
            }
            Action::RequestDecision(stage) => panic!("no external policy decides: {stage:?}"),
            Action::TtiClosed => panic!("no decision is queued"),
            Action::Remove(removal) => panic!("no removal is queued: {removal:?}"),
            Action::Grant { updates, .. } => {
                let grant = *session.grant_message();
                let totals = grant.wants_totals.then(|| {
                    advance(&mut machines, grant.first);
                    machines.iter().map(Machine::totals).sum::<DeviceTotals>()
                });
                for update in &updates {
                    air.deliver_plan(update.from, &update.plan, DeviceId(0), machines.len(), |j, duty| {
                        machines[j].set_duty(update.from, duty);
                    });
                }
                let (mut reports, mut failures, mut unable) = (Vec::new(), Vec::new(), UnableDetectors::default());
                // Hosts answer in any order.
                for machine in machines.iter_mut().rev() {
                    match grant.stimulus.map(|event| machine.sense(grant.last, &event, &physics)) {
                        Some(SenseOutcome::Reported(report)) => reports.push(report),
                        Some(SenseOutcome::TransmissionFailed(failure)) => failures.push(failure),
                        Some(SenseOutcome::Failed) => unable += UnableDetectors::FAILED,
                        Some(SenseOutcome::Unpowered) => unable += UnableDetectors::UNPOWERED,
                        Some(SenseOutcome::Nothing) | None => {}
                    }
                    machine.begin(grant.last);
                }
                let views: Vec<DeviceView> = machines.iter().map(Machine::view).collect();
                assert!(grant.wants_views, "the observer wants states");
                let answers = GrantAnswers {
                    reports: &mut reports,
                    failures: &mut failures,
                    unable,
                    views: &views,
                };
                if let Some(totals) = totals {
                    session.apply_result(ActionResult::Totals(totals), &mut recorder);
                }
                session.apply_result(ActionResult::GrantAnswers(answers), &mut recorder);
            }
            Action::Gather => unreachable!("the answers came with the grant"),
            Action::Wake(order) => {
                if let Some(HostLoss { first, count, .. }) =
                    loss.filter(|loss| (loss.tti, loss.wake_up) == (order.tti, order.number))
                {
                    let lost_devices = (first.0..first.0 + count).map(DeviceId);
                    for device in lost_devices.clone() {
                        machines[device.index()].remove(order.tti);
                    }
                    assert_eq!(remove(&mut session, lost_devices.clone(), &mut recorder), 1);
                    assert_eq!(remove(&mut session, lost_devices, &mut recorder), 0, "removed twice");
                }
                let machine = &mut machines[order.device.index()];
                let outcome = machine.wake(order.tti, order.stimulus.as_ref(), &physics);
                session.apply_result(ActionResult::Woken(outcome), &mut recorder);
            }
            Action::Finish(_) => return finish(session, machines, recorder),
        }
    }
}

/// Removes `devices`, and returns how many removals are stored for them.
fn remove(session: &mut Session, devices: impl Iterator<Item = DeviceId>, recorder: &mut RunRecorder) -> u32 {
    let stored = Cell::new(0);
    let store = |_: &DeviceRemoval| -> Result<(), ()> {
        stored.set(stored.get() + 1);
        Ok(())
    };
    session
        .remove_devices(devices, recorder, store)
        .expect("the removal is stored");
    stored.get()
}

/// Runs `prepared` with `removals` in memory, where totals are collected before the grant.
fn run(prepared: &PreparedRun, removals: &[DeviceRemoval]) -> (RunOutcome, RunRecorder) {
    let options = RunOptions {
        window: WINDOW,
        ..RunOptions::default()
    };
    let mut recorder = RunRecorder::default();
    let mut run = Run::new(prepared, options);
    run.schedule_inputs(&ExternalInputs::from_removals(removals));
    let outcome = run.finish(&mut recorder);
    (outcome, recorder)
}

#[test]
fn late_totals_and_repeated_actions_change_no_result() {
    for policy in ["knn", "q-learning", "age-index", "genie", "random"] {
        let prepared = prepared(policy);
        let (outcome, recorded) = serve(&prepared, None, Tti::NEVER);
        let windows = recorded.windows.len();
        assert!(windows > 25, "{policy}: {windows} windows");
        assert_eq!((outcome, recorded), run(&prepared, &[]), "{policy}");
    }
}

#[test]
fn a_run_that_stops_before_late_totals_arrive_has_its_last_window() {
    let prepared = prepared("knn");
    let (_, complete) = run(&prepared, &[]);
    let stop = Tti(20 * WINDOW);
    let (outcome, stopped) = serve(&prepared, None, stop);
    assert_eq!(outcome.ttis_done, stop.0);
    assert_eq!(stopped.windows.last().map(|window| window.end), Some(stop));
    assert_eq!(stopped.windows, complete.windows[..stopped.windows.len()]);
}

#[test]
fn a_host_lost_during_a_wake_up_equals_a_scheduled_removal() {
    let prepared = prepared("knn");
    let mut recorder = WakeUpRecorder::default();
    Run::new(&prepared, RunOptions::default()).finish(&mut recorder);
    // The second wake-up of a TTI, so that its number has an effect.
    let same_tti = |pair: &&[(Tti, DeviceId)]| pair[0].0 == pair[1].0;
    let pair = recorder.wake_ups.windows(2).find(same_tti);
    let (tti, device) = pair.expect("a TTI with two wake-ups")[1];
    let loss = HostLoss {
        // The woken device is among the lost ones.
        first: DeviceId(device.0.saturating_sub(2).min(DEVICES - LOST_DEVICES)),
        count: LOST_DEVICES,
        tti,
        wake_up: 1,
    };
    let (outcome, recorded) = serve(&prepared, Some(loss), Tti::NEVER);
    let removal = DeviceRemoval {
        first: loss.first,
        count: loss.count,
        tti,
        wake_ups: Some(1),
    };
    assert_eq!(recorded.removals, [removal]);
    assert_ne!(outcome.digest, run(&prepared, &[]).0.digest);
    assert_eq!((outcome, recorded), run(&prepared, &[removal]));
}

/// Observer of the sent wake-ups.
#[derive(Default)]
struct WakeUpRecorder {
    /// TTIs and devices, in order.
    wake_ups: Vec<(Tti, DeviceId)>,
}

impl Observer for WakeUpRecorder {
    fn notify(&mut self, notification: &Notification<'_>) {
        if let Notification::WakeUpSent { tti, device, .. } = notification {
            self.wake_ups.push((*tti, *device));
        }
    }
}

/// `Session::apply_result` panics with this text.
#[test]
#[should_panic(expected = "no action of phase Between has reports as its result")]
fn a_result_that_fits_no_action_is_refused() {
    let mut session = Session::new(&prepared("knn"), u64::MAX);
    let no_answers = GrantAnswers {
        reports: &mut [],
        failures: &mut [],
        unable: UnableDetectors::default(),
        views: &[],
    };
    session.apply_result(ActionResult::GrantAnswers(no_answers), &mut ());
}
