//! Trajectories: what a BS knew, did and gained in each TTI under any policy.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::rng::PolicyPurpose;

use super::senses::Senses;
use crate::beliefs::ages::price::needed;
use crate::beliefs::candidates::Candidates;
use crate::beliefs::coverage::Union;
use crate::beliefs::posterior::Belief;
use crate::beliefs::reward::{self, Looked, MU1, MU2};
use crate::knowledge::Knowledge;
use crate::levels::Levels;
use crate::observation::Observation;
use crate::policy::contract::{Opaque, Policy};
use reveille_common::scenario::WakeUpRanking;

/// What happened to one device in a TTI.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Look {
    /// Events that it would find if it looked and nothing but α was known of them.
    pub expected: f32,
    /// Whether it was in S1 (δ = 1).
    pub on: bool,
    /// Whether it was the first, or among the first, to report an event.
    pub found: bool,
    /// Of a device that was woken: the information that was expected of it, and that it brought, shares of Ψ.
    pub wake_up: Option<(f32, f32)>,
}

/// One TTI of a trajectory.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// The TTI.
    pub tti: Tti,
    /// The tokens of the devices, `[N, F]`.
    pub tokens: Vec<f32>,
    /// By device.
    pub looks: Vec<Look>,
    /// The share of the area that was looked at: of events that start in this TTI, those to be found in it.
    pub share: f32,
    /// r(k), with the expectation over events that start in this TTI.
    pub reward: f32,
    /// r*(k) with μ2 = 1, 0 where nobody was woken.
    pub wake_reward: f32,
}

/// Where steps go, one TTI after the other.
pub trait Sink: Send {
    /// Takes the next.
    fn take(&mut self, step: Step);
}

impl<F: FnMut(Step) + Send> Sink for F {
    fn take(&mut self, step: Step) {
        self(step);
    }
}

/// How a policy is recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Manner {
    /// The probability, `[0, 1)`, with which a device does not do what the policy says.
    pub explores: f64,
    /// Whether a policy that does not look at batteries goes by those that are recorded when it asks who can pay for a
    /// report. With `bs.battery_knowledge = "oracle"` those are the true ones, and it wakes others than in a run that
    /// is not recorded.
    pub told: bool,
}

/// What the policy is shown of batteries.
#[derive(Debug)]
enum Own {
    /// What is recorded.
    Recorded,
    /// No levels; what it goes by when it asks who can pay for a report, as without a recording.
    Hidden(Option<Box<Levels>>),
}

impl Own {
    /// `seen` as the policy is to see it.
    fn shown<'a>(&'a self, seen: &Observation<'a>) -> Observation<'a> {
        match self {
            Self::Recorded => *seen,
            Self::Hidden(levels) => Observation {
                batteries: &[],
                levels: levels.as_deref(),
                ..*seen
            },
        }
    }

    /// Does `keep` with what is reckoned besides.
    fn keep(&mut self, keep: impl FnOnce(&mut Levels)) {
        if let Self::Hidden(Some(levels)) = self {
            keep(levels);
        }
    }
}

/// A policy whose trajectory is recorded. It may be made to explore: then a device does not do what the policy says in
/// a share of its TTIs.
pub struct Recorded<S> {
    policy: Box<dyn Policy>,
    own: Own,
    senses: Senses,
    union: Union,
    /// Tell what was to be expected of a wake-up.
    candidates: Candidates,
    explores: f64,
    sink: S,
    plan: Option<Plan>,
    due: Tti,
    open: Option<Step>,
    /// The device that is woken, with the expected information, and Î before.
    woken: Option<(DeviceId, f64, f64)>,
}

impl<S: Sink> Recorded<S> {
    /// `policy`, for the devices in `known`, recorded in this `manner`.
    pub fn new(policy: Box<dyn Policy>, known: &Knowledge, manner: Manner, sink: S) -> Self {
        let own = if policy.looks_at_batteries() || manner.told {
            Own::Recorded
        } else {
            Own::Hidden(policy.wakes().then(|| Box::new(Levels::reckoned(known))))
        };
        Self {
            policy,
            own,
            senses: Senses::new(known, |j| needed(&known.devices[j].energy)),
            union: reward::union(known),
            candidates: Candidates::by(WakeUpRanking::Posterior, known),
            explores: manner.explores,
            sink,
            plan: None,
            due: Tti::ZERO,
            open: None,
            woken: None,
        }
    }

    /// What the devices do in the TTI of `seen` where the policy says `plan`.
    fn explored(&self, seen: &Observation<'_>, plan: &Plan) -> Vec<bool> {
        let known = seen.known;
        let is_on = |j: usize| plan.duty_cycle(DeviceId(j as u32)).is_on(seen.now);
        let draw = |j: usize| {
            known
                .streams
                .unit_for_pair(PolicyPurpose::Exploration, seen.now.0, j as u64)
        };
        let can = |j: usize| seen.batteries[j] >= needed(&known.devices[j].energy);
        (0..known.n())
            .map(|j| is_on(j) ^ (self.explores > 0.0 && can(j) && draw(j) < self.explores))
            .collect()
    }
}

impl<S: Sink> Policy for Recorded<S> {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        if let Some(step) = self.open.take() {
            self.sink.take(step);
        }
        self.senses.begin(seen);
        let decides = seen.now >= self.due;
        if decides {
            self.plan = Some(self.policy.decide(&self.own.shown(seen)));
            self.due = self.policy.next_decision(seen.now);
        }
        if decides || self.explores > 0.0 {
            self.own.keep(|levels| levels.pass(seen.now, seen.plan));
        }
        let on = self.explored(seen, self.plan.as_ref().expect("decided in TTI 0"));
        let looked = Looked::of(&mut self.union, &on);
        let mut looks = vec![Look::default(); on.len()];
        for (j, (look, &on)) in looks.iter_mut().zip(&on).enumerate() {
            (look.expected, look.on) = (self.senses.expected(j), on);
        }
        self.open = Some(Step {
            tti: seen.now,
            tokens: self.senses.tokens().to_vec(),
            looks,
            share: (1.0 - looked.uncovered) as f32,
            reward: looked.reward(seen.known.alpha, MU1) as f32,
            wake_reward: 0.0,
        });
        let plan = if self.explores > 0.0 {
            Plan::from_bits(on)
        } else {
            self.plan.clone().expect("decided in TTI 0")
        };
        self.senses.look(seen.now, &plan, false);
        plan
    }

    fn next_decision(&self, now: Tti) -> Tti {
        now + 1
    }

    fn looks_at_batteries(&self) -> bool {
        true
    }

    fn wakes(&self) -> bool {
        self.policy.wakes()
    }

    fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        for report in reports {
            self.senses.hear(seen, report);
            if let Some(step) = &mut self.open {
                step.looks[report.device.index()].found = true;
            }
        }
        let ages = self.senses.ages();
        self.candidates.start_with(seen, reports, |place| ages.at(place));
        self.own.keep(|levels| levels.gathered(seen.now, seen.plan, reports));
        self.policy.reported(&self.own.shown(seen), reports);
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let device = self.policy.next_wake_up(&self.own.shown(seen))?;
        let own = self.candidates.next(seen, |candidate| candidate == device);
        self.woken = Some((device, own.map_or(0.0, |(_, gain)| gain), seen.information));
        Some(device)
    }

    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        let psi = seen.known.sensing.psi;
        let woken = self.woken.take();
        if let Some((device, ..)) = woken {
            self.own.keep(|levels| match report {
                Some(report) => levels.heard(device, seen.now, report.battery),
                None => levels.silent(device, seen.now, seen.plan),
            });
        }
        if let (Some((device, gain, before)), Some(step)) = (woken, &mut self.open) {
            let brought = (seen.information - before) / psi;
            step.looks[device.index()].wake_up = Some(((gain / psi) as f32, brought as f32));
            let [worth, cost] = reward::of_wake_ups(MU2, brought, 1, seen.known.n());
            step.wake_reward += (worth + cost) as f32;
        }
        if let Some(report) = report {
            self.senses.hear(seen, report);
            let ages = self.senses.ages();
            self.candidates.add_with(seen, report, |place| ages.at(place));
        }
        self.policy.answered(&self.own.shown(seen), report);
    }

    fn facts(&self) -> Vec<(&'static str, f64)> {
        self.policy.facts()
    }

    fn learned(&self) -> Option<Opaque> {
        self.policy.learned()
    }

    fn groups(&self) -> Option<&[u32]> {
        self.policy.groups()
    }

    fn belief(&self) -> Option<&Belief> {
        self.policy.belief()
    }
}
