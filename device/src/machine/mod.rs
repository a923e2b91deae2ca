//! One device as a state machine without I/O. `lab/src/run.rs` and `view/src/device_mirror.rs` call it directly, `host`
//! through its actors. All of them must call it in the same way, or states diverge. Rules and costs are part of the
//! digest; `tests/src/reference/device.rs` repeats them.
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
//!            wake-up received (WuR powered)
//! ```
//! A device that cannot pay for S1 or for its wake-up radio is left with an empty battery: in S4, unpowered until the
//! next TTI. A false or late wake-up takes a device S4 → S2 → S4 within a TTI and costs E_idle on top of E_WuR. Unless
//! that empties its battery, the device still receives wake-up signals in that TTI.
//!
//! An operator can let the device fail. A failed device is in none of the states S1 to S4 and consumes no energy; its
//! battery still receives harvest. A removed device, whose host is lost, stays in S4, unpowered, with its ledger
//! closed.
//!
//! The machine is lazy. It catches up with TTIs that only have harvest and δ when the device is next needed, many at a
//! time ([`Machine::advance_to`]). The result must equal single steps: `machine/tests/step_by_step.rs` checks this for
//! devices that never fail, `tests/tests/actions.rs` for others. Callers name TTIs in ascending order; a step back
//! panics, except for a removed device.

use std::sync::Arc;

use reveille_common::codec;
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::harvest::{HarvestSource, SharedSourceData};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, DeviceCheckpoint, DeviceSetup, FailedTransmission, Report, WakeOutcome};
use reveille_common::plan::DutyCycle;
use reveille_common::radio::{Air, FalseWakeUps, RadioSettings};
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::Sensing;
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::units::Energy;
use serde::{Deserialize, Serialize};

use crate::battery::Battery;
use crate::ledger::LedgerBuilder;

/// Largest number of TTIs per span: levels of up to 10¹⁵ micro-units, `MAX_UNITS` in `common/src/units.rs`, summed over
/// this many, fit in 64 bits.
const MAX_SPAN_TTIS: u64 = 1 << 13;

/// The outcome of a stimulus for a device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SenseOutcome {
    /// No effect: δ = 0, out of range, not detected, in S3 already, or a removed device.
    Nothing,
    /// The device would have detected the event, but an operator had failed it.
    Failed,
    /// The device would have detected the event, but could not pay for S1.
    Unpowered,
    /// S1 → S2 → S3.
    Reported(Report),
    /// S1 → S2 → S4: the battery could not pay for the report.
    TransmissionFailed(FailedTransmission),
}

/// The physics shared by all devices of a run. Equal on every host; only `sources` covers the devices given to
/// [`Self::new`].
#[derive(Clone, Debug)]
pub struct Physics {
    /// The seed of the run's streams.
    pub seed: u64,
    /// The sensing model.
    pub sensing: Sensing,
    /// The faults of the radio.
    pub radio: RadioSettings,
    /// The data shared by the energy sources.
    pub sources: SharedSourceData,
    /// The first measured TTI; the TTIs before it are warm-up.
    pub measured_from: Tti,
}

impl Physics {
    /// Creates the physics of `devices`, all devices of a run or of a host, with the streams of `seed`, measured from
    /// TTI `measured_from` on. `traces` hold recorded energy per TTI, by row.
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
            sources: SharedSourceData::new(devices.iter().map(|d| &d.harvest), traces),
        }
    }
}

/// The saved state of a machine; everything else follows from its setup and the seed. Its fields, in this order, are
/// the format of [`DeviceCheckpoint`]: a change raises `WIRE_VERSION` (`common/src/codec.rs`).
#[derive(Serialize, Deserialize)]
struct MachineState {
    battery: Battery,
    duty: DutyCycle,
    state: DeviceState,
    next: Tti,
    is_open: bool,
    ledger_builder: LedgerBuilder,
    is_removed: bool,
    has_failed: bool,
}

/// One device.
#[derive(Clone, Debug)]
pub struct Machine {
    id: DeviceId,
    position: Point,
    costs: EnergyModel,
    battery: Battery,
    harvest_source: HarvestSource,
    duty: DutyCycle,
    state: DeviceState,
    /// The first TTI whose harvest and δ have not been applied.
    next: Tti,
    /// Whether TTI `next - 1` is still open: its end, when the battery is accounted, is outstanding.
    is_open: bool,
    ledger_builder: LedgerBuilder,
    /// Whether the device is removed; it then stays unchanged.
    is_removed: bool,
    /// Whether an operator has let the device fail.
    has_failed: bool,
    /// The faults of the wake-up radio; `None` if it never fails.
    wake_up_faults: Option<Box<WakeUpFaults>>,
    /// The first TTI from `next` on with a false wake-up, if the device is in S4 then.
    next_false_wake_up: Tti,
}

impl Machine {
    /// Creates the device of `setup` before TTI 0, asleep until a plan changes δ. `physics` must cover the device.
    ///
    /// # Panics
    /// If the initial level exceeds E_max, or the energy source names an unknown trace. Loading a scenario and
    /// `HostSetup::validate` rule both out.
    pub fn new(setup: &DeviceSetup, physics: &Physics) -> Self {
        let wake_up_faults = WakeUpFaults::new(physics.seed, &physics.radio, setup.id);
        Self {
            id: setup.id,
            position: setup.position,
            costs: setup.energy,
            battery: Battery::new(&setup.energy),
            harvest_source: HarvestSource::new(&setup.harvest, &physics.sources, physics.seed, setup.id),
            duty: DutyCycle::ASLEEP,
            state: DeviceState::Sleep { powered: true },
            next: Tti::ZERO,
            is_open: false,
            ledger_builder: LedgerBuilder::new(physics.measured_from),
            is_removed: false,
            has_failed: false,
            next_false_wake_up: wake_up_faults
                .as_ref()
                .map_or(Tti::NEVER, |faults| faults.next_false_wake_up()),
            wake_up_faults,
        }
    }

    /// Returns a checkpoint of the device, with which another process can continue.
    pub fn checkpoint(&self) -> DeviceCheckpoint {
        DeviceCheckpoint(codec::encode(&MachineState {
            battery: self.battery.clone(),
            duty: self.duty,
            state: self.state,
            next: self.next,
            is_open: self.is_open,
            ledger_builder: self.ledger_builder.clone(),
            is_removed: self.is_removed,
            has_failed: self.has_failed,
        }))
    }

    /// Restores the device of `setup` from `checkpoint`, of the same run.
    ///
    /// # Errors
    /// If the checkpoint cannot be decoded, or its battery or its first measured TTI does not fit `setup` and
    /// `physics`; the error is a message.
    pub fn from_checkpoint(
        setup: &DeviceSetup,
        physics: &Physics,
        checkpoint: &DeviceCheckpoint,
    ) -> Result<Self, String> {
        let saved: MachineState = codec::decode(&checkpoint.0).map_err(|error| error.to_string())?;
        let mut machine = Self::new(setup, physics);
        if !saved.battery.can_belong_to(&setup.energy) || saved.ledger_builder.measured_from() != physics.measured_from
        {
            return Err(format!("the checkpoint of device {} is for another device", setup.id));
        }
        // A checkpoint holds no stream: the draws up to it are repeated from the seed.
        while machine.harvest_source.next_arrival() < saved.next {
            machine.harvest_source.take_arrival();
        }
        machine.skip_false_wake_ups(saved.next);
        (machine.battery, machine.ledger_builder) = (saved.battery, saved.ledger_builder);
        (machine.duty, machine.state) = (saved.duty, saved.state);
        (machine.next, machine.is_open) = (saved.next, saved.is_open);
        (machine.is_removed, machine.has_failed) = (saved.is_removed, saved.has_failed);
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
        if self.is_removed {
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

    /// Removes the device at the end of TTI `k` and closes its ledger. Every further step has no effect.
    ///
    /// # Panics
    /// As for [`Self::begin`].
    pub fn remove(&mut self, k: Tti) {
        self.begin(k);
        self.advance_to(k + 1);
        self.is_removed = true;
        self.state = DeviceState::Sleep { powered: false };
    }

    /// Makes `change` at the start of TTI `k`. Without effect if the change concerns other devices or a setting, or the
    /// device is removed.
    ///
    /// # Panics
    /// If TTI `k` or a later one has already begun.
    pub fn apply(&mut self, k: Tti, change: &Change) {
        if self.is_removed || change.devices().is_none_or(|devices| !devices.contains(self.id)) {
            return;
        }
        self.advance_to(k);
        match *change {
            Change::Fail(_) => self.has_failed = true,
            Change::Revive(_) => self.has_failed = false,
            Change::AddEnergy(_, energy) => self.battery.harvest(energy),
            Change::Set(..) => {}
        }
    }

    /// Sets δ to `duty`, a valid cycle, from TTI `from` on.
    ///
    /// # Panics
    /// If `duty` is new and TTI `from` or a later one has already begun.
    pub fn set_duty(&mut self, from: Tti, duty: DutyCycle) {
        if duty != self.duty && !self.is_removed {
            self.advance_to(from);
            self.duty = duty;
        }
    }

    /// Ends all TTIs before `k`.
    ///
    /// # Panics
    /// If TTI `k` or a later one has already begun.
    pub fn advance_to(&mut self, k: Tti) {
        if self.is_removed {
            return;
        }
        assert!(
            self.next <= k,
            "device {}: TTI {k} has begun, the next is {}",
            self.id,
            self.next
        );
        // Catching up stops at the first measured TTI, where the ledger is divided.
        if self.next <= self.ledger_builder.measured_from() && self.ledger_builder.measured_from() <= k {
            self.catch_up(self.ledger_builder.measured_from());
            let warm_up_totals = self.totals();
            self.ledger_builder.start_measuring(warm_up_totals);
        }
        self.catch_up(k);
    }

    /// Advances through the TTIs before `k`, in spans where possible.
    fn catch_up(&mut self, k: Tti) {
        self.end_open_tti();
        if self.has_failed {
            self.advance_failed(k);
            return;
        }
        while self.next_false_wake_up < k {
            // A false wake-up costs energy within its TTI, so that TTI is not part of a span.
            let false_wake_up_tti = self.next_false_wake_up;
            self.advance_without_false_wake_ups(false_wake_up_tti);
            self.begin_next(false_wake_up_tti);
            self.end_open_tti();
        }
        self.advance_without_false_wake_ups(k);
    }

    /// Advances through the TTIs before `k`, in which the electronics are off and the battery only charges.
    fn advance_failed(&mut self, k: Tti) {
        while self.next < k {
            if self.harvest_source.next_arrival() == self.next {
                self.battery.harvest(self.harvest_source.take_arrival());
            }
            let span_end = self.harvest_source.next_arrival().min(k);
            let ttis = span_end - self.next;
            self.ledger_builder.record_off(ttis);
            self.ledger_builder
                .record_end(self.battery.level(), self.costs.e_tx, ttis);
            self.next = span_end;
        }
        self.skip_false_wake_ups(k);
    }

    /// Consumes the false wake-ups before TTI `k`, which a failed device does not notice.
    fn skip_false_wake_ups(&mut self, k: Tti) {
        while self.next_false_wake_up < k
            && let Some(wake_up_faults) = &mut self.wake_up_faults
        {
            self.next_false_wake_up = wake_up_faults.take_false_wake_up();
        }
    }

    /// Advances through the TTIs before `k`, which must not contain a false wake-up.
    fn advance_without_false_wake_ups(&mut self, k: Tti) {
        let mut phase = self.duty.phase(self.next);
        while self.next < k {
            if self.harvest_source.next_arrival() == self.next {
                self.battery.harvest(self.harvest_source.take_arrival());
            }
            // Harvest precedes δ within a TTI: an arrival opens a span, and the next one ends it.
            let span_end = self.harvest_source.next_arrival().min(k);
            phase = self.advance_span((span_end - self.next).min(MAX_SPAN_TTIS) as u32, phase);
        }
    }

    /// Whether TTI `k` has ended.
    pub const fn has_ended(&self, k: Tti) -> bool {
        self.next.0 > k.0 && !(self.is_open && self.next.0 == k.0 + 1)
    }

    /// Begins TTI `k`: ends all TTIs before it, then applies harvest and δ, in this order. Does nothing if `k` is the
    /// open TTI.
    ///
    /// # Panics
    /// If TTI `k` has ended, or a later one has begun.
    pub fn begin(&mut self, k: Tti) {
        if self.is_removed || (self.is_open && self.next == k + 1) {
            return;
        }
        self.advance_to(k);
        self.begin_next(k);
    }

    /// Applies harvest, then δ of TTI `k`, which must be the next one.
    fn begin_next(&mut self, k: Tti) {
        if self.harvest_source.next_arrival() == k {
            self.battery.harvest(self.harvest_source.take_arrival());
        }
        (self.next, self.is_open) = (k + 1, true);
        if self.has_failed {
            self.ledger_builder.record_off(1);
            self.state = DeviceState::Failed;
            self.skip_false_wake_ups(k + 1);
            return;
        }
        let is_on = self.duty.is_on(k);
        let cost = if is_on { self.costs.e_idle } else { self.costs.e_wur };
        let payment = self.battery.pay(cost);
        self.ledger_builder.record_duty(is_on, payment);
        self.state = match (payment, is_on) {
            (Ok(()), true) => DeviceState::Idle,
            (Ok(()), false) => DeviceState::Sleep { powered: true },
            (Err(_), _) => DeviceState::Sleep { powered: false },
        };
        if self.next_false_wake_up == k {
            self.apply_false_wake_up();
        }
    }

    /// Consumes the false wake-up of the open TTI, which only a device in S4 with power notices.
    fn apply_false_wake_up(&mut self) {
        if let Some(wake_up_faults) = &mut self.wake_up_faults {
            self.next_false_wake_up = wake_up_faults.take_false_wake_up();
        }
        if self.state == (DeviceState::Sleep { powered: true }) {
            let _outcome = self.wake_without_detection();
        }
    }

    /// Enters S2 and returns to S4 without a report, after a false or a late wake-up.
    fn wake_without_detection(&mut self) -> WakeOutcome {
        let payment = self.battery.pay(self.costs.e_idle);
        self.ledger_builder.record_false_wake_up(payment);
        let powered = payment.is_ok();
        self.state = DeviceState::Sleep { powered };
        WakeOutcome::Late {
            spent: payment.err().unwrap_or(self.costs.e_idle),
            powered,
        }
    }

    /// Returns whether the device has δ = 1 in TTI `k` and is within d_max of `stimulus`. The draw of the detection and
    /// the battery decide later, in [`Self::sense`]. `grant_follower` has the same rule for hosts.
    pub fn can_detect(&self, k: Tti, stimulus: &Stimulus, physics: &Physics) -> bool {
        self.duty.is_on(k) && self.position.distance(stimulus.epicentre) <= physics.sensing.d_max
    }

    /// Senses `stimulus` in TTI `k` and transmits a report of a detection. Begins TTI `k` if it has not begun.
    /// `physics` is the one of [`Self::new`], here and in [`Self::wake`].
    ///
    /// # Panics
    /// As for [`Self::begin`].
    pub fn sense(&mut self, k: Tti, stimulus: &Stimulus, physics: &Physics) -> SenseOutcome {
        self.begin(k);
        let d = self.position.distance(stimulus.epicentre);
        if self.is_removed || !self.duty.is_on(k) || !physics.sensing.detects(physics.seed, stimulus.event, self.id, d)
        {
            return SenseOutcome::Nothing;
        }
        match self.state {
            DeviceState::Idle => self
                .transmit(k, d, physics)
                .map_or_else(SenseOutcome::TransmissionFailed, SenseOutcome::Reported),
            DeviceState::Sleep { powered: false } => SenseOutcome::Unpowered,
            DeviceState::Failed => SenseOutcome::Failed,
            DeviceState::Sleep { powered: true } | DeviceState::Active | DeviceState::Transmission => {
                SenseOutcome::Nothing
            }
        }
    }

    /// Receives a wake-up signal in TTI `k`, after sensing. `stimulus` is present if the event still lasts when the
    /// device is awake. Begins TTI `k` if it has not begun. A repeated call may pay again.
    ///
    /// # Panics
    /// As for [`Self::begin`].
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
                None => self.wake_without_detection(),
            },
            DeviceState::Sleep { .. }
            | DeviceState::Idle
            | DeviceState::Active
            | DeviceState::Transmission
            | DeviceState::Failed => WakeOutcome::Missed,
        }
    }

    fn misses_wake_up(&mut self, k: Tti) -> bool {
        self.wake_up_faults
            .as_mut()
            .is_some_and(|faults| faults.misses_wake_up(k))
    }

    /// The device's totals over all TTIs that have ended. A TTI that has begun must have ended, as after
    /// [`Self::advance_to`].
    pub fn totals(&self) -> DeviceTotals {
        self.ledger_builder.totals(self.next, &self.costs, &self.battery)
    }

    /// The device's ledger over all TTIs that have ended, as for [`Self::totals`].
    pub fn ledger(&self) -> Ledger {
        self.ledger_builder.ledger(self.totals())
    }

    /// Goes to S2, and from there to S3 with a report, or to S4 if the battery cannot pay.
    fn transmit(&mut self, k: Tti, d: f64, physics: &Physics) -> Result<Report, FailedTransmission> {
        self.state = DeviceState::Active;
        let payment = self.battery.pay(self.costs.e_tx);
        self.ledger_builder.record_transmission(payment);
        match payment {
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
                    drained_energy: drained,
                })
            }
        }
    }

    /// Ends the open TTI, if any: accounts for the battery level.
    fn end_open_tti(&mut self) {
        if self.is_open {
            self.is_open = false;
            self.ledger_builder.record_end(self.battery.level(), self.costs.e_tx, 1);
        }
    }

    /// Advances through `n` whole TTIs from `self.next` on, without harvest, event or wake-up. The first is at `phase`
    /// of the duty cycle. Returns the phase after them.
    fn advance_span(&mut self, n: u32, phase: u32) -> u32 {
        let EnergyModel {
            e_idle, e_wur, e_tx, ..
        } = self.costs;
        let level = self.battery.level();
        let (on_ttis, on_remaining, phase_after) = self.duty.sum_over_span(phase, n);
        let starts_on = phase < self.duty.t_on;
        let n = u64::from(n);
        let cost = e_idle.times(on_ttis) + e_wur.times(n - on_ttis);
        let after_first = level.saturating_sub(if starts_on { e_idle } else { e_wur });
        let after_all = level.saturating_sub(cost);
        // Levels only fall within a span, so its ends show whether they cross E_Tx or reach 0.
        if level < cost || (after_first >= e_tx && after_all < e_tx) {
            self.advance_span_by_tti(n);
            return phase_after;
        }
        // A cost paid i TTIs before the end of the span lowers i of its end-of-TTI levels. `MAX_SPAN_TTIS` keeps the
        // sums within 64 bits.
        let off_remaining = n * (n + 1) / 2 - on_remaining;
        let level_loss = e_idle.times(on_remaining) + e_wur.times(off_remaining);
        self.ledger_builder.record_paid_span(
            on_ttis,
            level.times(n) - level_loss,
            if after_first < e_tx { n } else { 0 },
        );
        self.battery.spend(cost);
        self.next = self.next + n;
        phase_after
    }

    /// Does the same as [`Self::advance_span`], one TTI at a time, for spans in which the battery runs out or falls
    /// below E_Tx.
    fn advance_span_by_tti(&mut self, n: u64) {
        let EnergyModel {
            e_idle, e_wur, e_tx, ..
        } = self.costs;
        for ttis_done in 0..n {
            // With an empty battery every action that costs energy fails, up to the end of the span.
            if self.battery.level() == Energy::ZERO && e_idle > Energy::ZERO && e_wur > Energy::ZERO {
                let remaining = n - ttis_done;
                let (on_ttis, ..) = self.duty.sum_over_span(self.duty.phase(self.next), remaining as u32);
                self.ledger_builder.record_outage(on_ttis, remaining - on_ttis);
                self.ledger_builder.record_end(Energy::ZERO, e_tx, remaining);
                self.next = self.next + remaining;
                return;
            }
            let is_on = self.duty.is_on(self.next);
            let payment = self.battery.pay(if is_on { e_idle } else { e_wur });
            self.ledger_builder.record_duty(is_on, payment);
            self.ledger_builder.record_end(self.battery.level(), e_tx, 1);
            self.next = self.next + 1;
        }
    }
}

/// The faults of a device's wake-up receiver: missed and false wake-ups.
#[derive(Clone, Debug)]
pub(crate) struct WakeUpFaults {
    device: DeviceId,
    air: Air,
    false_wake_ups: FalseWakeUps,
}

impl WakeUpFaults {
    /// Creates the faults of `device` in a run with `seed`. Returns `None` if `radio` never fails.
    pub(crate) fn new(seed: u64, radio: &RadioSettings, device: DeviceId) -> Option<Box<Self>> {
        let build = || Self {
            device,
            air: Air::new(seed, radio),
            false_wake_ups: FalseWakeUps::new(seed, radio.false_wake_up, device),
        };
        (!radio.is_perfect()).then(|| Box::new(build()))
    }

    /// The TTI of the next false wake-up, if the device sleeps then.
    pub(crate) const fn next_false_wake_up(&self) -> Tti {
        self.false_wake_ups.next_tti()
    }

    /// Consumes that TTI and returns the next one.
    pub(crate) fn take_false_wake_up(&mut self) -> Tti {
        self.false_wake_ups.advance()
    }

    /// Returns whether the device misses a wake-up signal in TTI `k`, which must not precede the last call's TTI.
    pub(crate) fn misses_wake_up(&mut self, k: Tti) -> bool {
        self.air.losses_at(k).misses_wake_up(self.device)
    }
}

#[cfg(test)]
mod tests;
