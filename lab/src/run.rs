//! One run in memory: the same device and BS machines as in the emulator, driven by a loop.

use reveille_bs::boundaries::Boundaries;
use reveille_bs::cycle::{Asking, Cycle, Step};
use reveille_bs::observe::{Happening, Observer};
use reveille_bs::outcome::Outcome;
use reveille_bs::policy::external::{Answered, Decision};
use reveille_bs::prepared::Prepared;
use reveille_bs::taken::{Start, Taken};
use reveille_common::event::Stimulus;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Checkpoint, Failure, Outage, Report};
use reveille_common::radio::Air;
use reveille_common::score::{Accounts, WindowRecord};
use reveille_common::state::DeviceView;
use reveille_common::totals::Ledger;
use reveille_common::world::World;
use reveille_device::machine::{Machine, Physics, Sensed};

use crate::coming::Coming;
use crate::inputs::{Input, Inputs};

/// How to run; none of it changes the outcome.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Grant as many TTIs at a time as possible, or one.
    pub lookahead: bool,
    /// TTIs in a window of the per-window series; `u64::MAX` for none.
    pub window: u64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            lookahead: true,
            window: u64::MAX,
        }
    }
}

/// A run under way.
pub struct Run {
    cycle: Cycle,
    machines: Vec<Machine>,
    physics: Physics,
    air: Air,
    boundaries: Boundaries,
    accounts: Accounts,
    options: Options,
    coming: Coming,
    is_undecided: bool,
    /// The TTI from which the plan in force holds.
    plan_from: Option<Tti>,
    /// The last boundary whose sums were taken.
    reached: Tti,
    reports: Vec<Report>,
    failures: Vec<Failure>,
    open: Open,
}

/// The TTI that was granted last, as far as its wake-ups go by it.
#[derive(Clone, Copy, Debug, Default)]
struct Open {
    tti: Tti,
    stimulus: Option<Stimulus>,
    /// Wake-ups that were sent.
    woken: u32,
    wants_states: bool,
}

/// Where a run stands whose decisions come from outside.
#[derive(Clone, Debug)]
pub(crate) enum Stand {
    /// A plan is asked for.
    Plan,
    /// It is asked whom to wake.
    Wake(Asking),
    /// It has come to its end, or the observer has said stop.
    Ended,
}

impl Run {
    /// The run that is `prepared`, before TTI 0.
    pub fn new(prepared: &Prepared, options: Options) -> Self {
        let world = World::new(&prepared.scenario, &prepared.deployment);
        Self::with_world(prepared, world, options)
    }

    /// As [`Self::new`], in a world of the caller's, such as one with scripted events.
    pub fn with_world(prepared: &Prepared, world: World, options: Options) -> Self {
        Self::with_cycle(prepared, Cycle::with_world(prepared, world), options)
    }

    /// The run that is `prepared`, before TTI 0, with a base station and a world of the caller's.
    pub fn with_cycle(prepared: &Prepared, cycle: Cycle, options: Options) -> Self {
        let Prepared {
            scenario, deployment, ..
        } = prepared;
        let physics = Physics::new(
            scenario.seed,
            scenario.warm_up_end(),
            scenario.sensing.clone(),
            scenario.radio,
            &deployment.devices,
            deployment.traces.clone(),
        );
        let boundaries = Boundaries::new(scenario, options.window);
        Self {
            cycle,
            machines: deployment
                .devices
                .iter()
                .map(|setup| Machine::new(setup, &physics))
                .collect(),
            accounts: Accounts::new(deployment),
            air: Air::new(scenario.seed, &scenario.radio),
            physics,
            boundaries,
            options,
            coming: Coming::default(),
            is_undecided: false,
            plan_from: None,
            reached: Tti::ZERO,
            reports: Vec::new(),
            failures: Vec::new(),
            open: Open::default(),
        }
    }

    /// What comes in a TTI that has not been granted: devices go, as if their process had been lost, or somebody
    /// outside decides.
    pub fn expect(&mut self, input: Input) {
        self.coming.add(input);
    }

    /// As [`Self::expect`], each kind in the order in which they come.
    pub fn expect_all(&mut self, inputs: &Inputs) {
        self.coming.add_all(inputs);
    }

    /// Whether there are outages that have not come.
    pub fn awaits_outages(&self) -> bool {
        !self.coming.has_no_outage()
    }

    /// The TTI of a question that no decision is there for, if the run stands at one. Nothing goes on from there, and
    /// where it is asked whom to wake the TTI is open: such a run comes to nothing.
    pub fn undecided(&self) -> Option<Tti> {
        let is_open = self.cycle.is_open();
        let tti = if is_open { self.open.tti } else { self.cycle.next_tti() };
        self.is_undecided.then_some(tti)
    }

    /// The decisions that nobody has asked for so far.
    pub fn take_decisions(&mut self) -> Vec<Answered> {
        self.coming.take_decisions()
    }

    /// The devices, in the order of ids.
    pub fn machines(&self) -> &[Machine] {
        &self.machines
    }

    /// The devices where the last granted TTI has left them, in the order of ids, S1 or S4 where nothing else has
    /// happened. Looking brings them all up to date and changes nothing else.
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

    /// Runs to the end, or until `observer` says stop.
    pub fn finish(mut self, observer: &mut impl Observer) -> Outcome {
        if self.advance(self.boundaries.end(), observer) {
            self.reach(observer);
        }
        let ledgers = self.ledgers(DeviceId(0), self.machines.len() as u32);
        self.cycle.finish(&ledgers)
    }

    /// The books of the devices from `first` on, `count` of them, before the next TTI.
    pub fn ledgers(&mut self, first: DeviceId, count: u32) -> Vec<Ledger> {
        let end = self.cycle.next_tti();
        let machines = &mut self.machines[first.index()..][..count as usize];
        machines
            .iter_mut()
            .map(|machine| settled(machine, end).ledger())
            .collect()
    }

    /// Runs to TTI `to`, which is then the next, or until `observer` says stop or a decision is missing; false if so.
    /// The sums of a window
    /// that ends with `to` are taken when the run goes on from there.
    pub fn advance(&mut self, to: Tti, observer: &mut impl Observer) -> bool {
        while self.cycle.next_tti() < to {
            if !self.reach(observer) {
                return false;
            }
            self.grant_before(to, observer);
            if self.is_undecided {
                return false;
            }
        }
        true
    }

    /// What the run comes to if it ends before the next TTI.
    pub fn cut_short(mut self) -> Outcome {
        self.boundaries = self.boundaries.until(self.cycle.next_tti());
        self.finish(&mut ())
    }

    /// The devices from `first` on, `count` of them, for other processes to go on with.
    pub fn checkpoints(&self, first: DeviceId, count: u32) -> Vec<Checkpoint> {
        let machines = &self.machines[first.index()..][..count as usize];
        machines.iter().map(Machine::checkpoint).collect()
    }

    /// The run for hosts on the bus to go on with.
    pub fn hand_over(mut self) -> Taken {
        let next = self.cycle.next_tti();
        let views = self
            .machines
            .iter_mut()
            .map(|machine| settled(machine, next).view())
            .collect();
        let start = Start {
            next,
            plan: self.plan_from,
            devices: self.checkpoints(DeviceId(0), self.machines.len() as u32),
        };
        Taken {
            cycle: self.cycle,
            accounts: self.accounts,
            start: start.into(),
            views,
        }
    }

    /// One grant of the clock: all its TTIs, with the reports and wake-ups of the last.
    pub fn grant(&mut self, observer: &mut impl Observer) {
        self.grant_before(Tti::NEVER, observer);
    }

    /// As [`Self::grant`], of TTIs before `limit` alone.
    fn grant_before(&mut self, limit: Tti, observer: &mut impl Observer) {
        self.brief(observer);
        if self.cycle.question().is_some() {
            let Some(decision) = self.coming.plan(self.cycle.next_tti()) else {
                self.is_undecided = true;
                return;
            };
            self.cycle.decide(decision);
            self.is_undecided = false;
        }
        let mut step = self.open(limit, observer);
        while let Some(asking) = self.wake(step, observer) {
            let Some(devices) = self.coming.whom(self.open.tti) else {
                // The TTI stays open: what would have been decided nobody knows.
                self.is_undecided = true;
                return;
            };
            step = self.cycle.wake(asking, &devices, observer);
        }
    }

    /// Tells the true batteries, where they are wanted.
    fn brief(&mut self, observer: &mut impl Observer) {
        let Self { cycle, machines, .. } = self;
        let k = cycle.next_tti();
        if cycle.wants_batteries() {
            let batteries = machines.iter_mut().map(|machine| {
                machine.settle(k);
                machine.battery()
            });
            cycle.tell_batteries(batteries, observer);
        }
    }

    /// Grants TTIs before `limit` and has their reports gathered.
    fn open(&mut self, limit: Tti, observer: &mut impl Observer) -> Step {
        let Self {
            cycle,
            machines,
            physics,
            air,
            reports,
            failures,
            coming,
            plan_from,
            open,
            ..
        } = self;
        let k = cycle.next_tti();
        let limit = limit.min(coming.next_outage().saturating_add(1)).max(k + 1);
        let horizon = if self.options.lookahead {
            self.boundaries.next_boundary(k)
        } else {
            k + 1
        };
        let wants_states = observer.wants_states();
        let granted = cycle.grant(horizon.min(limit), observer);
        for update in &granted.updates {
            *plan_from = Some(update.from);
            let air = air.at(update.from);
            for machine in machines.iter_mut().filter(|machine| !air.misses_plan(machine.id())) {
                machine.set_duty(update.from, update.plan.duty_cycle(machine.id()));
            }
        }
        let (last, stimulus) = (granted.grant.last, granted.grant.stimulus);
        *open = Open {
            tti: last,
            stimulus,
            woken: 0,
            wants_states,
        };
        reports.clear();
        failures.clear();
        while let Some(outage) = coming.outage(last, None) {
            go(&outage, machines, cycle, observer);
        }
        if let Some(stimulus) = &stimulus {
            for device in cycle.detectors() {
                match machines[device.index()].sense(last, stimulus, physics) {
                    Sensed::Nothing => {}
                    Sensed::Reported(report) => reports.push(report),
                    Sensed::Failed(failure) => failures.push(failure),
                }
            }
        }
        cycle.gathered(granted, reports, failures, observer)
    }

    /// Does the wake-ups from `step` on. Gives what somebody outside is asked before the TTI can be closed.
    fn wake(&mut self, mut step: Step, observer: &mut impl Observer) -> Option<Asking> {
        let Self {
            cycle,
            machines,
            physics,
            coming,
            open:
                Open {
                    tti,
                    stimulus,
                    woken,
                    wants_states,
                },
            ..
        } = self;
        let tti = *tti;
        loop {
            match step {
                Step::WakeUp(waking) => {
                    while let Some(outage) = coming.outage(tti, Some(*woken)) {
                        go(&outage, machines, cycle, observer);
                    }
                    *woken += 1;
                    let stimulus = stimulus.as_ref().filter(|_| !waking.is_late());
                    let outcome = machines[waking.device().index()].wake(tti, stimulus, physics);
                    step = cycle.woken(waking, &outcome, observer);
                }
                Step::Asks(asking) => return Some(asking),
                Step::Closed => break,
            }
        }
        if *wants_states {
            let view = |machine: &mut Machine| {
                machine.begin(tti);
                machine.view()
            };
            let states: Vec<DeviceView> = machines.iter_mut().map(view).collect();
            observer.see(&Happening::States(&states));
        }
        None
    }

    /// Goes on from between two TTIs to where somebody outside has to decide.
    pub(crate) fn seek_question(&mut self, observer: &mut impl Observer) -> Stand {
        while self.reach(observer) {
            self.brief(observer);
            if self.cycle.next_tti() >= self.boundaries.end() {
                break;
            }
            if self.cycle.question().is_some() {
                return Stand::Plan;
            }
            let step = self.open(Tti::NEVER, observer);
            if let Some(asking) = self.wake(step, observer) {
                return Stand::Wake(asking);
            }
        }
        Stand::Ended
    }

    /// Goes on from [`Stand::Plan`] with this answer.
    pub(crate) fn decide(&mut self, decision: Decision, observer: &mut impl Observer) -> Stand {
        self.cycle.decide(decision);
        let step = self.open(Tti::NEVER, observer);
        self.go_on(step, observer)
    }

    /// Goes on from [`Stand::Wake`] with this answer.
    pub(crate) fn call(&mut self, asking: Asking, devices: &[DeviceId], observer: &mut impl Observer) -> Stand {
        let step = self.cycle.wake(asking, devices, observer);
        self.go_on(step, observer)
    }

    fn go_on(&mut self, step: Step, observer: &mut impl Observer) -> Stand {
        match self.wake(step, observer) {
            Some(asking) => Stand::Wake(asking),
            None => self.seek_question(observer),
        }
    }

    /// A copy that goes on from here, where somebody outside decides.
    pub(crate) fn branch(&self) -> Option<Self> {
        Some(Self {
            cycle: self.cycle.branch()?,
            machines: self.machines.clone(),
            physics: self.physics.clone(),
            air: self.air.clone(),
            accounts: self.accounts.clone(),
            coming: self.coming.clone(),
            reports: Vec::new(),
            failures: Vec::new(),
            ..*self
        })
    }

    /// Takes the sums at the next TTI, if it is a boundary whose sums were not taken. False if `observer` says stop.
    fn reach(&mut self, observer: &mut impl Observer) -> bool {
        let k = self.cycle.next_tti();
        if !self.boundaries.is_boundary(k) || k <= self.reached {
            return true;
        }
        self.reached = k;
        let energy = self
            .machines
            .iter_mut()
            .map(|machine| settled(machine, k).totals())
            .sum();
        let window = self.accounts.reach(k, energy, *self.cycle.event_totals());
        observer.window(&window)
    }
}

/// Devices go in the TTI that was granted last.
fn go(outage: &Outage, machines: &mut [Machine], cycle: &mut Cycle, observer: &mut impl Observer) {
    let devices = outage.first.index()..=outage.last().index();
    machines[devices].iter_mut().for_each(|machine| machine.go(outage.tti));
    cycle.gone(outage, observer);
}

fn settled(machine: &mut Machine, k: Tti) -> &Machine {
    machine.settle(k);
    machine
}

/// An observer that stops a run when this says so, looking at the end of each window.
#[derive(Clone, Copy, Debug)]
pub struct StopWhen<F>(pub F);

impl<F: Fn() -> bool> Observer for StopWhen<F> {
    fn window(&mut self, _: &WindowRecord) -> bool {
        !(self.0)()
    }
}
