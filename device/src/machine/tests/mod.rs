//! Tests of [`Machine`]: each transition between S1 to S4 with its cost. `step_by_step` compares it with a device that
//! executes the TTIs one by one. Not tested here: other effects of failures (`tests/tests/actions.rs`), removal
//! (`tests/tests/device_removal.rs`) and checkpoints (takeovers and resumed runs in `tests/program/`).

mod step_by_step;

use std::sync::Arc;

use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::harvest::{HarvestSetup, TraceSetup};
use reveille_common::ids::{DeviceId, EventId, Tti};
use reveille_common::message::{Change, DeviceRange, DeviceSetup, FailedTransmission, Report, WakeOutcome};
use reveille_common::plan::DutyCycle;
use reveille_common::radio::RadioSettings;
use reveille_common::scenario::{EnergyModel, TraceEnd};
use reveille_common::sensing::{DetectionKind, Fusion, Sensing};
use reveille_common::totals::EnergyByState;
use reveille_common::units::Energy;

use super::{DeviceState, Machine, Physics, SenseOutcome};

/// The seed of the streams of [`device_with`].
pub(super) const SEED: u64 = 1;
/// The device of [`device_with`].
pub(super) const DEVICE: DeviceId = DeviceId(7);
/// The first measured TTI, after the warm-up.
pub(super) const MEASURED_FROM: Tti = Tti(7);
pub(super) const ASLEEP: DeviceState = DeviceState::Sleep { powered: true };
pub(super) const UNPOWERED: DeviceState = DeviceState::Sleep { powered: false };
/// Events up to this distance, m, are always detected.
pub(super) const D_MAX: f64 = 4.0;
/// A distance within d_max, m, and the information of a report from there: exp(−3), with the sensing model of
/// [`device_with`].
pub(super) const NEAR: f64 = 3.0;
pub(super) const NEAR_INFORMATION: f64 = 0.049_787_068_367_863_944;
/// A distance beyond d_max, m.
pub(super) const FAR: f64 = 5.0;

pub(super) const fn micro(n: u64) -> Energy {
    Energy::from_micro(n)
}

/// E_idle = 10, E_WuR = 1 and E_Tx = 100 micro-units, in a battery of 1000. The levels expected below follow from them.
pub(super) fn energy_model(initial: u64) -> EnergyModel {
    EnergyModel {
        e_max: micro(1000),
        e_idle: micro(10),
        e_wur: micro(1),
        e_tx: micro(100),
        initial: micro(initial),
    }
}

/// Creates a device at the origin, asleep, with a perfect radio, that harvests `rows`, one in each TTI, cyclically,
/// micro-units.
pub(super) fn device(energy: EnergyModel, rows: &[u64]) -> (Machine, Physics) {
    device_with(RadioSettings::default(), energy, rows)
}

/// Creates the device of [`device`], but with `radio`. The number of rows is the length of the cycle, TTIs.
pub(super) fn device_with(radio: RadioSettings, energy: EnergyModel, rows: &[u64]) -> (Machine, Physics) {
    let setup = DeviceSetup {
        id: DEVICE,
        position: Point { x: 0.0, y: 0.0 },
        energy,
        harvest: HarvestSetup::Trace(TraceSetup {
            trace: 0,
            ttis_per_row: 1,
            end: TraceEnd::Cycle,
        }),
    };
    let sensing = Sensing {
        kind: DetectionKind::Range,
        d_max: D_MAX,
        eta: 1.0,
        psi: 1.0,
        g: Fusion::Max,
    };
    let rows = rows.iter().copied().map(micro).collect();
    let physics = Physics::new(
        SEED,
        MEASURED_FROM,
        sensing,
        radio,
        std::slice::from_ref(&setup),
        vec![Arc::new(rows)],
    );
    (Machine::new(&setup, &physics), physics)
}

/// Creates a device that harvests nothing, with δ = 0 throughout.
fn sleeping_device(initial: u64) -> (Machine, Physics) {
    device(energy_model(initial), &[0])
}

/// Creates a device that harvests nothing, with δ = 1 throughout.
fn sensing_device(initial: u64) -> (Machine, Physics) {
    let (mut machine, physics) = sleeping_device(initial);
    machine.set_duty(Tti(0), DutyCycle::SENSING);
    (machine, physics)
}

/// An event at this distance from the device, m.
pub(super) fn event_at(distance: f64) -> Stimulus {
    Stimulus {
        event: EventId(0),
        epicentre: Point { x: distance, y: 0.0 },
    }
}

pub(super) fn assert_information(report: &Report, expected: f64) {
    assert!(
        (report.information - expected).abs() < 1e-15,
        "{report:?}, not information {expected}"
    );
}

#[test]
fn a_new_device_sleeps_with_its_initial_battery() {
    let (machine, _) = sleeping_device(500);
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(500)));
    assert_eq!(machine.id(), DEVICE);
}

#[test]
fn a_false_wake_up_costs_e_idle_in_s4_and_the_device_still_receives_wake_ups() {
    let radio = RadioSettings {
        false_wake_up: 1.0,
        ..RadioSettings::default()
    };
    let (mut machine, physics) = device_with(radio, energy_model(500), &[0]);
    machine.begin(Tti(0));
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(489)));
    assert!(matches!(
        machine.wake(Tti(0), Some(&event_at(NEAR)), &physics),
        WakeOutcome::Reported(_)
    ));
    machine.set_duty(Tti(1), DutyCycle::SENSING);
    machine.begin(Tti(1));
    assert_eq!(machine.battery(), micro(379), "a false wake-up costs nothing in S1");
    machine.advance_to(Tti(2));
    let totals = machine.totals();
    assert_eq!(
        (totals.false_wake_ups, totals.spent.sleep, totals.spent.sensing),
        (1, micro(11), micro(10))
    );
    // It cannot pay for the second: the remaining energy is lost, and it is unpowered.
    let (mut machine, physics) = device_with(radio, energy_model(16), &[0]);
    machine.begin(Tti(1));
    assert_eq!((machine.state(), machine.battery()), (UNPOWERED, micro(0)));
    assert_eq!(
        machine.wake(Tti(1), Some(&event_at(NEAR)), &physics),
        WakeOutcome::Missed
    );
    machine.advance_to(Tti(2));
    let totals = machine.totals();
    assert_eq!(
        (totals.false_wake_ups, totals.unpowered_ttis, totals.spent.sleep),
        (2, 0, micro(16))
    );
    assert!(totals.is_balanced());
}

#[test]
fn a_missed_wake_up_costs_nothing() {
    let radio = RadioSettings {
        wake_miss: 1.0,
        ..RadioSettings::default()
    };
    let (mut machine, physics) = device_with(radio, energy_model(500), &[0]);
    assert_eq!(
        machine.wake(Tti(3), Some(&event_at(NEAR)), &physics),
        WakeOutcome::Missed
    );
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(496)));
}

#[test]
fn s4_to_s1_pays_e_idle_and_back_e_wur() {
    let (mut machine, _) = sensing_device(500);
    machine.begin(Tti(0));
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Idle, micro(490)));
    machine.set_duty(Tti(1), DutyCycle::ASLEEP);
    machine.begin(Tti(1));
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(489)));
}

#[test]
fn beginning_a_tti_twice_pays_once() {
    let (mut machine, physics) = sensing_device(500);
    machine.begin(Tti(0));
    machine.begin(Tti(0));
    assert_eq!(machine.sense(Tti(0), &event_at(FAR), &physics), SenseOutcome::Nothing);
    assert_eq!(machine.battery(), micro(490));
}

#[test]
fn s1_to_s3_reports_and_pays_e_tx() {
    let (mut machine, physics) = sensing_device(500);
    let SenseOutcome::Reported(report) = machine.sense(Tti(0), &event_at(NEAR), &physics) else {
        panic!("{machine:?}")
    };
    assert_eq!(
        (report.device, report.tti, report.battery),
        (DEVICE, Tti(0), micro(390))
    );
    assert_information(&report, NEAR_INFORMATION);
    assert_eq!(
        (machine.state(), machine.battery()),
        (DeviceState::Transmission, micro(390))
    );
    // S3 lasts to the end of the TTI: it neither senses again nor receives a wake-up.
    assert_eq!(machine.sense(Tti(0), &event_at(NEAR), &physics), SenseOutcome::Nothing);
    assert_eq!(
        machine.wake(Tti(0), Some(&event_at(NEAR)), &physics),
        WakeOutcome::Missed
    );
    machine.begin(Tti(1));
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Idle, micro(380)));
}

#[test]
fn s3_to_s4_if_delta_is_0_in_the_next_tti() {
    let (mut machine, physics) = sensing_device(500);
    machine.sense(Tti(0), &event_at(NEAR), &physics);
    machine.set_duty(Tti(1), DutyCycle::ASLEEP);
    machine.begin(Tti(1));
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(389)));
}

#[test]
fn an_event_beyond_d_max_or_in_s4_is_not_sensed() {
    let (mut machine, physics) = sensing_device(500);
    assert_eq!(machine.sense(Tti(0), &event_at(FAR), &physics), SenseOutcome::Nothing);
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Idle, micro(490)));
    let (mut machine, physics) = sleeping_device(500);
    assert_eq!(machine.sense(Tti(0), &event_at(NEAR), &physics), SenseOutcome::Nothing);
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(499)));
}

#[test]
fn s2_to_s4_if_e_tx_exceeds_the_battery_which_is_drained() {
    let (mut machine, physics) = sensing_device(109);
    let failure = FailedTransmission {
        device: DEVICE,
        drained_energy: micro(99),
    };
    assert_eq!(
        machine.sense(Tti(0), &event_at(NEAR), &physics),
        SenseOutcome::TransmissionFailed(failure)
    );
    assert_eq!((machine.state(), machine.battery()), (UNPOWERED, micro(0)));
    assert_eq!(
        machine.wake(Tti(0), Some(&event_at(NEAR)), &physics),
        WakeOutcome::Missed
    );
    machine.advance_to(Tti(1));
    let spent = EnergyByState {
        sensing: micro(10),
        report: micro(99),
        ..EnergyByState::default()
    };
    assert_eq!(
        machine.totals().spent,
        spent,
        "the drained energy counts for the failed report"
    );
    let (mut machine, physics) = sensing_device(110);
    assert!(
        matches!(
            machine.sense(Tti(0), &event_at(NEAR), &physics),
            SenseOutcome::Reported(_)
        ),
        "the battery equals E_idle plus E_Tx"
    );
}

#[test]
fn s4_to_s3_by_a_received_wake_up() {
    let (mut machine, physics) = sleeping_device(500);
    let WakeOutcome::Reported(report) = machine.wake(Tti(3), Some(&event_at(NEAR)), &physics) else {
        panic!("{machine:?}")
    };
    assert_eq!(
        (report.tti, report.battery),
        (Tti(3), micro(396)),
        "four TTIs of E_WuR, one E_Tx"
    );
    assert_information(&report, NEAR_INFORMATION);
    assert_eq!(machine.state(), DeviceState::Transmission);
}

#[test]
fn a_woken_device_beyond_d_max_reports_no_information() {
    let (mut machine, physics) = sleeping_device(500);
    let WakeOutcome::Reported(report) = machine.wake(Tti(0), Some(&event_at(FAR)), &physics) else {
        panic!("{machine:?}")
    };
    assert_information(&report, 0.0);
    assert_eq!(machine.battery(), micro(399));
}

#[test]
fn a_wake_up_with_too_little_energy_for_a_report_drains_the_battery() {
    let (mut machine, physics) = sleeping_device(100);
    let failure = FailedTransmission {
        device: DEVICE,
        drained_energy: micro(99),
    };
    assert_eq!(
        machine.wake(Tti(0), Some(&event_at(NEAR)), &physics),
        WakeOutcome::Failed(failure)
    );
    assert_eq!((machine.state(), machine.battery()), (UNPOWERED, micro(0)));
}

#[test]
fn a_wake_up_is_missed_in_s1_and_without_power() {
    let (mut machine, physics) = sensing_device(500);
    assert_eq!(
        machine.wake(Tti(0), Some(&event_at(NEAR)), &physics),
        WakeOutcome::Missed
    );
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Idle, micro(490)));
    let (mut machine, physics) = sleeping_device(0);
    assert_eq!(
        machine.wake(Tti(0), Some(&event_at(NEAR)), &physics),
        WakeOutcome::Missed
    );
    assert_eq!(machine.state(), UNPOWERED);
}

#[test]
fn a_failed_device_would_detect_events_with_delta_1_within_d_max() {
    let (mut machine, physics) = sensing_device(500);
    let devices = DeviceRange {
        first: DEVICE,
        count: 1,
    };
    machine.apply(Tti(0), &Change::Fail(devices));
    assert_eq!(machine.sense(Tti(0), &event_at(FAR), &physics), SenseOutcome::Nothing);
    assert_eq!(machine.sense(Tti(0), &event_at(NEAR), &physics), SenseOutcome::Failed);
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Failed, micro(500)));
    let mut sleeping = machine.clone();
    sleeping.set_duty(Tti(1), DutyCycle::ASLEEP);
    assert_eq!(sleeping.sense(Tti(1), &event_at(NEAR), &physics), SenseOutcome::Nothing);
    machine.remove(Tti(0));
    assert_eq!(machine.sense(Tti(1), &event_at(NEAR), &physics), SenseOutcome::Nothing);
}

#[test]
fn a_device_with_too_little_energy_for_s1_is_unpowered_until_it_harvests() {
    let (mut machine, physics) = device(energy_model(9), &[0, 300]);
    machine.set_duty(Tti(0), DutyCycle::SENSING);
    assert_eq!(machine.sense(Tti(0), &event_at(FAR), &physics), SenseOutcome::Nothing);
    assert_eq!(
        machine.sense(Tti(0), &event_at(NEAR), &physics),
        SenseOutcome::Unpowered
    );
    assert_eq!((machine.state(), machine.battery()), (UNPOWERED, micro(0)));
    assert_eq!(
        machine.wake(Tti(0), Some(&event_at(NEAR)), &physics),
        WakeOutcome::Missed
    );
    assert!(matches!(
        machine.sense(Tti(1), &event_at(NEAR), &physics),
        SenseOutcome::Reported(_)
    ));
    assert_eq!(machine.battery(), micro(300 - 10 - 100));
}

#[test]
fn a_harvest_is_stored_and_overflows_before_costs_are_paid() {
    let (mut machine, _) = device(energy_model(995), &[20]);
    machine.begin(Tti(0));
    assert_eq!(machine.battery(), micro(999), "full, then E_WuR");
    let totals = machine.totals();
    assert_eq!((totals.harvested, totals.overflow), (micro(20), micro(15)));
}

#[test]
fn sums_include_the_end_of_each_tti() {
    let (mut machine, _) = sleeping_device(102);
    machine.begin(Tti(0));
    assert_eq!(
        (machine.totals().battery_sum, machine.totals().low_ttis),
        (0, 0),
        "TTI 0 has not ended"
    );
    machine.advance_to(Tti(4));
    let totals = machine.totals();
    assert_eq!(totals.battery_sum, 101 + 100 + 99 + 98);
    assert_eq!(totals.low_ttis, 2, "below E_Tx at the end of two TTIs");
}

#[test]
#[should_panic(expected = "has begun")]
fn advancing_to_a_tti_that_has_begun_panics() {
    let (mut machine, _) = sleeping_device(500);
    machine.begin(Tti(5));
    machine.advance_to(Tti(5));
}
