//! The hosts of a run and their devices, and what can be true of them. Every number that comes in over the bus is
//! checked here, for it may be anything.

use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{DeviceSetup, Failure, Report, WakeOutcome};
use reveille_common::state::DeviceView;
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::units::Energy;

use crate::host::admission::Places;

/// The devices of a run and the hosts that carry them.
#[derive(Clone, Debug)]
pub struct Roster {
    devices: Vec<DeviceSetup>,
    /// Largest information Ψ of a report.
    psi: f64,
    hosts: Vec<Places>,
    /// Whether the host at a position has gone, with its devices.
    gone: Vec<bool>,
    /// The position in `hosts` of each host by its number.
    positions: Vec<Option<usize>>,
    /// The position in `hosts` of each device's host, once there are any.
    carriers: Vec<usize>,
}

impl Roster {
    /// The roster of `devices`, in the order of ids, whose reports carry at most `psi`. Nobody carries them yet.
    pub const fn new(devices: Vec<DeviceSetup>, psi: f64) -> Self {
        Self {
            devices,
            psi,
            hosts: Vec::new(),
            gone: Vec::new(),
            positions: Vec::new(),
            carriers: Vec::new(),
        }
    }

    /// The run begins with these hosts.
    pub fn set_hosts(&mut self, hosts: Vec<Places>) {
        self.positions.clear();
        self.carriers = vec![0; self.devices.len()];
        for (position, places) in hosts.iter().enumerate() {
            self.set_position(places.host, Some(position));
            self.carriers[places.first.index()..][..places.count as usize].fill(position);
        }
        self.gone = vec![false; hosts.len()];
        self.hosts = hosts;
    }

    /// The host at `position` has gone, and nobody carries its devices any more.
    pub fn lose(&mut self, position: usize) {
        self.set_position(self.hosts[position].host, None);
        self.gone[position] = true;
    }

    /// Whether the host at `position` has gone for good.
    pub fn is_gone(&self, position: usize) -> bool {
        self.gone[position]
    }

    /// From now on the devices of the host `lost` are those of `heir`, the same ones.
    ///
    /// # Panics
    /// If `lost` carries no devices, or others.
    pub fn replace(&mut self, lost: HostId, heir: Places) {
        let position = self.position(lost).expect("a host of this run");
        let Places { first, count, .. } = self.hosts[position];
        assert_eq!(
            (first, count),
            (heir.first, heir.count),
            "an heir has all that was left"
        );
        self.set_position(lost, None);
        self.set_position(heir.host, Some(position));
        self.hosts[position] = heir;
    }

    /// The host that carries `device`, once there are any; none if it has gone for good.
    pub fn carrier(&self, device: DeviceId) -> Option<HostId> {
        let position = *self.carriers.get(device.index())?;
        (!self.gone[position]).then(|| self.hosts[position].host)
    }

    /// The hosts that carry devices.
    pub fn carrying(&self) -> usize {
        self.gone.iter().filter(|is_gone| !**is_gone).count()
    }

    /// Number of devices N.
    pub const fn devices(&self) -> usize {
        self.devices.len()
    }

    fn set_position(&mut self, host: HostId, position: Option<usize>) {
        let length = self.positions.len().max(host.index() + 1);
        self.positions.resize(length, None);
        self.positions[host.index()] = position;
    }

    /// How many hosts there are, or were.
    pub const fn hosts(&self) -> usize {
        self.hosts.len()
    }

    /// The position of `host`, `0 .. hosts()`, if it carries devices.
    pub fn position(&self, host: HostId) -> Option<usize> {
        self.positions.get(host.index()).copied().flatten()
    }

    /// The places of the host at `position`.
    pub fn places(&self, position: usize) -> Places {
        self.hosts[position]
    }

    /// Whether the host at `position` carries `device`.
    pub fn owns(&self, position: usize, device: DeviceId) -> bool {
        let Places { first, count, .. } = self.hosts[position];
        device.0.checked_sub(first.0).is_some_and(|offset| offset < count)
    }

    /// Whether a device of this run can have sent `report`.
    pub fn can_report(&self, report: &Report) -> bool {
        let battery_fits = self
            .setup(report.device)
            .is_some_and(|setup| report.battery <= setup.energy.e_max);
        battery_fits && (0.0..=self.psi).contains(&report.information)
    }

    /// Whether `failure` can have happened.
    pub fn can_fail(&self, failure: &Failure) -> bool {
        self.setup(failure.device)
            .is_some_and(|setup| failure.drained < setup.energy.e_tx)
    }

    /// Whether a wake-up of `device` can have come to this, where no report was sent.
    pub fn can_come_to(&self, device: DeviceId, outcome: &WakeOutcome) -> bool {
        match outcome {
            WakeOutcome::Unheard => true,
            WakeOutcome::Failed(failure) => failure.device == device && self.can_fail(failure),
            WakeOutcome::Late { spent, powered } => self.setup(device).is_some_and(|setup| {
                let e_idle = setup.energy.e_idle;
                if *powered { *spent == e_idle } else { *spent < e_idle }
            }),
            WakeOutcome::Reported(_) | WakeOutcome::Lost(_) => false,
        }
    }

    /// Whether the host at `position` can have come to so many reports and these failures in one TTI.
    pub fn can_be_done(&self, position: usize, reports: u32, failures: &[Failure]) -> bool {
        let places = self.hosts[position];
        let is_own = failures
            .iter()
            .all(|f| self.owns(position, f.device) && self.can_fail(f));
        is_own && failures.len() <= places.count as usize && reports <= places.count - failures.len() as u32
    }

    /// Whether `sums` can be those of all devices of the host at `position`.
    pub fn can_sum_to(&self, position: usize, sums: &DeviceTotals) -> bool {
        let own = self.own(position);
        let (mut initial, mut capacity) = (Energy::ZERO, Energy::ZERO);
        for setup in own {
            initial += setup.energy.initial;
            capacity += setup.energy.e_max;
        }
        sums.closes() && sums.initial == initial && sums.battery <= capacity
    }

    /// Whether `views` can be those of the devices of the host at `position`, in the order of ids.
    pub fn can_look_so(&self, position: usize, views: &[DeviceView]) -> bool {
        let own = self.own(position);
        own.len() == views.len()
            && own
                .iter()
                .zip(views)
                .all(|(setup, view)| view.battery <= setup.energy.e_max)
    }

    /// Whether `ledgers` are those of the devices of the host at `position`: each once, and each closes.
    pub fn can_end_with(&self, position: usize, ledgers: &[(DeviceId, Ledger)]) -> bool {
        let mut devices: Vec<DeviceId> = ledgers.iter().map(|(device, _)| *device).collect();
        devices.sort_unstable();
        let is_whole = devices
            .iter()
            .copied()
            .eq(self.own(position).iter().map(|setup| setup.id));
        let is_sound = |(device, ledger): &(DeviceId, Ledger)| {
            self.setup(*device).is_some_and(|setup| {
                let energy = setup.energy;
                let whole = &ledger.whole;
                ledger.is_sound() && whole.initial == energy.initial && whole.battery <= energy.e_max
            })
        };
        is_whole && ledgers.iter().all(is_sound)
    }

    fn own(&self, position: usize) -> &[DeviceSetup] {
        let Places { first, count, .. } = self.hosts[position];
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
    pub(crate) fn roster() -> Roster {
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
        let places = |host, first| Places {
            host: HostId(host),
            first: DeviceId(first),
            count: 5,
        };
        roster.set_hosts(vec![places(0, 0), places(1, 5)]);
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
    fn ledgers_are_whole_and_close() {
        let roster = roster();
        let own: Vec<_> = (5..10).rev().map(|id| (DeviceId(id), ledger())).collect();
        assert!(roster.can_end_with(1, &own));
        assert!(!roster.can_end_with(0, &own), "another host's");
        assert!(!roster.can_end_with(1, &own[1..]), "one is missing");
        let mut false_one = own.clone();
        false_one[2].1.whole.spent.sleep = Energy::from_micro(1);
        assert!(!roster.can_end_with(1, &false_one), "one does not close");
        let sums: DeviceTotals = own.iter().map(|(_, ledger)| ledger.whole).sum();
        assert!(roster.can_sum_to(1, &sums) && !roster.can_sum_to(1, &ledger().whole));
    }

    #[test]
    fn impossible_reports_and_failures_are_known() {
        let roster = roster();
        let report = |device, information, battery| Report {
            device: DeviceId(device),
            tti: reveille_common::ids::Tti(1),
            information,
            battery: Energy::from_micro(battery),
        };
        assert!(roster.can_report(&report(9, 1.0, 100_000_000)));
        let bad = [
            (10, 0.5, 0),
            (0, 1.5, 0),
            (0, f64::NAN, 0),
            (0, -0.1, 0),
            (0, 0.5, 100_000_001),
        ];
        assert!(
            bad.iter()
                .all(|&(device, i, battery)| !roster.can_report(&report(device, i, battery)))
        );
        let failure = |device, drained| Failure {
            device: DeviceId(device),
            drained: Energy::from_micro(drained),
        };
        assert!(roster.can_be_done(0, 4, &[failure(4, 9_999_999)]));
        assert!(!roster.can_be_done(0, 5, &[failure(4, 0)]), "more than it carries");
        assert!(!roster.can_be_done(0, 0, &[failure(5, 0)]), "another host's device");
        assert!(!roster.can_fail(&failure(0, 10_000_000)), "it could have paid");
    }
}
