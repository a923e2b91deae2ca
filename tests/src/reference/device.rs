//! One device of the reference, stepped TTI by TTI by `world.rs`: its state, battery and ledger.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_common::ids::DeviceId;
use reveille_common::message::Change;
use reveille_common::scenario::EnergyModel;
use reveille_common::totals::{DeviceTotals, EnergyByState, Ledger};
use reveille_common::units::Energy;

use super::harvest::ReferenceSource;

/// Index of the energy spent for sensing in S1 in [`Device::spent`].
pub(super) const S1: usize = 0;
/// Index of the energy spent in S4, false and late wake-ups included, in [`Device::spent`].
pub(super) const S4: usize = 1;
/// Index of the energy spent for reports in S3 in [`Device::spent`].
pub(super) const S3: usize = 2;

/// State of a device at the end of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReferenceState {
    /// S1.
    Idle,
    /// S3.
    Transmission,
    /// S4 with a powered wake-up radio.
    Asleep,
    /// S4, unpowered after an action that the battery could not pay.
    Unpowered,
    /// Failed by an operator: it neither spends energy nor answers.
    Failed,
}

/// One device and its ledger, micro-units. `world.rs` steps it and sets `state`, `battery_sum`, `low_ttis` and the
/// other counts; this file keeps battery and energies consistent.
#[derive(Clone, Debug)]
pub(super) struct Device {
    pub(super) costs: EnergyModel,
    pub(super) source: ReferenceSource,
    pub(super) state: ReferenceState,
    pub(super) battery: u64,
    /// Energy that arrived, from the source or an operator, overflow included.
    pub(super) harvested: u64,
    /// Spent energy, indexed by [`S1`], [`S4`] and [`S3`].
    spent: [u64; 3],
    pub(super) overflow: u64,
    /// Sum of the battery levels at the ends of TTIs.
    pub(super) battery_sum: u128,
    /// TTIs at whose end the battery cannot pay for a report.
    pub(super) low_ttis: u64,
    /// TTIs with δ = 1, paid or not.
    pub(super) sensing_ttis: u64,
    /// TTIs with δ = 1 that the battery could not pay; `failed_ttis` of the totals.
    pub(super) unpaid_sensing_ttis: u64,
    /// TTIs with δ = 0 that the battery could not pay.
    pub(super) unpowered_ttis: u64,
    /// False wake-ups, and wake-ups that came too late for their event.
    pub(super) false_wake_ups: u64,
    /// Consecutive TTIs that the battery could not pay, up to now.
    pub(super) current_outage: u64,
    /// Longest outage since the end of the warm-up, TTIs.
    pub(super) longest_outage: u64,
    /// Totals at the end of the warm-up; `None` before it.
    pub(super) totals_at_warm_up_end: Option<DeviceTotals>,
    /// TTI in which an operator made the device fail; `None` unless it is failed now.
    pub(super) failed_since: Option<u64>,
}

impl Device {
    pub(super) fn new(costs: EnergyModel, source: ReferenceSource) -> Self {
        Self {
            source,
            state: ReferenceState::Asleep,
            battery: costs.initial.micro(),
            costs,
            harvested: 0,
            spent: [0; 3],
            overflow: 0,
            battery_sum: 0,
            low_ttis: 0,
            sensing_ttis: 0,
            unpaid_sensing_ttis: 0,
            unpowered_ttis: 0,
            false_wake_ups: 0,
            current_outage: 0,
            longest_outage: 0,
            totals_at_warm_up_end: None,
            failed_since: None,
        }
    }

    /// Applies an operator's change before TTI `k` if it concerns this device, whose number is `id`.
    pub(super) fn apply_change(&mut self, id: DeviceId, k: u64, change: &Change) {
        match *change {
            Change::Fail(range) if range.contains(id) => self.failed_since = self.failed_since.or(Some(k)),
            Change::Revive(range) if range.contains(id) => self.failed_since = None,
            Change::AddEnergy(range, energy) if range.contains(id) => self.store(energy.micro()),
            Change::Fail(_) | Change::Revive(_) | Change::AddEnergy(..) | Change::Set(..) => {}
        }
    }

    /// Stores the energy `arriving`; the part that does not fit is overflow.
    pub(super) fn store(&mut self, arriving: u64) {
        let free_capacity = self.costs.e_max.micro() - self.battery;
        let stored = arriving.min(free_capacity);
        self.harvested += arriving;
        self.overflow += arriving - stored;
        self.battery += stored;
    }

    /// Pays `cost`, or loses the remaining charge. The energy counts under `spent_index`, [`S1`], [`S4`] or [`S3`].
    /// Returns the energy that left the battery, and whether it was enough.
    pub(super) fn pay(&mut self, cost: Energy, spent_index: usize) -> (u64, bool) {
        let is_enough = self.battery >= cost.micro();
        let spent = if is_enough { cost.micro() } else { self.battery };
        self.battery -= spent;
        self.spent[spent_index] += spent;
        (spent, is_enough)
    }

    /// Ledger up to now. Its measured part is empty before the end of the warm-up.
    pub(super) fn ledger(&self) -> Ledger {
        let whole = self.totals();
        Ledger {
            whole,
            measured: self
                .totals_at_warm_up_end
                .map_or_else(DeviceTotals::default, |warm_up| whole - warm_up),
            longest_outage: self.longest_outage,
        }
    }

    /// Totals since TTI 0, the warm-up included.
    pub(super) fn totals(&self) -> DeviceTotals {
        let [sensing, sleep, report] = self.spent.map(Energy::from_micro);
        DeviceTotals {
            initial: self.costs.initial,
            harvested: Energy::from_micro(self.harvested),
            spent: EnergyByState { sensing, sleep, report },
            overflow: Energy::from_micro(self.overflow),
            battery: Energy::from_micro(self.battery),
            battery_sum: self.battery_sum,
            low_ttis: self.low_ttis,
            sensing_ttis: self.sensing_ttis,
            failed_ttis: self.unpaid_sensing_ttis,
            unpowered_ttis: self.unpowered_ttis,
            false_wake_ups: self.false_wake_ups,
        }
    }
}
