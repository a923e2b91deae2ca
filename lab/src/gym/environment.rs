//! One environment: a run that actions advance by steps, with the rewards of Sec. V-B. `batch.rs` and [`super::record`]
//! step it. `bs/src/beliefs/reward.rs` has the formulas; rewards do not affect the run.

use std::sync::Arc;

use reveille_bs::beliefs::coverage::CoverageUnion;
use reveille_bs::beliefs::reward::{self, CoverageReward, DEFAULT_MU1, DEFAULT_MU2};
use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::external::{DecisionContext, DecisionStage, PlanDecision};
use reveille_bs::policy::outside::is_external;
use reveille_bs::scenario::Scenario;
use reveille_common::ids::DeviceId;
use reveille_common::message::WakeOutcome;
use reveille_common::plan::Plan;
use reveille_common::sensing::Sensing;
use reveille_common::world::World;

use crate::run::RunOptions;
use crate::stepped_run::SteppedRun;

/// The weights of the rewards (Sec. V-B).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RewardWeights {
    /// μ1, the weight of misdetections, ≥ 0.
    pub mu1: f64,
    /// μ2, the weight of information, ≥ 0.
    pub mu2: f64,
}

impl Default for RewardWeights {
    fn default() -> Self {
        Self {
            mu1: DEFAULT_MU1,
            mu2: DEFAULT_MU2,
        }
    }
}

/// A deployed scenario for environments, with the data shared by all episodes.
#[derive(Clone, Debug)]
pub struct EpisodeTemplate {
    prepared: Arc<PreparedRun>,
    coverage_union: CoverageUnion,
}

impl EpisodeTemplate {
    /// Prepares `scenario`, whose policy must be `external`.
    ///
    /// # Panics
    /// If it has another policy.
    pub fn new(scenario: &Scenario) -> Self {
        assert!(
            is_external(&scenario.policy),
            "{} decides itself",
            scenario.policy.name()
        );
        let prepared = PreparedRun::without_pilots(scenario);
        let coverage_union = reward::coverage_union(&prepared.knowledge());
        Self {
            prepared: Arc::new(prepared),
            coverage_union,
        }
    }

    /// The scenario.
    pub fn scenario(&self) -> &Scenario {
        &self.prepared.scenario
    }
}

/// The reward of a step, by term. Stage 0 is a plan, stage 1 are wake-ups.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RewardTerms {
    /// The share of sleeping devices, the first term of r(k); 0 at stage 1.
    pub asleep: f64,
    /// −α μ1 times the uncovered share of the area, the expectation of the second term of r(k); 0 at stage 1.
    pub missed: f64,
    /// μ2 times the gain in Î by wake-ups, as a share of Ψ; 0 at stage 0.
    pub information: f64,
    /// −1/N times the number of woken devices; 0 at stage 0.
    pub woken: f64,
}

impl RewardTerms {
    /// r(k) at stage 0, the step's share of r*(k) at stage 1.
    pub fn reward(&self) -> f64 {
        self.asleep + self.missed + self.information + self.woken
    }
}

/// Accumulates the gain of wake-ups from the base station's notifications.
#[derive(Clone, Debug)]
struct StepObserver {
    sensing: Sensing,
    /// Î of the open TTI.
    information: f64,
    /// The number of wake-ups sent since [`Environment::step_wake_ups`] has reset it.
    sent_wake_ups: u32,
}

impl Observer for StepObserver {
    fn notify(&mut self, notification: &Notification<'_>) {
        match *notification {
            // Î counts the reports of one TTI; a grant opens the next one.
            Notification::TtisGranted(_) => self.information = 0.0,
            Notification::ReportReceived(report)
            | Notification::WakeUpCompleted {
                outcome: WakeOutcome::Reported(report),
                ..
            } => self.information = self.sensing.fuse(self.information, report.information),
            Notification::WakeUpSent { .. } => self.sent_wake_ups += 1,
            Notification::PlanSent { .. }
            | Notification::EventStarted(_)
            | Notification::ReportLost(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::BeliefUpdated { .. }
            | Notification::DevicesRemoved(_)
            | Notification::ActionTaken(_)
            | Notification::EventEnded(_)
            | Notification::TtiClosed(_)
            | Notification::DeviceStates(_) => {}
        }
    }
}

/// A run that is stepped from its first TTI to its last.
pub struct Environment {
    template: EpisodeTemplate,
    weights: RewardWeights,
    run: SteppedRun<StepObserver>,
    device_count: usize,
    /// δ of the last plan; kept to reuse its memory.
    plan_bits: Vec<bool>,
    devices_to_wake: Vec<DeviceId>,
}

impl Environment {
    /// Creates the run of `template` at its first decision request.
    pub fn new(template: EpisodeTemplate, weights: RewardWeights) -> Self {
        let prepared = &template.prepared;
        let world = World::new(&prepared.scenario, &prepared.deployment);
        Self::with_world(template, world, weights)
    }

    /// Creates the run as [`Self::new`] does, in the caller's world of the same deployment, such as one with scripted
    /// events.
    pub fn with_world(template: EpisodeTemplate, world: World, weights: RewardWeights) -> Self {
        let observer = StepObserver {
            sensing: template.prepared.scenario.sensing.clone(),
            information: 0.0,
            sent_wake_ups: 0,
        };
        Self {
            run: SteppedRun::with_world(&template.prepared, world, RunOptions::default(), observer),
            device_count: template.prepared.deployment.devices.len(),
            template,
            weights,
            plan_bits: Vec::new(),
            devices_to_wake: Vec::new(),
        }
    }

    /// The template of the environment.
    pub const fn template(&self) -> &EpisodeTemplate {
        &self.template
    }

    /// The pending decision request; `None` at the end of the run.
    pub fn pending_decision(&self) -> Option<DecisionContext<'_>> {
        self.run.pending_decision()
    }

    /// The pending decision request; at the end of the run, the one that would follow.
    pub fn decision_context(&self) -> DecisionContext<'_> {
        self.run.decision_context()
    }

    /// The number of closed TTIs.
    pub const fn ttis_done(&self) -> u64 {
        self.run.now().0
    }

    /// Takes a step with the action `is_set`, by device: whether it senses, or is woken. Has no effect at the end of
    /// the run.
    pub fn step(&mut self, is_set: impl Fn(usize) -> bool) -> RewardTerms {
        match self.run.pending_decision().map(|request| request.stage) {
            None => RewardTerms::default(),
            Some(DecisionStage::Plan) => self.step_plan(is_set),
            Some(DecisionStage::Wake) => self.step_wake_ups(is_set),
        }
    }

    fn step_plan(&mut self, is_set: impl Fn(usize) -> bool) -> RewardTerms {
        self.plan_bits.clear();
        self.plan_bits.extend((0..self.device_count).map(is_set));
        let coverage = CoverageReward::new(&mut self.template.coverage_union, &self.plan_bits);
        self.run.decide(PlanDecision {
            plan: Plan::from_bits(self.plan_bits.iter().copied()),
            // A step is one decision, so a plan is due in every TTI.
            next: self.run.now() + 1,
        });
        let alpha = self.template.scenario().events.alpha;
        RewardTerms {
            asleep: coverage.asleep_share,
            missed: coverage.reward(alpha, self.weights.mu1) - coverage.asleep_share,
            ..RewardTerms::default()
        }
    }

    fn step_wake_ups(&mut self, is_set: impl Fn(usize) -> bool) -> RewardTerms {
        self.devices_to_wake.clear();
        let devices = (0..self.device_count).filter(|j| is_set(*j));
        self.devices_to_wake.extend(devices.map(|j| DeviceId(j as u32)));
        // Reports of sensing devices count in Î before the first wake-up; only the gain by wake-ups is rewarded.
        let (psi, information_before) = (self.template.scenario().sensing.psi, self.information());
        self.run.observer_mut().sent_wake_ups = 0;
        self.run.wake(&self.devices_to_wake);
        // A plan is due in every TTI, so the run stops before the next grant: Î still belongs to this TTI.
        let observer = self.run.observer();
        let gain = (observer.information - information_before) / psi;
        let [information, woken] =
            reward::wake_up_reward_terms(self.weights.mu2, gain, observer.sent_wake_ups, self.device_count);
        RewardTerms {
            information,
            woken,
            ..RewardTerms::default()
        }
    }

    fn information(&self) -> f64 {
        self.run.observer().information
    }

    /// Returns a copy that continues from the current state.
    #[must_use]
    pub fn fork(&self) -> Self {
        Self {
            template: self.template.clone(),
            run: self.run.fork(),
            plan_bits: Vec::new(),
            devices_to_wake: Vec::new(),
            ..*self
        }
    }

    /// The outcome of the run so far; incomplete before its end.
    pub fn outcome(&self) -> RunOutcome {
        // `finish` consumes a run and answers an open request, so it works on a copy.
        self.run.fork().finish().0
    }
}
