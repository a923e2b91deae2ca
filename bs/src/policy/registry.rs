//! The policies there are.

use reveille_common::scenario::{PolicyChoice, PolicyKind};

use super::adjusted::AdjustedKind;
use super::age_index::AgeIndexKind;
use super::contract::Opaque;
use super::dt::DtKind;
use super::genie::GenieKind;
use super::kind::{Profile, Registered};
use super::knn::KnnKind;
use super::mind::Mind;
use super::pilots::Pilots;
use super::q_learning::QLearningKind;
use super::random::RandomKind;
use crate::knowledge::Knowledge;

/// Policies, in the order of lists.
pub type Registry = &'static [&'static dyn Registered];

/// All policies of this program.
pub const POLICIES: Registry = &[
    &KnnKind,
    &AdjustedKind,
    &QLearningKind,
    &DtKind,
    &RandomKind,
    &GenieKind,
    &AgeIndexKind,
];

/// All policies as a scenario names them.
pub fn kinds() -> Vec<&'static dyn PolicyKind> {
    POLICIES.iter().map(|policy| *policy as &dyn PolicyKind).collect()
}

/// The names of all policies.
pub fn names() -> impl Iterator<Item = &'static str> + Clone {
    POLICIES.iter().map(|policy| policy.name())
}

/// The policy called `name`.
pub fn named(name: &str) -> Option<&'static dyn Registered> {
    POLICIES.iter().copied().find(|policy| policy.name() == name)
}

/// The one of `policies` that `choice` names, for a base station that knows `known`.
///
/// # Panics
/// If it is none of them.
pub fn build(policies: Registry, choice: &PolicyChoice, known: &Knowledge, findings: Option<&Opaque>) -> Mind {
    chosen(policies, choice).build(choice, known, findings)
}

/// The pilot runs that the one of `policies` asks for that `choice` names.
///
/// # Panics
/// If it is none of them.
pub fn pilots(policies: Registry, choice: &PolicyChoice) -> Option<Box<dyn Pilots>> {
    chosen(policies, choice).pilots(choice)
}

fn chosen(policies: Registry, choice: &PolicyChoice) -> &'static dyn Registered {
    let named = policies.iter().find(|policy| policy.name() == choice.name());
    *named.expect("a scenario names a policy that it was loaded with")
}

/// The names of the policies of which `is_so` holds, joined by commas: for lists on the command line.
pub fn list(is_so: impl Fn(&Profile) -> bool) -> String {
    let chosen = POLICIES.iter().filter(|policy| is_so(&policy.profile()));
    chosen.map(|policy| policy.name()).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_places_are_each_taken_once() {
        for (index, policy) in POLICIES.iter().enumerate() {
            for other in &POLICIES[..index] {
                assert_ne!(policy.name(), other.name());
                assert_ne!(policy.profile().series, other.profile().series, "{}", policy.name());
            }
            if let Some(section) = policy.section() {
                assert_eq!(section.path, format!("policy.{}", policy.name()));
            }
            assert!(policy.about().ends_with('.'), "{}", policy.about());
        }
    }
}
