//! A host executes each grant once, with all its plans, despite lost and repeated messages.

use reveille_common::ids::EventId;
use reveille_common::radio::RadioSettings;
use reveille_common::rng::{Purpose, Stream};

use super::*;

const FIRST: u32 = 3;
const END: Tti = Tti(500);
const D_MAX: f64 = 4.0;

/// A host with devices 3, 4 and 5, at 0, 3 and 6 m along a line.
fn follower() -> GrantFollower {
    with_radio(&RadioSettings::default())
}

fn with_radio(radio: &RadioSettings) -> GrantFollower {
    let beginning = FollowerStart {
        first: DeviceId(FIRST),
        positions: (0..3).map(|j| Point::new(3.0 * f64::from(j), 0.0)).collect(),
        duties: vec![DutyCycle::ASLEEP; 3],
        resume_point: ResumePoint::default(),
    };
    GrantFollower::new(beginning, D_MAX, END, 1, radio)
}

/// A plan from TTI `from` on under which the devices of `on` sense.
fn plan(from: u64, on: &[u32]) -> PlanUpdate {
    PlanUpdate {
        from: Tti(from),
        plan: Plan::from_bits((0..8).map(|device| on.contains(&device))),
    }
}

fn tick(first: u64, last: u64, plan: u64, plans: u32) -> GrantMessage {
    GrantMessage {
        first: Tti(first),
        last: Tti(last),
        stimulus: None,
        until: Tti(last).saturating_add(1),
        account: false,
        views: false,
        plan: Tti(plan),
        plans,
    }
}

fn event_at(x: f64) -> Stimulus {
    Stimulus {
        event: EventId(0),
        epicentre: Point::new(x, 0.0),
    }
}

#[test]
fn a_grant_is_followed_once() {
    let mut host = follower();
    assert!(host.receive_plan(plan(0, &[4])));
    let changes = vec![(1, Tti(0), DutyCycle::SENSING)];
    let turn = GrantTask {
        duty_changes: changes,
        sensing_devices: Vec::new(),
    };
    assert_eq!(host.receive_grant(tick(0, 9, 0, 1)), Disposition::Execute(turn));
    assert_eq!((host.last_granted(), host.next()), (Tti(9), Tti(10)));
    assert_eq!(host.receive_grant(tick(0, 9, 0, 1)), Disposition::Retransmit);
    assert_eq!(host.receive_grant(tick(0, 4, 0, 0)), Disposition::NotReady, "stale");
    assert_eq!(
        host.receive_grant(tick(11, 12, 0, 0)),
        Disposition::NotReady,
        "one is missing before it"
    );
    assert_eq!(
        host.receive_grant(tick(10, 12, 0, 0)),
        Disposition::Execute(GrantTask::default())
    );
}

#[test]
fn it_waits_for_each_plan_that_goes_with_a_grant() {
    let mut host = follower();
    let grant = tick(0, 9, 7, 3);
    host.receive_plan(plan(0, &[3]));
    host.receive_plan(plan(7, &[5]));
    assert_eq!(
        host.receive_grant(grant),
        Disposition::NotReady,
        "the plan of TTI 4 is missing"
    );
    host.receive_plan(plan(4, &[3, 4]));
    let Disposition::Execute(turn) = host.receive_grant(grant) else {
        panic!("everything is there");
    };
    let (on, off) = (DutyCycle::SENSING, DutyCycle::ASLEEP);
    let changes = [(0, 0, on), (1, 4, on), (0, 7, off), (1, 7, off), (2, 7, on)];
    assert_eq!(turn.duty_changes, changes.map(|(j, from, duty)| (j, Tti(from), duty)));
    assert!(!host.receive_plan(plan(7, &[3])), "sent again, when it was followed");
    assert_eq!(
        host.receive_grant(tick(10, 10, 10, 1)),
        Disposition::NotReady,
        "it has another plan"
    );
    host.receive_plan(plan(12, &[3]));
    assert_eq!(
        host.receive_grant(tick(10, 11, 7, 0)),
        Disposition::Execute(GrantTask::default()),
        "one that comes later has no say"
    );
}

#[test]
fn who_listens_has_delta_1_and_is_within_reach() {
    let mut host = follower();
    host.receive_plan(plan(0, &[3, 5]));
    let mut grant = tick(0, 0, 0, 1);
    grant.stimulus = Some(event_at(2.0));
    let Disposition::Execute(turn) = host.receive_grant(grant) else {
        panic!("everything is there");
    };
    assert_eq!(turn.sensing_devices, [0, 2], "at 2 m and, just so, at 4 m");
    let mut grant = tick(1, 1, 0, 0);
    grant.stimulus = Some(event_at(1.9));
    let Disposition::Execute(turn) = host.receive_grant(grant) else {
        panic!("everything is there");
    };
    assert_eq!(turn.sensing_devices, [0]);
}

#[test]
fn a_wake_up_counts_in_its_tti_for_its_device_while_there_is_something_to_see() {
    let mut host = follower();
    let wake = |tti| WakeUp { tti: Tti(tti) };
    assert_eq!(
        host.receive_wake_up(DeviceId(4), wake(0)),
        None,
        "before the first grant"
    );
    host.receive_plan(plan(0, &[]));
    host.receive_grant(tick(0, 3, 0, 1));
    assert_eq!(host.receive_wake_up(DeviceId(4), wake(3)), None, "nothing to see");
    let mut grant = tick(4, 6, 0, 0);
    grant.stimulus = Some(event_at(1.0));
    host.receive_grant(grant);
    let call = |device| WakeUpTask {
        device,
        tti: Tti(6),
        stimulus: Some(event_at(1.0)),
    };
    assert_eq!(host.receive_wake_up(DeviceId(FIRST), wake(6)), Some(call(0)));
    assert_eq!(host.receive_wake_up(DeviceId(5), wake(6)), Some(call(2)));
    for (device, tti) in [(FIRST - 1, 6), (6, 6), (u32::MAX, 6), (4, 5), (4, 7)] {
        assert_eq!(
            host.receive_wake_up(DeviceId(device), wake(tti)),
            None,
            "{device} in {tti}"
        );
    }
}

#[test]
fn who_wakes_late_finds_what_is_there_then() {
    let mut host = with_radio(&RadioSettings {
        wake_latency: 3,
        ..RadioSettings::default()
    });
    host.receive_plan(plan(0, &[]));
    let mut grant = tick(0, 10, 0, 1);
    (grant.stimulus, grant.until) = (Some(event_at(1.0)), Tti(17));
    host.receive_grant(grant);
    let seen = |sent| {
        host.receive_wake_up(DeviceId(4), WakeUp { tti: Tti(sent) })
            .map(|call| (call.tti.0, call.stimulus.is_some()))
    };
    // Awake in TTIs 13, 16 and 19; the event's last is 17.
    assert_eq!(
        [10, 13, 16].map(seen),
        [Some((10, true)), Some((10, true)), Some((10, false))]
    );
    assert_eq!(
        [7, 9, 11, 12, 14, u64::MAX].map(seen),
        [None; 6],
        "never sent then for this event"
    );
}

#[test]
fn the_end_is_followed_once_and_in_its_place() {
    let mut host = follower();
    assert_eq!(host.receive_collect_ledgers(Tti(10)), Disposition::NotReady);
    host.receive_plan(plan(0, &[]));
    host.receive_grant(tick(0, 9, 0, 1));
    assert_eq!(host.receive_collect_ledgers(Tti(10)), Disposition::Execute(()));
    assert_eq!(host.receive_collect_ledgers(Tti(10)), Disposition::Retransmit);
    assert_eq!(
        host.receive_grant(tick(0, 9, 0, 1)),
        Disposition::NotReady,
        "the grant is answered"
    );
}

#[test]
fn nothing_reaches_beyond_the_end_of_the_run() {
    let mut host = follower();
    host.receive_plan(plan(0, &[]));
    assert_eq!(host.receive_grant(tick(0, END.0, 0, 1)), Disposition::NotReady);
    assert_eq!(host.receive_grant(tick(0, u64::MAX, 0, 1)), Disposition::NotReady);
    assert!(!host.receive_plan(plan(END.0, &[3])) && !host.receive_plan(plan(u64::MAX, &[3])));
    assert_ne!(host.receive_grant(tick(0, END.0 - 1, 0, 1)), Disposition::NotReady);
    assert_eq!(host.next(), END);
}

/// Messages are lost, repeated and late. The host applies the plans of the base station, TTI by TTI.
#[test]
fn over_a_bad_link_it_follows_what_was_planned() {
    for seed in 0..50 {
        let mut draw = Stream::new(seed, Purpose::Training, 0);
        let mut host = follower();
        let mut planned: Vec<PlanUpdate> = Vec::new();
        let mut sent: Vec<Received> = Vec::new();
        let mut did = [DutyCycle::ASLEEP; 3];
        let mut next = 0;
        while next < 200 {
            let last = next + draw.below(8);
            let mut with = 0;
            for from in next..=last {
                if from == 0 || draw.below(3) == 0 {
                    let on: Vec<u32> = (0..8).filter(|_| draw.below(2) == 0).collect();
                    planned.push(plan(from, &on));
                    with += 1;
                }
            }
            let grant = tick(next, last, planned.last().expect("the first TTI has one").from.0, with);
            let news = &planned[planned.len() - with as usize..];
            let turn = loop {
                for update in news {
                    sent.push(Received::Plan(update.clone()));
                }
                sent.push(Received::Grant(grant));
                // Any message sent so far may arrive again, in any order.
                let again = draw.below(sent.len() as u64) as usize;
                let mut arriving: Vec<Received> = sent[sent.len() - 1 - news.len()..].to_vec();
                arriving.insert(draw.below(arriving.len() as u64 + 1) as usize, sent[again].clone());
                arriving.retain(|_| draw.below(3) > 0);
                let mut followed = None;
                for heard in arriving {
                    match heard {
                        Received::Plan(update) => drop(host.receive_plan(update)),
                        Received::Grant(tick) => {
                            if let Disposition::Execute(turn) = host.receive_grant(tick) {
                                assert!(tick == grant && followed.is_none(), "followed twice, or out of turn");
                                followed = Some(turn);
                            }
                        }
                    }
                }
                if let Some(turn) = followed {
                    break turn;
                }
            };
            let mut changes = turn.duty_changes.into_iter().peekable();
            for k in (next..=last).map(Tti) {
                while let Some((j, _, duty)) = changes.next_if(|(_, from, _)| *from <= k) {
                    did[j] = duty;
                }
                let in_force = planned.iter().rfind(|update| update.from <= k).expect("a first plan");
                for (j, duty) in did.iter().enumerate() {
                    let device = DeviceId(FIRST + j as u32);
                    assert_eq!(
                        duty.is_on(k),
                        in_force.plan.duty_cycle(device).is_on(k),
                        "{device} in TTI {k}, seed {seed}"
                    );
                }
            }
            next = last + 1;
        }
    }
}

#[derive(Clone)]
enum Received {
    Plan(PlanUpdate),
    Grant(GrantMessage),
}
