//! Mirror of the devices of a run, driven by observer frames: the same machines, advanced through the same TTIs.
//!
//! Device states follow from the scenario, plans, stimuli and wake-ups, so an observer can compute them without
//! receiving them. Reports and failures in the frames are checked against the mirrored machines.

use std::collections::VecDeque;
use std::sync::Arc;

use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::event::Stimulus;
use reveille_common::ids::{DeviceId, MAX_TTIS, Tti};
use reveille_common::message::{
    DeviceRemoval, FailedTransmission, Frame, Message, PlanUpdate, Report, WakeOutcome, WakeUp, WorldUpdate,
};
use reveille_common::plan::Plan;
use reveille_common::radio::{Air, RadioSettings};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::Ledger;
use reveille_device::machine::{Machine, Physics, SenseOutcome};

/// A frame that contradicts the frames before it: one is missing or changed, or comes from another version.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("TTI {tti}: {what}")]
pub struct Discrepancy {
    /// TTI of the frame.
    pub tti: Tti,
    /// Description of the contradiction.
    pub what: String,
}

/// The mirrored devices of a run.
#[derive(Clone, Debug)]
pub struct DeviceMirror {
    machines: Vec<Machine>,
    physics: Physics,
    radio: RadioSettings,
    air: Air,
    /// Number of devices that missed the last plan.
    missed: u64,
    plan: Option<Plan>,
    /// The open grant; `None` before the first one.
    world: Option<WorldUpdate>,
    /// Reports and failures still expected from devices with δ = 1 in the last TTI of the grant, in the order of ids.
    reports: VecDeque<Report>,
    failures: VecDeque<FailedTransmission>,
    /// Copies of the devices that sensed, and of the last woken device, from before that action. A removal restores
    /// them.
    unsensed: Vec<Machine>,
    unwoken: Option<Machine>,
    /// Open wake-up: its device and the expected outcome.
    waking: Option<(DeviceId, WakeOutcome)>,
    /// Whether the report of the open wake-up has arrived.
    has_reported: bool,
}

impl DeviceMirror {
    /// Creates the devices of `scenario` at the positions in `deployment`, before TTI 0.
    pub fn new(scenario: &Scenario, deployment: &Deployment) -> Self {
        let physics = Physics::new(
            scenario.run.seed,
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
            air: Air::new(scenario.run.seed, &scenario.radio),
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

    /// Current TTI of the devices: the last one of the latest grant.
    pub fn now(&self) -> Option<Tti> {
        self.world.map(|world| world.last)
    }

    /// The current plan.
    pub const fn plan(&self) -> Option<&Plan> {
        self.plan.as_ref()
    }

    /// Number of devices that missed the last plan.
    pub const fn missed_plans(&self) -> u64 {
        self.missed
    }

    /// Stimulus in the current TTI, if any device might react to it.
    pub fn stimulus(&self) -> Option<Stimulus> {
        self.world.and_then(|world| world.stimulus)
    }

    /// Whether a wake-up is open, that is, its outcome has not arrived.
    pub(crate) const fn is_waking(&self) -> bool {
        self.waking.is_some()
    }

    /// State and battery of `device` in the current TTI.
    pub fn view(&mut self, device: DeviceId) -> Option<DeviceView> {
        let now = self.now()?;
        let machine = self.machines.get_mut(device.index())?;
        machine.begin(now);
        Some(machine.view())
    }

    /// Advances all devices to TTI `tti` under the current plan and returns their views, in the order of ids. The views
    /// are valid unless more frames up to `tti` follow. Successive calls may step through the coming TTIs.
    ///
    /// # Panics
    /// If a device is already past `tti`.
    pub(crate) fn views_at(&mut self, tti: Tti) -> Vec<DeviceView> {
        let view = |machine: &mut Machine| {
            machine.begin(tti);
            machine.view()
        };
        self.machines.iter_mut().map(view).collect()
    }

    /// Advances `device` to TTI `tti` and returns its state and battery, like [`Self::views_at`].
    pub(crate) fn view_at(&mut self, device: DeviceId, tti: Tti) -> Option<DeviceView> {
        let machine = self.machines.get_mut(device.index())?;
        machine.begin(tti);
        Some(machine.view())
    }

    /// State of `device` in the current TTI.
    pub fn state(&mut self, device: DeviceId) -> Option<DeviceState> {
        self.view(device).map(|view| view.state)
    }

    /// State and battery of all devices in the current TTI, in the order of ids; empty before TTI 0.
    pub fn views(&mut self) -> Vec<DeviceView> {
        let ids: Vec<DeviceId> = self.machines.iter().map(Machine::id).collect();
        ids.into_iter().filter_map(|id| self.view(id)).collect()
    }

    /// Ledgers of all devices if the run ended after the current TTI, in the order of ids.
    pub fn ledgers(&self) -> Vec<Ledger> {
        let end = self.next();
        // On copies: settling closes the open TTI, and the run may continue.
        let mut machines = self.machines.clone();
        let ledger = |machine: &mut Machine| {
            machine.advance_to(end);
            machine.ledger()
        };
        machines.iter_mut().map(ledger).collect()
    }

    /// Ledger of `device` if the run ended before TTI `end`, which is at most the next TTI.
    pub fn ledger(&self, device: DeviceId, end: Tti) -> Option<Ledger> {
        let mut machine = self.machines.get(device.index())?.clone();
        machine.advance_to(end);
        Some(machine.ledger())
    }

    /// Applies `frame`, whose decoded content is `message`.
    ///
    /// # Errors
    /// If the frame contradicts the frames before it. Later frames can still be applied, but may fail too.
    pub fn apply(&mut self, frame: &Frame, message: &Message) -> Result<(), Discrepancy> {
        let tti = frame.tti;
        self.apply_message(frame, message)
            .map_err(|what| Discrepancy { tti, what })
    }

    fn apply_message(&mut self, frame: &Frame, message: &Message) -> Result<(), String> {
        match message {
            Message::Plan(update) => self.command(update),
            Message::World(world) => self.play(*world),
            Message::Report(report) => self.heard(report, false),
            Message::Lost(lost) => self.heard(&lost.report, true),
            Message::Failed(failed) => {
                let own = |failure: &FailedTransmission| *failure == failed.failure;
                let at = self.failures.iter().position(own);
                let own = at.and_then(|at| self.failures.remove(at));
                let none = || format!("an unexpected failed report of device {}", failed.failure.device);
                own.map(|_| ()).ok_or_else(none)
            }
            Message::Removed(outage) => self.remove_devices(outage),
            Message::Wake(wake) => self.wake(frame.number, *wake),
            Message::Woken(woken) => match self.waking.take() {
                Some((device, outcome)) if Some(device.0) == frame.number && outcome == woken.outcome => {
                    let is_told = self.has_reported || !matches!(outcome, WakeOutcome::Reported(_));
                    is_told
                        .then_some(())
                        .ok_or_else(|| format!("the report of device {device} is missing"))
                }
                Some((device, outcome)) => Err(format!("the outcome for device {device} must be: {outcome}")),
                None => Err("an outcome of a wake-up that was not sent".to_owned()),
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

    /// The next TTI.
    pub fn next(&self) -> Tti {
        self.now().map_or(Tti::ZERO, |last| last + 1)
    }

    /// Checks that `world` grants the next TTIs.
    ///
    /// # Errors
    /// If it grants any other TTIs.
    pub fn fits(&self, world: &WorldUpdate) -> Result<(), String> {
        let next = self.next();
        // The bound keeps a corrupt recording from making the devices play TTIs without end.
        if world.first == next && world.first <= world.last && world.last.0 < MAX_TTIS {
            Ok(())
        } else {
            Err(format!(
                "TTIs {} to {} follow, but TTI {next} is next",
                world.first, world.last
            ))
        }
    }

    fn command(&mut self, update: &PlanUpdate) -> Result<(), String> {
        self.end_tti()?;
        let next = self.next();
        if update.from != next {
            return Err(format!("a plan from TTI {}, but TTI {next} is next", update.from));
        }
        let Self { air, machines, .. } = self;
        let (from, count) = (update.from, machines.len());
        self.missed = air.deliver_plan(from, &update.plan, DeviceId(0), count, |j, cycle| {
            machines[j].set_duty(from, cycle);
        });
        self.plan = Some(update.plan.clone());
        Ok(())
    }

    /// Advances the devices through the TTIs of `world`.
    fn play(&mut self, world: WorldUpdate) -> Result<(), String> {
        self.end_tti()?;
        self.fits(&world)?;
        if self.plan.is_none() {
            return Err("there is no plan yet".to_owned());
        }
        self.unsensed.clear();
        if let Some(stimulus) = &world.stimulus {
            for machine in &mut self.machines {
                // Machines are lazy: a device that cannot sense catches up when it is next needed.
                if !machine.can_detect(world.last, stimulus, &self.physics) {
                    continue;
                }
                let unsensed = machine.clone();
                match machine.sense(world.last, stimulus, &self.physics) {
                    SenseOutcome::Nothing => continue,
                    SenseOutcome::Reported(report) => self.reports.push_back(report),
                    SenseOutcome::Failed(failure) => self.failures.push_back(failure),
                }
                self.unsensed.push(unsensed);
            }
        }
        self.world = Some(world);
        Ok(())
    }

    /// Removes devices in the current TTI.
    fn remove_devices(&mut self, outage: &DeviceRemoval) -> Result<(), String> {
        if self.now() != Some(outage.tti) || !outage.is_valid(self.machines.len() as u32) {
            return Err(format!("{outage} in TTI {}, which has not been reached", outage.tti));
        }
        let mut undone = Vec::new();
        // Removed before they could sense, so their part in this TTI is undone.
        if outage.wake_ups.is_none() {
            undone.extend(self.unsensed.extract_if(.., |machine| outage.has(machine.id())));
            self.reports.retain(|report| !outage.has(report.device));
            self.failures.retain(|failure| !outage.has(failure.device));
        }
        if let Some((device, outcome)) = &mut self.waking
            && outage.has(*device)
        {
            // The wake-up was open, and its host no longer answers.
            *outcome = WakeOutcome::Missed;
            undone.extend(self.unwoken.take());
        }
        for machine in undone.into_iter().filter(|machine| outage.has(machine.id())) {
            let at = machine.id().index();
            self.machines[at] = machine;
        }
        // `is_valid` above has checked the range.
        for machine in &mut self.machines[outage.first.index()..=outage.last().index()] {
            machine.remove(outage.tti);
        }
        Ok(())
    }

    /// Ends the current TTI. All expected reports, failures and wake-up outcomes must have arrived.
    fn end_tti(&mut self) -> Result<(), String> {
        let missing = self.reports.drain(..).map(|report| report.device);
        let missing = missing.chain(self.failures.drain(..).map(|failure| failure.device));
        let missing = missing.min().or(self.waking.take().map(|(device, _)| device));
        missing.map_or(Ok(()), |device| {
            Err(format!("a report or an outcome of device {device} is missing"))
        })
    }

    /// Checks a report that arrived or, if `is_lost`, was lost on the air.
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
        let stimulus = world.stimulus.ok_or("a wake-up without an event")?;
        let device = number.map(DeviceId).ok_or("a wake-up without a device")?;
        let machine = self.machines.get_mut(device.index());
        let machine = machine.ok_or_else(|| format!("a wake-up for device {device}, which does not exist"))?;
        let air = self.air.at(world.last);
        self.unwoken = Some(machine.clone());
        let stimulus = (!self.radio.is_late(wake.tti, world.until)).then_some(&stimulus);
        let outcome = machine.wake(world.last, stimulus, &self.physics).after_uplink(&air);
        self.has_reported = false;
        match self.waking.replace((device, outcome)) {
            None => Ok(()),
            Some((before, _)) => Err(format!("the outcome of the wake-up of device {before} is missing")),
        }
    }
}
