//! A run in memory whose decisions come from outside: it stands at a question until it is answered.
//!
//! Nothing waits in it, so any number of such runs can be held at once, and copied to try several answers.

use reveille_bs::observe::Observer;
use reveille_bs::outcome::Outcome;
use reveille_bs::policy::external::{Decision, Question};
use reveille_bs::policy::outside::EXTERNAL;
use reveille_bs::prepared::Prepared;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::scenario::Scenario;
use reveille_common::world::World;

use crate::run::{Options, Run, Stand};

/// A run that stands at a question, or at its end.
pub struct Stepping<O> {
    run: Run,
    stand: Stand,
    observer: O,
}

impl<O: Observer> Stepping<O> {
    /// The run of `scenario`, whose policy is `external`, at its first question.
    ///
    /// # Panics
    /// If another policy decides.
    pub fn new(scenario: &Scenario, observer: O) -> Self {
        let prepared = Prepared::with_policies(scenario, EXTERNAL);
        let world = World::new(&prepared.scenario, &prepared.deployment);
        Self::with_world(&prepared, world, Options::default(), observer)
    }

    /// The run that is `prepared`, with a world of the caller's, at its first question.
    ///
    /// # Panics
    /// If a policy decides that is not `external`.
    pub fn with_world(prepared: &Prepared, world: World, options: Options, mut observer: O) -> Self {
        let mut run = Run::with_world(prepared, world, options);
        let stand = run.seek_question(&mut observer);
        Self { run, stand, observer }
    }

    /// What is to be decided; nothing at the end of the run.
    pub fn question(&self) -> Option<Question<'_>> {
        match &self.stand {
            Stand::Plan => self.run.cycle().question(),
            Stand::Wake(asking) => Some(self.run.cycle().question_of(asking)),
            Stand::Ended => None,
        }
    }

    /// As [`Self::question`]; at the end of the run, what would be asked if it went on.
    pub fn view(&self) -> Question<'_> {
        let question = self.question().or_else(|| self.run.cycle().outlook());
        question.expect("somebody outside decides")
    }

    /// Answers at [`Stage::Plan`](reveille_bs::policy::external::Stage::Plan) and goes on to the next question.
    ///
    /// # Panics
    /// If that is not asked.
    pub fn decide(&mut self, decision: Decision) {
        let stand = std::mem::replace(&mut self.stand, Stand::Ended);
        assert!(matches!(stand, Stand::Plan), "no plan was asked for: {stand:?}");
        self.stand = self.run.decide(decision, &mut self.observer);
    }

    /// Answers at [`Stage::Wake`](reveille_bs::policy::external::Stage::Wake) and goes on to the next question.
    ///
    /// # Panics
    /// If that is not asked.
    pub fn wake(&mut self, devices: &[DeviceId]) {
        match std::mem::replace(&mut self.stand, Stand::Ended) {
            Stand::Wake(asking) => self.stand = self.run.call(asking, devices, &mut self.observer),
            stand @ (Stand::Plan | Stand::Ended) => panic!("nobody asked whom to wake: {stand:?}"),
        }
    }

    /// The next TTI to be granted, or the open one.
    pub const fn now(&self) -> Tti {
        self.run.cycle().next_tti()
    }

    /// The observer.
    pub const fn observer(&self) -> &O {
        &self.observer
    }

    /// The observer, to take from it what it has gathered.
    pub const fn observer_mut(&mut self) -> &mut O {
        &mut self.observer
    }

    /// What the run comes to, with its observer. One that is not at its end is cut short: nobody else is woken in the
    /// open TTI.
    pub fn finish(mut self) -> (Outcome, O) {
        if let Stand::Wake(asking) = self.stand {
            self.run.call(asking, &[], &mut self.observer);
        }
        (self.run.cut_short(), self.observer)
    }
}

impl<O: Observer + Clone> Stepping<O> {
    /// A copy that stands at the same question. Both go on without each other.
    #[must_use]
    pub fn branch(&self) -> Self {
        Self {
            run: self.run.branch().expect("somebody outside decides"),
            stand: self.stand.clone(),
            observer: self.observer.clone(),
        }
    }
}
