//! The TTI cycle of the base station as a machine without I/O.
//!
//! ```text
//!            grant()                gathered()                 woken()
//!   Between ─────────► Gathering ─────────────► Waking(j) ◄──────────┐
//!      ▲                   │                        │  └─────────────┘ the policy asks for one more
//!      │                   │ nobody to wake         │
//!      └───────────────────┴────────────────────────┘ the TTI closes
//! ```
//! A grant covers one or more TTIs. All but the last are *quiet*: no device can detect anything in them, whatever its
//! battery, because no event is active or no device that could sense it has δ = 1. The clock knows that from the plan and
//! from the world it plays; the policy sees none of it. A driver that asks for one TTI at a time gets the same run.

use reveille_common::deployment::Deployment;
use reveille_common::digest::Fingerprint;
use reveille_common::event::{ActiveEvent, EventProcess, Stimulus};
use reveille_common::geometry::{Buckets, Point};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Failure, PlanUpdate, Report, WakeOutcome, WakeUp};
use reveille_common::metrics::{
    ControlTotals, DeviceTotals, EventTally, EventTotals, Metrics, PICO_PER_INFORMATION, Totals,
};
use reveille_common::plan::Plan;
use reveille_common::scenario::Scenario;
use reveille_common::units::Energy;
use reveille_common::{codec, ids::EventId};

use crate::levels::Levels;
use crate::observation::Observation;
use crate::outcome::{EventRecord, Outcome};
use crate::policy::PolicyEngine;

/// The TTIs that the devices may go through next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grant {
    /// First granted TTI.
    pub first: Tti,
    /// Last granted TTI; only in this one can a device have anything to report.
    pub last: Tti,
    /// What the world shows in `last`, if any device might react to it.
    pub stimulus: Option<Stimulus>,
}

/// What follows the reports of a TTI.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Send this device a wake-up and tell [`Cycle::woken`] what came of it.
    WakeUp(DeviceId),
    /// The TTI is closed; the next may be granted.
    Closed,
}

/// The event under way and what has come of it.
#[derive(Clone, Debug)]
struct Current {
    event: ActiveEvent,
    tally: EventTally,
    /// Î, at the BS.
    information: f64,
    /// Devices that detect the event in any TTI in which they have δ = 1.
    audience: Vec<DeviceId>,
    /// Whom a genie would wake, once.
    genies_choice: Option<DeviceId>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Between,
    Gathering(Tti),
    Waking(Tti, DeviceId),
}

/// What the base station knows without being told by a report.
struct Known {
    scenario: Scenario,
    positions: Vec<Point>,
    plan: Plan,
    /// For a policy that looks at batteries.
    levels: Option<Levels>,
}

impl Known {
    /// What a policy sees in TTI `now`, with Î so far.
    fn observe(&self, now: Tti, information: f64) -> Observation<'_> {
        Observation {
            now,
            positions: &self.positions,
            sensing: &self.scenario.sensing,
            plan: &self.plan,
            information,
            batteries: self.levels.as_ref().map_or(&[], Levels::all),
        }
    }
}

/// The base station of one run.
pub struct Cycle {
    known: Known,
    e_tx: Vec<Energy>,
    buckets: Buckets,
    world: EventProcess,
    policy: PolicyEngine,
    plan_is_new: bool,
    next_decision: Tti,
    phase: Phase,
    next: Tti,
    current: Option<Current>,
    detectors: Vec<DeviceId>,
    events: EventTotals,
    control: ControlTotals,
    fingerprint: Fingerprint,
    records: Option<Vec<EventRecord>>,
}

impl Cycle {
    /// The base station of `scenario` with its devices as in `deployment`. `keep_records` fills [`Self::take_records`].
    pub fn new(scenario: &Scenario, deployment: &Deployment, keep_records: bool) -> Self {
        let positions = deployment.positions();
        let policy = PolicyEngine::new(scenario, deployment);
        Self {
            buckets: Buckets::new(&positions, scenario.area, scenario.sensing.d_max),
            e_tx: deployment.devices.iter().map(|d| d.energy.e_tx).collect(),
            world: EventProcess::new(scenario),
            plan_is_new: false,
            next_decision: Tti::ZERO,
            phase: Phase::Between,
            next: Tti::ZERO,
            current: None,
            detectors: Vec::new(),
            events: EventTotals::default(),
            control: ControlTotals::default(),
            fingerprint: Fingerprint::default(),
            records: keep_records.then(Vec::new),
            known: Known {
                scenario: scenario.clone(),
                plan: Plan::from_bits(positions.iter().map(|_| false)),
                positions,
                levels: policy
                    .looks_at_batteries()
                    .then(|| Levels::new(scenario.bs.battery_knowledge, deployment)),
            },
            policy,
        }
    }

    /// The next TTI to be granted.
    pub const fn next_tti(&self) -> Tti {
        self.next
    }

    /// The plan in force.
    pub const fn plan(&self) -> &Plan {
        &self.known.plan
    }

    /// Sums over the counted events so far.
    pub const fn event_totals(&self) -> &EventTotals {
        &self.events
    }

    /// The events that ended since the last call; empty unless records are kept.
    pub fn take_records(&mut self) -> Vec<EventRecord> {
        self.records.as_mut().map(std::mem::take).unwrap_or_default()
    }

    /// Ground truth for a driver that owns all devices: who detects the event in the granted TTI, battery permitting.
    pub fn detectors(&self) -> &[DeviceId] {
        &self.detectors
    }

    /// Whether the true batteries are to be told before the next TTI is announced.
    pub fn wants_batteries(&self) -> bool {
        self.next >= self.next_decision
            && self.next > Tti::ZERO
            && self.known.levels.as_ref().is_some_and(Levels::are_told)
    }

    /// Whether the true batteries after the TTIs that are granted next will be wanted.
    pub fn will_want_batteries(&self) -> bool {
        self.known.levels.as_ref().is_some_and(Levels::are_told)
    }

    /// The battery levels of all devices, in the order of ids, as the last TTI has left them.
    pub fn tell_batteries(&mut self, levels: impl IntoIterator<Item = Energy>) {
        assert_eq!(self.phase, Phase::Between, "batteries are told between TTIs");
        if let Some(known) = &mut self.known.levels {
            known.tell(levels);
        }
    }

    /// What must go out on the air before the next grant: a new plan, or the plan in force once more for synchronisation.
    /// Call it once before each [`Self::grant`].
    pub fn announce(&mut self) -> Option<PlanUpdate> {
        assert_eq!(self.phase, Phase::Between, "a plan is set between TTIs");
        let k = self.next;
        if k >= self.next_decision {
            let seen = self.known.observe(k, 0.0);
            let plan = self.policy.decide(&seen);
            self.next_decision = self.policy.next_decision(k);
            assert!(self.next_decision > k, "a policy decides at most once per TTI");
            self.plan_is_new = k == Tti::ZERO || plan != self.known.plan;
            self.known.plan = plan;
        }
        let is_sync = k.0.is_multiple_of(self.known.scenario.bs.sync_interval);
        if !self.plan_is_new && !is_sync {
            return None;
        }
        let update = PlanUpdate {
            from: k,
            plan: self.known.plan.clone(),
        };
        if std::mem::take(&mut self.plan_is_new) {
            self.fingerprint.plan(&update);
        }
        self.count_control(k, codec::encoded_len(&update));
        Some(update)
    }

    /// Grants TTIs from [`Self::next_tti`] on, at most up to and not including `horizon`.
    pub fn grant(&mut self, horizon: Tti) -> Grant {
        assert_eq!(self.phase, Phase::Between, "TTI {} is still open", self.next);
        let first = self.next;
        let sync = self.known.scenario.bs.sync_interval;
        let next_sync = Tti((first.0 / sync + 1) * sync);
        let horizon = horizon.min(next_sync).min(self.next_decision);
        assert!(first < horizon, "a grant covers at least one TTI");
        self.detectors.clear();
        let stimulated = self.first_stimulated(first, horizon);
        let last = stimulated.unwrap_or(Tti(horizon.0 - 1));
        self.phase = Phase::Gathering(last);
        let stimulus = stimulated.and(self.current.as_ref()).map(|c| c.event.stimulus);
        Grant { first, last, stimulus }
    }

    /// The devices have done the grant; these are its reports, in any order, and the devices that failed to report.
    pub fn gathered(&mut self, reports: &mut [Report], failures: &[Failure]) -> Step {
        let Phase::Gathering(tti) = self.phase else {
            panic!("no grant is out")
        };
        if let Some(levels) = &mut self.known.levels {
            // A policy that looks at batteries decides every TTI.
            levels.pass(tti, &self.known.plan);
            for report in reports.iter() {
                levels.heard(report.device, report.battery);
            }
        }
        let Some(current) = self
            .current
            .as_mut()
            .filter(|_| !reports.is_empty() || !failures.is_empty())
        else {
            assert!(reports.is_empty() && failures.is_empty(), "a report without an event");
            return self.next_step(tti);
        };
        reports.sort_unstable_by_key(|r| r.device);
        for report in reports.iter() {
            self.fingerprint.report(report);
            current.tally.reports += 1;
            current.information = self
                .known
                .scenario
                .sensing
                .fuse(current.information, report.information);
        }
        for failure in failures {
            current.tally.wrong_activations += 1;
            current.tally.wasted += failure.drained;
        }
        if let (PolicyEngine::Blind(policy), false) = (&mut self.policy, reports.is_empty()) {
            policy.reported(&self.known.observe(tti, current.information), reports);
        }
        self.next_step(tti)
    }

    /// What came of the wake-up that the last [`Step`] asked for.
    pub fn woken(&mut self, outcome: &WakeOutcome) -> Step {
        let Phase::Waking(tti, device) = self.phase else {
            panic!("no wake-up is out")
        };
        let current = self.current.as_mut().expect("only an event makes the BS wake anyone");
        self.fingerprint.wake_up(tti, device, outcome);
        let sensing = &self.known.scenario.sensing;
        let distance = self.known.positions[device.index()].distance(current.event.stimulus.epicentre);
        let is_far = distance > sensing.d_max;
        let (wrong, wasted, report) = match outcome {
            WakeOutcome::Reported(report) => (
                is_far,
                if is_far {
                    self.e_tx[device.index()]
                } else {
                    Energy::ZERO
                },
                Some(report),
            ),
            WakeOutcome::Failed(failure) => (true, failure.drained, None),
            WakeOutcome::Unheard => (false, Energy::ZERO, None),
        };
        current.tally.wrong_activations += u64::from(wrong);
        current.tally.wasted += wasted;
        if let Some(levels) = &mut self.known.levels {
            match report {
                Some(report) => levels.heard(device, report.battery),
                None => levels.silent(device),
            }
        }
        if let Some(report) = report {
            current.tally.reports += 1;
            current.information = sensing.fuse(current.information, report.information);
        }
        if let PolicyEngine::Blind(policy) = &mut self.policy {
            policy.answered(&self.known.observe(tti, current.information), report);
        }
        self.next_step(tti)
    }

    /// The run's outcome. `ledgers` are the devices' totals in the order of ids, `at_warm_up` their sum at the end of the
    /// warm-up (`None` if the run did not get there).
    pub fn finish(self, ledgers: &[DeviceTotals], at_warm_up: Option<DeviceTotals>) -> Outcome {
        assert_eq!(self.phase, Phase::Between, "TTI {} is still open", self.next);
        let total: DeviceTotals = ledgers.iter().copied().sum();
        let totals = Totals {
            devices: ledgers.len() as u64,
            ttis: self.next.0.saturating_sub(self.known.scenario.warm_up_end().0),
            events: self.events,
            control: self.control,
            energy: at_warm_up.map_or_else(DeviceTotals::default, |before| total - before),
        };
        Outcome {
            facts: self.policy.facts(),
            learned: self.policy.learned(),
            digest: self.fingerprint.finish(ledgers, &totals),
            metrics: Metrics::new(&self.known.scenario, &totals),
            totals,
            ttis_done: self.next.0,
            complete: self.next.0 == self.known.scenario.ttis,
        }
    }

    /// The first TTI in `k .. horizon` in which a device may react. Events that start before it are started, and those that
    /// end before it, unseen, are ended.
    fn first_stimulated(&mut self, mut k: Tti, horizon: Tti) -> Option<Tti> {
        loop {
            let Some(current) = &self.current else {
                k = self.world.next_start();
                if k >= horizon {
                    return None;
                }
                self.start_event();
                continue;
            };
            let (start, last) = (current.event.start, current.event.last);
            if current.genies_choice.is_some() && k == start {
                return Some(k);
            }
            let mut reaction = Tti::NEVER;
            for &j in &current.audience {
                let next_on = self.known.plan.duty_cycle(j).next_on(k);
                if next_on < reaction {
                    self.detectors.clear();
                    reaction = next_on;
                }
                if next_on == reaction {
                    self.detectors.push(j);
                }
            }
            if reaction <= last && reaction < horizon {
                return Some(reaction);
            }
            self.detectors.clear();
            if last >= horizon || reaction <= last {
                return None;
            }
            self.end_event(last);
            k = last + 1;
        }
    }

    fn start_event(&mut self) {
        let event = self.world.start();
        let EventId(id) = event.stimulus.event;
        self.fingerprint.event_started(event.start, &event.stimulus);
        let (sensing, seed) = (&self.known.scenario.sensing, self.known.scenario.seed);
        let mut audience = Vec::new();
        let mut genies_choice = None;
        match &self.policy {
            PolicyEngine::Genie(genie) => genies_choice = genie.closest(&event.stimulus),
            PolicyEngine::Blind(_) => self.buckets.within(event.stimulus.epicentre, sensing.d_max, |j, d| {
                if sensing.detects(seed, EventId(id), DeviceId(j as u32), d) {
                    audience.push(DeviceId(j as u32));
                }
            }),
        }
        self.current = Some(Current {
            event,
            tally: EventTally::default(),
            information: 0.0,
            audience,
            genies_choice,
        });
    }

    /// The policy's next wake-up in `tti`, or the end of it.
    fn next_step(&mut self, tti: Tti) -> Step {
        let Some(current) = self.current.as_mut() else {
            return self.close(tti);
        };
        let wake = match &mut self.policy {
            PolicyEngine::Blind(policy) if current.tally.reports > 0 => {
                policy.next_wake_up(&self.known.observe(tti, current.information))
            }
            PolicyEngine::Blind(_) => None,
            PolicyEngine::Genie(_) => current.genies_choice.take_if(|_| tti == current.event.start),
        };
        let Some(device) = wake else { return self.close(tti) };
        current.tally.wake_ups += 1;
        self.count_control(tti, codec::encoded_len(&WakeUp { tti }));
        self.phase = Phase::Waking(tti, device);
        Step::WakeUp(device)
    }

    fn close(&mut self, tti: Tti) -> Step {
        if self
            .current
            .as_ref()
            .is_some_and(|c| c.tally.reports > 0 || c.event.last == tti)
        {
            self.end_event(tti);
        }
        self.phase = Phase::Between;
        self.next = tti + 1;
        Step::Closed
    }

    /// Ends the current event; `last` is its last TTI.
    fn end_event(&mut self, last: Tti) {
        let current = self.current.take().expect("an event is under way");
        let information_pico = (current.information * PICO_PER_INFORMATION).round() as u64;
        let tally = EventTally {
            information_pico,
            ..current.tally
        };
        self.fingerprint.event_ended(last, &tally);
        let ActiveEvent { stimulus, start, .. } = current.event;
        let counted = start >= self.known.scenario.warm_up_end();
        if counted {
            self.events.count(&tally);
        }
        if let Some(records) = &mut self.records {
            let Stimulus { event, epicentre } = stimulus;
            records.push(EventRecord {
                event,
                epicentre,
                start,
                last,
                counted,
                tally,
            });
        }
        self.world.end(last);
    }

    fn count_control(&mut self, tti: Tti, bytes: u64) {
        if tti >= self.known.scenario.warm_up_end() {
            self.control.messages += 1;
            self.control.bytes += bytes;
        }
    }
}
