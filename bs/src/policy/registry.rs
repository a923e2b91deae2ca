//! The list of policies, [`POLICIES`]. Scenarios, the command line, sweeps, figures and tests read it. Names are part
//! of scenario files and result tables. docs/writing-a-policy.md lists the parts of a new entry. `external` is not a
//! policy of this program: see [`super::outside`].

use super::adjusted::ADJUSTED;
use super::age_index::AGE_INDEX;
use super::dt::DT;
use super::factory::PolicyEntry;
use super::genie::GENIE;
use super::knn::KNN;
use super::q_learning::Q_LEARNING;
use super::random::RANDOM;

/// All policies of this program, in the order of help texts and of docs/scenario.md.
pub const POLICIES: &[PolicyEntry] = &[KNN, ADJUSTED, Q_LEARNING, DT, RANDOM, GENIE, AGE_INDEX];

/// Returns references to all policies, the form in which loading a scenario takes them.
pub fn all_policies() -> Vec<&'static PolicyEntry> {
    POLICIES.iter().collect()
}

/// Returns the names of all policies.
pub fn names() -> impl Iterator<Item = &'static str> + Clone {
    POLICIES.iter().map(|policy| policy.name)
}

/// Returns the policy called `name`.
pub fn named(name: &str) -> Option<&'static PolicyEntry> {
    POLICIES.iter().find(|policy| policy.name == name)
}

/// Returns the names of the policies that satisfy `is_included`, joined by commas, as a list on the command line.
pub fn comma_separated_names(is_included: impl Fn(&PolicyEntry) -> bool) -> String {
    let chosen = POLICIES.iter().filter(|policy| is_included(policy));
    chosen.map(|policy| policy.name).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_sections_are_named_after_their_policy() {
        for (index, policy) in POLICIES.iter().enumerate() {
            assert!(
                POLICIES[..index].iter().all(|other| other.name != policy.name),
                "{}",
                policy.name
            );
            if let Some(section) = policy.section {
                assert_eq!(section.path, format!("policy.{}", policy.name));
            }
        }
    }
}
