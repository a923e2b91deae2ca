//! The interface between scenarios and policies. A scenario holds a policy with its settings; only the policy
//! interprets them. `PolicyEntry` in `bs/src/policy/factory.rs` implements it for all policies, `testing.rs` for tests.

use std::fmt::Debug;
use std::sync::Arc;

use super::site::Site;
use crate::declare::{FieldReader, FieldSink, ScenarioError, Section, TomlPage, Visit};

/// A policy that a scenario can name.
pub trait PolicyKind: Sync + Debug + 'static {
    /// The validated settings of any policy of the program.
    type Settings: Visit + Debug + ?Sized;

    /// The name in `policy.name`, on the command line, in the scenario hash and in every file.
    fn name(&self) -> &'static str;

    /// A description in one sentence, for help and `docs/scenario.md`.
    fn about(&self) -> &'static str;

    /// The fields under `policy.NAME`; `None` for a policy without settings.
    fn section(&self) -> Option<&'static Section>;

    /// Reads the settings, for a base station that knows `site`. `reader` only reads the policy's own fields.
    ///
    /// # Errors
    /// If a value is not allowed.
    fn read_settings(&self, reader: &FieldReader<'_>, site: &Site<'_>) -> Result<Arc<Self::Settings>, ScenarioError>;

    /// Returns the number of TTIs, ≥ 1, within which the policy promises to look at every place once, with the path of
    /// its field; `None` without such a promise. Validation warns if events can end within it.
    fn delay_budget(settings: &Self::Settings) -> Option<(&'static str, u64)>;

    /// Returns the length in TTIs of the pilot runs that the policy needs, with the path of its field; `None` without
    /// any. Validation rejects a length for which sums of energy overflow.
    fn pilot_ttis(settings: &Self::Settings) -> Option<(&'static str, u64)>;
}

/// All policies that a program knows, in the order of lists.
pub type Policies<'p, K> = &'p [&'static K];

/// A policy with its settings.
#[derive(Debug)]
pub struct PolicyChoice<K: PolicyKind> {
    kind: &'static K,
    settings: Arc<K::Settings>,
}

impl<K: PolicyKind> PolicyChoice<K> {
    /// Combines the policy `kind` with its `settings`.
    pub const fn new(kind: &'static K, settings: Arc<K::Settings>) -> Self {
        Self { kind, settings }
    }

    /// The policy's name.
    pub fn name(&self) -> &'static str {
        self.kind.name()
    }

    /// The policy.
    pub const fn kind(&self) -> &'static K {
        self.kind
    }

    /// The settings of the policy.
    pub fn settings(&self) -> &K::Settings {
        &self.settings
    }

    /// Returns [`PolicyKind::delay_budget`] for these settings.
    pub(super) fn delay_budget(&self) -> Option<(&'static str, u64)> {
        K::delay_budget(&self.settings)
    }

    /// Returns [`PolicyKind::pilot_ttis`] for these settings.
    pub(super) fn pilot_ttis(&self) -> Option<(&'static str, u64)> {
        K::pilot_ttis(&self.settings)
    }
}

// Written by hand because a derived implementation would require `K: Clone`.
impl<K: PolicyKind> Clone for PolicyChoice<K> {
    fn clone(&self) -> Self {
        Self {
            kind: self.kind,
            settings: Arc::clone(&self.settings),
        }
    }
}

impl<K: PolicyKind> Visit for PolicyChoice<K> {
    fn visit(&self, sink: &mut dyn FieldSink) {
        self.settings.visit(sink);
    }
}

impl<K: PolicyKind> PartialEq for PolicyChoice<K> {
    /// Whether both are the same policy with the same settings.
    fn eq(&self, other: &Self) -> bool {
        let values = |choice: &Self| {
            let mut page = TomlPage::default();
            choice.visit(&mut page);
            page
        };
        self.name() == other.name() && values(self) == values(other)
    }
}
