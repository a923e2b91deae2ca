//! One device as a state machine without I/O.
//!
//! ```text
//!            δ = 1, pays E_idle                detects the event
//!      ┌───────────────────────────► S1 idle ────────────────────► S2 active
//!      │                             │                              │    │
//!   S4 sleep ◄───────────────────────┘ δ = 0                        │    │ pays E_Tx
//!    │ ▲ ▲                                                          │    ▼
//!    │ │ └──────────────────────────────────────────────────────────┘   S3 transmission
//!    │ │       cannot pay E_Tx: the battery is emptied              ▲    │
//!    │ └────────────────────────────────────────────────────────────│────┘ next TTI, δ = 0 (to S1 if δ = 1)
//!    └──────────────────────────────────────────────────────────────┘
//!            wake-up heard (WuR powered)
//! ```
//! A device that cannot pay for S1 or for its wake-up radio ends up with an empty battery, in S4, deaf until the next
//! TTI. One that wakes for nothing, as its wake-up radio fails, goes S4 → S2 → S4 within a TTI, for E_idle on top of
//! E_WuR; unless that empties its battery it hears a wake-up in that TTI like any other in S4.
//!
//! The machine is lazy: TTIs in which nothing but harvest and δ happens are caught up with, exactly and many at a time,
//! when the device is next needed ([`Machine::settle`], [`Machine::begin`]).

use std::sync::Arc;

use reveille_common::codec;
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::harvest::{HarvestSource, Sources};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Checkpoint, DeviceSetup, Failure, Report, WakeOutcome};
use reveille_common::plan::DutyCycle;
use reveille_common::radio::Radio;
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::Sensing;
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::units::Energy;
use serde::{Deserialize, Serialize};

use crate::battery::Battery;
use crate::books::Books;
use crate::ears::Ears;

/// TTIs that are caught up with at a time: levels of up to 10¹⁰ micro-units, summed over that many, fit in 64 bits.
const LONGEST_SPAN: u64 = 1 << 13;

/// What an S1 device made of the stimulus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Sensed {
    /// Nothing: not in S1, out of range, or not detected.
    Nothing,
    /// S1 → S2 → S3.
    Reported(Report),
    /// S1 → S2 → S4.
    Failed(Failure),
}

/// The physics that all devices of a run share.
#[derive(Clone, Debug)]
pub struct Physics {
    /// Seed of the run's streams.
    pub seed: u64,
    /// The sensing model.
    pub sensing: Sensing,
    /// How the radio fails.
    pub radio: Radio,
    /// What the energy sources share.
    pub sources: Sources,
    /// The first measured TTI: what happens before it is warm-up.
    pub measured_from: Tti,
}

impl Physics {
    /// The physics of `devices`, with the streams of `seed`, measured from TTI `measured_from` on. `traces` are
    /// recorded energy per TTI by row.
    pub fn new(
        seed: u64,
        measured_from: Tti,
        sensing: Sensing,
        radio: Radio,
        devices: &[DeviceSetup],
        traces: Vec<Arc<Vec<Energy>>>,
    ) -> Self {
        Self {
            seed,
            measured_from,
            sensing,
            radio,
            sources: Sources::new(devices.iter().map(|d| &d.harvest), traces),
        }
    }
}

/// What a machine has become since TTI 0; all else of it follows from its setup and the seed.
#[derive(Serialize, Deserialize)]
struct Kept {
    battery: Battery,
    duty: DutyCycle,
    state: DeviceState,
    next: Tti,
    open: bool,
    books: Books,
    is_gone: bool,
}

/// One device.
#[derive(Clone, Debug)]
pub struct Machine {
    id: DeviceId,
    position: Point,
    costs: EnergyModel,
    battery: Battery,
    source: HarvestSource,
    duty: DutyCycle,
    state: DeviceState,
    /// The first TTI whose harvest and δ have not been applied.
    next: Tti,
    /// Whether TTI `next - 1` still waits for its end, when the battery is accounted.
    open: bool,
    books: Books,
    /// Whether it has gone for good: nothing happens to it any more.
    is_gone: bool,
    /// Its wake-up radio, where that fails.
    ears: Option<Box<Ears>>,
    /// The first TTI from `next` on in which it wakes for nothing if it is in S4.
    false_wake: Tti,
}

impl Machine {
    /// The device of `setup` before TTI 0, asleep until a plan says otherwise.
    pub fn new(setup: &DeviceSetup, physics: &Physics) -> Self {
        let ears = Ears::of(physics.seed, &physics.radio, setup.id);
        Self {
            id: setup.id,
            position: setup.position,
            costs: setup.energy,
            battery: Battery::new(&setup.energy),
            source: HarvestSource::new(&setup.harvest, &physics.sources, physics.seed, setup.id),
            duty: DutyCycle::ASLEEP,
            state: DeviceState::Sleep { powered: true },
            next: Tti::ZERO,
            open: false,
            books: Books::new(physics.measured_from),
            is_gone: false,
            false_wake: ears.as_ref().map_or(Tti::NEVER, |ears| ears.false_wake()),
            ears,
        }
    }

    /// The device as it is, for another process to go on with.
    pub fn checkpoint(&self) -> Checkpoint {
        Checkpoint(codec::encode(&Kept {
            battery: self.battery.clone(),
            duty: self.duty,
            state: self.state,
            next: self.next,
            open: self.open,
            books: self.books.clone(),
            is_gone: self.is_gone,
        }))
    }

    /// The device of `setup` as `checkpoint` has it.
    ///
    /// # Errors
    /// What is wrong with the checkpoint, in words.
    pub fn resumed(setup: &DeviceSetup, physics: &Physics, checkpoint: &Checkpoint) -> Result<Self, String> {
        let kept: Kept = codec::decode(&checkpoint.0).map_err(|error| error.to_string())?;
        let mut machine = Self::new(setup, physics);
        if !kept.battery.is_of(&setup.energy) || kept.books.measured_from() != physics.measured_from {
            return Err(format!("the checkpoint of device {} is another device's", setup.id));
        }
        while machine.source.next() < kept.next {
            machine.source.take();
        }
        while machine.false_wake < kept.next {
            let Some(ears) = &mut machine.ears else { break };
            machine.false_wake = ears.take_false_wake();
        }
        (machine.battery, machine.books) = (kept.battery, kept.books);
        (machine.duty, machine.state) = (kept.duty, kept.state);
        (machine.next, machine.open, machine.is_gone) = (kept.next, kept.open, kept.is_gone);
        Ok(machine)
    }

    /// Its number.
    pub const fn id(&self) -> DeviceId {
        self.id
    }

    /// Its state after the last step taken.
    pub const fn state(&self) -> DeviceState {
        self.state
    }

    /// Its battery level after the last step taken; nothing once it is gone.
    pub const fn battery(&self) -> Energy {
        if self.is_gone {
            Energy::ZERO
        } else {
            self.battery.level()
        }
    }

    /// Its duty cycle.
    pub const fn duty(&self) -> DutyCycle {
        self.duty
    }

    /// Its state and battery level after the last step taken.
    pub const fn view(&self) -> DeviceView {
        DeviceView {
            state: self.state,
            battery: self.battery(),
        }
    }

    /// It goes for good with the end of TTI `k`, of which nothing more will be heard. Its books end there.
    pub fn go(&mut self, k: Tti) {
        self.begin(k);
        self.settle(k + 1);
        self.is_gone = true;
        self.state = DeviceState::Sleep { powered: false };
    }

    /// δ is `duty` from TTI `from` on.
    pub fn set_duty(&mut self, from: Tti, duty: DutyCycle) {
        if duty != self.duty && !self.is_gone {
            self.settle(from);
            self.duty = duty;
        }
    }

    /// Ends all TTIs before `k`.
    ///
    /// # Panics
    /// If TTI `k` or a later one has already begun.
    pub fn settle(&mut self, k: Tti) {
        if self.is_gone {
            return;
        }
        assert!(
            self.next <= k,
            "device {}: TTI {k} has begun, the next is {}",
            self.id,
            self.next
        );
        if self.next <= self.books.measured_from() && self.books.measured_from() <= k {
            self.catch_up(self.books.measured_from());
            let so_far = self.totals();
            self.books.begin_measuring(so_far);
        }
        self.catch_up(k);
    }

    fn catch_up(&mut self, k: Tti) {
        self.end_open();
        while self.false_wake < k {
            let then = self.false_wake;
            self.pass(then);
            self.start(then);
            self.end_open();
        }
        self.pass(k);
    }

    /// The TTIs before `k`, in none of which it wakes for nothing.
    fn pass(&mut self, k: Tti) {
        let mut phase = self.duty.phase(self.next);
        while self.next < k {
            if self.source.next() == self.next {
                self.battery.harvest(self.source.take());
            }
            let span_end = self.source.next().min(k);
            phase = self.quiet((span_end - self.next).min(LONGEST_SPAN) as u32, phase);
        }
    }

    /// Steps 1 and 2 of TTI `k` (harvest, then δ), after ending all TTIs before it. Does nothing if `k` has begun.
    pub fn begin(&mut self, k: Tti) {
        if self.is_gone || (self.open && self.next == k + 1) {
            return;
        }
        self.settle(k);
        self.start(k);
    }

    /// The same for the TTI that comes next.
    fn start(&mut self, k: Tti) {
        if self.source.next() == k {
            self.battery.harvest(self.source.take());
        }
        let on = self.duty.is_on(k);
        let cost = if on { self.costs.e_idle } else { self.costs.e_wur };
        let paid = self.battery.pay(cost);
        self.books.duty(on, paid);
        self.state = match (paid, on) {
            (Ok(()), true) => DeviceState::Idle,
            (Ok(()), false) => DeviceState::Sleep { powered: true },
            (Err(_), _) => DeviceState::Sleep { powered: false },
        };
        if self.false_wake == k {
            self.wake_for_nothing();
        }
        self.next = k + 1;
        self.open = true;
    }

    fn wake_for_nothing(&mut self) {
        if let Some(ears) = &mut self.ears {
            self.false_wake = ears.take_false_wake();
        }
        if self.state == (DeviceState::Sleep { powered: true }) {
            let _late = self.find_nothing();
        }
    }

    /// S2, and from there to S4 with nothing found.
    fn find_nothing(&mut self) -> WakeOutcome {
        let paid = self.battery.pay(self.costs.e_idle);
        self.books.false_wake(paid);
        let powered = paid.is_ok();
        self.state = DeviceState::Sleep { powered };
        WakeOutcome::Late {
            spent: paid.err().unwrap_or(self.costs.e_idle),
            powered,
        }
    }

    /// Whether it has δ = 1 in TTI `k` and is near enough to detect `stimulus`, battery permitting.
    pub fn may_sense(&self, k: Tti, stimulus: &Stimulus, physics: &Physics) -> bool {
        self.duty.is_on(k) && self.position.distance(stimulus.epicentre) <= physics.sensing.d_max
    }

    /// Steps 4 and 5 of TTI `k`: senses `stimulus` and transmits. TTI `k` is begun if it was not.
    pub fn sense(&mut self, k: Tti, stimulus: &Stimulus, physics: &Physics) -> Sensed {
        self.begin(k);
        match self.state {
            DeviceState::Idle => {
                let d = self.position.distance(stimulus.epicentre);
                if physics.sensing.detects(physics.seed, stimulus.event, self.id, d) {
                    self.transmit(k, d, physics)
                        .map_or_else(Sensed::Failed, Sensed::Reported)
                } else {
                    Sensed::Nothing
                }
            }
            DeviceState::Active | DeviceState::Transmission | DeviceState::Sleep { .. } => Sensed::Nothing,
        }
    }

    /// Step 6 of TTI `k`: a wake-up sent to this device. `stimulus` is what the world shows when it is awake; nothing
    /// if the event is over by then. TTI `k` is begun if it was not.
    pub fn wake(&mut self, k: Tti, stimulus: Option<&Stimulus>, physics: &Physics) -> WakeOutcome {
        self.begin(k);
        let is_missed = self.misses_wake_up(k);
        match self.state {
            DeviceState::Sleep { powered: true } if !is_missed => match stimulus {
                Some(stimulus) => {
                    let d = self.position.distance(stimulus.epicentre);
                    self.transmit(k, d, physics)
                        .map_or_else(WakeOutcome::Failed, WakeOutcome::Reported)
                }
                None => self.find_nothing(),
            },
            DeviceState::Sleep { .. } | DeviceState::Idle | DeviceState::Active | DeviceState::Transmission => {
                WakeOutcome::Unheard
            }
        }
    }

    fn misses_wake_up(&mut self, k: Tti) -> bool {
        self.ears.as_mut().is_some_and(|ears| ears.misses_wake_up(k))
    }

    /// The device's sums over all TTIs that have ended.
    pub fn totals(&self) -> DeviceTotals {
        self.books.totals(self.next, &self.costs, &self.battery)
    }

    /// The device's books over all TTIs that have ended.
    pub fn ledger(&self) -> Ledger {
        self.books.ledger(self.totals())
    }

    /// S2, and from there to S3 with a report or to S4.
    fn transmit(&mut self, k: Tti, d: f64, physics: &Physics) -> Result<Report, Failure> {
        self.state = DeviceState::Active;
        let paid = self.battery.pay(self.costs.e_tx);
        self.books.transmission(paid);
        match paid {
            Ok(()) => {
                self.state = DeviceState::Transmission;
                let information = physics.sensing.information(d);
                Ok(Report {
                    device: self.id,
                    tti: k,
                    information,
                    battery: self.battery.level(),
                })
            }
            Err(drained) => {
                self.state = DeviceState::Sleep { powered: false };
                Err(Failure {
                    device: self.id,
                    drained,
                })
            }
        }
    }

    /// Step 7 of the TTI that has begun, if one has.
    fn end_open(&mut self) {
        if self.open {
            self.open = false;
            self.books.ends(self.battery.level(), self.costs.e_tx, 1);
        }
    }

    /// `n` whole TTIs from `self.next` on, the first at `phase` of the duty cycle, without a harvest, event or wake-up.
    /// Gives the phase after them.
    fn quiet(&mut self, n: u32, phase: u32) -> u32 {
        let EnergyModel {
            e_idle, e_wur, e_tx, ..
        } = self.costs;
        let level = self.battery.level();
        let (on, on_remaining, phase_after) = self.duty.span(phase, n);
        let is_on = phase < self.duty.t_on;
        let n = u64::from(n);
        let cost = e_idle.times(on) + e_wur.times(n - on);
        let after_first = level.saturating_sub(if is_on { e_idle } else { e_wur });
        let after_all = level.saturating_sub(cost);
        if level < cost || (after_first >= e_tx && after_all < e_tx) {
            self.quiet_step_by_step(n);
            return phase_after;
        }
        // Paid i TTIs before the end of the span, a cost lowers i of the span's end-of-TTI levels. A span is short
        // enough for 64 bits.
        let off_remaining = n * (n + 1) / 2 - on_remaining;
        let lowered = e_idle.times(on_remaining) + e_wur.times(off_remaining);
        self.books
            .span(on, level.times(n) - lowered, if after_first < e_tx { n } else { 0 });
        self.battery.spend(cost);
        self.next = self.next + n;
        phase_after
    }

    /// The same, one TTI at a time: for spans in which the battery runs out or falls below E_Tx.
    fn quiet_step_by_step(&mut self, n: u64) {
        let EnergyModel {
            e_idle, e_wur, e_tx, ..
        } = self.costs;
        for done in 0..n {
            if self.battery.level() == Energy::ZERO && e_idle > Energy::ZERO && e_wur > Energy::ZERO {
                let rest = n - done;
                let (on, ..) = self.duty.span(self.duty.phase(self.next), rest as u32);
                self.books.outage(on, rest - on);
                self.books.ends(Energy::ZERO, e_tx, rest);
                self.next = self.next + rest;
                return;
            }
            let on = self.duty.is_on(self.next);
            let paid = self.battery.pay(if on { e_idle } else { e_wur });
            self.books.duty(on, paid);
            self.books.ends(self.battery.level(), e_tx, 1);
            self.next = self.next + 1;
        }
    }
}

#[cfg(test)]
mod step_by_step_tests;
#[cfg(test)]
mod tests;
