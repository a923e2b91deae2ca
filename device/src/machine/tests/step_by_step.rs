//! The lazy machine against a device that executes the TTIs one by one, in plain integers.

use proptest::prelude::*;
use reveille_common::ids::Tti;
use reveille_common::message::WakeOutcome;
use reveille_common::plan::DutyCycle;
use reveille_common::radio::RadioSettings;
use reveille_common::rng::{Geometric, Purpose, Stream, unit_for_pair};
use reveille_common::scenario::EnergyModel;
use reveille_common::totals::{DeviceTotals, EnergyByState, Ledger};
use reveille_common::units::Energy;

use super::{ASLEEP, DARK, FAR, MEASURED_FROM, NEAR, device_with, event, micro};
use crate::machine::{DeviceState, SenseOutcome};

/// An incident of a device in a TTI.
#[derive(Clone, Debug)]
enum Incident {
    /// No input to the machine.
    Quiet,
    /// The machine catches up.
    Settled,
    /// The world shows it an event, and a wake-up may follow.
    Event { distance: f64, is_woken: bool },
    /// A wake-up without a preceding event.
    Woken { distance: f64 },
    /// A wake-up that takes effect after the event is over.
    Late,
}

fn incident() -> impl Strategy<Value = Incident> {
    let distance = || prop_oneof![Just(NEAR), Just(FAR)];
    prop_oneof![
        6 => Just(Incident::Quiet),
        1 => Just(Incident::Settled),
        1 => (distance(), any::<bool>()).prop_map(|(distance, is_woken)| Incident::Event { distance, is_woken }),
        1 => distance().prop_map(|distance| Incident::Woken { distance }),
        1 => Just(Incident::Late),
    ]
}

fn duty_cycle() -> impl Strategy<Value = DutyCycle> {
    (1..12_u32, any::<u32>(), any::<u32>()).prop_map(|(t_drx, on, offset)| DutyCycle {
        t_on: on % (t_drx + 1),
        t_drx,
        offset: offset % t_drx,
    })
}

fn any_costs() -> impl Strategy<Value = EnergyModel> {
    (1..400_u64, 0..30_u64, 0..10_u64, 0..120_u64, 0..=100_u64).prop_map(|(e_max, idle, wur, tx, share)| EnergyModel {
        e_max: micro(e_max),
        e_idle: micro(idle),
        e_wur: micro(wur),
        e_tx: micro(tx),
        initial: micro(e_max * share / 100),
    })
}

/// A device that executes the TTIs one by one, in plain integers.
struct Plain {
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
    /// Whether the battery could not pay for anything, by TTI.
    failed: Vec<bool>,
    /// The totals before each TTI.
    before: Vec<DeviceTotals>,
}

impl Plain {
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
            failed: Vec::new(),
            before: Vec::new(),
        }
    }

    /// Pays `cost` and returns whether the battery held it; if not, the remaining energy is lost.
    fn pays(&mut self, cost: Energy, state: usize) -> bool {
        let is_paid = self.level >= cost.micro();
        let gone = if is_paid { cost.micro() } else { self.level };
        self.level -= gone;
        self.spent[state] += gone;
        is_paid
    }

    fn starts(&mut self, harvest: u64, delta: bool, is_startled: bool) {
        self.before.push(self.totals());
        self.harvested += harvest;
        self.level += harvest;
        let overflow = self.level.saturating_sub(self.costs.e_max.micro());
        self.level -= overflow;
        self.overflow += overflow;
        let is_paid = if delta {
            self.pays(self.costs.e_idle, 0)
        } else {
            self.pays(self.costs.e_wur, 1)
        };
        self.sensing_ttis += u64::from(delta);
        self.failed_ttis += u64::from(delta && !is_paid);
        self.unpowered_ttis += u64::from(!delta && !is_paid);
        self.failed.push(!is_paid);
        self.state = match (delta, is_paid) {
            (true, true) => DeviceState::Idle,
            (false, true) => ASLEEP,
            (_, false) => DARK,
        };
        if is_startled && self.state == ASLEEP {
            self.wakes_for_nothing();
        }
    }

    /// Goes through a false wake-up and returns whether the battery could pay for it.
    fn wakes_for_nothing(&mut self) -> bool {
        self.false_wake_ups += 1;
        let is_paid = self.pays(self.costs.e_idle, 1);
        self.state = if is_paid { ASLEEP } else { DARK };
        is_paid
    }

    /// Transmits if the battery can pay; otherwise returns the energy lost in the attempt.
    fn transmits(&mut self) -> Result<(), u64> {
        let before = self.level;
        if self.pays(self.costs.e_tx, 2) {
            self.state = DeviceState::Transmission;
            Ok(())
        } else {
            self.state = DARK;
            Err(before)
        }
    }

    fn ends(&mut self) {
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
        let runs = self.failed.iter().skip(from).collect::<Vec<_>>();
        let longest = runs.split(|failed| !**failed).map(<[_]>::len).max();
        // The battery at the start of the measured part equals the one at the end of the TTI before.
        let measured = match self.before.get(from) {
            Some(before) => whole - *before,
            None if self.before.len() == from => DeviceTotals {
                initial: whole.battery,
                battery: whole.battery,
                ..DeviceTotals::default()
            },
            None => DeviceTotals::default(),
        };
        Ledger {
            whole,
            measured,
            longest_outage: longest.unwrap_or(0) as u64,
        }
    }
}

/// The outcome of an event or a wake-up, without its information.
type ReferenceOutcome = Option<Result<(), u64>>;

fn of_sensed(sensed: &SenseOutcome) -> ReferenceOutcome {
    match sensed {
        SenseOutcome::Nothing => None,
        SenseOutcome::Reported(_) => Some(Ok(())),
        SenseOutcome::Failed(failure) => Some(Err(failure.drained_energy.micro())),
    }
}

fn of_woken(woken: &WakeOutcome) -> ReferenceOutcome {
    match woken {
        WakeOutcome::Missed => None,
        WakeOutcome::Reported(_) => Some(Ok(())),
        WakeOutcome::Failed(failure) => Some(Err(failure.drained_energy.micro())),
        WakeOutcome::Lost(_) | WakeOutcome::Late { .. } => panic!("nothing is lost, and it was not late: {woken}"),
    }
}

/// Radios that never fail, fail rarely, and fail often.
fn any_radio() -> impl Strategy<Value = RadioSettings> {
    let p = || prop_oneof![1 => Just(0.0), 2 => 0.0..0.2_f64, 1 => 0.5..=1.0_f64];
    (p(), p()).prop_map(|(wake_miss, false_wake_up)| RadioSettings {
        wake_miss,
        false_wake_up,
        ..RadioSettings::default()
    })
}

/// Whether device 7 of a run with seed 1 has a false wake-up, for each of the first `ttis` TTIs: gap by gap.
fn startled(radio: &RadioSettings, ttis: u64) -> Vec<bool> {
    let (law, mut stream) = (
        Geometric::new(radio.false_wake_up),
        Stream::new(1, Purpose::FalseWakes, 7),
    );
    let mut gap = law.draw(&mut stream);
    let each = (0..ttis).map(|_| {
        gap -= 1;
        let is_due = gap == 0;
        if is_due {
            gap = law.draw(&mut stream);
        }
        is_due
    });
    each.collect()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn catching_up_is_doing_each_tti(
        costs in any_costs(),
        radio in any_radio(),
        rows in prop::collection::vec(prop_oneof![4 => Just(0), 1 => 0..200_u64], 1..30),
        steps in prop::collection::vec((incident(), prop::option::weighted(0.1, duty_cycle())), 1..120),
    ) {
        let (mut machine, world) = device_with(radio, costs, &rows);
        let startled = startled(&radio, steps.len() as u64);
        let mut plain = Plain::new(costs);
        let mut duty = DutyCycle::ASLEEP;
        for (k, (notification, new_duty)) in (0..).zip(&steps) {
            if let Some(new_duty) = new_duty {
                duty = *new_duty;
                machine.set_duty(Tti(k), duty);
            }
            let delta = (k + u64::from(duty.offset)) % u64::from(duty.t_drx) < u64::from(duty.t_on);
            if matches!(notification, Incident::Settled) {
                machine.advance_to(Tti(k));
                prop_assert_eq!(machine.totals(), plain.totals(), "before TTI {}", k);
            }
            plain.starts(rows[k as usize % rows.len()], delta, startled[k as usize]);
            if let Incident::Event { distance, .. } = *notification {
                let is_sensed = plain.state == DeviceState::Idle && distance <= 4.0;
                let expected = is_sensed.then(|| plain.transmits());
                prop_assert_eq!(of_sensed(&machine.sense(Tti(k), &event(distance), &world)), expected, "TTI {}", k);
            }
            if let Incident::Woken { distance } | Incident::Event { distance, is_woken: true } = *notification {
                let hears = unit_for_pair(1, Purpose::WakeMiss, 7, k) >= radio.wake_miss;
                let expected = (plain.state == ASLEEP && hears).then(|| plain.transmits());
                prop_assert_eq!(of_woken(&machine.wake(Tti(k), Some(&event(distance)), &world)), expected, "TTI {}", k);
            }
            if matches!(notification, Incident::Late) {
                let hears = unit_for_pair(1, Purpose::WakeMiss, 7, k) >= radio.wake_miss;
                let expected = if plain.state == ASLEEP && hears {
                    let before = plain.level;
                    let powered = plain.wakes_for_nothing();
                    WakeOutcome::Late { spent: micro(before - plain.level), powered }
                } else {
                    WakeOutcome::Missed
                };
                prop_assert_eq!(machine.wake(Tti(k), None, &world), expected, "TTI {}", k);
            }
            if matches!(notification, Incident::Event { .. } | Incident::Woken { .. } | Incident::Late) {
                prop_assert_eq!((machine.state(), machine.battery()), (plain.state, micro(plain.level)), "TTI {}", k);
            }
            plain.ends();
        }
        machine.advance_to(Tti(steps.len() as u64));
        prop_assert_eq!(machine.ledger(), plain.ledger());
        prop_assert!(machine.ledger().is_valid());
    }

    /// Spans longer than `MAX_SPAN_TTIS`.
    #[test]
    fn catching_up_with_many_ttis_is_doing_each(
        costs in any_costs(),
        scale in 1..2000_u64,
        radio in any_radio(),
        duty in duty_cycle(),
        ttis in 1..40_000_u64,
        harvest in 0..400_u64,
    ) {
        let costs = EnergyModel {
            e_max: costs.e_max.times(scale),
            initial: costs.initial.times(scale),
            ..costs
        };
        let mut rows = vec![0; 10_007];
        rows[5] = harvest * scale;
        let (mut machine, _) = device_with(radio, costs, &rows);
        let startled = startled(&radio, ttis);
        machine.set_duty(Tti(0), duty);
        let mut plain = Plain::new(costs);
        for k in 0..ttis {
            plain.starts(
                rows[k as usize % rows.len()],
                (k + u64::from(duty.offset)) % u64::from(duty.t_drx) < u64::from(duty.t_on),
                startled[k as usize],
            );
            plain.ends();
        }
        machine.advance_to(Tti(ttis));
        prop_assert_eq!(machine.ledger(), plain.ledger());
    }
}
