//! One environment.

use std::sync::Arc;

use reveille_bs::beliefs::coverage::Union;
use reveille_bs::beliefs::reward::{self, Looked, MU1, MU2};
use reveille_bs::observe::{Happening, Observer};
use reveille_bs::outcome::Outcome;
use reveille_bs::policy::external::{Decision, Question, Stage};
use reveille_bs::policy::outside::EXTERNAL;
use reveille_bs::prepared::Prepared;
use reveille_common::ids::DeviceId;
use reveille_common::message::WakeOutcome;
use reveille_common::plan::Plan;
use reveille_common::scenario::Scenario;
use reveille_common::sensing::Sensing;
use reveille_common::world::World;

use crate::run::Options;
use crate::stepping::Stepping;

/// The weights of the rewards (Sec. V-B).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// μ1, of misdetections, ≥ 0.
    pub mu1: f64,
    /// μ2, of information, ≥ 0.
    pub mu2: f64,
}

impl Default for Weights {
    fn default() -> Self {
        Self { mu1: MU1, mu2: MU2 }
    }
}

/// A scenario put on the ground for environments, with what is worth keeping from one episode to the next.
#[derive(Clone, Debug)]
pub struct Ground {
    prepared: Arc<Prepared>,
    union: Union,
}

impl Ground {
    /// The ground of `scenario`, whose policy is `external`.
    pub fn new(scenario: &Scenario) -> Self {
        let prepared = Prepared::with_policies(scenario, EXTERNAL);
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

/// What a step has brought.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Step {
    /// The share of devices that sleep, the first term of r(k); 0 at stage 1.
    pub asleep: f64,
    /// −α μ1 times the share of the area that nobody looks at, the second term of r(k) as it is to be expected; 0 at
    /// stage 1.
    pub missed: f64,
    /// μ2 times what wake-ups have added to Î, a share of Ψ; 0 at stage 0.
    pub information: f64,
    /// −1/N times the number of devices that were woken; 0 at stage 0.
    pub woken: f64,
}

impl Step {
    /// r(k) at stage 0, the step's share of r*(k) at stage 1.
    pub fn reward(&self) -> f64 {
        self.asleep + self.missed + self.information + self.woken
    }
}

/// What wake-ups bring, as the base station hears of it.
#[derive(Clone, Debug)]
struct Ear {
    sensing: Sensing,
    information: f64,
    wake_ups: u32,
}

impl Observer for Ear {
    fn see(&mut self, happening: &Happening<'_>) {
        match *happening {
            Happening::Granted(_) => self.information = 0.0,
            Happening::Reported(report)
            | Happening::Woken {
                outcome: WakeOutcome::Reported(report),
                ..
            } => self.information = self.sensing.fuse(self.information, report.information),
            Happening::WakeUp { .. } => self.wake_ups += 1,
            Happening::Plan { .. }
            | Happening::EventStarted(_)
            | Happening::Lost(_)
            | Happening::Failed { .. }
            | Happening::Woken { .. }
            | Happening::Believed { .. }
            | Happening::Gone(_)
            | Happening::EventEnded(_)
            | Happening::Closed(_)
            | Happening::States(_) => {}
        }
    }
}

/// A run to be stepped through, from its first TTI to its last.
pub struct Environment {
    ground: Ground,
    weights: Weights,
    stepping: Stepping<Ear>,
    devices: usize,
    /// δ of the last plan; kept for its memory.
    on: Vec<bool>,
    chosen: Vec<DeviceId>,
}

impl Environment {
    /// The run on `ground` at its first question.
    pub fn new(ground: Ground, weights: Weights) -> Self {
        let prepared = &ground.prepared;
        let world = World::new(&prepared.scenario, &prepared.deployment);
        Self::with_world(ground, world, weights)
    }

    /// As [`Self::new`], in a world of the caller's, such as one with scripted events.
    pub fn with_world(ground: Ground, world: World, weights: Weights) -> Self {
        let ear = Ear {
            sensing: ground.prepared.scenario.sensing.clone(),
            information: 0.0,
            wake_ups: 0,
        };
        Self {
            stepping: Stepping::with_world(&ground.prepared, world, Options::default(), ear),
            devices: ground.prepared.deployment.devices.len(),
            ground,
            weights,
            on: Vec::new(),
            chosen: Vec::new(),
        }
    }

    /// Where it stands.
    pub const fn ground(&self) -> &Ground {
        &self.ground
    }

    /// What is to be decided; nothing at the end.
    pub fn question(&self) -> Option<Question<'_>> {
        self.stepping.question()
    }

    /// What is to be decided; at the end, what would be if it went on.
    pub fn view(&self) -> Question<'_> {
        self.stepping.view()
    }

    /// TTIs that are closed.
    pub const fn ttis_done(&self) -> u64 {
        self.stepping.now().0
    }

    /// Takes a step with the action `is_set`, by device. At the end nothing happens.
    pub fn step(&mut self, is_set: impl Fn(usize) -> bool) -> Step {
        match self.stepping.question().map(|question| question.stage) {
            None => Step::default(),
            Some(Stage::Plan) => self.sense(is_set),
            Some(Stage::Wake) => self.wake(is_set),
        }
    }

    fn sense(&mut self, is_set: impl Fn(usize) -> bool) -> Step {
        self.on.clear();
        self.on.extend((0..self.devices).map(is_set));
        let looked = Looked::of(&mut self.ground.union, &self.on);
        self.stepping.decide(Decision {
            plan: Plan::from_bits(self.on.iter().copied()),
            next: self.stepping.now() + 1,
        });
        let alpha = self.ground.scenario().events.alpha;
        Step {
            asleep: looked.asleep,
            missed: looked.reward(alpha, self.weights.mu1) - looked.asleep,
            ..Step::default()
        }
    }

    fn wake(&mut self, is_set: impl Fn(usize) -> bool) -> Step {
        self.chosen.clear();
        let devices = (0..self.devices).filter(|j| is_set(*j));
        self.chosen.extend(devices.map(|j| DeviceId(j as u32)));
        let (psi, before) = (self.ground.scenario().sensing.psi, self.information());
        self.stepping.observer_mut().wake_ups = 0;
        self.stepping.wake(&self.chosen);
        let ear = self.stepping.observer();
        let brought = (ear.information - before) / psi;
        let [information, woken] = reward::of_wake_ups(self.weights.mu2, brought, ear.wake_ups, self.devices);
        Step {
            information,
            woken,
            ..Step::default()
        }
    }

    fn information(&self) -> f64 {
        self.stepping.observer().information
    }

    /// A copy that goes on from here.
    #[must_use]
    pub fn branch(&self) -> Self {
        Self {
            ground: self.ground.clone(),
            stepping: self.stepping.branch(),
            on: Vec::new(),
            chosen: Vec::new(),
            ..*self
        }
    }

    /// What the run has come to; cut short before its end.
    pub fn outcome(&self) -> Outcome {
        self.stepping.branch().finish().0
    }
}
