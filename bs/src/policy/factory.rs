//! The interface of a policy for the rest of the program: its registry entry ([`PolicyEntry`]), its validated settings,
//! which build it for a run ([`PolicyFactory`]), and pilot runs before a run ([`PilotSearch`]). A change also
//! concerns docs/patrol.rs and docs/writing-a-policy.md.

use std::any::Any;
use std::fmt::Debug;
use std::sync::Arc;

use reveille_common::declare::{FieldReader, ScenarioError, Section, Settings, Visit};
use reveille_common::scenario::{PolicyKind, Site};
use reveille_common::score::Metrics;

use super::interface::Policy;
use crate::knowledge::Knowledge;

/// The validated settings of a policy, which build the policy.
pub trait PolicyFactory: Visit + Any + Debug + Send + Sync {
    /// Builds the policy for a base station that knows `known`. If [`Self::pilot_search`] returns a search, only its
    /// outcome is built.
    fn build(&self, known: &Knowledge) -> Box<dyn Policy>;

    /// Returns the pilot search that must choose the factory to build with, if any.
    fn pilot_search(&self) -> Option<PilotSearch> {
        None
    }

    /// See [`PolicyKind::delay_budget`].
    fn delay_budget(&self) -> Option<(&'static str, u64)> {
        None
    }

    /// See [`PolicyKind::pilot_ttis`].
    fn pilot_ttis(&self) -> Option<(&'static str, u64)> {
        None
    }
}

impl dyn PolicyFactory {
    /// Returns the settings if they are a `T`.
    pub fn downcast_ref<T: PolicyFactory>(&self) -> Option<&T> {
        (self as &dyn Any).downcast_ref()
    }
}

/// Function that reads the settings of a policy.
pub type ReadSettings = fn(&FieldReader<'_>, &Site<'_>) -> Result<Arc<dyn PolicyFactory>, ScenarioError>;

/// A policy of this program, with the facts that lists, figures and comparisons need.
#[derive(Clone, Copy, Debug)]
#[expect(clippy::struct_excessive_bools, reason = "facts that do not depend on each other")]
pub struct PolicyEntry {
    /// Name in `policy.name`, on the command line and in every file.
    pub name: &'static str,
    /// Behaviour in one sentence, for help and the generated page docs/scenario.md.
    pub about: &'static str,
    /// Fields under `policy.NAME`; `None` for a policy without settings.
    pub section: Option<&'static Section>,
    /// Reader of its settings.
    pub read_settings: ReadSettings,
    /// Whether it can learn and has tables to train.
    pub learns: bool,
    /// Whether it wakes devices; tests compare this with its runs.
    pub wakes: bool,
    /// Whether it ranks wake-up candidates by `bs.ranking`; labels of figures and tables then name the ranking.
    pub heeds_ranking: bool,
    /// Whether it receives ground truth: an upper bound, which no base station could run.
    pub is_bound: bool,
    /// The paper's growth of the time of a decision with N; "–" where the paper gives none.
    pub runtime: &'static str,
}

impl PolicyEntry {
    /// Creates the entry of a policy that wakes devices, with the name and the help of `section`, `policy.NAME`.
    pub const fn new(section: &'static Section, read_settings: ReadSettings) -> Self {
        Self {
            section: Some(section),
            ..Self::without_settings(section.path.split_at("policy.".len()).1, section.about, read_settings)
        }
    }

    /// Creates the entry of a policy that wakes devices, whose settings `S` have no further conditions and build it.
    pub const fn for_settings<S: Settings + PolicyFactory>() -> Self {
        Self::new(S::SECTION, |reader, _| Ok(Arc::new(S::read(reader)?)))
    }

    /// Creates the entry of a policy without settings that wakes devices.
    pub(crate) const fn without_settings(name: &'static str, about: &'static str, read_settings: ReadSettings) -> Self {
        Self {
            name,
            about,
            section: None,
            read_settings,
            learns: false,
            wakes: true,
            heeds_ranking: false,
            is_bound: false,
            runtime: "–",
        }
    }
}

impl PolicyKind for PolicyEntry {
    type Settings = dyn PolicyFactory;

    fn name(&self) -> &'static str {
        self.name
    }

    fn about(&self) -> &'static str {
        self.about
    }

    fn section(&self) -> Option<&'static Section> {
        self.section
    }

    fn read_settings(
        &self,
        reader: &FieldReader<'_>,
        site: &Site<'_>,
    ) -> Result<Arc<dyn PolicyFactory>, ScenarioError> {
        (self.read_settings)(reader, site)
    }

    fn delay_budget(settings: &dyn PolicyFactory) -> Option<(&'static str, u64)> {
        settings.delay_budget()
    }

    fn pilot_ttis(settings: &dyn PolicyFactory) -> Option<(&'static str, u64)> {
        settings.pilot_ttis()
    }
}

/// Pilot runs before a run: a search among factories. Each candidate gets a run on the same deployment with other
/// events and harvests.
pub struct PilotSearch {
    /// Length of the first pilot runs, TTIs, ≥ 1.
    pub initial_ttis: u64,
    /// Events after the warm-up that each pilot run must hold; otherwise all are repeated at twice the length, up to
    /// `max_ttis`.
    pub min_events: u64,
    /// The greatest length of a pilot run, TTIs.
    pub max_ttis: u64,
    /// The candidates, at least one, in the order of the search.
    pub candidates: Vec<Arc<dyn PolicyFactory>>,
    /// Chooses the factory to build with, for a base station that knows the deployment.
    pub judge: Box<Judge>,
}

/// Function that judges the pilot runs, for a base station that knows the deployment.
pub type Judge = dyn Fn(&Knowledge, &PilotRuns) -> SearchOutcome;

/// The outcome of a search: the factory to build with, and warnings, a sentence each without its stop.
pub type SearchOutcome = (Arc<dyn PolicyFactory>, Vec<String>);

/// The pilot runs of a search.
#[derive(Clone, Debug, PartialEq)]
pub struct PilotRuns {
    /// The length of each run, TTIs.
    pub run_ttis: u64,
    /// The TTIs of all pilot runs together, including the runs that were too short.
    pub total_ttis: u64,
    /// Metrics in the order of the candidates.
    pub metrics: Vec<Metrics>,
}

impl PilotRuns {
    /// Returns the number of events in the pilot run with the fewest.
    pub(crate) fn fewest_events(&self) -> u64 {
        self.metrics.iter().map(|metrics| metrics.events).min().unwrap_or(0)
    }
}
