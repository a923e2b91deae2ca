//! The hosts and devices of a run, and plausibility checks of received values. Every number from the bus is checked
//! here, since a host can send anything: a new field of an answer needs a check that the barrier calls.

use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{DeviceSetup, FailedTransmission, Report, UnableDetectors, WakeOutcome};
use reveille_common::state::DeviceView;
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::units::Energy;

use super::admission::Assignment;

/// The devices of a run and the hosts that they are assigned to. Each host has a position; a successor takes it over,
/// and a removed host keeps it. Methods with a `position` panic unless it is below [`Self::host_count`].
#[derive(Clone, Debug)]
pub struct Roster {
    devices: Vec<DeviceSetup>,
    /// Largest information Ψ of a report.
    psi: f64,
    assignments: Vec<Assignment>,
    /// Whether the host at each position is removed, with its devices.
    removed: Vec<bool>,
    /// By host number: the position in `assignments`, `None` for a host that is unknown or removed.
    positions: Vec<Option<usize>>,
    /// The position in `assignments` of each device's owner; empty before the run begins.
    owners: Vec<usize>,
}

impl Roster {
    /// Creates a roster of `devices`, in the order of ids, without hosts. A report carries at most `psi`.
    pub const fn new(devices: Vec<DeviceSetup>, psi: f64) -> Self {
        Self {
            devices,
            psi,
            assignments: Vec::new(),
            removed: Vec::new(),
            positions: Vec::new(),
            owners: Vec::new(),
        }
    }

    /// Sets the hosts with which the run begins. The caller ensures that they own every device, each only once.
    pub fn set_hosts(&mut self, assignments: Vec<Assignment>) {
        self.positions.clear();
        self.owners = vec![0; self.devices.len()];
        for (position, assignment) in assignments.iter().enumerate() {
            self.set_position(assignment.host, Some(position));
            self.owners[assignment.first.index()..][..assignment.count as usize].fill(position);
        }
        self.removed = vec![false; assignments.len()];
        self.assignments = assignments;
    }

    /// Removes the host at `position` with its devices. Only the barrier calls this, once it expects nothing from the
    /// host.
    pub fn remove_host(&mut self, position: usize) {
        self.set_position(self.assignments[position].host, None);
        self.removed[position] = true;
    }

    /// Whether the host at `position` is removed.
    pub fn is_removed(&self, position: usize) -> bool {
        self.removed[position]
    }

    /// Assigns all devices of the host `lost` to `successor`.
    ///
    /// # Panics
    /// If `lost` is not a host of the run, or `successor` has a different range of devices.
    pub fn replace(&mut self, lost: HostId, successor: Assignment) {
        let position = self.position(lost).expect("a host of this run");
        let Assignment { first, count, .. } = self.assignments[position];
        assert_eq!(
            (first, count),
            (successor.first, successor.count),
            "a successor takes over the whole range"
        );
        self.set_position(lost, None);
        self.set_position(successor.host, Some(position));
        self.assignments[position] = successor;
    }

    /// The owner of `device`; `None` before the run begins and after its removal.
    pub fn owner_of(&self, device: DeviceId) -> Option<HostId> {
        let position = *self.owners.get(device.index())?;
        (!self.removed[position]).then(|| self.assignments[position].host)
    }

    /// Number of hosts that are not removed.
    pub fn active_host_count(&self) -> usize {
        self.removed.iter().filter(|is_removed| !**is_removed).count()
    }

    /// Number of devices N.
    pub const fn device_count(&self) -> usize {
        self.devices.len()
    }

    fn set_position(&mut self, host: HostId, position: Option<usize>) {
        let length = self.positions.len().max(host.index() + 1);
        self.positions.resize(length, None);
        self.positions[host.index()] = position;
    }

    /// Number of hosts, including removed ones.
    pub const fn host_count(&self) -> usize {
        self.assignments.len()
    }

    /// The position of `host`, `0 .. host_count()`, if it owns devices.
    pub fn position(&self, host: HostId) -> Option<usize> {
        self.positions.get(host.index()).copied().flatten()
    }

    /// The assignment of the host at `position`.
    pub fn assignment(&self, position: usize) -> Assignment {
        self.assignments[position]
    }

    /// Whether the host at `position` is the owner of `device`.
    pub fn owns(&self, position: usize, device: DeviceId) -> bool {
        let Assignment { first, count, .. } = self.assignments[position];
        // A device before the range must not wrap into it.
        device.0.checked_sub(first.0).is_some_and(|offset| offset < count)
    }

    /// Whether `report` is possible for a device of this run.
    pub fn is_possible_report(&self, report: &Report) -> bool {
        let battery_fits = self
            .setup(report.device)
            .is_some_and(|setup| report.battery <= setup.energy.e_max);
        // NaN lies in no range, so it is refused as well.
        battery_fits && (0.0..=self.psi).contains(&report.information)
    }

    /// Whether `failure` is possible for its device, whichever host sends it.
    pub(crate) fn is_possible_failure(&self, failure: &FailedTransmission) -> bool {
        self.setup(failure.device)
            // A device fails only when it holds less than E_Tx, and it loses its whole level.
            .is_some_and(|setup| failure.drained_energy < setup.energy.e_tx)
    }

    /// Whether `outcome` is possible for a wake-up of `device` that led to no report.
    pub(crate) fn is_possible_outcome(&self, device: DeviceId, outcome: &WakeOutcome) -> bool {
        match outcome {
            WakeOutcome::Missed => true,
            WakeOutcome::Failed(failure) => failure.device == device && self.is_possible_failure(failure),
            WakeOutcome::Late { spent, powered } => self.setup(device).is_some_and(|setup| {
                let e_idle = setup.energy.e_idle;
                // With power, waking costs E_idle in full; without enough, the battery is emptied by less than that.
                if *powered { *spent == e_idle } else { *spent < e_idle }
            }),
            // In both cases the host sends a report instead, and the base station decides whether it is lost.
            WakeOutcome::Reported(_) | WakeOutcome::Lost(_) => false,
        }
    }

    /// Whether the host at `position` can have had this number of reports, these failures and these `unable` devices
    /// in one TTI.
    pub(crate) fn is_possible_answer(
        &self,
        position: usize,
        reports: u32,
        failures: &[FailedTransmission],
        unable: UnableDetectors,
    ) -> bool {
        let assignment = self.assignments[position];
        let are_own_failures = failures
            .iter()
            .all(|f| self.owns(position, f.device) && self.is_possible_failure(f));
        // A device has at most one of these outcomes. In 64 bits, because a host can send any numbers.
        let outcomes = u64::from(reports) + unable.total() + failures.len() as u64;
        are_own_failures && outcomes <= u64::from(assignment.count)
    }

    /// Whether `sums` are possible totals for the devices of the host at `position`.
    pub(crate) fn are_possible_totals(&self, position: usize, sums: &DeviceTotals) -> bool {
        let setups = self.setups_of(position);
        let (mut initial, mut capacity) = (Energy::ZERO, Energy::ZERO);
        for setup in setups {
            initial += setup.energy.initial;
            capacity += setup.energy.e_max;
        }
        // `initial` is known from the scenario; a host could otherwise balance any false field with it.
        sums.is_balanced() && sums.initial == initial && sums.battery <= capacity
    }

    /// Whether `views` are possible for the devices of the host at `position`, in the order of ids.
    pub(crate) fn are_possible_views(&self, position: usize, views: &[DeviceView]) -> bool {
        let setups = self.setups_of(position);
        // `zip` stops at the shorter side, so the lengths must agree first.
        setups.len() == views.len()
            && setups
                .iter()
                .zip(views)
                .all(|(setup, view)| view.battery <= setup.energy.e_max)
    }

    /// Whether `ledgers` contains each device of the host at `position` once, with a balanced ledger.
    pub(crate) fn are_possible_ledgers(&self, position: usize, ledgers: &[(DeviceId, Ledger)]) -> bool {
        let mut devices: Vec<DeviceId> = ledgers.iter().map(|(device, _)| *device).collect();
        // Sorted, the list equals the host's devices only if each occurs exactly once.
        devices.sort_unstable();
        let is_complete = devices
            .iter()
            .copied()
            .eq(self.setups_of(position).iter().map(|setup| setup.id));
        let is_balanced = |(device, ledger): &(DeviceId, Ledger)| {
            self.setup(*device).is_some_and(|setup| {
                let energy = setup.energy;
                let totals = &ledger.whole;
                ledger.is_valid() && totals.initial == energy.initial && totals.battery <= energy.e_max
            })
        };
        is_complete && ledgers.iter().all(is_balanced)
    }

    fn setups_of(&self, position: usize) -> &[DeviceSetup] {
        let Assignment { first, count, .. } = self.assignments[position];
        &self.devices[first.index()..][..count as usize]
    }

    fn setup(&self, device: DeviceId) -> Option<&DeviceSetup> {
        self.devices.get(device.index())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use reveille_common::geometry::Point;
    use reveille_common::harvest::{ArrivalsSetup, HarvestSetup};
    use reveille_common::scenario::EnergyModel;

    use super::*;

    /// Ten devices with 50 of 100 units, five on each of the hosts 0 and 1.
    pub(crate) fn two_host_roster() -> Roster {
        let units = |n: u64| Energy::from_micro(n * 1_000_000);
        let energy = EnergyModel {
            e_max: units(100),
            e_idle: units(1),
            e_wur: units(0),
            e_tx: units(10),
            initial: units(50),
        };
        let harvest = HarvestSetup::Arrivals(ArrivalsSetup { p: 0.5, e_b: units(5) });
        let device = |id| DeviceSetup {
            id: DeviceId(id),
            position: Point::new(1.0, 1.0),
            energy,
            harvest,
        };
        let mut roster = Roster::new((0..10).map(device).collect(), 1.0);
        let assignment = |host, first| Assignment {
            host: HostId(host),
            first: DeviceId(first),
            count: 5,
        };
        roster.set_hosts(vec![assignment(0, 0), assignment(1, 5)]);
        roster
    }

    fn ledger() -> Ledger {
        let initial = Energy::from_micro(50_000_000);
        let whole = DeviceTotals {
            initial,
            battery: initial,
            ..DeviceTotals::default()
        };
        Ledger {
            whole,
            ..Ledger::default()
        }
    }

    #[test]
    fn ledgers_must_be_complete_and_balanced() {
        let roster = two_host_roster();
        let ledgers: Vec<_> = (5..10).rev().map(|id| (DeviceId(id), ledger())).collect();
        assert!(roster.are_possible_ledgers(1, &ledgers));
        assert!(!roster.are_possible_ledgers(0, &ledgers), "devices of another host");
        assert!(!roster.are_possible_ledgers(1, &ledgers[1..]), "one is missing");
        let mut unbalanced = ledgers.clone();
        unbalanced[2].1.whole.spent.sleep = Energy::from_micro(1);
        assert!(!roster.are_possible_ledgers(1, &unbalanced), "one is not balanced");
        let sums: DeviceTotals = ledgers.iter().map(|(_, ledger)| ledger.whole).sum();
        assert!(roster.are_possible_totals(1, &sums) && !roster.are_possible_totals(1, &ledger().whole));
    }

    #[test]
    fn impossible_reports_and_failures_are_detected() {
        let roster = two_host_roster();
        let report = |device, information, battery| Report {
            device: DeviceId(device),
            tti: reveille_common::ids::Tti(1),
            information,
            battery: Energy::from_micro(battery),
        };
        assert!(roster.is_possible_report(&report(9, 1.0, 100_000_000)));
        let impossible = [
            (10, 0.5, 0),
            (0, 1.5, 0),
            (0, f64::NAN, 0),
            (0, -0.1, 0),
            (0, 0.5, 100_000_001),
        ];
        assert!(
            impossible
                .iter()
                .all(|&(device, i, battery)| !roster.is_possible_report(&report(device, i, battery)))
        );
        let failure = |device, drained| FailedTransmission {
            device: DeviceId(device),
            drained_energy: Energy::from_micro(drained),
        };
        let one_each = UnableDetectors {
            unpowered: 1,
            failed: 1,
        };
        assert!(roster.is_possible_answer(0, 2, &[failure(4, 9_999_999)], one_each));
        assert!(
            !roster.is_possible_answer(0, 3, &[failure(4, 0)], one_each),
            "more outcomes than devices"
        );
        assert!(
            !roster.is_possible_answer(0, 0, &[failure(5, 0)], UnableDetectors::default()),
            "a device of another host"
        );
        assert!(
            !roster.is_possible_failure(&failure(0, 10_000_000)),
            "the battery would have paid for the report"
        );
    }
}
