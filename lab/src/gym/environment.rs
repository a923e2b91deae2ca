//! One environment.

use std::sync::Arc;

use reveille_bs::beliefs::coverage::Union;
use reveille_bs::beliefs::reward::{self, CoverageReward, MU1, MU2};
use reveille_bs::cycle::{Outcome, PreparedRun};
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
        Self { mu1: MU1, mu2: MU2 }
    }
}

/// A deployed scenario for environments, with the data shared by all episodes.
#[derive(Clone, Debug)]
pub struct EpisodeTemplate {
    prepared: Arc<PreparedRun>,
    union: Union,
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
        let union = reward::union(&prepared.knowledge());
        Self {
            prepared: Arc::new(prepared),
            union,
        }
    }

    /// The scenario.
    pub fn scenario(&self) -> &Scenario {
        &self.prepared.scenario
    }
}

/// The reward of a step, by term.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepResult {
    /// The share of sleeping devices, the first term of r(k); 0 at stage 1.
    pub asleep: f64,
    /// −α μ1 times the uncovered share of the area, the expectation of the second term of r(k); 0 at stage 1.
    pub missed: f64,
    /// μ2 times the gain in Î by wake-ups, as a share of Ψ; 0 at stage 0.
    pub information: f64,
    /// −1/N times the number of woken devices; 0 at stage 0.
    pub woken: f64,
}

impl StepResult {
    /// r(k) at stage 0, the step's share of r*(k) at stage 1.
    pub fn reward(&self) -> f64 {
        self.asleep + self.missed + self.information + self.woken
    }
}

/// Accumulates the gain of wake-ups from the base station's notifications.
#[derive(Clone, Debug)]
struct StepObserver {
    sensing: Sensing,
    information: f64,
    wake_ups: u32,
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
            Notification::WakeUpSent { .. } => self.wake_ups += 1,
            Notification::PlanSent { .. }
            | Notification::EventStarted(_)
            | Notification::ReportLost(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::BeliefUpdated { .. }
            | Notification::DevicesRemoved(_)
            | Notification::EventEnded(_)
            | Notification::TtiClosed(_)
            | Notification::DeviceStates(_) => {}
        }
    }
}

/// A run that is stepped from its first TTI to its last.
pub struct Environment {
    ground: EpisodeTemplate,
    weights: RewardWeights,
    stepping: SteppedRun<StepObserver>,
    devices: usize,
    /// δ of the last plan; kept to reuse its memory.
    on: Vec<bool>,
    chosen: Vec<DeviceId>,
}

impl Environment {
    /// Creates the run of `ground` at its first decision request.
    pub fn new(ground: EpisodeTemplate, weights: RewardWeights) -> Self {
        let prepared = &ground.prepared;
        let world = World::new(&prepared.scenario, &prepared.deployment);
        Self::with_world(ground, world, weights)
    }

    /// Creates the run as [`Self::new`] does, in the caller's world, such as one with scripted events.
    pub fn with_world(ground: EpisodeTemplate, world: World, weights: RewardWeights) -> Self {
        let ear = StepObserver {
            sensing: ground.prepared.scenario.sensing.clone(),
            information: 0.0,
            wake_ups: 0,
        };
        Self {
            stepping: SteppedRun::with_world(&ground.prepared, world, RunOptions::default(), ear),
            devices: ground.prepared.deployment.devices.len(),
            ground,
            weights,
            on: Vec::new(),
            chosen: Vec::new(),
        }
    }

    /// The template of the environment.
    pub const fn ground(&self) -> &EpisodeTemplate {
        &self.ground
    }

    /// The pending decision request; `None` at the end of the run.
    pub fn pending_decision(&self) -> Option<DecisionContext<'_>> {
        self.stepping.pending_decision()
    }

    /// The pending decision request; at the end of the run, the one that would follow.
    pub fn view(&self) -> DecisionContext<'_> {
        self.stepping.view()
    }

    /// The number of closed TTIs.
    pub const fn ttis_done(&self) -> u64 {
        self.stepping.now().0
    }

    /// Takes a step with the action `is_set`, by device. Has no effect at the end of the run.
    pub fn step(&mut self, is_set: impl Fn(usize) -> bool) -> StepResult {
        match self.stepping.pending_decision().map(|question| question.stage) {
            None => StepResult::default(),
            Some(DecisionStage::Plan) => self.sense(is_set),
            Some(DecisionStage::Wake) => self.wake(is_set),
        }
    }

    fn sense(&mut self, is_set: impl Fn(usize) -> bool) -> StepResult {
        self.on.clear();
        self.on.extend((0..self.devices).map(is_set));
        let looked = CoverageReward::new(&mut self.ground.union, &self.on);
        self.stepping.decide(PlanDecision {
            plan: Plan::from_bits(self.on.iter().copied()),
            // A step is one decision, so a plan is due in every TTI.
            next: self.stepping.now() + 1,
        });
        let alpha = self.ground.scenario().events.alpha;
        StepResult {
            asleep: looked.asleep,
            missed: looked.reward(alpha, self.weights.mu1) - looked.asleep,
            ..StepResult::default()
        }
    }

    fn wake(&mut self, is_set: impl Fn(usize) -> bool) -> StepResult {
        self.chosen.clear();
        let devices = (0..self.devices).filter(|j| is_set(*j));
        self.chosen.extend(devices.map(|j| DeviceId(j as u32)));
        // Reports of sensing devices count in Î before the first wake-up; only the gain by wake-ups is rewarded.
        let (psi, before) = (self.ground.scenario().sensing.psi, self.information());
        self.stepping.observer_mut().wake_ups = 0;
        self.stepping.wake(&self.chosen);
        // A plan is due in every TTI, so the run stops before the next grant: Î still belongs to this TTI.
        let ear = self.stepping.observer();
        let brought = (ear.information - before) / psi;
        let [information, woken] = reward::of_wake_ups(self.weights.mu2, brought, ear.wake_ups, self.devices);
        StepResult {
            information,
            woken,
            ..StepResult::default()
        }
    }

    fn information(&self) -> f64 {
        self.stepping.observer().information
    }

    /// Returns a copy that continues from the current state.
    #[must_use]
    pub fn fork(&self) -> Self {
        Self {
            ground: self.ground.clone(),
            stepping: self.stepping.fork(),
            on: Vec::new(),
            chosen: Vec::new(),
            ..*self
        }
    }

    /// The outcome of the run so far; incomplete before its end.
    pub fn outcome(&self) -> Outcome {
        // `finish` consumes a run and answers an open request, so it works on a copy.
        self.stepping.fork().finish().0
    }
}
