//! A validated scenario, on which all parts of a run rely. [`super::load()`] creates it.
//!
//! The order, names and values of fields in [`Scenario::visit`] are the scenario hash, by which sweeps recognise
//! finished runs, and input logs and resume marks their run. A new field changes every hash, which costs users a
//! repetition of unfinished sweeps and is recorded in `tests/digests/`. A section that passes nothing at its default,
//! as the radio's, keeps the hashes. A new section also needs a line in `declaration.rs`.

use std::fmt::Write as _;

use super::classes::DeviceClass;
use super::policy::{PolicyChoice, PolicyKind};
use super::run::{BsSettings, PolicyName, RunSettings};
use super::site::{ClassKnowledge, Site};
use crate::declare::{FieldSink, ScenarioHasher, Visit};
use crate::energy::EnergyModel;
use crate::event::event_settings::EventSettings;
use crate::geometry::{Area, Layout};
use crate::ids::Tti;
use crate::radio::RadioSettings;
use crate::sensing::Sensing;
use crate::units::Energy;

/// The version of the format that [`Scenario::hash`] hashes. Raise it if equal bytes would come to mean another run.
const HASH_FORMAT: &str = "reveille scenario 2";

/// The complete description of a run: two runs of one scenario without external inputs are identical, bit
/// for bit. `P` is the policy and its settings, a [`PolicyChoice`] of the program's policies.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario<P> {
    /// The general settings of the run.
    pub run: RunSettings,
    /// The served area ξ.
    pub area: Area,
    /// The positions of the devices.
    pub layout: Layout,
    /// Device classes, at least one; their shares add up to 1.
    pub classes: Vec<DeviceClass>,
    /// The sensing model.
    pub sensing: Sensing,
    /// The event process.
    pub events: EventSettings,
    /// The failures of the radio.
    pub radio: RadioSettings,
    /// The BS's settings.
    pub bs: BsSettings,
    /// The policy with its settings.
    pub policy: P,
}

/// A loaded scenario.
#[derive(Clone, Debug)]
pub struct LoadedScenario<P> {
    /// The scenario.
    pub scenario: Scenario<P>,
    /// Warnings about its source, each a sentence without its full stop. They do not affect the run.
    pub warnings: Vec<String>,
}

impl<P> Scenario<P> {
    pub(super) fn with_policy<Q>(self, policy: Q) -> Scenario<Q> {
        Scenario {
            run: self.run,
            area: self.area,
            layout: self.layout,
            classes: self.classes,
            sensing: self.sensing,
            events: self.events,
            radio: self.radio,
            bs: self.bs,
            policy,
        }
    }

    /// Returns this scenario with another seed, without a new validation. Where classes have zones and the layout is
    /// random, [`DeviceClass::share`] stays as counted for the old seed, and a device can lie outside all zones.
    #[must_use]
    pub fn with_seed(&self, seed: u64) -> Self
    where
        P: Clone,
    {
        let mut other = self.clone();
        other.run.seed = seed;
        other
    }

    /// Returns the first TTI that counts in the metrics.
    pub fn warm_up_end(&self) -> Tti {
        Tti((self.run.ttis as f64 * self.run.warm_up).floor() as u64)
    }

    /// Returns the length in TTIs of the longest run with these devices for which all energy sums fit in 64 bits; 0 if
    /// the full batteries alone do not fit.
    pub fn max_ttis(&self) -> u64 {
        let (level, turnover) = (self.largest_level(), self.largest_turnover());
        let devices = u128::from(self.run.devices);
        let free = u128::from(u64::MAX).saturating_sub(devices * u128::from(level.micro()));
        // At least 1, because it is a divisor.
        let ttis = free / (devices * turnover.max(1));
        u64::try_from(ttis).unwrap_or(u64::MAX)
    }

    /// Returns the largest amount of energy that any device can hold.
    pub(super) fn largest_level(&self) -> Energy {
        let levels = self.classes.iter().map(|class| class.energy.e_max);
        levels.max().unwrap_or_default()
    }

    /// Returns an upper bound on the energy, micro-units, that any device can harvest and spend in one TTI together.
    pub(super) fn largest_turnover(&self) -> u128 {
        let turnover = |class: &DeviceClass| {
            let EnergyModel {
                e_idle, e_wur, e_tx, ..
            } = class.energy;
            let amounts = [class.harvest.max_per_tti(), e_idle, e_wur, e_tx];
            amounts.iter().map(|energy| u128::from(energy.micro())).sum()
        };
        self.classes.iter().map(turnover).max().unwrap_or_default()
    }

    /// Returns the base station's knowledge of its site.
    pub fn site(&self) -> Site<'_> {
        let classes = self.classes.iter().map(|class| ClassKnowledge {
            name: &class.name,
            share: class.share,
            energy: class.energy,
            mean_harvest: class.harvest.mean(self.run.tau),
        });
        Site {
            devices: self.run.devices,
            area: self.area,
            layout: &self.layout,
            sensing: &self.sensing,
            alpha: self.events.alpha,
            bs: self.bs,
            classes: classes.collect(),
        }
    }
}

impl<K: PolicyKind> Scenario<PolicyChoice<K>> {
    /// Passes every active field to `sink`, in the order of declaration.
    pub fn visit(&self, sink: &mut dyn FieldSink) {
        // Without `..`, so that a new section cannot be forgotten.
        let Self {
            run,
            area,
            layout,
            classes,
            sensing,
            events,
            radio,
            bs,
            policy,
        } = self;
        run.visit(sink);
        area.visit(sink);
        layout.visit(sink);
        sensing.visit(sink);
        events.visit(sink);
        radio.visit(sink);
        bs.visit(sink);
        PolicyName {
            name: policy.name().to_owned(),
        }
        .visit(sink);
        policy.visit(sink);
        DeviceClass::visit_all(classes, sink);
    }

    /// Returns the SHA-256 hash of everything that decides a run: the paths and values of all active fields. Layout,
    /// trace and table files count by their contents, not by their paths. The name of the preset is omitted, because
    /// it only decides the fields that it sets.
    #[must_use]
    pub fn hash(&self) -> [u8; 32] {
        let mut hasher = ScenarioHasher::new(HASH_FORMAT, "preset");
        self.visit(&mut hasher);
        hasher.finish()
    }

    /// Returns [`Self::hash`] as 64 hexadecimal digits.
    #[must_use]
    pub fn hash_hex(&self) -> String {
        self.hash().iter().fold(String::with_capacity(64), |mut digits, byte| {
            let _ = write!(digits, "{byte:02x}");
            digits
        })
    }
}
