//! The settings of a policy, whose meaning only that policy knows.

use std::any::Any;
use std::fmt::Debug;

use crate::declare::Sink;

/// The settings of a policy, validated.
pub trait PolicySettings: Any + Debug + Send + Sync {
    /// Hands every field with its value to `sink`.
    fn visit(&self, sink: &mut dyn Sink);

    /// What a user should know before a run, a sentence each.
    fn warnings(&self) -> Vec<String> {
        Vec::new()
    }

    /// The TTIs within which the policy promises to look at every place once, ≥ 1, with the path of the field that says
    /// it; `None` if it promises nothing.
    fn delay_budget(&self) -> Option<(&'static str, u64)> {
        None
    }

    /// The lengths of runs that the policy has made for itself, TTIs, each with the path of the field that says it.
    fn own_runs(&self) -> Vec<(&'static str, u64)> {
        Vec::new()
    }
}

/// The settings of a policy that has none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NoSettings;

impl PolicySettings for NoSettings {
    fn visit(&self, _: &mut dyn Sink) {}
}
