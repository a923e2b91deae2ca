//! One device of the reference, stepped TTI by TTI by `world.rs`: its state, battery and ledger.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_common::ids::DeviceId;
use reveille_common::message::Change;
use reveille_common::scenario::EnergyModel;
use reveille_common::totals::{DeviceTotals, EnergyByState, Ledger};
use reveille_common::units::Energy;

use super::harvest::ReferenceSource;

/// Position of S1 in the energy by state.
pub(super) const S1: usize = 0;
/// Position of S4 in the energy by state.
pub(super) const S4: usize = 1;
/// Position of S3 in the energy by state; it includes the energy spent in S2.
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
    /// An operator has let the device fail.
    Failed,
}

/// One device and its ledger, micro-units.
#[derive(Clone, Debug)]
pub(super) struct Device {
    pub(super) costs: EnergyModel,
    pub(super) source: ReferenceSource,
    pub(super) state: ReferenceState,
    pub(super) battery: u64,
    pub(super) harvested: u64,
    /// Spent energy by state: [`S1`], [`S4`], [`S3`].
    spent: [u64; 3],
    pub(super) overflow: u64,
    pub(super) battery_sum: u128,
    pub(super) low_ttis: u64,
    pub(super) sensing_ttis: u64,
    /// TTIs in which the battery could not pay for sensing; failures by operators are not counted.
    pub(super) failed_ttis: u64,
    pub(super) unpowered_ttis: u64,
    pub(super) false_wake_ups: u64,
    /// Consecutive TTIs without power: current and longest.
    pub(super) outage: [u64; 2],
    pub(super) totals_at_warm_up_end: Option<DeviceTotals>,
    /// The TTI in which an operator let the device fail, while it has failed.
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
            failed_ttis: 0,
            unpowered_ttis: 0,
            false_wake_ups: 0,
            outage: [0; 2],
            totals_at_warm_up_end: None,
            failed_since: None,
        }
    }

    /// Makes an operator's change before TTI `k`; this device has the number `id`.
    pub(super) fn act(&mut self, id: DeviceId, k: u64, change: &Change) {
        match *change {
            Change::Fail(range) if range.contains(id) => self.failed_since = self.failed_since.or(Some(k)),
            Change::Revive(range) if range.contains(id) => self.failed_since = None,
            Change::AddEnergy(range, energy) if range.contains(id) => self.store(energy.micro()),
            Change::Fail(_) | Change::Revive(_) | Change::AddEnergy(..) | Change::Set(..) => {}
        }
    }

    /// Stores the energy `arriving`; what does not fit is overflow.
    pub(super) fn store(&mut self, arriving: u64) {
        let room = self.costs.e_max.micro() - self.battery;
        let stored = arriving.min(room);
        self.harvested += arriving;
        self.overflow += arriving - stored;
        self.battery += stored;
    }

    /// Pays `cost`, or loses the remaining charge. Returns the energy that left the battery, and whether it was enough.
    pub(super) fn pay(&mut self, cost: Energy, state: usize) -> (u64, bool) {
        let is_enough = self.battery >= cost.micro();
        let spent = if is_enough { cost.micro() } else { self.battery };
        self.battery -= spent;
        self.spent[state] += spent;
        (spent, is_enough)
    }

    pub(super) fn ledger(&self) -> Ledger {
        let whole = self.totals();
        Ledger {
            whole,
            measured: self
                .totals_at_warm_up_end
                .map_or_else(DeviceTotals::default, |warm_up| whole - warm_up),
            longest_outage: self.outage[1],
        }
    }

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
            failed_ttis: self.failed_ttis,
            unpowered_ttis: self.unpowered_ttis,
            false_wake_ups: self.false_wake_ups,
        }
    }
}
