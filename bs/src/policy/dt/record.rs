//! Trajectories: observation, action and reward of a base station in each TTI under any policy.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::rng::PolicyPurpose;

use super::tokens::TokenBuilder;
use crate::battery_estimator::BatteryEstimator;
use crate::beliefs::ages::price::min_level;
use crate::beliefs::candidates::Candidates;
use crate::beliefs::coverage::Union;
use crate::beliefs::posterior::EpicentreBelief;
use crate::beliefs::reward::{self, CoverageReward, MU1, MU2};
use crate::knowledge::Knowledge;
use crate::observation::Observation;
use crate::policy::interface::{Opaque, Policy};
use reveille_common::scenario::WakeUpRanking;

/// Action and outcome of one device in a TTI.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DeviceStep {
    /// Events that it would find if it sensed, given only α.
    pub expected: f32,
    /// Whether it was in S1 (δ = 1).
    pub on: bool,
    /// Whether its report was among the first reports of an event.
    pub found: bool,
    /// Expected and actual gain of information of a woken device, shares of Ψ.
    pub wake_up: Option<(f32, f32)>,
}

/// One TTI of a trajectory.
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectoryStep {
    /// The TTI.
    pub tti: Tti,
    /// The tokens of the devices, `[N, F]`.
    pub tokens: Vec<f32>,
    /// Actions and outcomes by device.
    pub looks: Vec<DeviceStep>,
    /// Covered share of the area: the probability that an event that starts in this TTI is found in it.
    pub share: f32,
    /// Reward r(k), in expectation over events that start in this TTI.
    pub reward: f32,
    /// Reward r*(k) with μ2 = 1; 0 without wake-ups.
    pub wake_reward: f32,
}

/// Consumer of the steps of a trajectory, in order of TTIs.
pub trait StepSink: Send {
    /// Takes the next step.
    fn take(&mut self, step: TrajectoryStep);
}

impl<F: FnMut(TrajectoryStep) + Send> StepSink for F {
    fn take(&mut self, step: TrajectoryStep) {
        self(step);
    }
}

/// Options of a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RecordingOptions {
    /// Probability that a device does the opposite of the plan, `[0, 1)`.
    pub explores: f64,
    /// Whether a policy that does not need batteries uses the recorded levels to find the devices that can pay for a
    /// report. With `bs.battery_knowledge = "oracle"` these are the true levels. The policy then wakes other devices
    /// than in a run without a recording.
    pub true_batteries: bool,
}

/// Battery levels that the policy receives.
#[derive(Debug)]
enum BatterySource {
    /// The recorded levels.
    Recorded,
    /// No levels. The estimator finds the devices that can pay for a report, as in a run without a recording.
    Hidden(Option<Box<BatteryEstimator>>),
}

impl BatterySource {
    /// Returns the observation `seen` with the battery levels for the policy.
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

    /// Applies `keep` to the separate estimator, if present.
    fn keep(&mut self, keep: impl FnOnce(&mut BatteryEstimator)) {
        if let Self::Hidden(Some(levels)) = self {
            keep(levels);
        }
    }
}

/// A policy whose trajectory is recorded, optionally with exploration ([`RecordingOptions::explores`]).
pub struct RecordingPolicy<S> {
    policy: Box<dyn Policy>,
    own: BatterySource,
    senses: TokenBuilder,
    union: Union,
    /// Candidates, which give the expected gain of a wake-up.
    candidates: Candidates,
    explores: f64,
    sink: S,
    plan: Option<Plan>,
    due: Tti,
    open: Option<TrajectoryStep>,
    /// Device being woken, its expected gain, and Î before.
    woken: Option<(DeviceId, f64, f64)>,
}

impl<S: StepSink> RecordingPolicy<S> {
    /// Records `policy`, for the devices in `known`, with the options in `manner`.
    pub fn new(policy: Box<dyn Policy>, known: &Knowledge, manner: RecordingOptions, sink: S) -> Self {
        let own = if policy.needs_batteries() || manner.true_batteries {
            BatterySource::Recorded
        } else {
            BatterySource::Hidden(
                policy
                    .needs_levels()
                    .then(|| Box::new(BatteryEstimator::estimated(known))),
            )
        };
        Self {
            policy,
            own,
            senses: TokenBuilder::new(known, |j| min_level(&known.devices[j].energy)),
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

    /// Returns whether each device senses in the TTI of `seen` under `plan` with exploration.
    fn explored(&self, seen: &Observation<'_>, plan: &Plan) -> Vec<bool> {
        let known = seen.known;
        let is_on = |j: usize| plan.duty_cycle(DeviceId(j as u32)).is_on(seen.now);
        let draw = |j: usize| {
            known
                .streams
                .unit_for_pair(PolicyPurpose::Exploration, seen.now.0, j as u64)
        };
        let can = |j: usize| seen.batteries[j] >= min_level(&known.devices[j].energy);
        (0..known.n())
            // An exploring device does the opposite of the plan; one without energy for a report does not explore.
            .map(|j| is_on(j) ^ (self.explores > 0.0 && can(j) && draw(j) < self.explores))
            .collect()
    }
}

impl<S: StepSink + 'static> Policy for RecordingPolicy<S> {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        // A step is complete only now: reports and wake-ups of a TTI come after its decision.
        if let Some(step) = self.open.take() {
            self.sink.take(step);
        }
        self.senses.begin(seen);
        let decides = seen.now >= self.due;
        if decides {
            self.plan = Some(self.policy.decide(&self.own.shown(seen)));
            self.due = self.policy.next_decision(seen.now);
        }
        // The plan changes when the policy decides, and in every TTI while devices explore.
        if decides || self.explores > 0.0 {
            self.own.keep(|levels| levels.advance(seen.now, seen.plan));
        }
        let on = self.explored(seen, self.plan.as_ref().expect("decided in TTI 0"));
        let looked = CoverageReward::new(&mut self.union, &on);
        let mut looks = vec![DeviceStep::default(); on.len()];
        for (j, (look, &on)) in looks.iter_mut().zip(&on).enumerate() {
            (look.expected, look.on) = (self.senses.expected(j), on);
        }
        self.open = Some(TrajectoryStep {
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
        self.senses.mark_sensing(seen.now, &plan, false);
        plan
    }

    fn needs_batteries(&self) -> bool {
        true
    }

    fn needs_levels(&self) -> bool {
        self.policy.needs_levels()
    }

    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        for report in reports {
            self.senses.add_report(seen, report);
            if let Some(step) = &mut self.open {
                step.looks[report.device.index()].found = true;
            }
        }
        let ages = self.senses.ages();
        self.candidates.start_with(seen, reports, |place| ages.age_at(place));
        self.own
            .keep(|levels| levels.observe_reports(seen.now, seen.plan, reports));
        self.policy.reports_received(&self.own.shown(seen), reports);
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let device = self.policy.next_wake_up(&self.own.shown(seen))?;
        // Restricted to the device that the policy wakes, the candidates give the expected gain of this device.
        let own = self.candidates.next(seen, |candidate| candidate == device);
        self.woken = Some((device, own.map_or(0.0, |(_, gain)| gain), seen.information));
        Some(device)
    }

    fn wake_up_answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        let psi = seen.known.sensing.psi;
        let woken = self.woken.take();
        if let Some((device, ..)) = woken {
            self.own.keep(|levels| match report {
                Some(report) => levels.observe_level(device, seen.now, report.battery),
                None => levels.observe_no_answer(device, seen.now, seen.plan),
            });
        }
        if let (Some((device, gain, before)), Some(step)) = (woken, &mut self.open) {
            let brought = (seen.information - before) / psi;
            step.looks[device.index()].wake_up = Some(((gain / psi) as f32, brought as f32));
            let [worth, cost] = reward::of_wake_ups(MU2, brought, 1, seen.known.n());
            step.wake_reward += (worth + cost) as f32;
        }
        if let Some(report) = report {
            self.senses.add_report(seen, report);
            let ages = self.senses.ages();
            self.candidates.add_with(seen, report, |place| ages.age_at(place));
        }
        self.policy.wake_up_answered(&self.own.shown(seen), report);
    }

    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        self.policy.summary_facts()
    }

    fn learned(&self) -> Option<Opaque> {
        self.policy.learned()
    }

    fn groups(&self) -> Option<&[u32]> {
        self.policy.groups()
    }

    fn belief(&self) -> Option<&EpicentreBelief> {
        self.policy.belief()
    }
}
