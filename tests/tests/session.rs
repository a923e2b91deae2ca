//! The session as seen by a shell, beyond runs in memory and on the bus.

use std::cell::Cell;

use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::{Override, load};
use reveille_bs::session::{Action, ActionResult, Gathered, Session};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::DeviceRemoval;
use reveille_common::radio::Air;
use reveille_common::score::WindowRecord;
use reveille_common::state::DeviceView;
use reveille_common::totals::DeviceTotals;
use reveille_device::machine::{Machine, Physics, SenseOutcome};
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};

const WINDOW: u64 = 7;

/// Windows of a run, and the reported states.
#[derive(Debug, Default, PartialEq)]
struct Seen {
    windows: Vec<WindowRecord>,
    states: Vec<Vec<DeviceView>>,
    outages: Vec<DeviceRemoval>,
}

impl Observer for Seen {
    fn notify(&mut self, notification: &Notification<'_>) {
        if let Notification::DeviceStates(views) = notification {
            self.states.push(views.to_vec());
        }
        if let Notification::DevicesRemoved(outage) = notification {
            self.outages.push(**outage);
        }
    }

    fn wants_states(&self) -> bool {
        true
    }

    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        self.windows.push(*window);
        true
    }
}

fn prepared(policy: &str) -> PreparedRun {
    let set = [
        "devices=60",
        "ttis=500",
        "radio.plan_loss=0.2",
        "radio.uplink_loss=0.2",
        "radio.wake_latency=1",
        &format!("policy.name={policy}"),
    ];
    let set = set.map(|set| Override::parse(set).expect("an override"));
    prepare(&load("paper", &set).expect("a scenario").scenario)
}

/// Loss of a host after the request for the outcome of the wake-up with this number in this TTI.
#[derive(Clone, Copy)]
struct Loss {
    first: DeviceId,
    count: u32,
    tti: Tti,
    wake_up: u32,
}

/// Drives a run like the shell on the bus: it requests every action twice, and sums travel with the next grant. Hosts
/// are lost while an answer is due. It stops before the first grant from TTI `stop` on.
fn serve(prepared: &PreparedRun, loss: Option<Loss>, stop: Tti) -> (RunOutcome, Seen) {
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
    let mut seen = Seen::default();
    let settle = |machines: &mut [Machine], k| machines.iter_mut().for_each(|machine| machine.advance_to(k));
    let finish = |session: Session, mut machines: Vec<Machine>, mut seen: Seen| {
        settle(&mut machines, session.next_tti());
        let ledgers: Vec<_> = machines.iter().map(Machine::ledger).collect();
        (session.finish(&ledgers, &mut seen), seen)
    };
    loop {
        let action = session.next_action(Tti::NEVER, &mut seen);
        if let Action::Gather | Action::Wake(_) | Action::CollectTotals(_) | Action::Finish(_) = action {
            let again = session.next_action(Tti::NEVER, &mut seen);
            assert_eq!(format!("{action:?}"), format!("{again:?}"));
        }
        match action {
            Action::CollectTotals(k) => {
                session.apply_result(ActionResult::TotalsFollow, &mut seen);
                if k >= stop {
                    return finish(session, machines, seen);
                }
            }
            Action::RequestDecision(stage) => panic!("no external policy decides: {stage:?}"),
            Action::TtiClosed => panic!("no decision is queued"),
            Action::Remove(outage) => panic!("no removal is queued: {outage:?}"),
            Action::Grant(updates) => {
                let tick = *session.grant_message();
                let sums = tick.account.then(|| {
                    settle(&mut machines, tick.first);
                    machines.iter().map(Machine::totals).sum::<DeviceTotals>()
                });
                for update in &updates {
                    let count = machines.len();
                    air.deliver_plan(update.from, &update.plan, DeviceId(0), count, |j, cycle| {
                        machines[j].set_duty(update.from, cycle);
                    });
                }
                let (mut reports, mut failures, mut unpowered) = (Vec::new(), Vec::new(), 0);
                // Hosts answer in any order.
                for machine in machines.iter_mut().rev() {
                    let sensed = tick.stimulus.map(|event| machine.sense(tick.last, &event, &physics));
                    match sensed {
                        Some(SenseOutcome::Reported(report)) => reports.push(report),
                        Some(SenseOutcome::Failed(failure)) => failures.push(failure),
                        Some(SenseOutcome::Unpowered) => unpowered += 1,
                        Some(SenseOutcome::Nothing) | None => {}
                    }
                    machine.begin(tick.last);
                }
                let views: Vec<DeviceView> = machines.iter().map(Machine::view).collect();
                assert!(tick.views, "the observer wants states");
                let gathered = Gathered {
                    reports: &mut reports,
                    failures: &mut failures,
                    unpowered,
                    views: &views,
                };
                if let Some(sums) = sums {
                    session.apply_result(ActionResult::Totals(sums), &mut seen);
                }
                session.apply_result(ActionResult::Gathered(gathered), &mut seen);
            }
            Action::Gather => unreachable!("the answers came with the grant"),
            Action::Wake(order) => {
                if let Some(Loss { first, count, .. }) =
                    loss.filter(|loss| (loss.tti, loss.wake_up) == (order.tti, order.number))
                {
                    let lost = (first.0..first.0 + count).map(DeviceId);
                    for device in lost.clone() {
                        machines[device.index()].remove(order.tti);
                    }
                    assert_eq!(remove(&mut session, lost.clone(), &mut seen), 1);
                    assert_eq!(remove(&mut session, lost, &mut seen), 0, "a device is removed once");
                }
                let machine = &mut machines[order.device.index()];
                let outcome = machine.wake(order.tti, order.stimulus.as_ref(), &physics);
                session.apply_result(ActionResult::Woken(outcome), &mut seen);
            }
            Action::Finish(_) => return finish(session, machines, seen),
        }
    }
}

/// Removes `devices`, and returns how many removals are stored for them.
fn remove(session: &mut Session, devices: impl Iterator<Item = DeviceId>, seen: &mut Seen) -> u32 {
    let kept = Cell::new(0);
    let keep = |_: &DeviceRemoval| -> Result<(), ()> {
        kept.set(kept.get() + 1);
        Ok(())
    };
    session.remove_devices(devices, seen, keep).expect("it is kept");
    kept.get()
}

/// Runs `prepared` with the removals `outages` in memory, where sums are collected before the grant.
fn run(prepared: &PreparedRun, outages: &[DeviceRemoval]) -> (RunOutcome, Seen) {
    let options = RunOptions {
        window: WINDOW,
        ..RunOptions::default()
    };
    let mut seen = Seen::default();
    let mut run = Run::new(prepared, options);
    run.schedule_inputs(&ExternalInputs::from_outages(outages));
    let outcome = run.finish(&mut seen);
    (outcome, seen)
}

#[test]
fn late_sums_and_repeated_requests_change_nothing() {
    for policy in ["knn", "q-learning", "age-index", "genie", "random"] {
        let prepared = prepared(policy);
        let served = serve(&prepared, None, Tti::NEVER);
        assert!(served.1.windows.len() > 25, "{policy}: {}", served.1.windows.len());
        assert_eq!(served, run(&prepared, &[]), "{policy}");
    }
}

#[test]
fn a_run_that_stops_while_sums_are_on_their_way_has_its_last_window() {
    let prepared = prepared("knn");
    let (_, whole) = run(&prepared, &[]);
    let stop = Tti(20 * WINDOW);
    let (outcome, seen) = serve(&prepared, None, stop);
    assert_eq!(outcome.ttis_done, stop.0);
    assert_eq!(seen.windows.last().map(|window| window.end), Some(stop));
    assert_eq!(seen.windows, whole.windows[..seen.windows.len()]);
}

#[test]
fn a_host_lost_during_a_wake_up_is_the_queued_removal() {
    let prepared = prepared("knn");
    let mut orders = Orders::default();
    Run::new(&prepared, RunOptions::default()).finish(&mut orders);
    // The second wake-up of a TTI, so that the number counts.
    let two = orders.0.windows(2).find(|two| two[0].0 == two[1].0);
    let (tti, device) = two.expect("a TTI with two wake-ups")[1];
    let loss = Loss {
        first: DeviceId(device.0.saturating_sub(2)),
        count: 4,
        tti,
        wake_up: 1,
    };
    let served = serve(&prepared, Some(loss), Tti::NEVER);
    let outage = DeviceRemoval {
        first: loss.first,
        count: loss.count,
        tti,
        wake_ups: Some(1),
    };
    assert_eq!(served.1.outages, [outage]);
    assert_eq!(served, run(&prepared, &[outage]));
    assert_ne!(served.0.digest, run(&prepared, &[]).0.digest);
}

/// The wake-ups of a run.
#[derive(Default)]
struct Orders(Vec<(Tti, DeviceId)>);

impl Observer for Orders {
    fn notify(&mut self, notification: &Notification<'_>) {
        if let Notification::WakeUpSent { tti, device, .. } = notification {
            self.0.push((*tti, *device));
        }
    }
}

#[test]
#[should_panic(expected = "no action of phase Between has reports as its result")]
fn a_result_that_no_action_asked_for_is_refused() {
    let mut session = Session::new(&prepared("knn"), u64::MAX);
    let none = Gathered {
        reports: &mut [],
        failures: &mut [],
        unpowered: 0,
        views: &[],
    };
    session.apply_result(ActionResult::Gathered(none), &mut ());
}
