//! Mirror of the devices of a run, driven by observer frames: the same machines, advanced through the same TTIs.
//!
//! Device states follow from the scenario, plans, stimuli and wake-ups, so an observer can compute them without
//! receiving them. Reports and failures in the frames are checked against the mirrored machines. The machines must be
//! called as in `lab/src/run.rs`, or states diverge from the run. `reconstruction`, `history` and the Perfetto export
//! use the mirror; `inspect verify` prints the texts of discrepancies.

use std::collections::VecDeque;
use std::sync::Arc;

use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::digits::count_noun;
use reveille_common::event::Stimulus;
use reveille_common::ids::{DeviceId, MAX_TTIS, Tti};
use reveille_common::message::{
    Change, DeviceRange, DeviceRemoval, FailedTransmission, Frame, Message, OperatorAction, PlanUpdate, Report,
    UnableDetectors, WakeOutcome, WakeUp, WorldUpdate,
};
use reveille_common::plan::Plan;
use reveille_common::radio::{Air, RadioSettings};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_device::machine::{Machine, Physics, SenseOutcome};

/// A frame that contradicts the frames before it: one is missing or changed, or comes from another version.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("TTI {tti}: {description}")]
pub struct Discrepancy {
    /// TTI of the frame.
    pub tti: Tti,
    /// Description of the contradiction.
    pub description: String,
}

/// The mirrored devices of a run.
#[derive(Clone, Debug)]
pub struct DeviceMirror {
    machines: Vec<Machine>,
    physics: Physics,
    radio: RadioSettings,
    air: Air,
    /// Number of devices that missed `sent_plan`.
    missed_plan_count: u64,
    /// The latest plan of the base station; a device that missed it keeps an earlier one.
    sent_plan: Option<Plan>,
    /// The latest grant; `None` before the first one.
    grant: Option<WorldUpdate>,
    /// Reports and failures still expected from devices with δ = 1 in the last TTI of the grant, in the order of ids.
    expected_reports: VecDeque<Report>,
    expected_failures: VecDeque<FailedTransmission>,
    /// Devices that would have detected the event in that TTI, but could not sense.
    unable: Vec<(DeviceId, UnableDetectors)>,
    /// Copies of the devices that sensed, and of the last woken device, from before that action. A removal restores
    /// them.
    before_sensing: Vec<Machine>,
    before_wake_up: Option<Machine>,
    /// Open wake-up: its device and the expected outcome.
    open_wake_up: Option<(DeviceId, WakeOutcome)>,
    /// Whether the report of the open wake-up has arrived.
    has_reported: bool,
    /// Changes that operators make at the start of the next TTI.
    pending_changes: Vec<Change>,
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
            missed_plan_count: 0,
            physics,
            sent_plan: None,
            grant: None,
            expected_reports: VecDeque::new(),
            expected_failures: VecDeque::new(),
            unable: Vec::new(),
            before_sensing: Vec::new(),
            before_wake_up: None,
            open_wake_up: None,
            has_reported: false,
            pending_changes: Vec::new(),
        }
    }

    /// Current TTI of the devices: the last one of the latest grant; `None` before TTI 0.
    pub fn current_tti(&self) -> Option<Tti> {
        self.grant.map(|world| world.last)
    }

    /// The latest plan of the base station. Devices that missed it keep an earlier one.
    pub const fn plan(&self) -> Option<&Plan> {
        self.sent_plan.as_ref()
    }

    /// Number of devices that missed the last plan.
    pub const fn missed_plan_count(&self) -> u64 {
        self.missed_plan_count
    }

    /// Devices that would have detected the event in the current TTI, but could not sense.
    pub fn unable_detectors(&self) -> UnableDetectors {
        self.unable.iter().map(|(_, unable)| *unable).sum()
    }

    /// Stimulus in the current TTI, if any device might react to it.
    pub fn stimulus(&self) -> Option<Stimulus> {
        self.grant.and_then(|world| world.stimulus)
    }

    /// Whether a wake-up is open, that is, its outcome has not arrived.
    pub(crate) const fn has_open_wake_up(&self) -> bool {
        self.open_wake_up.is_some()
    }

    /// State and battery of `device` in the current TTI; `None` before TTI 0, and if it does not exist.
    pub fn view(&mut self, device: DeviceId) -> Option<DeviceView> {
        let now = self.current_tti()?;
        let machine = self.machines.get_mut(device.index())?;
        begin(machine, now);
        Some(machine.view())
    }

    /// Advances all devices to TTI `tti` under the current plan and returns their views, in the order of ids. The views
    /// are valid unless more frames up to `tti` follow. Successive calls may step through the coming TTIs. After a call
    /// for a coming TTI, [`Self::ledgers`] panics until a grant has reached that TTI, and [`Self::view`] returns its
    /// state.
    ///
    /// # Panics
    /// If a device is already past `tti`.
    pub(crate) fn views_at(&mut self, tti: Tti) -> Vec<DeviceView> {
        self.apply_changes_up_to(tti);
        let view = |machine: &mut Machine| {
            machine.begin(tti);
            machine.view()
        };
        self.machines.iter_mut().map(view).collect()
    }

    /// Advances all devices to TTI `tti` under the current plan, and returns their views and their totals since TTI 0.
    /// They are valid unless more frames up to `tti` follow. After a call for a coming TTI, [`Self::ledgers`] panics
    /// until a grant has reached that TTI.
    ///
    /// # Panics
    /// If a device is past `tti` + 1.
    pub fn views_and_totals_at(&mut self, tti: Tti) -> Vec<(DeviceView, DeviceTotals)> {
        self.apply_changes_up_to(tti);
        let machines = self.machines.iter_mut();
        machines.map(|machine| view_and_totals(machine, tti)).collect()
    }

    /// Advances `device` to TTI `tti`, like [`Self::views_and_totals_at`], and returns its totals since TTI 0; `None`
    /// if it does not exist.
    pub(crate) fn totals_at(&mut self, device: DeviceId, tti: Tti) -> Option<DeviceTotals> {
        self.apply_changes_up_to(tti);
        let machine = self.machines.get_mut(device.index())?;
        Some(view_and_totals(machine, tti).1)
    }

    /// Advances `device` to TTI `tti` and returns its state and battery, like [`Self::views_at`]; `None` if it does not
    /// exist.
    ///
    /// # Panics
    /// If the device is already past `tti`.
    pub(crate) fn view_at(&mut self, device: DeviceId, tti: Tti) -> Option<DeviceView> {
        self.apply_changes_up_to(tti);
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
    ///
    /// # Panics
    /// If a device is past the current TTI, after `views_at`, `views_and_totals_at` or `view_at`.
    pub fn ledgers(&self) -> Vec<Ledger> {
        let end = self.next_tti();
        // On copies: settling closes the open TTI, and the run may continue.
        let mut machines = self.machines.clone();
        let ledger = |machine: &mut Machine| {
            machine.advance_to(end);
            machine.ledger()
        };
        machines.iter_mut().map(ledger).collect()
    }

    /// Applies `frame`, whose decoded content is `message`. Frames must come in the order of the run from TTI 0 on.
    /// Frames of the emulation plane have no effect.
    ///
    /// # Errors
    /// If the frame contradicts the frames before it. Later frames can still be applied, but may fail too.
    pub fn apply(&mut self, frame: &Frame, message: &Message) -> Result<(), Discrepancy> {
        let tti = frame.tti;
        self.apply_message(frame, message)
            .map_err(|description| Discrepancy { tti, description })
    }

    fn apply_message(&mut self, frame: &Frame, message: &Message) -> Result<(), String> {
        match message {
            Message::Plan(update) => self.apply_plan(update),
            Message::World(world) => self.apply_grant(*world),
            Message::Report(report) => self.check_report(report, false),
            Message::Lost(lost) => self.check_report(&lost.report, true),
            Message::Failed(failed) => {
                let is_equal = |failure: &FailedTransmission| *failure == failed.failure;
                let index = self.expected_failures.iter().position(is_equal);
                let expected = index.and_then(|index| self.expected_failures.remove(index));
                let unexpected = || format!("an unexpected failed report of device {}", failed.failure.device);
                expected.map(|_| ()).ok_or_else(unexpected)
            }
            Message::Removed(removal) => self.remove_devices(removal),
            Message::Action(action) => self.add_change(action),
            Message::Wake(wake) => self.apply_wake_up(frame.number, *wake),
            Message::Woken(woken) => match self.open_wake_up.take() {
                Some((device, outcome)) if Some(device.0) == frame.number && outcome == woken.outcome => {
                    let is_report_known = self.has_reported || !matches!(outcome, WakeOutcome::Reported(_));
                    is_report_known
                        .then_some(())
                        .ok_or_else(|| format!("the report of device {device} is missing"))
                }
                Some((device, outcome)) => Err(format!("the outcome for device {device} must be: {outcome}")),
                None => Err("an outcome of a wake-up that was not sent".to_owned()),
            },
            Message::States(states) => {
                let views = self.views();
                let differs = |(mirrored, received): (&DeviceView, &DeviceView)| mirrored != received;
                match views.iter().zip(&states.views).position(differs) {
                    None if views.len() == states.views.len() => Ok(()),
                    None => Err(format!("states of {} devices, not {}", states.views.len(), views.len())),
                    Some(j) => Err(format!(
                        "device {j}: the messages before lead to {:?}, but the message states {:?}",
                        views[j], states.views[j]
                    )),
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
            | Message::Log(_)
            | Message::Act(_) => Ok(()),
        }
    }

    /// The next TTI.
    pub fn next_tti(&self) -> Tti {
        self.current_tti().map_or(Tti::ZERO, |last| last + 1)
    }

    /// Checks that `world` grants the next TTIs.
    ///
    /// # Errors
    /// If it grants any other TTIs.
    pub fn check_grant(&self, world: &WorldUpdate) -> Result<(), String> {
        let next = self.next_tti();
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

    /// Delivers a plan after the last message of the current TTI, whose views stay available.
    fn apply_plan(&mut self, update: &PlanUpdate) -> Result<(), String> {
        self.end_tti()?;
        let next = self.next_tti();
        if update.from != next {
            return Err(format!("a plan from TTI {}, but TTI {next} is next", update.from));
        }
        let now = self.current_tti();
        let Self { air, machines, .. } = self;
        let (from, count) = (update.from, machines.len());
        self.missed_plan_count = air.deliver_plan(from, &update.plan, DeviceId(0), count, |j, cycle| {
            // A new duty cycle ends the current TTI, which is begun first, so that its state stays visible.
            if let Some(now) = now {
                begin(&mut machines[j], now);
            }
            machines[j].set_duty(from, cycle);
        });
        self.sent_plan = Some(update.plan.clone());
        Ok(())
    }

    /// Keeps the change of `action` for the next grant, so that the devices stay in the current TTI.
    fn add_change(&mut self, action: &OperatorAction) -> Result<(), String> {
        let next = self.next_tti();
        if action.tti != next {
            return Err(format!("an action in TTI {}, but TTI {next} is next", action.tti));
        }
        let devices = self.machines.len() as u32;
        if action.change.devices().is_some_and(|range| !range.is_valid(devices)) {
            return Err(format!("{action}, and the run has {}", count_noun(devices, "device")));
        }
        self.pending_changes.push(action.change);
        Ok(())
    }

    /// Applies the changes of the next TTI if `tti` is that TTI or a later one.
    fn apply_changes_up_to(&mut self, tti: Tti) {
        let next = self.next_tti();
        if tti >= next {
            self.apply_changes(next);
        }
    }

    /// Applies the pending changes at the start of TTI `tti`.
    fn apply_changes(&mut self, tti: Tti) {
        for change in std::mem::take(&mut self.pending_changes) {
            let devices = change.devices().into_iter().flat_map(DeviceRange::devices);
            devices.for_each(|device| self.machines[device.index()].apply(tti, &change));
        }
    }

    /// Advances the devices through the TTIs of `world`.
    fn apply_grant(&mut self, world: WorldUpdate) -> Result<(), String> {
        self.end_tti()?;
        self.check_grant(&world)?;
        if self.sent_plan.is_none() {
            return Err("there is no plan yet".to_owned());
        }
        self.apply_changes(world.first);
        self.before_sensing.clear();
        self.unable.clear();
        if let Some(stimulus) = &world.stimulus {
            for machine in &mut self.machines {
                // Machines are lazy: a device that cannot sense catches up when it is next needed.
                if !machine.can_detect(world.last, stimulus, &self.physics) {
                    continue;
                }
                let unsensed = machine.clone();
                match machine.sense(world.last, stimulus, &self.physics) {
                    SenseOutcome::Nothing => continue,
                    SenseOutcome::Failed => {
                        self.unable.push((machine.id(), UnableDetectors::FAILED));
                        continue;
                    }
                    SenseOutcome::Unpowered => {
                        self.unable.push((machine.id(), UnableDetectors::UNPOWERED));
                        continue;
                    }
                    SenseOutcome::Reported(report) => self.expected_reports.push_back(report),
                    SenseOutcome::TransmissionFailed(failure) => self.expected_failures.push_back(failure),
                }
                self.before_sensing.push(unsensed);
            }
        }
        self.grant = Some(world);
        Ok(())
    }

    /// Removes devices in the current TTI.
    fn remove_devices(&mut self, removal: &DeviceRemoval) -> Result<(), String> {
        if self.current_tti() != Some(removal.tti) || !removal.is_valid(self.machines.len() as u32) {
            return Err(format!("{removal} in TTI {}, which has not been reached", removal.tti));
        }
        let mut undone = Vec::new();
        // Removed before they could sense, so their part in this TTI is undone.
        if removal.wake_ups.is_none() {
            undone.extend(
                self.before_sensing
                    .extract_if(.., |machine| removal.contains(machine.id())),
            );
            self.expected_reports.retain(|report| !removal.contains(report.device));
            self.expected_failures
                .retain(|failure| !removal.contains(failure.device));
            self.unable.retain(|(device, _)| !removal.contains(*device));
        }
        if let Some((device, outcome)) = &mut self.open_wake_up
            && removal.contains(*device)
        {
            // The wake-up was open, and its host no longer answers.
            *outcome = WakeOutcome::Missed;
            undone.extend(self.before_wake_up.take());
        }
        for machine in undone.into_iter().filter(|machine| removal.contains(machine.id())) {
            let index = machine.id().index();
            self.machines[index] = machine;
        }
        // `is_valid` above has checked the range.
        for machine in &mut self.machines[removal.first.index()..=removal.last().index()] {
            machine.remove(removal.tti);
        }
        Ok(())
    }

    /// Ends the current TTI. All expected reports, failures and wake-up outcomes must have arrived.
    fn end_tti(&mut self) -> Result<(), String> {
        let missing = self.expected_reports.drain(..).map(|report| report.device);
        let missing = missing.chain(self.expected_failures.drain(..).map(|failure| failure.device));
        let missing = missing.min().or(self.open_wake_up.take().map(|(device, _)| device));
        missing.map_or(Ok(()), |device| {
            Err(format!("a report or an outcome of device {device} is missing"))
        })
    }

    /// Checks a report that arrived or, if `is_lost`, was lost on the air.
    fn check_report(&mut self, report: &Report, is_lost: bool) -> Result<(), String> {
        if let Some((device, WakeOutcome::Reported(expected))) = &self.open_wake_up
            && *device == report.device
        {
            self.has_reported = expected == report;
            return if self.has_reported {
                Ok(())
            } else {
                Err(format!("device {device} reported: {expected}; not: {report}"))
            };
        }
        let is_from_sender = |expected: &Report| expected.device == report.device;
        let index = self.expected_reports.iter().position(is_from_sender);
        let expected = index.and_then(|index| self.expected_reports.remove(index));
        let expected = expected.ok_or_else(|| format!("a report of device {}, which has sent none", report.device))?;
        if expected != *report {
            return Err(format!(
                "device {} reported: {expected}; not: {report}",
                expected.device
            ));
        }
        if self.air.losses_at(report.tti).loses_report(expected.device) == is_lost {
            Ok(())
        } else {
            let correction = if is_lost { "arrived" } else { "was lost" };
            Err(format!("the report of device {} {correction}", expected.device))
        }
    }

    /// Wakes device `number` of an open event. The outcome must follow before the next wake-up.
    fn apply_wake_up(&mut self, number: Option<u32>, wake: WakeUp) -> Result<(), String> {
        let world = self.grant.ok_or("a wake-up before the first TTI")?;
        let stimulus = world.stimulus.ok_or("a wake-up without an event")?;
        let device = number.map(DeviceId).ok_or("a wake-up without a device")?;
        let machine = self.machines.get_mut(device.index());
        let machine = machine.ok_or_else(|| format!("a wake-up for device {device}, which does not exist"))?;
        let air = self.air.losses_at(world.last);
        self.before_wake_up = Some(machine.clone());
        let stimulus = (!self.radio.is_late(wake.tti, world.stimulus_last)).then_some(&stimulus);
        let outcome = machine.wake(world.last, stimulus, &self.physics).after_uplink(&air);
        self.has_reported = false;
        match self.open_wake_up.replace((device, outcome)) {
            None => Ok(()),
            Some((previous, _)) => Err(format!("the outcome of the wake-up of device {previous} is missing")),
        }
    }
}

/// Advances `machine` to TTI `tti`, and returns its view and its totals at the end of that TTI.
fn view_and_totals(machine: &mut Machine, tti: Tti) -> (DeviceView, DeviceTotals) {
    begin(machine, tti);
    // On a copy: settling closes the open TTI, and the run may continue.
    let mut ended = machine.clone();
    ended.advance_to(tti + 1);
    (machine.view(), ended.totals())
}

/// Begins TTI `now` of a device, unless a new plan has ended it already. Neither state nor battery changes at an end.
fn begin(machine: &mut Machine, now: Tti) {
    if !machine.has_ended(now) {
        machine.begin(now);
    }
}

#[cfg(test)]
mod tests {
    use reveille_bs::observer::frames::FrameObserver;
    use reveille_bs::scenario::{Override, load};
    use reveille_common::units::Energy;
    use reveille_lab::external_inputs::ExternalInputs;
    use reveille_lab::preparation::prepare;
    use reveille_lab::run::{Run, RunOptions};

    use super::*;

    /// Returns a scenario of 30 devices that often lack energy, and the frames of its run with `actions`.
    /// `recording/tests.rs` tests reconstructions of whole runs.
    fn frames_of_run(policy: &str, actions: &[OperatorAction], lookahead: bool) -> (Scenario, Vec<Frame>) {
        let policy = format!("policy.name={policy}");
        let fields = [
            "devices=30",
            "ttis=300",
            "harvest.lambda=0.04",
            "events.alpha=0.05",
            &policy,
        ];
        let overrides = fields.map(|field| Override::parse(field).expect("an override"));
        let scenario = load("paper", &overrides).expect("a scenario").scenario;
        let options = RunOptions {
            lookahead,
            ..RunOptions::default()
        };
        let mut run = Run::new(&prepare(&scenario), options);
        run.schedule_inputs(&ExternalInputs::from_actions(actions));
        let mut frames = Vec::new();
        run.finish(&mut FrameObserver::new(0, |frame: Frame| frames.push(frame)));
        (scenario, frames)
    }

    /// A plan arrives before its grant, so the current TTI is still the last one of the grant before.
    #[test]
    fn a_plan_does_not_change_the_views_of_the_current_tti() {
        let (scenario, frames) = frames_of_run("age-index", &[], true);
        let mut mirror = DeviceMirror::new(&scenario, &Deployment::new(&scenario));
        let mut plan_count = 0;
        for frame in &frames {
            let message = frame.message().expect("a message");
            let before = mirror.clone().views();
            mirror.apply(frame, &message).expect("a consistent frame");
            if matches!(message, Message::Plan(_)) {
                assert_eq!(mirror.clone().views(), before, "{}", frame.tti);
                plan_count += 1;
            }
        }
        assert!(plan_count > 50, "{plan_count} plans");
    }

    /// Grants of single TTIs are the reference.
    #[test]
    fn actions_take_effect_within_long_grants() {
        let range = |first, last| DeviceRange {
            first: DeviceId(first),
            count: last - first + 1,
        };
        let actions = [
            (40, Change::Fail(range(0, 9))),
            (41, Change::AddEnergy(range(5, 20), Energy::from_micro(2_500_000))),
            (90, Change::Revive(range(3, 9))),
        ];
        let actions = actions.map(|(tti, change)| OperatorAction { tti: Tti(tti), change });
        let (scenario, single) = frames_of_run("random", &actions, false);
        let (_, long) = frames_of_run("random", &actions, true);
        let deployment = Deployment::new(&scenario);
        let mut expected = Vec::new();
        let mut mirror = DeviceMirror::new(&scenario, &deployment);
        for frame in &single {
            let message = frame.message().expect("a message");
            if matches!(message, Message::World(_)) {
                expected.extend(mirror.current_tti().map(|_| mirror.clone().views()));
            }
            mirror.apply(frame, &message).expect("a consistent frame");
        }
        let (mut mirror, mut next, mut compared) = (DeviceMirror::new(&scenario, &deployment), Tti::ZERO, 0);
        for frame in &long {
            let message = frame.message().expect("a message");
            if let Message::World(world) = &message {
                while next < world.last {
                    assert_eq!(mirror.views_at(next), expected[next.0 as usize], "TTI {next}");
                    (next, compared) = (next + 1, compared + 1);
                }
                next = world.last + 1;
            }
            mirror.apply(frame, &message).expect("a consistent frame");
        }
        assert!(compared > 100, "{compared} TTIs");
    }
}
