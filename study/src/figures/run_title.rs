//! Names of a run's scenario and policy, for titles and captions of the figures of one run.

use reveille_bs::policy::registry;
use reveille_bs::scenario::{Scenario, preset_label};

use crate::first_letter::lower_first;

/// Names the scenario and the policy of a run, for example "preset paper, N = 50, policy knn".
pub(super) fn run_name(scenario: &Scenario) -> String {
    format!(
        "preset {}, N = {}, policy {}",
        preset_label(scenario),
        scenario.run.devices,
        scenario.policy.name()
    )
}

/// Describes the policy in one sentence, from its entry in the registry; empty for a policy without an entry.
pub(super) fn policy_sentence(scenario: &Scenario) -> String {
    let Some(entry) = registry::named(scenario.policy.name()) else {
        return String::new();
    };
    let ends = [". ", " ("].iter().filter_map(|end| entry.about.find(end));
    let first_clause = entry.about[..ends.min().unwrap_or(entry.about.len())].trim_end_matches('.');
    format!("Policy {}: {}.", entry.name, lower_first(first_clause))
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    #[test]
    fn a_changed_setting_is_named_and_the_size_of_a_run_is_not() {
        let name = |assignments: &[&str]| {
            let overrides: Vec<Override> = assignments
                .iter()
                .map(|text| Override::parse(text).expect("an override"))
                .collect();
            run_name(&load("quick", &overrides).expect("a scenario").scenario)
        };
        assert_eq!(
            name(&["devices=30", "ttis=300", "seed=7", "policy.name=age-index"]),
            "preset quick, N = 30, policy age-index"
        );
        assert_eq!(
            name(&["devices=30", "events.alpha=0.3"]),
            "preset quick with changes, N = 30, policy knn"
        );
    }

    #[test]
    fn every_policy_has_a_sentence() {
        for policy in registry::names() {
            let overrides = [Override::parse(&format!("policy.name={policy}")).expect("an override")];
            let sentence = policy_sentence(&load("paper", &overrides).expect("a scenario").scenario);
            assert!(sentence.starts_with(&format!("Policy {policy}: ")), "{sentence}");
            assert!(sentence.ends_with('.') && !sentence.contains(['(', '`']), "{sentence}");
        }
    }
}
