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
//! A device that cannot pay for S1 or for its wake-up radio is left with an empty battery: in S4, unpowered until the
//! next TTI. A false wake-up takes a device S4 → S2 → S4 within a TTI and costs E_idle on top of E_WuR. Unless that
//! empties its battery, the device still receives wake-up signals in that TTI.
//!
//! The machine is lazy. It catches up with TTIs that only have harvest and δ when the device is next needed, exactly
//! and many at a time ([`Machine::advance_to`], [`Machine::begin`]).

use std::sync::Arc;

use reveille_common::codec;
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::harvest::{HarvestSource, Sources};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{DeviceCheckpoint, DeviceSetup, FailedTransmission, Report, WakeOutcome};
use reveille_common::plan::DutyCycle;
use reveille_common::radio::{Air, FalseWakes, RadioSettings};
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::Sensing;
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::units::Energy;
use serde::{Deserialize, Serialize};

use crate::battery::Battery;
use crate::ledger::LedgerBuilder;

/// Largest number of TTIs per span: levels of up to 10¹⁰ micro-units, summed over this many, fit in 64 bits.
const LONGEST_SPAN: u64 = 1 << 13;

/// The outcome of a stimulus for a device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SenseOutcome {
    /// No effect: not in S1, out of range, or not detected.
    Nothing,
    /// S1 → S2 → S3.
    Reported(Report),
    /// S1 → S2 → S4.
    Failed(FailedTransmission),
}

/// The physics shared by all devices of a run.
#[derive(Clone, Debug)]
pub struct Physics {
    /// The seed of the run's streams.
    pub seed: u64,
    /// The sensing model.
    pub sensing: Sensing,
    /// The faults of the radio.
    pub radio: RadioSettings,
    /// The data shared by the energy sources.
    pub sources: Sources,
    /// The first measured TTI; the TTIs before it are warm-up.
    pub measured_from: Tti,
}

impl Physics {
    /// Creates the physics of `devices`, with the streams of `seed`, measured from TTI `measured_from` on. `traces`
    /// hold recorded energy per TTI, by row.
    pub fn new(
        seed: u64,
        measured_from: Tti,
        sensing: Sensing,
        radio: RadioSettings,
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

/// The saved state of a machine; everything else follows from its setup and the seed.
#[derive(Serialize, Deserialize)]
struct MachineState {
    battery: Battery,
    duty: DutyCycle,
    state: DeviceState,
    next: Tti,
    open: bool,
    books: LedgerBuilder,
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
    /// Whether TTI `next - 1` is still open: its end, when the battery is accounted, is outstanding.
    open: bool,
    books: LedgerBuilder,
    /// Whether the device is removed; it then stays unchanged.
    is_gone: bool,
    /// The wake-up radio, if it can fail.
    ears: Option<Box<WakeUpRadio>>,
    /// The first TTI from `next` on with a false wake-up, if the device is in S4 then.
    false_wake_up: Tti,
}

impl Machine {
    /// Creates the device of `setup` before TTI 0, asleep until a plan changes δ.
    pub fn new(setup: &DeviceSetup, physics: &Physics) -> Self {
        let ears = WakeUpRadio::new(physics.seed, &physics.radio, setup.id);
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
            books: LedgerBuilder::new(physics.measured_from),
            is_gone: false,
            false_wake_up: ears.as_ref().map_or(Tti::NEVER, |ears| ears.false_wake_up()),
            ears,
        }
    }

    /// Returns a checkpoint of the device, with which another process can continue.
    pub fn checkpoint(&self) -> DeviceCheckpoint {
        DeviceCheckpoint(codec::encode(&MachineState {
            battery: self.battery.clone(),
            duty: self.duty,
            state: self.state,
            next: self.next,
            open: self.open,
            books: self.books.clone(),
            is_gone: self.is_gone,
        }))
    }

    /// Restores the device of `setup` from `checkpoint`.
    ///
    /// # Errors
    /// If the checkpoint is invalid or belongs to another device; the error is a message.
    pub fn from_checkpoint(
        setup: &DeviceSetup,
        physics: &Physics,
        checkpoint: &DeviceCheckpoint,
    ) -> Result<Self, String> {
        let kept: MachineState = codec::decode(&checkpoint.0).map_err(|error| error.to_string())?;
        let mut machine = Self::new(setup, physics);
        if !kept.battery.is_of(&setup.energy) || kept.books.measured_from() != physics.measured_from {
            return Err(format!("the checkpoint of device {} is for another device", setup.id));
        }
        // A checkpoint holds no stream: the draws up to it are repeated from the seed.
        while machine.source.next() < kept.next {
            machine.source.take();
        }
        while machine.false_wake_up < kept.next {
            let Some(ears) = &mut machine.ears else { break };
            machine.false_wake_up = ears.take_false_wake();
        }
        (machine.battery, machine.books) = (kept.battery, kept.books);
        (machine.duty, machine.state) = (kept.duty, kept.state);
        (machine.next, machine.open, machine.is_gone) = (kept.next, kept.open, kept.is_gone);
        Ok(machine)
    }

    /// The device id.
    pub const fn id(&self) -> DeviceId {
        self.id
    }

    /// The state after the last step.
    pub const fn state(&self) -> DeviceState {
        self.state
    }

    /// The battery level after the last step; 0 once the device is removed.
    pub const fn battery(&self) -> Energy {
        if self.is_gone {
            Energy::ZERO
        } else {
            self.battery.level()
        }
    }

    /// The duty cycle.
    pub const fn duty(&self) -> DutyCycle {
        self.duty
    }

    /// The state and battery level after the last step.
    pub const fn view(&self) -> DeviceView {
        DeviceView {
            state: self.state,
            battery: self.battery(),
        }
    }

    /// Removes the device at the end of TTI `k` and closes its ledger.
    pub fn remove(&mut self, k: Tti) {
        self.begin(k);
        self.advance_to(k + 1);
        self.is_gone = true;
        self.state = DeviceState::Sleep { powered: false };
    }

    /// Sets δ to `duty` from TTI `from` on.
    pub fn set_duty(&mut self, from: Tti, duty: DutyCycle) {
        if duty != self.duty && !self.is_gone {
            self.advance_to(from);
            self.duty = duty;
        }
    }

    /// Ends all TTIs before `k`.
    ///
    /// # Panics
    /// If TTI `k` or a later one has already begun.
    pub fn advance_to(&mut self, k: Tti) {
        if self.is_gone {
            return;
        }
        assert!(
            self.next <= k,
            "device {}: TTI {k} has begun, the next is {}",
            self.id,
            self.next
        );
        // Catching up stops at the first measured TTI, where the ledger is divided.
        if self.next <= self.books.measured_from() && self.books.measured_from() <= k {
            self.catch_up(self.books.measured_from());
            let so_far = self.totals();
            self.books.start_measuring(so_far);
        }
        self.catch_up(k);
    }

    fn catch_up(&mut self, k: Tti) {
        self.end_open();
        while self.false_wake_up < k {
            // A false wake-up costs energy within its TTI, so that TTI is not part of a span.
            let then = self.false_wake_up;
            self.advance(then);
            self.start(then);
            self.end_open();
        }
        self.advance(k);
    }

    /// Advances through the TTIs before `k`, which must not contain a false wake-up.
    fn advance(&mut self, k: Tti) {
        let mut phase = self.duty.phase(self.next);
        while self.next < k {
            if self.source.next() == self.next {
                self.battery.harvest(self.source.take());
            }
            // Harvest precedes δ within a TTI: an arrival opens a span, and the next one ends it.
            let span_end = self.source.next().min(k);
            phase = self.quiet((span_end - self.next).min(LONGEST_SPAN) as u32, phase);
        }
    }

    /// Steps 1 and 2 of TTI `k` (harvest, then δ), after ending all TTIs before it. Does nothing if `k` has begun.
    pub fn begin(&mut self, k: Tti) {
        if self.is_gone || (self.open && self.next == k + 1) {
            return;
        }
        self.advance_to(k);
        self.start(k);
    }

    /// Performs steps 1 and 2 of TTI `k`, which must be the next one.
    fn start(&mut self, k: Tti) {
        if self.source.next() == k {
            self.battery.harvest(self.source.take());
        }
        let on = self.duty.is_on(k);
        let cost = if on { self.costs.e_idle } else { self.costs.e_wur };
        let paid = self.battery.pay(cost);
        self.books.record_duty(on, paid);
        self.state = match (paid, on) {
            (Ok(()), true) => DeviceState::Idle,
            (Ok(()), false) => DeviceState::Sleep { powered: true },
            (Err(_), _) => DeviceState::Sleep { powered: false },
        };
        if self.false_wake_up == k {
            self.wake_for_nothing();
        }
        self.next = k + 1;
        self.open = true;
    }

    fn wake_for_nothing(&mut self) {
        if let Some(ears) = &mut self.ears {
            self.false_wake_up = ears.take_false_wake();
        }
        if self.state == (DeviceState::Sleep { powered: true }) {
            let _late = self.find_nothing();
        }
    }

    /// Goes to S2 and back to S4 without a detection.
    fn find_nothing(&mut self) -> WakeOutcome {
        let paid = self.battery.pay(self.costs.e_idle);
        self.books.false_wake_up(paid);
        let powered = paid.is_ok();
        self.state = DeviceState::Sleep { powered };
        WakeOutcome::Late {
            spent: paid.err().unwrap_or(self.costs.e_idle),
            powered,
        }
    }

    /// Returns whether the device has δ = 1 in TTI `k` and is near enough to detect `stimulus`, battery permitting.
    pub fn can_detect(&self, k: Tti, stimulus: &Stimulus, physics: &Physics) -> bool {
        self.duty.is_on(k) && self.position.distance(stimulus.epicentre) <= physics.sensing.d_max
    }

    /// Performs steps 4 and 5 of TTI `k`: senses `stimulus` and transmits. Begins TTI `k` if it has not begun.
    pub fn sense(&mut self, k: Tti, stimulus: &Stimulus, physics: &Physics) -> SenseOutcome {
        self.begin(k);
        match self.state {
            DeviceState::Idle => {
                let d = self.position.distance(stimulus.epicentre);
                if physics.sensing.detects(physics.seed, stimulus.event, self.id, d) {
                    self.transmit(k, d, physics)
                        .map_or_else(SenseOutcome::Failed, SenseOutcome::Reported)
                } else {
                    SenseOutcome::Nothing
                }
            }
            DeviceState::Active | DeviceState::Transmission | DeviceState::Sleep { .. } => SenseOutcome::Nothing,
        }
    }

    /// Performs step 6 of TTI `k`: a wake-up signal to this device. `stimulus` is present if the event still lasts when
    /// the device is awake. Begins TTI `k` if it has not begun.
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
                WakeOutcome::Missed
            }
        }
    }

    fn misses_wake_up(&mut self, k: Tti) -> bool {
        self.ears.as_mut().is_some_and(|ears| ears.misses_wake_up(k))
    }

    /// The device's totals over all TTIs that have ended.
    pub fn totals(&self) -> DeviceTotals {
        self.books.totals(self.next, &self.costs, &self.battery)
    }

    /// The device's ledger over all TTIs that have ended.
    pub fn ledger(&self) -> Ledger {
        self.books.ledger(self.totals())
    }

    /// Goes to S2, and from there to S3 with a report, or to S4 if the battery cannot pay.
    fn transmit(&mut self, k: Tti, d: f64, physics: &Physics) -> Result<Report, FailedTransmission> {
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
                Err(FailedTransmission {
                    device: self.id,
                    drained,
                })
            }
        }
    }

    /// Performs step 7 of the open TTI, if any.
    fn end_open(&mut self) {
        if self.open {
            self.open = false;
            self.books.ends(self.battery.level(), self.costs.e_tx, 1);
        }
    }

    /// Advances through `n` whole TTIs from `self.next` on, without harvest, event or wake-up. The first is at `phase`
    /// of the duty cycle. Returns the phase after them.
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
        // Levels only fall within a span, so its ends show whether they cross E_Tx or reach 0.
        if level < cost || (after_first >= e_tx && after_all < e_tx) {
            self.quiet_step_by_step(n);
            return phase_after;
        }
        // A cost paid i TTIs before the end of the span lowers i of its end-of-TTI levels. `LONGEST_SPAN` keeps the
        // sums within 64 bits.
        let off_remaining = n * (n + 1) / 2 - on_remaining;
        let lowered = e_idle.times(on_remaining) + e_wur.times(off_remaining);
        self.books
            .record_paid_span(on, level.times(n) - lowered, if after_first < e_tx { n } else { 0 });
        self.battery.spend(cost);
        self.next = self.next + n;
        phase_after
    }

    /// Does the same as [`Self::quiet`], one TTI at a time, for spans in which the battery runs out or falls below
    /// E_Tx.
    fn quiet_step_by_step(&mut self, n: u64) {
        let EnergyModel {
            e_idle, e_wur, e_tx, ..
        } = self.costs;
        for done in 0..n {
            // With an empty battery every action that costs energy fails, up to the end of the span.
            if self.battery.level() == Energy::ZERO && e_idle > Energy::ZERO && e_wur > Energy::ZERO {
                let rest = n - done;
                let (on, ..) = self.duty.span(self.duty.phase(self.next), rest as u32);
                self.books.record_outage(on, rest - on);
                self.books.ends(Energy::ZERO, e_tx, rest);
                self.next = self.next + rest;
                return;
            }
            let on = self.duty.is_on(self.next);
            let paid = self.battery.pay(if on { e_idle } else { e_wur });
            self.books.record_duty(on, paid);
            self.books.ends(self.battery.level(), e_tx, 1);
            self.next = self.next + 1;
        }
    }
}

/// The missed and false wake-ups of a device's wake-up radio.
#[derive(Clone, Debug)]
pub(crate) struct WakeUpRadio {
    device: DeviceId,
    air: Air,
    false_wake_ups: FalseWakes,
}

impl WakeUpRadio {
    /// Creates the faults of `device` in a run with `seed`. Returns `None` if `radio` never fails.
    pub(crate) fn new(seed: u64, radio: &RadioSettings, device: DeviceId) -> Option<Box<Self>> {
        let of = || Self {
            device,
            air: Air::new(seed, radio),
            false_wake_ups: FalseWakes::new(seed, radio.false_wake_up, device),
        };
        (!radio.is_perfect()).then(|| Box::new(of()))
    }

    /// The TTI of the next false wake-up, if the device sleeps then.
    pub(crate) const fn false_wake_up(&self) -> Tti {
        self.false_wake_ups.next()
    }

    /// Consumes that TTI and returns the next one.
    pub(crate) fn take_false_wake(&mut self) -> Tti {
        self.false_wake_ups.take()
    }

    /// Returns whether the device misses a wake-up signal in TTI `k`, which must not precede the last call's TTI.
    pub(crate) fn misses_wake_up(&mut self, k: Tti) -> bool {
        self.air.at(k).misses_wake_up(self.device)
    }
}

#[cfg(test)]
mod tests;
