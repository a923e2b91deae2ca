//! The devices of a run, as what observers are told says: the same machines, taken through the same TTIs.
//!
//! Nobody has to send the states of all devices for an observer to know them: they follow from the scenario, the plans,
//! what the world shows and the wake-ups. What the devices are heard to say is compared with what the machines say.

use std::collections::VecDeque;
use std::sync::Arc;

use reveille_common::deployment::Deployment;
use reveille_common::event::Stimulus;
use reveille_common::ids::{DeviceId, MAX_TTIS, Tti};
use reveille_common::message::{Failure, Frame, Message, Outage, PlanUpdate, Report, WakeOutcome, WakeUp, World};
use reveille_common::plan::Plan;
use reveille_common::radio::{Air, Radio};
use reveille_common::scenario::Scenario;
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::Ledger;
use reveille_device::machine::{Machine, Physics, Sensed};

/// What does not fit to what was before it: a frame is missing, was changed, or comes from another version.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("TTI {tti}: {what}")]
pub struct Discrepancy {
    /// The TTI.
    pub tti: Tti,
    /// What is wrong.
    pub what: String,
}

/// The devices of a run.
#[derive(Clone, Debug)]
pub struct Mirror {
    machines: Vec<Machine>,
    physics: Physics,
    radio: Radio,
    air: Air,
    /// How many devices have missed the last plan.
    missed: u64,
    plan: Option<Plan>,
    /// The TTIs that the devices go through, once there are any.
    world: Option<World>,
    /// What devices with δ = 1 must be heard to say in the last of them, in the order of ids.
    reports: VecDeque<Report>,
    failures: VecDeque<Failure>,
    /// Those that do, as they were before, in case they turn out to be gone; likewise who was woken last.
    unsensed: Vec<Machine>,
    unwoken: Option<Machine>,
    /// The wake-up that is under way: whom, and what comes of it.
    waking: Option<(DeviceId, WakeOutcome)>,
    /// Whether its report has been heard already.
    has_reported: bool,
}

impl Mirror {
    /// The devices of `scenario`, which stand as in `deployment`, before TTI 0.
    pub fn new(scenario: &Scenario, deployment: &Deployment) -> Self {
        let physics = Physics::new(
            scenario.seed,
            scenario.warm_up_end(),
            scenario.sensing.clone(),
            scenario.radio,
            &deployment.devices,
            deployment.traces.iter().map(Arc::clone).collect(),
        );
        Self {
            machines: deployment
                .devices
                .iter()
                .map(|setup| Machine::new(setup, &physics))
                .collect(),
            radio: scenario.radio,
            air: Air::new(scenario.seed, &scenario.radio),
            missed: 0,
            physics,
            plan: None,
            world: None,
            reports: VecDeque::new(),
            failures: VecDeque::new(),
            unsensed: Vec::new(),
            unwoken: None,
            waking: None,
            has_reported: false,
        }
    }

    /// The TTI that the devices have reached: the last of those granted last.
    pub fn now(&self) -> Option<Tti> {
        self.world.map(|world| world.last)
    }

    /// The plan in force.
    pub const fn plan(&self) -> Option<&Plan> {
        self.plan.as_ref()
    }

    /// How many devices have missed the last plan.
    pub const fn missed_plans(&self) -> u64 {
        self.missed
    }

    /// What the world shows in the TTI that the devices have reached, if any device might react to it.
    pub fn stimulus(&self) -> Option<Stimulus> {
        self.world.and_then(|world| world.stimulus)
    }

    /// Whether a wake-up is under way, of which it has still to be told what came of it.
    pub const fn is_waking(&self) -> bool {
        self.waking.is_some()
    }

    /// The state and battery of `device` in the TTI that has been reached.
    pub fn view(&mut self, device: DeviceId) -> Option<DeviceView> {
        let now = self.now()?;
        let machine = self.machines.get_mut(device.index())?;
        machine.begin(now);
        Some(machine.view())
    }

    /// State and battery of all devices in TTI `tti`, in the order of ids, unless more is heard of it: one after
    /// another the TTIs from the one that has been reached to those that come next, under the plan in force.
    ///
    /// # Panics
    /// If a device has gone beyond it.
    pub fn views_at(&mut self, tti: Tti) -> Vec<DeviceView> {
        let view = |machine: &mut Machine| {
            machine.begin(tti);
            machine.view()
        };
        self.machines.iter_mut().map(view).collect()
    }

    /// State and battery of `device` in TTI `tti`, as in [`Self::views_at`].
    pub fn view_at(&mut self, device: DeviceId, tti: Tti) -> Option<DeviceView> {
        let machine = self.machines.get_mut(device.index())?;
        machine.begin(tti);
        Some(machine.view())
    }

    /// The state of `device` in the TTI that has been reached.
    pub fn state(&mut self, device: DeviceId) -> Option<DeviceState> {
        self.view(device).map(|view| view.state)
    }

    /// State and battery of all devices in the TTI that has been reached, in the order of ids; nothing before TTI 0.
    pub fn views(&mut self) -> Vec<DeviceView> {
        let ids: Vec<DeviceId> = self.machines.iter().map(Machine::id).collect();
        ids.into_iter().filter_map(|id| self.view(id)).collect()
    }

    /// The books of all devices where the run has ended after the TTI that has been reached, in the order of ids.
    pub fn ledgers(&self) -> Vec<Ledger> {
        let end = self.next();
        let mut machines = self.machines.clone();
        let ledger = |machine: &mut Machine| {
            machine.settle(end);
            machine.ledger()
        };
        machines.iter_mut().map(ledger).collect()
    }

    /// The books of `device` where the run has ended before TTI `end`, which is not after the one that comes next.
    pub fn ledger(&self, device: DeviceId, end: Tti) -> Option<Ledger> {
        let mut machine = self.machines.get(device.index())?.clone();
        machine.settle(end);
        Some(machine.ledger())
    }

    /// Goes on with `frame`, in which `message` was read.
    ///
    /// # Errors
    /// If it does not fit to what was before it. What follows can be taken, and may not fit either.
    pub fn take(&mut self, frame: &Frame, message: &Message) -> Result<(), Discrepancy> {
        let tti = frame.tti;
        self.go_on(frame, message).map_err(|what| Discrepancy { tti, what })
    }

    fn go_on(&mut self, frame: &Frame, message: &Message) -> Result<(), String> {
        match message {
            Message::Plan(update) => self.command(update),
            Message::World(world) => self.play(*world),
            Message::Report(report) => self.heard(report, false),
            Message::Lost(lost) => self.heard(&lost.report, true),
            Message::Failed(failed) => {
                let own = |failure: &Failure| *failure == failed.failure;
                let at = self.failures.iter().position(own);
                let own = at.and_then(|at| self.failures.remove(at));
                let none = || format!("device {} has not failed so", failed.failure.device);
                own.map(|_| ()).ok_or_else(none)
            }
            Message::Gone(outage) => self.gone(outage),
            Message::Wake(wake) => self.wake(frame.number, *wake),
            Message::Woken(woken) => match self.waking.take() {
                Some((device, outcome)) if Some(device.0) == frame.number && outcome == woken.outcome => {
                    let is_told = self.has_reported || !matches!(outcome, WakeOutcome::Reported(_));
                    is_told
                        .then_some(())
                        .ok_or_else(|| format!("the report of device {device} is missing"))
                }
                Some((device, outcome)) => Err(format!("the wake-up of device {device} came to: {outcome}")),
                None => Err("what came of a wake-up that was not sent".to_owned()),
            },
            Message::States(states) => {
                let views = self.views();
                let differs = |(own, told): (&DeviceView, &DeviceView)| own != told;
                match views.iter().zip(&states.views).position(differs) {
                    None if views.len() == states.views.len() => Ok(()),
                    None => Err(format!("states of {} devices, not {}", states.views.len(), views.len())),
                    Some(j) => Err(format!("device {j} is {:?}, not {:?}", views[j], states.views[j])),
                }
            }
            Message::Event(_)
            | Message::Belief(_)
            | Message::Clock(_)
            | Message::Answer(_)
            | Message::Join(_)
            | Message::Ready(_)
            | Message::Control(_)
            | Message::Describe(_)
            | Message::Log(_) => Ok(()),
        }
    }

    /// The TTI that is to come next.
    pub fn next(&self) -> Tti {
        self.now().map_or(Tti::ZERO, |last| last + 1)
    }

    /// Whether the TTIs of `world` are those that come next.
    ///
    /// # Errors
    /// They are not.
    pub fn fits(&self, world: &World) -> Result<(), String> {
        let next = self.next();
        if world.first == next && world.first <= world.last && world.last.0 < MAX_TTIS {
            Ok(())
        } else {
            Err(format!(
                "TTIs {} to {} come where {next} was to come",
                world.first, world.last
            ))
        }
    }

    fn command(&mut self, update: &PlanUpdate) -> Result<(), String> {
        self.end_tti()?;
        let next = self.next();
        if update.from != next {
            return Err(format!("a plan from TTI {} on comes before TTI {next}", update.from));
        }
        let air = self.air.at(update.from);
        self.missed = 0;
        for machine in &mut self.machines {
            if air.misses_plan(machine.id()) {
                self.missed += 1;
            } else {
                machine.set_duty(update.from, update.plan.duty_cycle(machine.id()));
            }
        }
        self.plan = Some(update.plan.clone());
        Ok(())
    }

    /// Takes the devices through the TTIs of `world`.
    fn play(&mut self, world: World) -> Result<(), String> {
        self.end_tti()?;
        self.fits(&world)?;
        if self.plan.is_none() {
            return Err("there is no plan yet".to_owned());
        }
        self.unsensed.clear();
        if let Some(stimulus) = &world.stimulus {
            for machine in &mut self.machines {
                if !machine.may_sense(world.last, stimulus, &self.physics) {
                    continue;
                }
                let unsensed = machine.clone();
                match machine.sense(world.last, stimulus, &self.physics) {
                    Sensed::Nothing => continue,
                    Sensed::Reported(report) => self.reports.push_back(report),
                    Sensed::Failed(failure) => self.failures.push_back(failure),
                }
                self.unsensed.push(unsensed);
            }
        }
        self.world = Some(world);
        Ok(())
    }

    /// Devices go in the TTI that has been reached.
    fn gone(&mut self, outage: &Outage) -> Result<(), String> {
        if self.now() != Some(outage.tti) || !outage.is_sound(self.machines.len() as u32) {
            return Err(format!("{outage} in TTI {}, which has not been reached", outage.tti));
        }
        let mut undone = Vec::new();
        if outage.wake_ups.is_none() {
            undone.extend(self.unsensed.extract_if(.., |machine| outage.has(machine.id())));
            self.reports.retain(|report| !outage.has(report.device));
            self.failures.retain(|failure| !outage.has(failure.device));
        }
        if let Some((device, outcome)) = &mut self.waking
            && outage.has(*device)
        {
            *outcome = WakeOutcome::Unheard;
            undone.extend(self.unwoken.take());
        }
        for machine in undone.into_iter().filter(|machine| outage.has(machine.id())) {
            let at = machine.id().index();
            self.machines[at] = machine;
        }
        for machine in &mut self.machines[outage.first.index()..=outage.last().index()] {
            machine.go(outage.tti);
        }
        Ok(())
    }

    /// A TTI is over: all that devices had to say must have been heard.
    fn end_tti(&mut self) -> Result<(), String> {
        let missing = self.reports.drain(..).map(|report| report.device);
        let missing = missing.chain(self.failures.drain(..).map(|failure| failure.device));
        let missing = missing.min().or(self.waking.take().map(|(device, _)| device));
        missing.map_or(Ok(()), |device| {
            Err(format!("nothing is told of what device {device} did before"))
        })
    }

    /// What a device has sent has arrived, or `is_lost`.
    fn heard(&mut self, report: &Report, is_lost: bool) -> Result<(), String> {
        if let Some((device, WakeOutcome::Reported(own))) = &self.waking
            && *device == report.device
        {
            self.has_reported = own == report;
            return if self.has_reported {
                Ok(())
            } else {
                Err(format!("device {device} reported: {own}; not: {report}"))
            };
        }
        let at = self.reports.iter().position(|own| own.device == report.device);
        let own = at.and_then(|at| self.reports.remove(at));
        let own = own.ok_or_else(|| format!("a report of device {}, which has sent none", report.device))?;
        if own != *report {
            return Err(format!("device {} reported: {own}; not: {report}", own.device));
        }
        if self.air.at(report.tti).loses_report(own.device) == is_lost {
            Ok(())
        } else {
            let came = if is_lost { "arrived" } else { "was lost" };
            Err(format!("the report of device {} {came}", own.device))
        }
    }

    fn wake(&mut self, number: Option<u32>, wake: WakeUp) -> Result<(), String> {
        let world = self.world.ok_or("a wake-up before the first TTI")?;
        let stimulus = world.stimulus.ok_or("a wake-up where there is no event")?;
        let device = number.map(DeviceId).ok_or("a wake-up for nobody")?;
        let machine = self.machines.get_mut(device.index());
        let machine = machine.ok_or_else(|| format!("a wake-up for device {device}, which there is not"))?;
        let air = self.air.at(world.last);
        self.unwoken = Some(machine.clone());
        let stimulus = (!self.radio.is_late(wake.tti, world.until)).then_some(&stimulus);
        let outcome = machine
            .wake(world.last, stimulus, &self.physics)
            .over(|device| air.loses_report(device));
        self.has_reported = false;
        match self.waking.replace((device, outcome)) {
            None => Ok(()),
            Some((before, _)) => Err(format!("what came of the wake-up of device {before} is not told")),
        }
    }
}
