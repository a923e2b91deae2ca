//! Tests of [`Barrier`]: the hosts that it waits for, and the answers and reports that it accepts, without a bus.
//! Removed hosts, ledgers and the checks of sums and views are left to `tests/fuzz/fuzz_targets/hosts.rs`, to the tests
//! of `roster`, and to runs over the bus.

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{HostAnswer, Report, WakeOutcome};
use reveille_common::units::Energy;

use super::*;
use crate::server::admission::Assignment;
use crate::server::roster::tests::two_host_roster;

fn grant_done(host: u32, tti: u64, reports: u32) -> HostAnswer {
    grant_done_with(host, tti, reports, UnableDetectors::default())
}

fn grant_done_with(host: u32, tti: u64, reports: u32, unable: UnableDetectors) -> HostAnswer {
    HostAnswer::GrantDone {
        host: HostId(host),
        tti: Tti(tti),
        reports,
        failures: vec![],
        unable,
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

/// Two hosts with five devices each, waiting for the answers to TTI 5. An event is active there if `is_event_active`.
fn waiting_barrier(is_event_active: bool) -> Barrier {
    let mut barrier = Barrier::new(two_host_roster());
    barrier.expect_grant(Tti(5), is_event_active, GrantOptions::default());
    barrier
}

/// Passes on a report from the host of its device. Returns whether the barrier is complete.
fn receive_from_own_host(barrier: &mut Barrier, report: Report) -> bool {
    // In `two_host_roster` each host runs five devices.
    barrier.receive_report(HostId(report.device.0 / 5), report)
}

#[test]
fn a_grant_waits_for_every_host_and_every_report() {
    let mut barrier = waiting_barrier(true);
    assert!(!barrier.receive_answer(HostId(0), grant_done(0, 5, 2)));
    assert!(
        !barrier.receive_answer(HostId(0), grant_done(0, 5, 2)),
        "the same answer twice"
    );
    assert!(
        !barrier.receive_answer(HostId(7), grant_done(7, 5, 0)),
        "an unknown host"
    );
    assert!(
        !barrier.receive_answer(HostId(1), grant_done(0, 5, 0)),
        "in the name of another host"
    );
    assert!(
        !barrier.receive_answer(HostId(1), grant_done(1, 4, 0)),
        "an answer to another grant"
    );
    assert!(
        !barrier.receive_answer(HostId(1), grant_done(1, 5, 6)),
        "more reports than devices"
    );
    assert_eq!(barrier.missing_hosts(), [HostId(1)]);
    assert!(!barrier.receive_answer(HostId(1), grant_done(1, 5, 0)));
    assert!(!receive_from_own_host(&mut barrier, report(3, 5)));
    assert!(
        !receive_from_own_host(&mut barrier, report(3, 5)),
        "the same report twice"
    );
    assert!(
        !receive_from_own_host(&mut barrier, report(4, 4)),
        "a report of another TTI"
    );
    assert!(
        !receive_from_own_host(&mut barrier, report(10, 5)),
        "a report of an unknown device"
    );
    assert!(
        !barrier.receive_report(HostId(1), report(4, 5)),
        "another host's device"
    );
    assert!(receive_from_own_host(&mut barrier, report(4, 5)));
    assert_eq!(barrier.take_grant_result().reports.len(), 2);
    // The answer to another grant and the report of another TTI are late, as after a retransmission, and are not
    // counted.
    assert_eq!(barrier.unexpected_messages(), 5);
}

#[test]
fn a_later_answer_replaces_one_with_a_wrong_number_of_reports() {
    let mut barrier = waiting_barrier(true);
    assert!(
        !barrier.receive_answer(HostId(0), grant_done(0, 5, 3)),
        "a wrong number of reports"
    );
    assert!(!barrier.receive_answer(HostId(1), grant_done(1, 5, 0)));
    assert!(barrier.receive_answer(HostId(0), grant_done(0, 5, 0)));
}

#[test]
fn without_an_event_no_report_is_accepted() {
    let mut barrier = waiting_barrier(false);
    assert!(!receive_from_own_host(&mut barrier, report(3, 5)));
    assert!(!barrier.receive_answer(HostId(0), grant_done(0, 5, 1)));
    for unable in [UnableDetectors::UNPOWERED, UnableDetectors::FAILED] {
        assert!(!barrier.receive_answer(HostId(0), grant_done_with(0, 5, 0, unable)));
    }
    assert!(
        !barrier.receive_answer(HostId(0), grant_done(0, 5, 0))
            && barrier.receive_answer(HostId(1), grant_done(1, 5, 0))
    );
    assert_eq!(
        (barrier.take_grant_result().reports.len(), barrier.unexpected_messages()),
        (0, 4)
    );
}

#[test]
fn devices_that_could_not_sense_are_added_over_the_hosts() {
    let mut barrier = waiting_barrier(true);
    barrier.receive_answer(HostId(0), grant_done_with(0, 5, 0, UnableDetectors::FAILED));
    let both = UnableDetectors {
        unpowered: 2,
        failed: 3,
    };
    assert!(barrier.receive_answer(HostId(1), grant_done_with(1, 5, 0, both)));
    let expected = UnableDetectors {
        unpowered: 2,
        failed: 4,
    };
    assert_eq!(barrier.take_grant_result().unable, expected);
}

#[test]
fn repeated_messages_after_a_takeover_count_once() {
    let mut barrier = waiting_barrier(true);
    barrier.receive_answer(HostId(0), grant_done(0, 5, 1));
    receive_from_own_host(&mut barrier, report(3, 5));
    let successor = Assignment {
        host: HostId(2),
        ..barrier.roster_mut().assignment(0)
    };
    barrier.roster_mut().replace(HostId(0), successor);
    assert!(
        !barrier.receive_answer(HostId(0), grant_done(0, 5, 1)),
        "host 0 is replaced"
    );
    assert!(
        !barrier.receive_report(HostId(2), report(3, 5)) && !barrier.receive_answer(HostId(2), grant_done(2, 5, 1))
    );
    assert!(barrier.receive_answer(HostId(1), grant_done(1, 5, 0)));
    assert_eq!(barrier.take_grant_result().reports.len(), 1);
    barrier.receive_answer(HostId(2), grant_done(2, 5, 1));
    assert_eq!(
        barrier.unexpected_messages(),
        1,
        "late answers of the new host are expected"
    );
}

#[test]
fn a_wake_up_waits_for_its_device() {
    let no_report = |tti| HostAnswer::NoReport {
        device: DeviceId(3),
        tti: Tti(tti),
        outcome: WakeOutcome::Missed,
    };
    let mut barrier = Barrier::new(two_host_roster());
    barrier.expect_wake(Tti(5), DeviceId(3));
    assert!(!receive_from_own_host(&mut barrier, report(4, 5)));
    assert!(!barrier.receive_answer(HostId(0), no_report(4)));
    assert!(
        !barrier.receive_answer(HostId(1), no_report(5)),
        "another host's device"
    );
    assert_eq!(barrier.missing_hosts(), [HostId(0)]);
    assert!(barrier.receive_answer(HostId(0), no_report(5)));
    assert_eq!(barrier.take_wake_outcome(), WakeOutcome::Missed);
}
