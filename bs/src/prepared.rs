//! Everything that is known before a run begins.

use std::sync::Arc;

use reveille_common::deployment::Deployment;
use reveille_common::rng::PolicyStreams;
use reveille_common::scenario::Scenario;

use crate::grids::Grids;
use crate::knowledge::Knowledge;
use crate::policy::contract::Opaque;
use crate::policy::mind::Mind;
use crate::policy::outside;
use crate::policy::registry::{self, Registry};

/// A scenario put on the ground, with what its policy asked to be found out before.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// The scenario.
    pub scenario: Scenario,
    /// Its devices.
    pub deployment: Deployment,
    /// The policies of which the scenario names one.
    pub policies: Registry,
    /// What pilot runs have found, if the policy asks for any.
    pub findings: Option<Opaque>,
    /// What a user should know of the pilot runs, a sentence each without its stop.
    pub warnings: Vec<String>,
    /// The draws of the policy. A pilot run has those of the run that it is for, so that it judges the same policy.
    pub streams: PolicyStreams,
    /// Grids of wake-up correlations, shared with other runs.
    pub grids: Arc<Grids>,
}

impl Prepared {
    /// `scenario` on its ground, for a policy of this program that needs no pilot runs, or for `external`.
    pub fn without_pilots(scenario: &Scenario) -> Self {
        Self::with_policies(scenario, outside::registry_of(&scenario.policy))
    }

    /// `scenario` on its ground, for one of `policies` that needs no pilot runs.
    pub fn with_policies(scenario: &Scenario, policies: Registry) -> Self {
        Self {
            policies,
            deployment: Deployment::new(scenario),
            scenario: scenario.clone(),
            findings: None,
            streams: PolicyStreams::new(scenario.seed),
            warnings: Vec::new(),
            grids: Arc::default(),
        }
    }

    /// What a base station knows of it.
    pub fn knowledge(&self) -> Knowledge {
        Knowledge {
            streams: self.streams.clone(),
            ..Knowledge::of(&self.scenario, &self.deployment, Arc::clone(&self.grids))
        }
    }

    /// Its policy, for a base station that knows `known`.
    pub fn mind(&self, known: &Knowledge) -> Mind {
        registry::build(self.policies, &self.scenario.policy, known, self.findings.as_ref())
    }
}
