//! What a policy of this program does, as the actions of an environment.

use std::collections::BTreeMap;

use reveille_bs::observe::{Happening, Observer};
use reveille_bs::outcome::Outcome;
use reveille_bs::policy::external::Stage;
use reveille_common::ids::DeviceId;
use reveille_common::plan::Plan;
use reveille_common::scenario::Scenario;

use super::environment::{Environment, Ground, Weights};
use crate::preparation::prepare;
use crate::run::{Options, Run};

/// A run of a policy, and the actions with which an environment does the same.
#[derive(Clone, Debug)]
pub struct Actions {
    /// 0 or 1, `[T, N]`: an action for each step. Devices are woken one at a time.
    pub rows: Vec<i8>,
    /// The stage of each, 0 or 1, `[T]`.
    pub stages: Vec<i8>,
    /// What the run of the policy came to.
    pub own: Outcome,
    /// What the environment came to. It has the digest of [`Self::own`] if the policy sends bits; where it sends duty
    /// cycles, the environment sends bits in their place whenever they change, and the digests differ by that.
    pub stepped: Outcome,
}

/// What a base station commands.
#[derive(Default)]
struct Commands {
    plans: BTreeMap<u64, Plan>,
    wake_ups: BTreeMap<u64, Vec<DeviceId>>,
}

impl Observer for Commands {
    fn see(&mut self, happening: &Happening<'_>) {
        if let Happening::Plan { update, is_new: true } = happening {
            self.plans.insert(update.from.0, update.plan.clone());
        }
        if let Happening::WakeUp { tti, device, .. } = happening {
            self.wake_ups.entry(tti.0).or_default().push(*device);
        }
    }
}

/// The run of `scenario` as actions in the environment of `outside`, the same scenario with the policy `external`.
/// Nothing for the genie, which wakes devices before anything was heard.
pub fn record(scenario: &Scenario, outside: &Scenario) -> Option<Actions> {
    let prepared = prepare(scenario);
    if prepared.mind(&prepared.knowledge()).genie().is_some() {
        return None;
    }
    let mut commands = Commands::default();
    let own = Run::new(&prepared, Options::default()).finish(&mut commands);
    let mut environment = Environment::new(Ground::new(outside), Weights::default());
    let (mut rows, mut stages) = (Vec::new(), Vec::new());
    let mut woken = 0;
    while let Some(question) = environment.question() {
        let (now, n) = (question.seen.now, question.seen.known.n());
        let action: Vec<bool> = match question.stage {
            Stage::Plan => {
                woken = 0;
                let (_, plan) = commands.plans.range(..=now.0).next_back().expect("a plan in TTI 0");
                (0..n as u32).map(|j| plan.duty_cycle(DeviceId(j)).is_on(now)).collect()
            }
            Stage::Wake => {
                let next = commands.wake_ups.get(&now.0).and_then(|all| all.get(woken));
                woken += 1;
                (0..n).map(|j| next.is_some_and(|device| device.index() == j)).collect()
            }
        };
        stages.push(i8::from(question.stage == Stage::Wake));
        rows.extend(action.iter().map(|on| i8::from(*on)));
        environment.step(|j| action[j]);
    }
    Some(Actions {
        rows,
        stages,
        own,
        stepped: environment.outcome(),
    })
}
