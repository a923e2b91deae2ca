//! The machine against its diagram, and against a device that executes the TTIs one by one.

mod step_by_step;

use std::sync::Arc;

use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::harvest::{HarvestSetup, TraceSetup};
use reveille_common::ids::{DeviceId, EventId, Tti};
use reveille_common::message::{DeviceSetup, FailedTransmission, Report, WakeOutcome};
use reveille_common::plan::DutyCycle;
use reveille_common::radio::RadioSettings;
use reveille_common::scenario::{EnergyModel, TraceEnd};
use reveille_common::sensing::{DetectionKind, Fusion, Sensing};
use reveille_common::totals::EnergyByState;
use reveille_common::units::Energy;

use super::{DeviceState, Machine, Physics, SenseOutcome};

/// The number of warm-up TTIs.
pub(super) const MEASURED_FROM: Tti = Tti(7);
pub(super) const ASLEEP: DeviceState = DeviceState::Sleep { powered: true };
pub(super) const DARK: DeviceState = DeviceState::Sleep { powered: false };
/// A distance within the sensing range, m, and the information of a report from there: exp(−3).
pub(super) const NEAR: f64 = 3.0;
pub(super) const WORTH: f64 = 0.049_787_068_367_863_944;
/// A distance beyond the sensing range, m.
pub(super) const FAR: f64 = 5.0;

pub(super) const fn micro(n: u64) -> Energy {
    Energy::from_micro(n)
}

/// E_idle = 10, E_WuR = 1 and E_Tx = 100 micro-units, in a battery of 1000.
pub(super) fn costs(initial: u64) -> EnergyModel {
    EnergyModel {
        e_max: micro(1000),
        e_idle: micro(10),
        e_wur: micro(1),
        e_tx: micro(100),
        initial: micro(initial),
    }
}

/// A device at the origin that harvests `rows`, one a TTI, cyclically.
pub(super) fn device(energy: EnergyModel, rows: &[u64]) -> (Machine, Physics) {
    device_with(RadioSettings::default(), energy, rows)
}

/// Creates such a device with a radio that may fail.
pub(super) fn device_with(radio: RadioSettings, energy: EnergyModel, rows: &[u64]) -> (Machine, Physics) {
    let setup = DeviceSetup {
        id: DeviceId(7),
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
        d_max: 4.0,
        eta: 1.0,
        psi: 1.0,
        g: Fusion::Max,
    };
    let rows = rows.iter().copied().map(micro).collect();
    let world = Physics::new(
        1,
        MEASURED_FROM,
        sensing,
        radio,
        std::slice::from_ref(&setup),
        vec![Arc::new(rows)],
    );
    (Machine::new(&setup, &world), world)
}

/// A device that harvests nothing, with δ = 1 throughout if `senses`.
pub(super) fn dry(initial: u64, senses: bool) -> (Machine, Physics) {
    let (mut machine, world) = device(costs(initial), &[0]);
    if senses {
        machine.set_duty(Tti(0), DutyCycle::SENSING);
    }
    (machine, world)
}

pub(super) fn event(distance: f64) -> Stimulus {
    Stimulus {
        event: EventId(0),
        epicentre: Point { x: distance, y: 0.0 },
    }
}

pub(super) fn assert_worth(report: &Report, worth: f64) {
    assert!((report.information - worth).abs() < 1e-15, "{report:?}");
}

#[test]
fn a_new_device_sleeps_with_its_initial_battery() {
    let (machine, _) = dry(500, false);
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(500)));
    assert_eq!(machine.id(), DeviceId(7));
}

#[test]
fn a_false_wake_costs_e_idle_in_s4_and_leaves_a_device_that_hears() {
    let always = RadioSettings {
        false_wake_up: 1.0,
        ..RadioSettings::default()
    };
    let (mut machine, world) = device_with(always, costs(500), &[0]);
    machine.begin(Tti(0));
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(489)));
    assert!(matches!(
        machine.wake(Tti(0), Some(&event(NEAR)), &world),
        WakeOutcome::Reported(_)
    ));
    machine.set_duty(Tti(1), DutyCycle::SENSING);
    machine.begin(Tti(1));
    assert_eq!(machine.battery(), micro(379), "a device in S1 is awake anyway");
    machine.advance_to(Tti(2));
    let totals = machine.totals();
    assert_eq!(
        (totals.false_wake_ups, totals.spent.sleep, totals.spent.sensing),
        (1, micro(11), micro(10))
    );
    // It cannot pay for the second: the remaining energy is lost, and it is unpowered.
    let (mut machine, world) = device_with(always, costs(16), &[0]);
    machine.begin(Tti(1));
    assert_eq!((machine.state(), machine.battery()), (DARK, micro(0)));
    assert_eq!(machine.wake(Tti(1), Some(&event(NEAR)), &world), WakeOutcome::Missed);
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
    let deaf = RadioSettings {
        wake_miss: 1.0,
        ..RadioSettings::default()
    };
    let (mut machine, world) = device_with(deaf, costs(500), &[0]);
    assert_eq!(machine.wake(Tti(3), Some(&event(NEAR)), &world), WakeOutcome::Missed);
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(496)));
}

#[test]
fn s4_to_s1_pays_e_idle_and_back_e_wur() {
    let (mut machine, _) = dry(500, true);
    machine.begin(Tti(0));
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Idle, micro(490)));
    machine.set_duty(Tti(1), DutyCycle::ASLEEP);
    machine.begin(Tti(1));
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(489)));
}

#[test]
fn beginning_a_tti_twice_pays_once() {
    let (mut machine, world) = dry(500, true);
    machine.begin(Tti(0));
    machine.begin(Tti(0));
    assert_eq!(machine.sense(Tti(0), &event(FAR), &world), SenseOutcome::Nothing);
    assert_eq!(machine.battery(), micro(490));
}

#[test]
fn s1_to_s3_reports_and_pays_e_tx() {
    let (mut machine, world) = dry(500, true);
    let SenseOutcome::Reported(report) = machine.sense(Tti(0), &event(NEAR), &world) else {
        panic!("{machine:?}")
    };
    assert_eq!(
        (report.device, report.tti, report.battery),
        (DeviceId(7), Tti(0), micro(390))
    );
    assert_worth(&report, WORTH);
    assert_eq!(
        (machine.state(), machine.battery()),
        (DeviceState::Transmission, micro(390))
    );
    // S3 lasts to the end of the TTI: it neither senses again nor receives a wake-up.
    assert_eq!(machine.sense(Tti(0), &event(NEAR), &world), SenseOutcome::Nothing);
    assert_eq!(machine.wake(Tti(0), Some(&event(NEAR)), &world), WakeOutcome::Missed);
    machine.begin(Tti(1));
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Idle, micro(380)));
}

#[test]
fn s3_to_s4_where_delta_is_0_in_the_next_tti() {
    let (mut machine, world) = dry(500, true);
    machine.sense(Tti(0), &event(NEAR), &world);
    machine.set_duty(Tti(1), DutyCycle::ASLEEP);
    machine.begin(Tti(1));
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(389)));
}

#[test]
fn an_event_out_of_reach_or_asleep_is_not_sensed() {
    let (mut machine, world) = dry(500, true);
    assert_eq!(machine.sense(Tti(0), &event(FAR), &world), SenseOutcome::Nothing);
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Idle, micro(490)));
    let (mut machine, world) = dry(500, false);
    assert_eq!(machine.sense(Tti(0), &event(NEAR), &world), SenseOutcome::Nothing);
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(499)));
}

#[test]
fn s2_to_s4_where_e_tx_cannot_be_paid_drains_the_battery() {
    let (mut machine, world) = dry(109, true);
    let failure = FailedTransmission {
        device: DeviceId(7),
        drained_energy: micro(99),
    };
    assert_eq!(
        machine.sense(Tti(0), &event(NEAR), &world),
        SenseOutcome::Failed(failure)
    );
    assert_eq!((machine.state(), machine.battery()), (DARK, micro(0)));
    assert_eq!(machine.wake(Tti(0), Some(&event(NEAR)), &world), WakeOutcome::Missed);
    machine.advance_to(Tti(1));
    let spent = EnergyByState {
        sensing: micro(10),
        report: micro(99),
        ..EnergyByState::default()
    };
    assert_eq!(
        machine.totals().spent,
        spent,
        "what is drained is spent in the state that failed"
    );
    let (mut machine, world) = dry(110, true);
    assert!(
        matches!(machine.sense(Tti(0), &event(NEAR), &world), SenseOutcome::Reported(_)),
        "just enough"
    );
}

#[test]
fn s4_to_s3_by_a_wake_up_that_is_heard() {
    let (mut machine, world) = dry(500, false);
    let WakeOutcome::Reported(report) = machine.wake(Tti(3), Some(&event(NEAR)), &world) else {
        panic!("{machine:?}")
    };
    assert_eq!(
        (report.tti, report.battery),
        (Tti(3), micro(396)),
        "four TTIs of E_WuR, one E_Tx"
    );
    assert_worth(&report, WORTH);
    assert_eq!(machine.state(), DeviceState::Transmission);
}

#[test]
fn a_woken_device_out_of_reach_reports_nothing_of_worth() {
    let (mut machine, world) = dry(500, false);
    let WakeOutcome::Reported(report) = machine.wake(Tti(0), Some(&event(FAR)), &world) else {
        panic!("{machine:?}")
    };
    assert_worth(&report, 0.0);
    assert_eq!(machine.battery(), micro(399));
}

#[test]
fn a_wake_up_that_cannot_be_paid_drains_the_battery() {
    let (mut machine, world) = dry(100, false);
    let failure = FailedTransmission {
        device: DeviceId(7),
        drained_energy: micro(99),
    };
    assert_eq!(
        machine.wake(Tti(0), Some(&event(NEAR)), &world),
        WakeOutcome::Failed(failure)
    );
    assert_eq!((machine.state(), machine.battery()), (DARK, micro(0)));
}

#[test]
fn a_wake_up_is_unheard_in_s1_and_by_a_radio_without_power() {
    let (mut machine, world) = dry(500, true);
    assert_eq!(machine.wake(Tti(0), Some(&event(NEAR)), &world), WakeOutcome::Missed);
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Idle, micro(490)));
    let (mut machine, world) = dry(0, false);
    assert_eq!(machine.wake(Tti(0), Some(&event(NEAR)), &world), WakeOutcome::Missed);
    assert_eq!(machine.state(), DARK);
}

#[test]
fn a_device_that_cannot_pay_for_s1_is_drained_and_unpowered_until_it_harvests() {
    let (mut machine, world) = device(costs(9), &[0, 300]);
    machine.set_duty(Tti(0), DutyCycle::SENSING);
    assert_eq!(machine.sense(Tti(0), &event(NEAR), &world), SenseOutcome::Nothing);
    assert_eq!((machine.state(), machine.battery()), (DARK, micro(0)));
    assert_eq!(machine.wake(Tti(0), Some(&event(NEAR)), &world), WakeOutcome::Missed);
    assert!(matches!(
        machine.sense(Tti(1), &event(NEAR), &world),
        SenseOutcome::Reported(_)
    ));
    assert_eq!(machine.battery(), micro(300 - 10 - 100));
}

#[test]
fn a_harvest_comes_before_the_costs_and_overflows_before_them() {
    let (mut machine, _) = device(costs(995), &[20]);
    machine.begin(Tti(0));
    assert_eq!(machine.battery(), micro(999), "full, then E_WuR");
    let totals = machine.totals();
    assert_eq!((totals.harvested, totals.overflow), (micro(20), micro(15)));
}

#[test]
fn sums_count_the_ends_of_ttis() {
    let (mut machine, _) = dry(102, false);
    machine.begin(Tti(0));
    assert_eq!(
        (machine.totals().battery_sum, machine.totals().low_ttis),
        (0, 0),
        "TTI 0 has not ended"
    );
    machine.advance_to(Tti(4));
    let totals = machine.totals();
    assert_eq!(totals.battery_sum, 101 + 100 + 99 + 98);
    assert_eq!(totals.low_ttis, 2, "less than E_Tx after two of the four");
}

#[test]
#[should_panic(expected = "has begun")]
fn a_tti_does_not_end_before_it_has_begun() {
    let (mut machine, _) = dry(500, false);
    machine.begin(Tti(5));
    machine.advance_to(Tti(5));
}
