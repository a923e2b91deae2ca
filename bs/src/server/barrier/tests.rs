//! Tests of the expected hosts and of the answers that the barrier accepts.

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{HostAnswer, Report, WakeOutcome};
use reveille_common::units::Energy;

use super::*;
use crate::server::admission::Assignment;
use crate::server::roster::tests::roster;

fn done(host: u32, tti: u64, reports: u32) -> HostAnswer {
    HostAnswer::GrantDone {
        host: HostId(host),
        tti: Tti(tti),
        reports,
        failures: vec![],
        totals: None,
        views: None,
    }
}

fn report(device: u32, tti: u64) -> Report {
    Report {
        device: DeviceId(device),
        tti: Tti(tti),
        information: 0.5,
        battery: Energy::ZERO,
    }
}

/// Two hosts with five devices each, waiting for TTI 5.
fn barrier(stimulus: bool) -> Barrier {
    let mut barrier = Barrier::new(roster());
    barrier.expect_grant(Tti(5), stimulus, GrantOptions::default());
    barrier
}

fn hear(b: &mut Barrier, report: Report) -> bool {
    b.receive_report(HostId(report.device.0 / 5), report)
}

#[test]
fn a_grant_waits_for_every_host_and_every_report() {
    let mut b = barrier(true);
    assert!(!b.receive_answer(HostId(0), done(0, 5, 2)));
    assert!(!b.receive_answer(HostId(0), done(0, 5, 2)), "the same answer twice");
    assert!(!b.receive_answer(HostId(7), done(7, 5, 0)), "an unknown host");
    assert!(!b.receive_answer(HostId(1), done(0, 5, 0)), "in another's name");
    assert!(
        !b.receive_answer(HostId(1), done(1, 4, 0)),
        "an answer to another grant"
    );
    assert!(!b.receive_answer(HostId(1), done(1, 5, 6)), "more reports than devices");
    assert_eq!(b.missing_hosts(), [HostId(1)]);
    assert!(!b.receive_answer(HostId(1), done(1, 5, 0)));
    assert!(!hear(&mut b, report(3, 5)));
    assert!(!hear(&mut b, report(3, 5)), "the same report twice");
    assert!(!hear(&mut b, report(4, 4)), "a report of another TTI");
    assert!(!hear(&mut b, report(10, 5)), "a report of a device that is not there");
    assert!(!b.receive_report(HostId(1), report(4, 5)), "another host's device");
    assert!(hear(&mut b, report(4, 5)));
    assert_eq!(b.take_grant_result().reports.len(), 2);
    // The answer to another grant and the report of another TTI are late, as after a retransmission, and are not
    // counted.
    assert_eq!(b.unexpected_messages(), 5);
}

#[test]
fn a_better_answer_takes_the_place_of_a_false_one() {
    let mut b = barrier(true);
    assert!(!b.receive_answer(HostId(0), done(0, 5, 3)), "a wrong number of reports");
    assert!(!b.receive_answer(HostId(1), done(1, 5, 0)));
    assert!(b.receive_answer(HostId(0), done(0, 5, 0)));
}

#[test]
fn nobody_reports_on_nothing() {
    let mut b = barrier(false);
    assert!(!hear(&mut b, report(3, 5)));
    assert!(!b.receive_answer(HostId(0), done(0, 5, 1)));
    assert!(!b.receive_answer(HostId(0), done(0, 5, 0)) && b.receive_answer(HostId(1), done(1, 5, 0)));
    assert_eq!((b.take_grant_result().reports.len(), b.unexpected_messages()), (0, 2));
}

#[test]
fn who_takes_over_says_the_same_once_more() {
    let mut b = barrier(true);
    b.receive_answer(HostId(0), done(0, 5, 1));
    hear(&mut b, report(3, 5));
    let heir = Assignment {
        host: HostId(2),
        ..b.roster_mut().assignment(0)
    };
    b.roster_mut().replace(HostId(0), heir);
    assert!(!b.receive_answer(HostId(0), done(0, 5, 1)), "it has no say any more");
    assert!(!b.receive_report(HostId(2), report(3, 5)) && !b.receive_answer(HostId(2), done(2, 5, 1)));
    assert!(b.receive_answer(HostId(1), done(1, 5, 0)));
    assert_eq!(b.take_grant_result().reports.len(), 1);
    b.receive_answer(HostId(2), done(2, 5, 1));
    assert_eq!(b.unexpected_messages(), 1, "what is late is no stray");
}

#[test]
fn a_wake_up_waits_for_its_device() {
    let not_woken = |tti| HostAnswer::NotWoken {
        device: DeviceId(3),
        tti: Tti(tti),
        outcome: WakeOutcome::Missed,
    };
    let mut b = Barrier::new(roster());
    b.expect_wake(Tti(5), DeviceId(3));
    assert!(!hear(&mut b, report(4, 5)));
    assert!(!b.receive_answer(HostId(0), not_woken(4)));
    assert!(!b.receive_answer(HostId(1), not_woken(5)), "another host's device");
    assert_eq!(b.missing_hosts(), [HostId(0)]);
    assert!(b.receive_answer(HostId(0), not_woken(5)));
    assert_eq!(b.take_wake_outcome(), WakeOutcome::Missed);
}
