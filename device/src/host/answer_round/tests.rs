//! Tests of [`AnswerRound`]: it answers once, when all parts have arrived, and repeats the same answer on request.
//! Nothing is sent: parts are added by `add_part`, without an uplink. All numbers are arbitrary.

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{FailedTransmission, HostAnswer, Report, UnableDetectors};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::units::Energy;

use super::{AnswerRound, DeviceAnswer};
use crate::grant_follower::HostRequest;

const HOST: HostId = HostId(3);
const TTI: Tti = Tti(41);

fn report(device: u32) -> Report {
    Report {
        device: DeviceId(device),
        tti: TTI,
        information: 0.5,
        battery: Energy::from_micro(9),
    }
}

fn ledger(harvested: u64) -> Ledger {
    Ledger {
        whole: totals(harvested),
        ..Ledger::default()
    }
}

fn totals(harvested: u64) -> DeviceTotals {
    DeviceTotals {
        harvested: Energy::from_micro(harvested),
        ..DeviceTotals::default()
    }
}

fn grant_done(reports: u32) -> HostAnswer {
    HostAnswer::GrantDone {
        host: HOST,
        tti: TTI,
        reports,
        failures: Vec::new(),
        unable: UnableDetectors::default(),
        totals: None,
        views: None,
    }
}

#[test]
fn a_round_without_devices_is_answered_by_the_host_alone() {
    let round = AnswerRound::new(HOST, HostRequest::Grant(TTI), 0);
    assert_eq!(round.add_part(&DeviceAnswer::Nothing), Some(grant_done(0)));
}

#[test]
fn the_last_part_answers_once() {
    let round = AnswerRound::new(HOST, HostRequest::Grant(TTI), 2);
    assert_eq!(round.add_part(&DeviceAnswer::Nothing), None, "the part of the host");
    assert_eq!(round.add_part(&DeviceAnswer::Reported(report(1))), None);
    assert_eq!(round.add_part(&DeviceAnswer::Reported(report(0))), Some(grant_done(2)));
}

#[test]
fn a_device_can_answer_before_the_part_of_the_host() {
    let round = AnswerRound::new(HOST, HostRequest::Grant(TTI), 1);
    assert_eq!(round.add_part(&DeviceAnswer::Reported(report(1))), None);
    assert_eq!(round.add_part(&DeviceAnswer::Nothing), Some(grant_done(1)));
}

#[test]
fn a_round_is_repeated_unchanged_after_its_completion_only() {
    let round = AnswerRound::new(HOST, HostRequest::Grant(TTI), 2);
    assert_eq!(round.completed(), None);
    round.add_part(&DeviceAnswer::Reported(report(1)));
    round.add_part(&DeviceAnswer::Nothing);
    assert_eq!(round.completed(), None, "one part is missing");
    let answer = round.add_part(&DeviceAnswer::Reported(report(0))).expect("the answer");
    let repeated = (vec![report(1), report(0)], answer);
    assert_eq!(round.completed(), Some(repeated.clone()));
    assert_eq!(round.completed(), Some(repeated));
}

#[test]
fn a_grant_collects_failures_totals_and_views() {
    let failure = FailedTransmission {
        device: DeviceId(4),
        drained_energy: Energy::from_micro(2),
    };
    let round = AnswerRound::new(HOST, HostRequest::Grant(TTI), 8);
    let view = |device: u32| DeviceView {
        state: DeviceState::Idle,
        battery: Energy::from_micro(u64::from(10 * device)),
    };
    let view_part = |device: u32| DeviceAnswer::View(DeviceId(device), view(device));
    for part in [
        DeviceAnswer::Failed(failure),
        DeviceAnswer::Unable(UnableDetectors::UNPOWERED),
        view_part(5),
        DeviceAnswer::Unable(UnableDetectors::FAILED),
        view_part(4),
        DeviceAnswer::Ledger(DeviceId(4), Box::new(ledger(3))),
        DeviceAnswer::Ledger(DeviceId(5), Box::new(ledger(8))),
        DeviceAnswer::Unable(UnableDetectors::UNPOWERED),
    ] {
        assert_eq!(round.add_part(&part), None);
    }
    let expected = HostAnswer::GrantDone {
        host: HOST,
        tti: TTI,
        reports: 0,
        failures: vec![failure],
        unable: UnableDetectors {
            unpowered: 2,
            failed: 1,
        },
        totals: Some(totals(11)),
        views: Some(vec![view(4), view(5)]),
    };
    assert_eq!(round.add_part(&DeviceAnswer::Nothing), Some(expected));
}

#[test]
fn ledgers_are_collected_by_device() {
    let round = AnswerRound::new(HOST, HostRequest::Ledgers, 2);
    round.add_part(&DeviceAnswer::Nothing);
    round.add_part(&DeviceAnswer::Ledger(DeviceId(4), Box::new(ledger(3))));
    let expected = HostAnswer::Ledgers {
        host: HOST,
        ledgers: vec![(DeviceId(4), ledger(3)), (DeviceId(5), ledger(8))],
    };
    assert_eq!(
        round.add_part(&DeviceAnswer::Ledger(DeviceId(5), Box::new(ledger(8)))),
        Some(expected)
    );
}
