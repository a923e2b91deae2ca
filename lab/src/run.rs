//! One run in memory: the same device and BS machines as in the emulator, driven by a loop.

use crate::adjusted::resolve;
use reveille_bs::cycle::{Cycle, Grant, Step};
use reveille_bs::outcome::{Accounts, Outcome, Watcher};
use reveille_bs::schedule::Schedule;
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Failure, Report, WakeOutcome};
use reveille_common::metrics::DeviceTotals;
use reveille_common::scenario::Scenario;
use reveille_device::machine::{Machine, Sensed, World};

/// How to run; none of it changes the outcome.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Grant as many TTIs at a time as possible, or one.
    pub lookahead: bool,
    /// TTIs in a window of the per-window series; `u64::MAX` for none.
    pub window: u64,
    /// Whether to keep the per-event series.
    pub keep_records: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            lookahead: true,
            window: u64::MAX,
            keep_records: false,
        }
    }
}

/// Sees everything that happens in a run, as nobody in it can. It changes nothing.
pub trait Observer {
    /// These TTIs come next.
    fn granted(&mut self, _grant: &Grant) {}
    /// The devices with δ = 1 have done the last of them; these reported and these failed to.
    fn gathered(&mut self, _reports: &[Report], _failures: &[Failure]) {}
    /// The BS has woken `device`.
    fn woken(&mut self, _device: DeviceId, _outcome: &WakeOutcome) {}
}

/// An observer that does not look.
impl Observer for () {}

/// A run under way.
pub struct Run {
    cycle: Cycle,
    machines: Vec<Machine>,
    world: World,
    schedule: Schedule,
    accounts: Accounts,
    options: Options,
    reports: Vec<Report>,
    failures: Vec<Failure>,
}

impl Run {
    /// A run of `scenario` before TTI 0. What its policy has to search for is searched first.
    pub fn new(scenario: &Scenario, options: Options) -> Self {
        Self::on(&resolve(scenario), &Deployment::new(scenario), options)
    }

    /// A run of `scenario`, ready as [`resolve`] leaves it, on the ground of `deployment`.
    pub fn on(scenario: &Scenario, deployment: &Deployment, options: Options) -> Self {
        let world = World::new(
            scenario.seed,
            scenario.sensing.clone(),
            &deployment.devices,
            deployment.traces.clone(),
        );
        let schedule = Schedule::new(scenario, options.window);
        Self {
            cycle: Cycle::new(scenario, deployment, options.keep_records),
            machines: deployment
                .devices
                .iter()
                .map(|setup| Machine::new(setup, &world))
                .collect(),
            accounts: Accounts::new(deployment, schedule.warm_up_end()),
            world,
            schedule,
            options,
            reports: Vec::new(),
            failures: Vec::new(),
        }
    }

    /// The devices, in the order of ids.
    pub fn machines(&self) -> &[Machine] {
        &self.machines
    }

    /// The devices where the last granted TTI has left them, in the order of ids, S1 or S4 where nothing else has happened.
    /// Looking brings them all up to date and changes nothing else.
    ///
    /// # Panics
    /// Before the first grant.
    pub fn look(&mut self) -> &[Machine] {
        let last = Tti(self.cycle.next_tti().0.checked_sub(1).expect("a TTI has been granted"));
        self.machines.iter_mut().for_each(|machine| machine.begin(last));
        &self.machines
    }

    /// The base station.
    pub const fn cycle(&self) -> &Cycle {
        &self.cycle
    }

    /// Runs to the end, or until `watcher` says stop.
    pub fn finish(mut self, watcher: &mut impl Watcher) -> Outcome {
        while self.cycle.next_tti() < self.schedule.end() {
            self.grant();
            let k = self.cycle.next_tti();
            if self.schedule.is_boundary(k) && !self.reach(k, watcher) {
                break;
            }
        }
        let end = self.cycle.next_tti();
        let ledgers: Vec<DeviceTotals> = self.machines.iter_mut().map(|machine| settled(machine, end)).collect();
        self.cycle.finish(&ledgers, self.accounts.at_warm_up())
    }

    /// One grant of the clock: all its TTIs, with the reports and wake-ups of the last.
    pub fn grant(&mut self) {
        self.grant_seen(&mut ());
    }

    /// The same as [`Self::grant`], before the eyes of `observer`.
    pub fn grant_seen(&mut self, observer: &mut impl Observer) {
        let k = self.cycle.next_tti();
        if self.cycle.wants_batteries() {
            let Self { cycle, machines, .. } = self;
            cycle.tell_batteries(machines.iter_mut().map(|machine| {
                machine.settle(k);
                machine.battery()
            }));
        }
        if let Some(update) = self.cycle.announce() {
            for machine in &mut self.machines {
                machine.set_duty(update.from, update.plan.duty_cycle(machine.id()));
            }
        }
        let horizon = if self.options.lookahead {
            self.schedule.next_boundary(k)
        } else {
            k + 1
        };
        let grant = self.cycle.grant(horizon);
        observer.granted(&grant);
        self.reports.clear();
        self.failures.clear();
        if let Some(stimulus) = &grant.stimulus {
            for device in self.cycle.detectors() {
                match self.machines[device.index()].sense(grant.last, stimulus, &self.world) {
                    Sensed::Nothing => {}
                    Sensed::Reported(report) => self.reports.push(report),
                    Sensed::Failed(failure) => self.failures.push(failure),
                }
            }
        }
        observer.gathered(&self.reports, &self.failures);
        let mut step = self.cycle.gathered(&mut self.reports, &self.failures);
        while let Step::WakeUp(device) = step {
            let stimulus = grant.stimulus.as_ref().expect("only an event makes the BS wake anyone");
            let outcome = self.machines[device.index()].wake(grant.last, stimulus, &self.world);
            observer.woken(device, &outcome);
            step = self.cycle.woken(&outcome);
        }
    }

    fn reach(&mut self, k: Tti, watcher: &mut impl Watcher) -> bool {
        let energy = self.machines.iter_mut().map(|machine| settled(machine, k)).sum();
        let window = self
            .accounts
            .reach(k, self.schedule.warm_up_end(), energy, *self.cycle.event_totals());
        watcher.window(&window, &self.cycle.take_records())
    }
}

fn settled(machine: &mut Machine, k: Tti) -> DeviceTotals {
    machine.settle(k);
    machine.totals()
}

/// Runs `scenario` from its first TTI to its last.
pub fn run(scenario: &Scenario) -> Outcome {
    Run::new(scenario, Options::default()).finish(&mut ())
}
