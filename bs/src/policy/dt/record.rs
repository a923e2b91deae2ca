//! Recording of trajectories: observation, action and reward of a base station in each TTI under any policy.
//! [`RecordingPolicy`] wraps the policy and passes each step to a [`StepSink`]. `lab/src/trajectories/` writes the
//! steps to files, from which `reveille train dt` learns; its `parquet.rs` repeats the fields of a step as columns, so
//! a change of their meaning needs a new `VERSION` there. With the default [`RecordingOptions`] a recording does not
//! change the run.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::rng::PolicyPurpose;
use reveille_common::scenario::WakeUpRanking;

use super::tokens::TokenBuilder;
use crate::battery_estimator::BatteryEstimator;
use crate::beliefs::ages::price::min_sensing_level;
use crate::beliefs::candidates::WakeUpCandidates;
use crate::beliefs::coverage::CoverageUnion;
use crate::beliefs::posterior::EpicentreBelief;
use crate::beliefs::reward::{self, CoverageReward, DEFAULT_MU1, DEFAULT_MU2};
use crate::knowledge::Knowledge;
use crate::observation::Observation;
use crate::policy::interface::{LearnedState, Policy};

/// Action and outcome of one device in a TTI.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DeviceStep {
    /// Events that it would detect if it sensed, given only α.
    pub expected_events: f32,
    /// Whether it was in S1 (δ = 1).
    pub is_sensing: bool,
    /// Whether its report was among the first reports of an event.
    pub has_reported_first: bool,
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
    pub devices: Vec<DeviceStep>,
    /// Covered share of the area: the probability that an event that starts in this TTI is detected in it.
    pub covered_share: f32,
    /// Reward r(k), in expectation over events that start in this TTI.
    pub reward: f32,
    /// Reward r*(k) with μ2 = 1; 0 without wake-ups.
    pub wake_reward: f32,
}

/// Consumer of the steps of a trajectory, in order of TTIs. It receives a step when the next TTI begins, so never the
/// last TTI of a run.
pub trait StepSink: Send {
    /// Receives the next step.
    fn accept(&mut self, step: TrajectoryStep);
}

impl<F: FnMut(TrajectoryStep) + Send> StepSink for F {
    fn accept(&mut self, step: TrajectoryStep) {
        self(step);
    }
}

/// Options of a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RecordingOptions {
    /// Probability that a device does the opposite of the plan, `[0, 1)`.
    pub exploration: f64,
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
    fn for_policy<'a>(&'a self, seen: &Observation<'a>) -> Observation<'a> {
        match self {
            Self::Recorded => *seen,
            Self::Hidden(estimator) => Observation {
                batteries: &[],
                battery_estimator: estimator.as_deref(),
                ..*seen
            },
        }
    }

    /// Applies `update` to the separate estimator, if present.
    fn update_estimator(&mut self, update: impl FnOnce(&mut BatteryEstimator)) {
        if let Self::Hidden(Some(estimator)) = self {
            update(estimator);
        }
    }
}

/// A policy whose trajectory is recorded, optionally with exploration ([`RecordingOptions::exploration`]). It decides
/// in every TTI, always reads batteries, and passes on all other calls of [`Policy`] except `oracle`. A new method
/// needs a line here.
pub struct RecordingPolicy<S> {
    policy: Box<dyn Policy>,
    battery_source: BatterySource,
    token_builder: TokenBuilder,
    coverage: CoverageUnion,
    /// Candidates by belief, from which the expected gain of a wake-up is computed. They make no decision.
    candidates: WakeUpCandidates,
    exploration: f64,
    sink: S,
    /// Last plan of the policy, without exploration.
    plan: Option<Plan>,
    next_decision_tti: Tti,
    open_step: Option<TrajectoryStep>,
    /// The wake-up that waits for its answer.
    pending_wake_up: Option<PendingWakeUp>,
}

#[derive(Clone, Copy, Debug)]
struct PendingWakeUp {
    device: DeviceId,
    /// Expected gain of information, `[0, Ψ]`.
    expected_gain: f64,
    /// Î before the wake-up.
    information_before: f64,
}

impl<S: StepSink> RecordingPolicy<S> {
    /// Records `policy`, for the devices in `known`, with the options in `options`.
    pub fn new(policy: Box<dyn Policy>, known: &Knowledge, options: RecordingOptions, sink: S) -> Self {
        let battery_source = if policy.needs_batteries() || options.true_batteries {
            BatterySource::Recorded
        } else {
            BatterySource::Hidden(
                policy
                    .needs_battery_estimates()
                    .then(|| Box::new(BatteryEstimator::new_estimated(known))),
            )
        };
        Self {
            policy,
            battery_source,
            token_builder: TokenBuilder::new(known, |j| min_sensing_level(&known.devices[j].energy)),
            coverage: reward::coverage_union(known),
            candidates: WakeUpCandidates::with_ranking(WakeUpRanking::Posterior, known),
            exploration: options.exploration,
            sink,
            plan: None,
            next_decision_tti: Tti::ZERO,
            open_step: None,
            pending_wake_up: None,
        }
    }

    /// Returns whether each device senses in the TTI of `seen` under `plan` with exploration.
    fn apply_exploration(&self, seen: &Observation<'_>, plan: &Plan) -> Vec<bool> {
        let known = seen.known;
        let is_on = |j: usize| plan.duty_cycle(DeviceId(j as u32)).is_on(seen.now);
        let draw = |j: usize| {
            known
                .streams
                .unit_for_pair(PolicyPurpose::Exploration, seen.now.0, j as u64)
        };
        let can_explore = |j: usize| seen.batteries[j] >= min_sensing_level(&known.devices[j].energy);
        (0..known.n())
            // An exploring device does the opposite of the plan; one without energy for a report does not explore.
            .map(|j| is_on(j) ^ (self.exploration > 0.0 && can_explore(j) && draw(j) < self.exploration))
            .collect()
    }
}

impl<S: StepSink + 'static> Policy for RecordingPolicy<S> {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        // A step is complete only now: reports and wake-ups of a TTI come after its decision.
        if let Some(step) = self.open_step.take() {
            self.sink.accept(step);
        }
        self.token_builder.begin_tti(seen);
        let is_decision_due = seen.now >= self.next_decision_tti;
        if is_decision_due {
            self.plan = Some(self.policy.decide(&self.battery_source.for_policy(seen)));
            self.next_decision_tti = self.policy.next_decision(seen.now);
        }
        // The plan changes when the policy decides, and in every TTI while devices explore.
        if is_decision_due || self.exploration > 0.0 {
            self.battery_source
                .update_estimator(|estimator| estimator.advance(seen.now, seen.plan));
        }
        let on_bits = self.apply_exploration(seen, self.plan.as_ref().expect("decided in TTI 0"));
        let coverage_reward = CoverageReward::new(&mut self.coverage, &on_bits);
        let mut devices = vec![DeviceStep::default(); on_bits.len()];
        for (j, (device, &is_on)) in devices.iter_mut().zip(&on_bits).enumerate() {
            (device.expected_events, device.is_sensing) = (self.token_builder.expected_events(j), is_on);
        }
        self.open_step = Some(TrajectoryStep {
            tti: seen.now,
            tokens: self.token_builder.tokens().to_vec(),
            devices,
            covered_share: (1.0 - coverage_reward.uncovered_share) as f32,
            reward: coverage_reward.reward(seen.known.alpha, DEFAULT_MU1) as f32,
            wake_reward: 0.0,
        });
        let plan = if self.exploration > 0.0 {
            Plan::from_bits(on_bits)
        } else {
            self.plan.clone().expect("decided in TTI 0")
        };
        // The recorder chooses no devices in the ages of the builder, so none is there yet.
        let are_in_ages = false;
        self.token_builder.mark_sensing(seen.now, &plan, are_in_ages);
        plan
    }

    fn needs_batteries(&self) -> bool {
        true
    }

    fn needs_battery_estimates(&self) -> bool {
        self.policy.needs_battery_estimates()
    }

    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        for report in reports {
            self.token_builder.add_report(seen, report);
            if let Some(step) = &mut self.open_step {
                step.devices[report.device.index()].has_reported_first = true;
            }
        }
        let ages = self.token_builder.ages();
        self.candidates.start_event_with_prior(seen, reports, ages);
        self.battery_source
            .update_estimator(|estimator| estimator.update_from_reports(seen.now, seen.plan, reports));
        self.policy
            .reports_received(&self.battery_source.for_policy(seen), reports);
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let device = self.policy.next_wake_up(&self.battery_source.for_policy(seen))?;
        // Restricted to the device that the policy wakes, the only candidate is this device, with its expected gain.
        let candidate = self.candidates.next_candidate(seen, |candidate| candidate == device);
        self.pending_wake_up = Some(PendingWakeUp {
            device,
            expected_gain: candidate.map_or(0.0, |(_, gain)| gain),
            information_before: seen.information,
        });
        Some(device)
    }

    fn take_wake_up_answer(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        let psi = seen.known.sensing.psi;
        let pending_wake_up = self.pending_wake_up.take();
        if let Some(PendingWakeUp { device, .. }) = pending_wake_up {
            self.battery_source.update_estimator(|estimator| match report {
                Some(report) => estimator.observe_level(device, seen.now, report.battery),
                None => estimator.observe_unanswered_wake_up(device, seen.now, seen.plan),
            });
        }
        if let (Some(wake_up), Some(step)) = (pending_wake_up, &mut self.open_step) {
            let expected_share = wake_up.expected_gain / psi;
            let gained_share = (seen.information - wake_up.information_before) / psi;
            step.devices[wake_up.device.index()].wake_up = Some((expected_share as f32, gained_share as f32));
            let reward_terms = reward::wake_up_reward_terms(DEFAULT_MU2, gained_share, 1, seen.known.n());
            step.wake_reward += reward_terms.iter().sum::<f64>() as f32;
        }
        if let Some(report) = report {
            self.token_builder.add_report(seen, report);
            let ages = self.token_builder.ages();
            self.candidates.add_report_with_prior(seen, report, ages);
        }
        self.policy
            .take_wake_up_answer(&self.battery_source.for_policy(seen), report);
    }

    fn set_price(&mut self, known: &Knowledge, price: f64) {
        self.policy.set_price(known, price);
    }

    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        self.policy.summary_facts()
    }

    fn learned_state(&self) -> Option<LearnedState> {
        self.policy.learned_state()
    }

    fn device_groups(&self) -> Option<&[u32]> {
        self.policy.device_groups()
    }

    fn epicentre_belief(&self) -> Option<&EpicentreBelief> {
        self.policy.epicentre_belief()
    }
}
