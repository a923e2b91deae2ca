//! A validated scenario: what every part of a run may rely on. [`super::load()`] makes it; nothing here is optional.
//!
//! The seam to policies stands here too: a scenario holds a policy, and a policy settles for a scenario.

use std::any::Any;
use std::fmt::{Debug, Write as _};
use std::sync::Arc;

use super::bs::BsSettings;
use super::classes::DeviceClass;
use super::policy::PolicySettings;
use super::run::{PolicyName, Run};
use super::site::{ClassKnowledge, Site};
use crate::declare::{Fingerprint, Page, Reader, ScenarioError, Section, Sink};
use crate::event::settings::Events;
use crate::geometry::{Area, Layout};
use crate::ids::Tti;
use crate::radio::Radio;
use crate::sensing::Sensing;
use crate::units::Energy;

/// The version of the form of [`Scenario::hash`].
const FORM: &str = "reveille scenario 2";

/// Everything that decides a run: two runs of one scenario are the same, bit for bit.
#[derive(Clone, Debug)]
pub struct Scenario {
    /// The name of the preset it starts from: `paper`, `paper-literal` or `quick`.
    pub preset: String,
    /// Number of devices N, `1 ..= 1 000 000`.
    pub devices: u32,
    /// Length of the run K in TTIs, `1 ..= 10⁹`, the warm-up included.
    pub ttis: u64,
    /// Seed of every random stream.
    pub seed: u64,
    /// Share of K that is simulated and left out of every metric, `[0, 1)`.
    pub warm_up: f64,
    /// Duration τ of a TTI in units of model time, > 0.
    pub tau: f64,
    /// The served area ξ.
    pub area: Area,
    /// Where the devices stand.
    pub layout: Layout,
    /// Device classes, at least one; their shares add up to 1.
    pub classes: Vec<DeviceClass>,
    /// The sensing model.
    pub sensing: Sensing,
    /// The event process.
    pub events: Events,
    /// How the radio fails.
    pub radio: Radio,
    /// The BS's settings.
    pub bs: BsSettings,
    /// Who senses and who is woken.
    pub policy: PolicyChoice,
    /// What the user should know of the file, a sentence each without its stop; not part of what decides a run.
    pub warnings: Vec<String>,
}

impl PartialEq for Scenario {
    /// Compares everything but the warnings.
    fn eq(&self, other: &Self) -> bool {
        let Self {
            preset,
            devices,
            ttis,
            seed,
            warm_up,
            tau,
            area,
            layout,
            classes,
            sensing,
            events,
            radio,
            bs,
            policy,
            warnings: _,
        } = self;
        let run = (preset, devices, ttis, seed, warm_up, tau);
        let same = run
            == (
                &other.preset,
                &other.devices,
                &other.ttis,
                &other.seed,
                &other.warm_up,
                &other.tau,
            );
        same && *area == other.area
            && *layout == other.layout
            && *classes == other.classes
            && *sensing == other.sensing
            && *events == other.events
            && *radio == other.radio
            && *bs == other.bs
            && *policy == other.policy
    }
}

impl Scenario {
    /// The first TTI that counts in the metrics.
    pub fn warm_up_end(&self) -> Tti {
        Tti((self.ttis as f64 * self.warm_up).floor() as u64)
    }

    /// The longest run with such devices, TTIs, of which all sums of energy fit in 64 bits.
    pub fn longest(&self) -> u64 {
        let per_tti = u128::from(self.devices) * u128::from(self.largest_energy().micro().max(1));
        u64::try_from(u128::from(u64::MAX) / per_tti).unwrap_or(u64::MAX)
    }

    /// The most that a device can hold or harvest in a TTI.
    pub(super) fn largest_energy(&self) -> Energy {
        let largest = |class: &DeviceClass| class.energy.e_max.max(class.harvest.peak());
        self.classes.iter().map(largest).max().unwrap_or_default()
    }

    /// What a base station knows of its site.
    pub fn site(&self) -> Site<'_> {
        let classes = self.classes.iter().map(|class| ClassKnowledge {
            name: &class.name,
            share: class.share,
            energy: class.energy,
            mean_harvest: class.harvest.mean(self.tau),
        });
        Site {
            devices: self.devices,
            area: self.area,
            layout: &self.layout,
            sensing: &self.sensing,
            alpha: self.events.alpha,
            bs: self.bs,
            classes: classes.collect(),
        }
    }

    /// Hands every field in force to `sink`, in the order of declaration; the preset's name is left out, for it decides
    /// nothing beyond the fields that it sets.
    pub fn visit(&self, sink: &mut dyn Sink) {
        Run {
            preset: None,
            devices: self.devices,
            ttis: self.ttis,
            seed: self.seed,
            warm_up: self.warm_up,
            tau: self.tau,
        }
        .visit(sink);
        self.area.visit(sink);
        self.layout.visit(sink);
        self.sensing.visit(sink);
        self.events.visit(sink);
        self.radio.visit(sink);
        self.bs.visit(sink);
        PolicyName {
            name: self.policy.name().to_owned(),
        }
        .visit(sink);
        self.policy.visit(sink);
        DeviceClass::visit_all(&self.classes, sink);
    }

    /// SHA-256 of everything that decides a run: the paths and values of all fields in force, with the contents of
    /// layout, trace and table files in place of their paths.
    #[must_use]
    pub fn hash(&self) -> [u8; 32] {
        let mut fingerprint = Fingerprint::new(FORM);
        self.visit(&mut fingerprint);
        fingerprint.finish()
    }

    /// [`Self::hash`] as 64 hexadecimal digits.
    #[must_use]
    pub fn hash_hex(&self) -> String {
        self.hash().iter().fold(String::with_capacity(64), |mut digits, byte| {
            let _ = write!(digits, "{byte:02x}");
            digits
        })
    }
}

/// A policy that a scenario can name: what it is called and how its settings are read.
pub trait PolicyKind: Sync + Debug {
    /// The name in `policy.name`, on the command line and in every file.
    fn name(&self) -> &'static str;

    /// What it does, one sentence for help and reference.
    fn about(&self) -> &'static str;

    /// Its fields, under `policy.NAME`; nothing for a policy without settings.
    fn section(&self) -> Option<&'static Section> {
        None
    }

    /// The settings that `reader` has, for a base station that knows `site`. The reader gives the policy's own fields
    /// alone.
    ///
    /// # Errors
    /// A value that may not be.
    fn settle(&self, reader: &Reader<'_>, site: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError>;
}

/// All policies that a program knows, in the order of lists.
pub type Policies<'p> = &'p [&'static dyn PolicyKind];

/// A policy with its settings.
#[derive(Clone, Debug)]
pub struct PolicyChoice {
    kind: &'static dyn PolicyKind,
    settings: Arc<dyn PolicySettings>,
}

impl PolicyChoice {
    /// The policy `kind` with `settings`, which it has made.
    pub fn new(kind: &'static dyn PolicyKind, settings: Arc<dyn PolicySettings>) -> Self {
        Self { kind, settings }
    }

    /// The policy's name.
    pub fn name(&self) -> &'static str {
        self.kind.name()
    }

    /// The policy.
    pub const fn kind(&self) -> &'static dyn PolicyKind {
        self.kind
    }

    /// Its settings if they are a `T`.
    pub fn settings<T: PolicySettings>(&self) -> Option<&T> {
        let any: &dyn Any = &*self.settings;
        any.downcast_ref()
    }

    /// The same policy with other settings of its own.
    #[must_use]
    pub fn with_settings(&self, settings: impl PolicySettings) -> Self {
        Self::new(self.kind, Arc::new(settings))
    }

    /// Hands every setting with its value to `sink`.
    pub fn visit(&self, sink: &mut dyn Sink) {
        self.settings.visit(sink);
    }

    /// What a user should know before a run, a sentence each.
    pub fn warnings(&self) -> Vec<String> {
        self.settings.warnings()
    }

    /// See [`PolicySettings::delay_budget`].
    pub fn delay_budget(&self) -> Option<(&'static str, u64)> {
        self.settings.delay_budget()
    }

    /// See [`PolicySettings::own_runs`].
    pub fn own_runs(&self) -> Vec<(&'static str, u64)> {
        self.settings.own_runs()
    }
}

impl PartialEq for PolicyChoice {
    /// Whether both are the same policy with the same settings.
    fn eq(&self, other: &Self) -> bool {
        let values = |choice: &Self| {
            let mut page = Page::default();
            choice.visit(&mut page);
            page
        };
        self.name() == other.name() && values(self) == values(other)
    }
}
