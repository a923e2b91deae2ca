//! Tests of [`GrantFollower`]: it executes each grant once, with all its plans, despite lost and repeated messages. The
//! devices, the bus and plans lost by the modelled radio are not part of these tests, and all hosts start at TTI 0.
//! Only one test has changes by operators. Distances and TTIs are arbitrary.

use std::ops::RangeInclusive;

use reveille_common::ids::EventId;
use reveille_common::message::DeviceRange;
use reveille_common::radio::RadioSettings;
use reveille_common::rng::{Purpose, Stream};

use super::*;

const FIRST_DEVICE: u32 = 3;
const END: Tti = Tti(500);
const D_MAX: f64 = 4.0;

/// A host with devices 3, 4 and 5, at 0, 3 and 6 m along a line.
fn new_follower() -> GrantFollower {
    follower_with(&RadioSettings::default())
}

fn follower_with(radio: &RadioSettings) -> GrantFollower {
    let start = FollowerStart {
        first: DeviceId(FIRST_DEVICE),
        positions: (0..3).map(|j| Point::new(3.0 * f64::from(j), 0.0)).collect(),
        duties: vec![DutyCycle::ASLEEP; 3],
        resume_point: ResumePoint::default(),
    };
    GrantFollower::new(start, D_MAX, END, 1, radio)
}

/// A plan from TTI `from` on under which `sensing_devices` sense.
fn plan_update(from: u64, sensing_devices: &[u32]) -> PlanUpdate {
    PlanUpdate {
        from: Tti(from),
        plan: Plan::from_bits((0..8).map(|device| sensing_devices.contains(&device))),
    }
}

/// The grant of `ttis`. The plan from TTI `plan_from` applies in the last of them; `plan_count` plans take effect in
/// them.
fn grant_of(ttis: RangeInclusive<u64>, plan_from: u64, plan_count: u32) -> GrantMessage {
    let (first, last) = ttis.into_inner();
    GrantMessage {
        first: Tti(first),
        last: Tti(last),
        stimulus: None,
        stimulus_last: Tti(last).saturating_add(1),
        wants_totals: false,
        wants_views: false,
        plan_from: Tti(plan_from),
        plan_count,
        change_count: 0,
    }
}

fn event_at(x: f64) -> Stimulus {
    Stimulus {
        event: EventId(0),
        epicentre: Point::new(x, 0.0),
    }
}

#[test]
fn a_grant_is_executed_once() {
    let mut follower = new_follower();
    assert!(follower.receive_plan(plan_update(0, &[4])));
    let duty_changes = vec![(1, Tti(0), DutyCycle::SENSING)];
    let task = GrantTask {
        duty_changes,
        ..GrantTask::default()
    };
    assert_eq!(
        follower.receive_grant(grant_of(0..=9, 0, 1)),
        Disposition::Execute(task)
    );
    assert_eq!((follower.last_granted(), follower.next()), (Tti(9), Tti(10)));
    assert_eq!(follower.receive_grant(grant_of(0..=9, 0, 1)), Disposition::Retransmit);
    assert_eq!(
        follower.receive_grant(grant_of(0..=4, 0, 0)),
        Disposition::NotReady,
        "an earlier grant"
    );
    assert_eq!(
        follower.receive_grant(grant_of(11..=12, 0, 0)),
        Disposition::NotReady,
        "the grant before is missing"
    );
    assert_eq!(
        follower.receive_grant(grant_of(10..=12, 0, 0)),
        Disposition::Execute(GrantTask::default())
    );
}

#[test]
fn a_grant_waits_for_each_of_its_plans() {
    let mut follower = new_follower();
    let grant = grant_of(0..=9, 7, 3);
    follower.receive_plan(plan_update(0, &[3]));
    follower.receive_plan(plan_update(7, &[5]));
    assert_eq!(
        follower.receive_grant(grant),
        Disposition::NotReady,
        "the plan of TTI 4 is missing"
    );
    follower.receive_plan(plan_update(4, &[3, 4]));
    let Disposition::Execute(task) = follower.receive_grant(grant) else {
        panic!("the grant is complete");
    };
    let (sensing, asleep) = (DutyCycle::SENSING, DutyCycle::ASLEEP);
    let changes = [
        (0, 0, sensing),
        (1, 4, sensing),
        (0, 7, asleep),
        (1, 7, asleep),
        (2, 7, sensing),
    ];
    assert_eq!(task.duty_changes, changes.map(|(j, from, duty)| (j, Tti(from), duty)));
    assert!(
        !follower.receive_plan(plan_update(7, &[3])),
        "repeated after its execution"
    );
    assert_eq!(
        follower.receive_grant(grant_of(10..=10, 10, 1)),
        Disposition::NotReady,
        "the plan of TTI 10 is missing"
    );
    follower.receive_plan(plan_update(12, &[3]));
    assert_eq!(
        follower.receive_grant(grant_of(10..=11, 7, 0)),
        Disposition::Execute(GrantTask::default()),
        "a plan for a later TTI has no effect"
    );
}

#[test]
fn a_grant_waits_for_all_of_its_changes() {
    let fail = |device| {
        let range = DeviceRange {
            first: DeviceId(device),
            count: 1,
        };
        Change::Fail(range)
    };
    let mut follower = new_follower();
    follower.receive_plan(plan_update(0, &[]));
    let grant = GrantMessage {
        change_count: 2,
        ..grant_of(0..=9, 0, 1)
    };
    assert_eq!(follower.receive_grant(grant), Disposition::NotReady, "no changes");
    assert!(follower.receive_changes(Tti(3), vec![fail(3), fail(4)]));
    assert_eq!(
        follower.receive_grant(grant),
        Disposition::NotReady,
        "changes of another TTI"
    );
    assert!(follower.receive_changes(Tti(0), vec![fail(3)]));
    assert_eq!(
        follower.receive_grant(grant),
        Disposition::NotReady,
        "a change is missing"
    );
    let changes = vec![fail(3), fail(9)];
    assert!(follower.receive_changes(Tti(0), changes.clone()));
    let expected = GrantTask {
        changes,
        ..GrantTask::default()
    };
    assert_eq!(follower.receive_grant(grant), Disposition::Execute(expected));
    assert!(
        !follower.receive_changes(Tti(0), vec![fail(3)]),
        "repeated after its execution"
    );
    assert_eq!(
        follower.receive_grant(grant_of(10..=12, 0, 0)),
        Disposition::Execute(GrantTask::default()),
        "the changes take effect once"
    );
}

#[test]
fn sensing_devices_have_delta_1_and_are_within_d_max() {
    let mut follower = new_follower();
    follower.receive_plan(plan_update(0, &[3, 5]));
    let mut grant = grant_of(0..=0, 0, 1);
    grant.stimulus = Some(event_at(2.0));
    let Disposition::Execute(task) = follower.receive_grant(grant) else {
        panic!("the grant is complete");
    };
    assert_eq!(task.sensing_devices, [0, 2], "at 2 m, and at exactly 4 m");
    let mut grant = grant_of(1..=1, 0, 0);
    grant.stimulus = Some(event_at(1.9));
    let Disposition::Execute(task) = follower.receive_grant(grant) else {
        panic!("the grant is complete");
    };
    assert_eq!(task.sensing_devices, [0]);
}

#[test]
fn a_wake_up_is_executed_in_its_tti_during_an_event_only() {
    let mut follower = new_follower();
    let wake = |tti| WakeUp { tti: Tti(tti) };
    assert_eq!(
        follower.receive_wake_up(DeviceId(4), wake(0)),
        None,
        "before the first grant"
    );
    follower.receive_plan(plan_update(0, &[]));
    follower.receive_grant(grant_of(0..=3, 0, 1));
    assert_eq!(follower.receive_wake_up(DeviceId(4), wake(3)), None, "without an event");
    let mut grant = grant_of(4..=6, 0, 0);
    grant.stimulus = Some(event_at(1.0));
    follower.receive_grant(grant);
    let task = |device| WakeUpTask {
        device,
        tti: Tti(6),
        stimulus: Some(event_at(1.0)),
    };
    assert_eq!(follower.receive_wake_up(DeviceId(FIRST_DEVICE), wake(6)), Some(task(0)));
    assert_eq!(follower.receive_wake_up(DeviceId(5), wake(6)), Some(task(2)));
    for (device, tti) in [(FIRST_DEVICE - 1, 6), (6, 6), (u32::MAX, 6), (4, 5), (4, 7)] {
        assert_eq!(
            follower.receive_wake_up(DeviceId(device), wake(tti)),
            None,
            "device {device} in TTI {tti}"
        );
    }
}

#[test]
fn a_late_wake_up_shows_the_event_only_until_its_end() {
    let mut follower = follower_with(&RadioSettings {
        wake_latency: 3,
        ..RadioSettings::default()
    });
    follower.receive_plan(plan_update(0, &[]));
    let mut grant = grant_of(0..=10, 0, 1);
    (grant.stimulus, grant.stimulus_last) = (Some(event_at(1.0)), Tti(17));
    follower.receive_grant(grant);
    let receive = |sent| {
        follower
            .receive_wake_up(DeviceId(4), WakeUp { tti: Tti(sent) })
            .map(|task| (task.tti.0, task.stimulus.is_some()))
    };
    // Awake in TTIs 13, 16 and 19; the event ends with TTI 17.
    assert_eq!(
        [10, 13, 16].map(receive),
        [Some((10, true)), Some((10, true)), Some((10, false))]
    );
    assert_eq!(
        [7, 9, 11, 12, 14, u64::MAX].map(receive),
        [None; 6],
        "no wake-up of this event is sent then"
    );
}

#[test]
fn ledgers_are_collected_once_after_the_last_grant() {
    let mut follower = new_follower();
    assert_eq!(follower.receive_collect_ledgers(Tti(10)), Disposition::NotReady);
    follower.receive_plan(plan_update(0, &[]));
    follower.receive_grant(grant_of(0..=9, 0, 1));
    assert_eq!(follower.receive_collect_ledgers(Tti(10)), Disposition::Execute(()));
    assert_eq!(follower.receive_collect_ledgers(Tti(10)), Disposition::Retransmit);
    assert_eq!(
        follower.receive_grant(grant_of(0..=9, 0, 1)),
        Disposition::NotReady,
        "the grant was answered"
    );
}

#[test]
fn grants_and_plans_beyond_the_end_are_refused() {
    let mut follower = new_follower();
    follower.receive_plan(plan_update(0, &[]));
    assert_eq!(follower.receive_grant(grant_of(0..=END.0, 0, 1)), Disposition::NotReady);
    assert_eq!(
        follower.receive_grant(grant_of(0..=u64::MAX, 0, 1)),
        Disposition::NotReady
    );
    assert!(!follower.receive_plan(plan_update(END.0, &[3])) && !follower.receive_plan(plan_update(u64::MAX, &[3])));
    assert_ne!(
        follower.receive_grant(grant_of(0..=END.0 - 1, 0, 1)),
        Disposition::NotReady
    );
    assert_eq!(follower.next(), END);
}

/// Plans and grants are lost, repeated and reordered.
#[test]
fn over_a_bad_link_the_duties_equal_the_plans_in_every_tti() {
    for seed in 0..50 {
        let mut stream = Stream::new(seed, Purpose::Training, 0);
        let mut follower = new_follower();
        let mut plans: Vec<PlanUpdate> = Vec::new();
        let mut sent: Vec<BsMessage> = Vec::new();
        let mut duties = [DutyCycle::ASLEEP; 3];
        let mut next = 0;
        while next < 200 {
            let last = next + stream.below(8);
            let mut plan_count = 0;
            for from in next..=last {
                if from == 0 || stream.below(3) == 0 {
                    let sensing_devices: Vec<u32> = (0..8).filter(|_| stream.below(2) == 0).collect();
                    plans.push(plan_update(from, &sensing_devices));
                    plan_count += 1;
                }
            }
            let grant = grant_of(
                next..=last,
                plans.last().expect("the first TTI has one").from.0,
                plan_count,
            );
            let new_plans = &plans[plans.len() - plan_count as usize..];
            let task = loop {
                for update in new_plans {
                    sent.push(BsMessage::Plan(update.clone()));
                }
                sent.push(BsMessage::Grant(grant));
                // Any message sent so far may arrive again, in any order.
                let repeated = stream.below(sent.len() as u64) as usize;
                let mut arriving: Vec<BsMessage> = sent[sent.len() - 1 - new_plans.len()..].to_vec();
                arriving.insert(stream.below(arriving.len() as u64 + 1) as usize, sent[repeated].clone());
                arriving.retain(|_| stream.below(3) > 0);
                let mut executed = None;
                for message in arriving {
                    match message {
                        BsMessage::Plan(update) => drop(follower.receive_plan(update)),
                        BsMessage::Grant(arriving_grant) => {
                            if let Disposition::Execute(task) = follower.receive_grant(arriving_grant) {
                                assert!(
                                    arriving_grant == grant && executed.is_none(),
                                    "a grant is executed twice or out of order"
                                );
                                executed = Some(task);
                            }
                        }
                    }
                }
                if let Some(task) = executed {
                    break task;
                }
            };
            let mut duty_changes = task.duty_changes.into_iter().peekable();
            for k in (next..=last).map(Tti) {
                while let Some((j, _, duty)) = duty_changes.next_if(|(_, from, _)| *from <= k) {
                    duties[j] = duty;
                }
                let current_plan = plans.iter().rfind(|update| update.from <= k).expect("a first plan");
                for (j, duty) in duties.iter().enumerate() {
                    let device = DeviceId(FIRST_DEVICE + j as u32);
                    assert_eq!(
                        duty.is_on(k),
                        current_plan.plan.duty_cycle(device).is_on(k),
                        "{device} in TTI {k}, seed {seed}"
                    );
                }
            }
            next = last + 1;
        }
    }
}

#[derive(Clone)]
enum BsMessage {
    Plan(PlanUpdate),
    Grant(GrantMessage),
}
