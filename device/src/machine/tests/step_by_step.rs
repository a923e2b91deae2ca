//! Tests of [`Machine`](crate::machine::Machine), which catches up with many TTIs at a time, against a device that
//! executes the TTIs one by one, in plain integers. Random costs, harvests, duty cycles, events, wake-ups and radio
//! faults are covered. The device never fails by an action, is never removed, and detects every event within d_max.

use proptest::prelude::*;
use reveille_common::ids::Tti;
use reveille_common::message::WakeOutcome;
use reveille_common::plan::DutyCycle;
use reveille_common::radio::RadioSettings;
use reveille_common::rng::{Geometric, Purpose, Stream, unit_for_pair};
use reveille_common::scenario::EnergyModel;
use reveille_common::totals::{DeviceTotals, EnergyByState, Ledger};
use reveille_common::units::Energy;

use super::{ASLEEP, D_MAX, DEVICE, FAR, MEASURED_FROM, NEAR, SEED, UNPOWERED, device_with, event_at, micro};
use crate::machine::{DeviceState, SenseOutcome};

/// Indices of the states in [`StepByStepDevice::spent`].
const SENSING: usize = 0;
const SLEEP: usize = 1;
const REPORT: usize = 2;

/// An input to a device in a TTI.
#[derive(Clone, Debug)]
enum Input {
    Nothing,
    /// The machine catches up before the TTI, in which nothing else happens.
    CatchUp,
    /// An event, and a wake-up after it if `is_woken`.
    Event {
        distance: f64,
        is_woken: bool,
    },
    /// A wake-up only.
    WakeUp {
        distance: f64,
    },
    /// A wake-up that takes effect after the event is over.
    LateWakeUp,
}

fn any_input() -> impl Strategy<Value = Input> {
    let distance = || prop_oneof![Just(NEAR), Just(FAR)];
    prop_oneof![
        6 => Just(Input::Nothing),
        1 => Just(Input::CatchUp),
        1 => (distance(), any::<bool>()).prop_map(|(distance, is_woken)| Input::Event { distance, is_woken }),
        1 => distance().prop_map(|distance| Input::WakeUp { distance }),
        1 => Just(Input::LateWakeUp),
    ]
}

fn any_duty_cycle() -> impl Strategy<Value = DutyCycle> {
    (1..12_u32, any::<u32>(), any::<u32>()).prop_map(|(t_drx, t_on, offset)| DutyCycle {
        t_on: t_on % (t_drx + 1),
        t_drx,
        offset: offset % t_drx,
    })
}

fn any_energy_model() -> impl Strategy<Value = EnergyModel> {
    (1..400_u64, 0..30_u64, 0..10_u64, 0..120_u64, 0..=100_u64).prop_map(
        |(e_max, e_idle, e_wur, e_tx, initial_percent)| EnergyModel {
            e_max: micro(e_max),
            e_idle: micro(e_idle),
            e_wur: micro(e_wur),
            e_tx: micro(e_tx),
            initial: micro(e_max * initial_percent / 100),
        },
    )
}

/// A device that executes the TTIs one by one, in plain integers. Energies are in micro-units.
struct StepByStepDevice {
    costs: EnergyModel,
    level: u64,
    state: DeviceState,
    harvested: u64,
    overflow: u64,
    /// By state: sensing, sleep, report.
    spent: [u64; 3],
    battery_sum: u128,
    low_ttis: u64,
    sensing_ttis: u64,
    failed_ttis: u64,
    unpowered_ttis: u64,
    false_wake_ups: u64,
    /// Whether the battery could not pay for δ, by TTI: the cause of an outage.
    unpaid: Vec<bool>,
    /// The totals before each TTI.
    totals_before: Vec<DeviceTotals>,
}

impl StepByStepDevice {
    fn new(costs: EnergyModel) -> Self {
        Self {
            costs,
            level: costs.initial.micro(),
            state: ASLEEP,
            harvested: 0,
            overflow: 0,
            spent: [0; 3],
            battery_sum: 0,
            low_ttis: 0,
            sensing_ttis: 0,
            failed_ttis: 0,
            unpowered_ttis: 0,
            false_wake_ups: 0,
            unpaid: Vec::new(),
            totals_before: Vec::new(),
        }
    }

    /// Pays `cost` and returns whether the battery held it; if not, the remaining energy is lost.
    fn pay(&mut self, cost: Energy, state: usize) -> bool {
        let is_paid = self.level >= cost.micro();
        let paid = if is_paid { cost.micro() } else { self.level };
        self.level -= paid;
        self.spent[state] += paid;
        is_paid
    }

    fn begin(&mut self, harvest: u64, delta: bool, has_false_wake_up: bool) {
        self.totals_before.push(self.totals());
        self.harvested += harvest;
        self.level += harvest;
        let overflow = self.level.saturating_sub(self.costs.e_max.micro());
        self.level -= overflow;
        self.overflow += overflow;
        let is_paid = if delta {
            self.pay(self.costs.e_idle, SENSING)
        } else {
            self.pay(self.costs.e_wur, SLEEP)
        };
        self.sensing_ttis += u64::from(delta);
        self.failed_ttis += u64::from(delta && !is_paid);
        self.unpowered_ttis += u64::from(!delta && !is_paid);
        self.unpaid.push(!is_paid);
        self.state = match (delta, is_paid) {
            (true, true) => DeviceState::Idle,
            (false, true) => ASLEEP,
            (_, false) => UNPOWERED,
        };
        if has_false_wake_up && self.state == ASLEEP {
            self.wake_without_report();
        }
    }

    /// Wakes without a report and returns whether the battery could pay for it.
    fn wake_without_report(&mut self) -> bool {
        self.false_wake_ups += 1;
        let is_paid = self.pay(self.costs.e_idle, SLEEP);
        self.state = if is_paid { ASLEEP } else { UNPOWERED };
        is_paid
    }

    /// Transmits if the battery can pay; otherwise returns the energy lost in the attempt.
    fn transmit(&mut self) -> Result<(), u64> {
        let level_before = self.level;
        if self.pay(self.costs.e_tx, REPORT) {
            self.state = DeviceState::Transmission;
            Ok(())
        } else {
            self.state = UNPOWERED;
            Err(level_before)
        }
    }

    fn end(&mut self) {
        self.battery_sum += u128::from(self.level);
        self.low_ttis += u64::from(self.level < self.costs.e_tx.micro());
    }

    fn totals(&self) -> DeviceTotals {
        let [sensing, sleep, report] = self.spent.map(micro);
        DeviceTotals {
            initial: self.costs.initial,
            harvested: micro(self.harvested),
            spent: EnergyByState { sensing, sleep, report },
            overflow: micro(self.overflow),
            battery: micro(self.level),
            battery_sum: self.battery_sum,
            low_ttis: self.low_ttis,
            sensing_ttis: self.sensing_ttis,
            failed_ttis: self.failed_ttis,
            unpowered_ttis: self.unpowered_ttis,
            false_wake_ups: self.false_wake_ups,
        }
    }

    fn ledger(&self) -> Ledger {
        let (whole, from) = (self.totals(), MEASURED_FROM.0 as usize);
        let unpaid = self.unpaid.iter().skip(from).collect::<Vec<_>>();
        let longest_outage = unpaid.split(|is_unpaid| !**is_unpaid).map(<[_]>::len).max();
        // The battery at the start of the measured part equals the one at the end of the TTI before.
        let measured = match self.totals_before.get(from) {
            Some(before) => whole - *before,
            None if self.totals_before.len() == from => DeviceTotals {
                initial: whole.battery,
                battery: whole.battery,
                ..DeviceTotals::default()
            },
            None => DeviceTotals::default(),
        };
        Ledger {
            whole,
            measured,
            longest_outage: longest_outage.unwrap_or(0) as u64,
        }
    }
}

/// The outcome of an event or a wake-up: no report, a report, or the energy lost in a failed one.
type ReportOutcome = Option<Result<(), u64>>;

fn outcome_of_sensing(sensed: &SenseOutcome) -> ReportOutcome {
    match sensed {
        SenseOutcome::Nothing | SenseOutcome::Failed | SenseOutcome::Unpowered => None,
        SenseOutcome::Reported(_) => Some(Ok(())),
        SenseOutcome::TransmissionFailed(failure) => Some(Err(failure.drained_energy.micro())),
    }
}

fn outcome_of_wake_up(woken: &WakeOutcome) -> ReportOutcome {
    match woken {
        WakeOutcome::Missed => None,
        WakeOutcome::Reported(_) => Some(Ok(())),
        WakeOutcome::Failed(failure) => Some(Err(failure.drained_energy.micro())),
        WakeOutcome::Lost(_) | WakeOutcome::Late { .. } => {
            panic!("the radio loses no report, and the wake-up was not late: {woken}")
        }
    }
}

/// Radios that never fail, fail rarely, and fail often.
fn any_radio() -> impl Strategy<Value = RadioSettings> {
    let probability = || prop_oneof![1 => Just(0.0), 2 => 0.0..0.2_f64, 1 => 0.5..=1.0_f64];
    (probability(), probability()).prop_map(|(wake_miss, false_wake_up)| RadioSettings {
        wake_miss,
        false_wake_up,
        ..RadioSettings::default()
    })
}

/// Returns whether the device of [`device_with`] has a false wake-up, for each of the first `ttis` TTIs.
fn draw_false_wake_ups(radio: &RadioSettings, ttis: u64) -> Vec<bool> {
    let (gap_distribution, mut stream) = (
        Geometric::new(radio.false_wake_up),
        Stream::new(SEED, Purpose::FalseWakeUps, u64::from(DEVICE.0)),
    );
    let mut gap = gap_distribution.draw(&mut stream);
    let is_due_by_tti = (0..ttis).map(|_| {
        gap -= 1;
        let is_due = gap == 0;
        if is_due {
            gap = gap_distribution.draw(&mut stream);
        }
        is_due
    });
    is_due_by_tti.collect()
}

/// Returns whether the device of [`device_with`] receives a wake-up signal in TTI `k`.
fn receives_wake_up(radio: &RadioSettings, k: u64) -> bool {
    unit_for_pair(SEED, Purpose::WakeMiss, u64::from(DEVICE.0), k) >= radio.wake_miss
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn catching_up_equals_single_ttis(
        energy in any_energy_model(),
        radio in any_radio(),
        rows in prop::collection::vec(prop_oneof![4 => Just(0), 1 => 0..200_u64], 1..30),
        steps in prop::collection::vec((any_input(), prop::option::weighted(0.1, any_duty_cycle())), 1..120),
    ) {
        let (mut machine, physics) = device_with(radio, energy, &rows);
        let false_wake_ups = draw_false_wake_ups(&radio, steps.len() as u64);
        let mut reference = StepByStepDevice::new(energy);
        let mut duty = DutyCycle::ASLEEP;
        for (k, (input, new_duty)) in (0..).zip(&steps) {
            if let Some(new_duty) = new_duty {
                duty = *new_duty;
                machine.set_duty(Tti(k), duty);
            }
            let delta = (k + u64::from(duty.offset)) % u64::from(duty.t_drx) < u64::from(duty.t_on);
            if matches!(input, Input::CatchUp) {
                machine.advance_to(Tti(k));
                prop_assert_eq!(machine.totals(), reference.totals(), "before TTI {}", k);
            }
            reference.begin(rows[k as usize % rows.len()], delta, false_wake_ups[k as usize]);
            if let Input::Event { distance, .. } = *input {
                let is_sensed = reference.state == DeviceState::Idle && distance <= D_MAX;
                let expected = is_sensed.then(|| reference.transmit());
                let outcome = outcome_of_sensing(&machine.sense(Tti(k), &event_at(distance), &physics));
                prop_assert_eq!(outcome, expected, "TTI {}", k);
            }
            if let Input::WakeUp { distance } | Input::Event { distance, is_woken: true } = *input {
                let receives = receives_wake_up(&radio, k);
                let expected = (reference.state == ASLEEP && receives).then(|| reference.transmit());
                let outcome = outcome_of_wake_up(&machine.wake(Tti(k), Some(&event_at(distance)), &physics));
                prop_assert_eq!(outcome, expected, "TTI {}", k);
            }
            if matches!(input, Input::LateWakeUp) {
                let receives = receives_wake_up(&radio, k);
                let expected = if reference.state == ASLEEP && receives {
                    let level_before = reference.level;
                    let powered = reference.wake_without_report();
                    WakeOutcome::Late { spent: micro(level_before - reference.level), powered }
                } else {
                    WakeOutcome::Missed
                };
                prop_assert_eq!(machine.wake(Tti(k), None, &physics), expected, "TTI {}", k);
            }
            if matches!(input, Input::Event { .. } | Input::WakeUp { .. } | Input::LateWakeUp) {
                let expected = (reference.state, micro(reference.level));
                prop_assert_eq!((machine.state(), machine.battery()), expected, "TTI {}", k);
            }
            reference.end();
        }
        machine.advance_to(Tti(steps.len() as u64));
        prop_assert_eq!(machine.ledger(), reference.ledger());
        prop_assert!(machine.ledger().is_valid());
    }

    /// Spans longer than `MAX_SPAN_TTIS` (8192): a harvest ends a span only once in 10 007 TTIs. A larger limit needs
    /// more rows here.
    #[test]
    fn catching_up_with_long_spans_equals_single_ttis(
        energy in any_energy_model(),
        scale in 1..2000_u64,
        radio in any_radio(),
        duty in any_duty_cycle(),
        ttis in 1..40_000_u64,
        harvest in 0..400_u64,
    ) {
        let energy = EnergyModel {
            e_max: energy.e_max.times(scale),
            initial: energy.initial.times(scale),
            ..energy
        };
        let mut rows = vec![0; 10_007];
        rows[5] = harvest * scale;
        let (mut machine, _) = device_with(radio, energy, &rows);
        let false_wake_ups = draw_false_wake_ups(&radio, ttis);
        machine.set_duty(Tti(0), duty);
        let mut reference = StepByStepDevice::new(energy);
        for k in 0..ttis {
            reference.begin(
                rows[k as usize % rows.len()],
                (k + u64::from(duty.offset)) % u64::from(duty.t_drx) < u64::from(duty.t_on),
                false_wake_ups[k as usize],
            );
            reference.end();
        }
        machine.advance_to(Tti(ttis));
        prop_assert_eq!(machine.ledger(), reference.ledger());
    }
}
