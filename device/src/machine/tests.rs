//! The machine against what its diagram says, and against a device that does every TTI one by one.

use std::sync::Arc;

use proptest::prelude::*;
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::harvest::{HarvestSetup, TraceSetup};
use reveille_common::ids::{DeviceId, EventId, Tti};
use reveille_common::message::{DeviceSetup, Failure, Report, WakeOutcome};
use reveille_common::plan::DutyCycle;
use reveille_common::radio::Radio;
use reveille_common::rng::{Geometric, Purpose, Stream, unit_for_pair};
use reveille_common::scenario::{EnergyModel, TraceEnd};
use reveille_common::sensing::{DetectionKind, Fusion, Sensing};
use reveille_common::totals::{DeviceTotals, Ledger, Spent};
use reveille_common::units::Energy;

use super::{DeviceState, Machine, Physics, Sensed};

/// TTIs of warm-up.
const MEASURED_FROM: Tti = Tti(7);
const ASLEEP: DeviceState = DeviceState::Sleep { powered: true };
const DARK: DeviceState = DeviceState::Sleep { powered: false };
/// Within the sensing range, and what a report from there is worth: exp(−3).
const NEAR: f64 = 3.0;
const WORTH: f64 = 0.049_787_068_367_863_944;
/// Beyond it.
const FAR: f64 = 5.0;

const fn micro(n: u64) -> Energy {
    Energy::from_micro(n)
}

/// E_idle = 10, E_WuR = 1 and E_Tx = 100 micro-units, in a battery of 1000.
fn costs(initial: u64) -> EnergyModel {
    EnergyModel {
        e_max: micro(1000),
        e_idle: micro(10),
        e_wur: micro(1),
        e_tx: micro(100),
        initial: micro(initial),
    }
}

/// A device at the origin that harvests `rows`, one a TTI, over and over.
fn device(energy: EnergyModel, rows: &[u64]) -> (Machine, Physics) {
    device_with(Radio::default(), energy, rows)
}

/// The same with a radio that may fail.
fn device_with(radio: Radio, energy: EnergyModel, rows: &[u64]) -> (Machine, Physics) {
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
fn dry(initial: u64, senses: bool) -> (Machine, Physics) {
    let (mut machine, world) = device(costs(initial), &[0]);
    if senses {
        machine.set_duty(Tti(0), DutyCycle::SENSING);
    }
    (machine, world)
}

fn event(distance: f64) -> Stimulus {
    Stimulus {
        event: EventId(0),
        epicentre: Point { x: distance, y: 0.0 },
    }
}

fn assert_worth(report: &Report, worth: f64) {
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
    let always = Radio {
        false_wake: 1.0,
        ..Radio::default()
    };
    let (mut machine, world) = device_with(always, costs(500), &[0]);
    machine.begin(Tti(0));
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(489)));
    assert!(matches!(
        machine.wake(Tti(0), &event(NEAR), &world),
        WakeOutcome::Reported(_)
    ));
    machine.set_duty(Tti(1), DutyCycle::SENSING);
    machine.begin(Tti(1));
    assert_eq!(machine.battery(), micro(379), "a device in S1 is awake anyway");
    machine.settle(Tti(2));
    let totals = machine.totals();
    assert_eq!(
        (totals.false_wakes, totals.spent.sleep, totals.spent.sensing),
        (1, micro(11), micro(10))
    );
    // It cannot pay for the second: what is left is lost, and it is deaf.
    let (mut machine, world) = device_with(always, costs(16), &[0]);
    machine.begin(Tti(1));
    assert_eq!((machine.state(), machine.battery()), (DARK, micro(0)));
    assert_eq!(machine.wake(Tti(1), &event(NEAR), &world), WakeOutcome::Unheard);
    machine.settle(Tti(2));
    let totals = machine.totals();
    assert_eq!(
        (totals.false_wakes, totals.dark_ttis, totals.spent.sleep),
        (2, 0, micro(16))
    );
    assert!(totals.closes());
}

#[test]
fn a_missed_wake_up_costs_nothing() {
    let deaf = Radio {
        wake_miss: 1.0,
        ..Radio::default()
    };
    let (mut machine, world) = device_with(deaf, costs(500), &[0]);
    assert_eq!(machine.wake(Tti(3), &event(NEAR), &world), WakeOutcome::Unheard);
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
    assert_eq!(machine.sense(Tti(0), &event(FAR), &world), Sensed::Nothing);
    assert_eq!(machine.battery(), micro(490));
}

#[test]
fn s1_to_s3_reports_and_pays_e_tx() {
    let (mut machine, world) = dry(500, true);
    let Sensed::Reported(report) = machine.sense(Tti(0), &event(NEAR), &world) else {
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
    // S3 lasts to the end of the TTI: it neither senses again nor hears a wake-up.
    assert_eq!(machine.sense(Tti(0), &event(NEAR), &world), Sensed::Nothing);
    assert_eq!(machine.wake(Tti(0), &event(NEAR), &world), WakeOutcome::Unheard);
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
    assert_eq!(machine.sense(Tti(0), &event(FAR), &world), Sensed::Nothing);
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Idle, micro(490)));
    let (mut machine, world) = dry(500, false);
    assert_eq!(machine.sense(Tti(0), &event(NEAR), &world), Sensed::Nothing);
    assert_eq!((machine.state(), machine.battery()), (ASLEEP, micro(499)));
}

#[test]
fn s2_to_s4_where_e_tx_cannot_be_paid_drains_the_battery() {
    let (mut machine, world) = dry(109, true);
    let failure = Failure {
        device: DeviceId(7),
        drained: micro(99),
    };
    assert_eq!(machine.sense(Tti(0), &event(NEAR), &world), Sensed::Failed(failure));
    assert_eq!((machine.state(), machine.battery()), (DARK, micro(0)));
    assert_eq!(machine.wake(Tti(0), &event(NEAR), &world), WakeOutcome::Unheard);
    machine.settle(Tti(1));
    let spent = Spent {
        sensing: micro(10),
        report: micro(99),
        ..Spent::default()
    };
    assert_eq!(
        machine.totals().spent,
        spent,
        "what is drained is spent in the state that failed"
    );
    let (mut machine, world) = dry(110, true);
    assert!(
        matches!(machine.sense(Tti(0), &event(NEAR), &world), Sensed::Reported(_)),
        "just enough"
    );
}

#[test]
fn s4_to_s3_by_a_wake_up_that_is_heard() {
    let (mut machine, world) = dry(500, false);
    let WakeOutcome::Reported(report) = machine.wake(Tti(3), &event(NEAR), &world) else {
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
    let WakeOutcome::Reported(report) = machine.wake(Tti(0), &event(FAR), &world) else {
        panic!("{machine:?}")
    };
    assert_worth(&report, 0.0);
    assert_eq!(machine.battery(), micro(399));
}

#[test]
fn a_wake_up_that_cannot_be_paid_drains_the_battery() {
    let (mut machine, world) = dry(100, false);
    let failure = Failure {
        device: DeviceId(7),
        drained: micro(99),
    };
    assert_eq!(machine.wake(Tti(0), &event(NEAR), &world), WakeOutcome::Failed(failure));
    assert_eq!((machine.state(), machine.battery()), (DARK, micro(0)));
}

#[test]
fn a_wake_up_is_unheard_in_s1_and_by_a_radio_without_power() {
    let (mut machine, world) = dry(500, true);
    assert_eq!(machine.wake(Tti(0), &event(NEAR), &world), WakeOutcome::Unheard);
    assert_eq!((machine.state(), machine.battery()), (DeviceState::Idle, micro(490)));
    let (mut machine, world) = dry(0, false);
    assert_eq!(machine.wake(Tti(0), &event(NEAR), &world), WakeOutcome::Unheard);
    assert_eq!(machine.state(), DARK);
}

#[test]
fn a_device_that_cannot_pay_for_s1_is_drained_and_deaf_until_it_harvests() {
    let (mut machine, world) = device(costs(9), &[0, 300]);
    machine.set_duty(Tti(0), DutyCycle::SENSING);
    assert_eq!(machine.sense(Tti(0), &event(NEAR), &world), Sensed::Nothing);
    assert_eq!((machine.state(), machine.battery()), (DARK, micro(0)));
    assert_eq!(machine.wake(Tti(0), &event(NEAR), &world), WakeOutcome::Unheard);
    assert!(matches!(
        machine.sense(Tti(1), &event(NEAR), &world),
        Sensed::Reported(_)
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
    machine.settle(Tti(4));
    let totals = machine.totals();
    assert_eq!(totals.battery_sum, 101 + 100 + 99 + 98);
    assert_eq!(totals.low_ttis, 2, "less than E_Tx after two of the four");
}

#[test]
#[should_panic(expected = "has begun")]
fn a_tti_does_not_end_before_it_has_begun() {
    let (mut machine, _) = dry(500, false);
    machine.begin(Tti(5));
    machine.settle(Tti(5));
}

/// What happens to a device in a TTI.
#[derive(Clone, Debug)]
enum Incident {
    /// Nothing that it is told of.
    Quiet,
    /// It is caught up with.
    Settled,
    /// The world shows it an event, and perhaps a wake-up follows.
    Event { distance: f64, is_woken: bool },
    /// It is woken without having been shown the event.
    Woken { distance: f64 },
}

fn happening() -> impl Strategy<Value = Incident> {
    let distance = || prop_oneof![Just(NEAR), Just(FAR)];
    prop_oneof![
        6 => Just(Incident::Quiet),
        1 => Just(Incident::Settled),
        1 => (distance(), any::<bool>()).prop_map(|(distance, is_woken)| Incident::Event { distance, is_woken }),
        1 => distance().prop_map(|distance| Incident::Woken { distance }),
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

/// The device that does each TTI one by one, in plain integers.
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
    dark_ttis: u64,
    false_wakes: u64,
    /// Whether each TTI so far began with a battery that could pay for nothing.
    failed: Vec<bool>,
    /// The sums before each TTI.
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
            dark_ttis: 0,
            false_wakes: 0,
            failed: Vec::new(),
            before: Vec::new(),
        }
    }

    /// Whether it could be paid for; if not, what there was is gone.
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
        self.dark_ttis += u64::from(!delta && !is_paid);
        self.failed.push(!is_paid);
        self.state = match (delta, is_paid) {
            (true, true) => DeviceState::Idle,
            (false, true) => ASLEEP,
            (_, false) => DARK,
        };
        if is_startled && self.state == ASLEEP {
            self.false_wakes += 1;
            if !self.pays(self.costs.e_idle, 1) {
                self.state = DARK;
            }
        }
    }

    /// Whether it transmits, where it comes to that: `Err` is what is lost in trying.
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
            spent: Spent { sensing, sleep, report },
            overflow: micro(self.overflow),
            battery: micro(self.level),
            battery_sum: self.battery_sum,
            low_ttis: self.low_ttis,
            sensing_ttis: self.sensing_ttis,
            failed_ttis: self.failed_ttis,
            dark_ttis: self.dark_ttis,
            false_wakes: self.false_wakes,
        }
    }

    fn ledger(&self) -> Ledger {
        let (whole, from) = (self.totals(), MEASURED_FROM.0 as usize);
        let runs = self.failed.iter().skip(from).collect::<Vec<_>>();
        let longest = runs.split(|failed| !**failed).map(<[_]>::len).max();
        // The battery at the start of the measured part is that of the TTI before.
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

/// What came of an event or a wake-up, without what it was worth.
type Came = Option<Result<(), u64>>;

fn of_sensed(sensed: &Sensed) -> Came {
    match sensed {
        Sensed::Nothing => None,
        Sensed::Reported(_) => Some(Ok(())),
        Sensed::Failed(failure) => Some(Err(failure.drained.micro())),
    }
}

fn of_woken(woken: &WakeOutcome) -> Came {
    match woken {
        WakeOutcome::Unheard => None,
        WakeOutcome::Reported(_) => Some(Ok(())),
        WakeOutcome::Failed(failure) => Some(Err(failure.drained.micro())),
        WakeOutcome::Lost(_) => panic!("a device does not know what is lost"),
    }
}

/// Radios that fail never, now and then, and often.
fn any_radio() -> impl Strategy<Value = Radio> {
    let p = || prop_oneof![1 => Just(0.0), 2 => 0.0..0.2_f64, 1 => 0.5..=1.0_f64];
    (p(), p()).prop_map(|(wake_miss, false_wake)| Radio {
        wake_miss,
        false_wake,
        ..Radio::default()
    })
}

/// In which of the first `ttis` TTIs something wakes device 7 of a run with seed 1 if it sleeps: gap by gap.
fn startled(radio: &Radio, ttis: u64) -> Vec<bool> {
    let (law, mut stream) = (Geometric::new(radio.false_wake), Stream::new(1, Purpose::FalseWakes, 7));
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
        steps in prop::collection::vec((happening(), prop::option::weighted(0.1, duty_cycle())), 1..120),
    ) {
        let (mut machine, world) = device_with(radio, costs, &rows);
        let startled = startled(&radio, steps.len() as u64);
        let mut plain = Plain::new(costs);
        let mut duty = DutyCycle::ASLEEP;
        for (k, (happening, new_duty)) in (0..).zip(&steps) {
            if let Some(new_duty) = new_duty {
                duty = *new_duty;
                machine.set_duty(Tti(k), duty);
            }
            let delta = (k + u64::from(duty.offset)) % u64::from(duty.t_drx) < u64::from(duty.t_on);
            if matches!(happening, Incident::Settled) {
                machine.settle(Tti(k));
                prop_assert_eq!(machine.totals(), plain.totals(), "before TTI {}", k);
            }
            plain.starts(rows[k as usize % rows.len()], delta, startled[k as usize]);
            if let Incident::Event { distance, .. } = *happening {
                let is_sensed = plain.state == DeviceState::Idle && distance <= 4.0;
                let expected = is_sensed.then(|| plain.transmits());
                prop_assert_eq!(of_sensed(&machine.sense(Tti(k), &event(distance), &world)), expected, "TTI {}", k);
            }
            if let Incident::Woken { distance } | Incident::Event { distance, is_woken: true } = *happening {
                let hears = unit_for_pair(1, Purpose::WakeMiss, 7, k) >= radio.wake_miss;
                let expected = (plain.state == ASLEEP && hears).then(|| plain.transmits());
                prop_assert_eq!(of_woken(&machine.wake(Tti(k), &event(distance), &world)), expected, "TTI {}", k);
            }
            if matches!(happening, Incident::Event { .. } | Incident::Woken { .. }) {
                prop_assert_eq!((machine.state(), machine.battery()), (plain.state, micro(plain.level)), "TTI {}", k);
            }
            plain.ends();
        }
        machine.settle(Tti(steps.len() as u64));
        prop_assert_eq!(machine.ledger(), plain.ledger());
        prop_assert!(machine.ledger().is_sound());
    }

    /// Spans that are longer than what is caught up with at a time.
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
        machine.settle(Tti(ttis));
        prop_assert_eq!(machine.ledger(), plain.ledger());
    }
}
