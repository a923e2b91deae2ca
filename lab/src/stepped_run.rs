//! A run in memory under an external policy that stops at each decision. The environments of [`crate::gym`] step it.
//! Answered with the decisions of a built-in policy, it must equal the run of that policy; `tests/tests/external.rs`
//! compares them.
//!
//! It never blocks, so one thread can hold any number of such runs, and copy them to try several decisions.

use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::observer::Observer;
use reveille_bs::policy::external::{Decision, DecisionContext, DecisionStage, PlanDecision};
use reveille_bs::policy::outside::is_external;
use reveille_bs::scenario::Scenario;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::world::World;

use crate::run::{Halt, Run, RunOptions};

/// A run that waits for a decision, or has ended.
pub struct SteppedRun<O> {
    run: Run,
    halt: Halt,
    observer: O,
}

impl<O: Observer> SteppedRun<O> {
    /// Creates the run of `scenario`, whose policy is `external`, at its first decision request.
    ///
    /// # Panics
    /// If it has another policy.
    pub fn new(scenario: &Scenario, observer: O) -> Self {
        assert!(
            is_external(&scenario.policy),
            "the policy {} makes its own decisions",
            scenario.policy.name()
        );
        let prepared = PreparedRun::without_pilots(scenario);
        let world = World::new(&prepared.scenario, &prepared.deployment);
        Self::with_world(&prepared, world, RunOptions::default(), observer)
    }

    /// Creates the run of `prepared`, in the caller's world of the same deployment, at its first decision request. The
    /// policy must be `external`: under any other the run ends without a request, and [`Self::decision_context`]
    /// panics.
    pub fn with_world(prepared: &PreparedRun, world: World, options: RunOptions, mut observer: O) -> Self {
        let mut run = Run::with_world(prepared, world, options);
        let halt = run.run_to_decision(&mut observer);
        Self { run, halt, observer }
    }

    /// The pending decision request; `None` at the end of the run.
    pub fn pending_decision(&self) -> Option<DecisionContext<'_>> {
        self.run.session().pending_decision()
    }

    /// The pending decision request; at the end of the run, the request with which a next TTI would begin.
    ///
    /// # Panics
    /// If the policy is not `external`.
    pub fn decision_context(&self) -> DecisionContext<'_> {
        let request = self.pending_decision().or_else(|| self.run.cycle().next_plan_context());
        request.expect("an external policy decides")
    }

    /// Decides a plan, at [`DecisionStage::Plan`], and continues to the next decision.
    ///
    /// # Panics
    /// If the run does not wait for a plan.
    pub fn decide(&mut self, decision: PlanDecision) {
        assert_eq!(
            self.halt,
            Halt::Undecided(DecisionStage::Plan),
            "the run does not wait for a plan"
        );
        self.answer(Decision::Plan(decision));
    }

    /// Decides the devices to wake, in this order, at [`DecisionStage::Wake`], and continues to the next decision. An
    /// empty list ends the wake-ups of the TTI.
    ///
    /// # Panics
    /// If the run does not wait for devices to wake.
    pub fn wake(&mut self, devices: &[DeviceId]) {
        assert_eq!(
            self.halt,
            Halt::Undecided(DecisionStage::Wake),
            "the run does not wait for devices to wake"
        );
        self.answer(Decision::Wake(devices.to_vec()));
    }

    fn answer(&mut self, decision: Decision) {
        self.run.apply_decision(decision, &mut self.observer);
        self.halt = self.run.run_to_decision(&mut self.observer);
    }

    /// The next TTI to be granted; while a grant is open, the first TTI that still has no outcome.
    pub const fn now(&self) -> Tti {
        self.run.cycle().next_tti()
    }

    /// The observer.
    pub const fn observer(&self) -> &O {
        &self.observer
    }

    /// The observer, for reading and resetting its data.
    pub(crate) const fn observer_mut(&mut self) -> &mut O {
        &mut self.observer
    }

    /// Ends the run, before its last TTI if a decision is pending, and returns its outcome and observer. If the run has
    /// not ended, no other device is woken in the open TTI.
    pub fn finish(mut self) -> (RunOutcome, O) {
        // An open TTI has no outcome: an empty answer closes it.
        if self.halt == Halt::Undecided(DecisionStage::Wake) {
            self.run.apply_decision(Decision::Wake(Vec::new()), &mut self.observer);
        }
        (self.run.partial_outcome(), self.observer)
    }
}

impl<O: Observer + Clone> SteppedRun<O> {
    /// Returns a copy that waits for the same decision and continues independently.
    #[must_use]
    pub fn fork(&self) -> Self {
        Self {
            run: self.run.fork().expect("an external policy decides"),
            halt: self.halt,
            observer: self.observer.clone(),
        }
    }
}
