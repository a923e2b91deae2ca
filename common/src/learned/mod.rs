//! What the `q-learning` policy has learned: its tables, and the file that they are kept in.
//!
//! The joint action of N devices is factorised (docs/q-learning.md): one table for duty cycling and one for each
//! wake-up ranking serve all devices of a deployment. They depend on how dense the devices stand, so a file holds an
//! [`Entry`] for each N that was trained.

mod file;
mod tables;

pub use file::{FORMAT, LearnedError, VERSION};
pub use tables::{
    AREAS, BATTERIES, Cell, DutyTable, INFORMATIONS, NODES, REPORTS, Rates, SCORES, Schedule, WakeTable, area_bucket,
    area_edge, battery_bucket, information_bucket, score_bucket, score_edge,
};

use serde::{Deserialize, Serialize};

use crate::scenario::Scenario;

/// How far N per area may lie from that of the nearest entry, as a factor.
const REACH: f64 = 2.0;

/// The weights that the tables were learned for.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Weights {
    /// μ1, weight of misdetections in r(k), ≥ 0 (Sec. V-B; the paper tunes it within 0.5 and 20).
    pub mu1: f64,
    /// μ2, weight of information in r*(k), ≥ 0 (the paper tunes it within 1 and 5).
    pub mu2: f64,
    /// Discount ζ of the duty cycling, `[0, 1)`.
    pub zeta: f64,
}

impl Weights {
    /// What covering the whole area once is worth in N r(k), where it then counts as covered for `window` TTIs and an event starts
    /// with probability `alpha`: N α μ1 Σ ζ^i, i = 0 .. `window`.
    pub fn covering(&self, devices: u32, alpha: f64, window: u32) -> f64 {
        let lasting = (0..window).fold(0.0, |sum, _| sum * self.zeta + 1.0);
        f64::from(devices) * alpha * self.mu1 * lasting
    }
}

/// What the tables were learned on: fields of the scenario that change what is worth doing. Energies are in units.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Setting {
    /// Layout, detection and battery knowledge by their names in scenario files.
    pub words: Vec<(String, String)>,
    /// Numbers by the paths of their fields.
    pub numbers: Vec<(String, f64)>,
}

impl Setting {
    /// The setting of `scenario`, with the energy model of its first device class.
    pub fn of(scenario: &Scenario) -> Self {
        let word = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        let class = &scenario.classes[0];
        let (energy, sensing) = (class.energy, &scenario.sensing);
        let harvest = class.harvest.mean(scenario.tau).units();
        let number = |name: &str, value: f64| (name.to_owned(), value);
        Self {
            words: vec![
                word("layout.kind", scenario.layout.name()),
                word("sensing.kind", sensing.kind.name()),
                word("bs.battery_knowledge", scenario.bs.battery_knowledge.name()),
            ],
            numbers: vec![
                number("events.alpha", scenario.events.alpha),
                number("events.duration", scenario.events.duration as f64),
                number("sensing.d_max", sensing.d_max),
                number("sensing.eta", sensing.eta),
                number("energy.e_max", energy.e_max.units()),
                number("energy.e_idle", energy.e_idle.units()),
                number("energy.e_wur", energy.e_wur.units()),
                number("energy.e_tx", energy.e_tx.units()),
                number("mean harvest", harvest),
            ],
        }
    }

    /// Where `other` differs, a phrase each: "events.alpha 0.2, here 0.3".
    pub fn differences(&self, other: &Self) -> Vec<String> {
        let mut found = Vec::new();
        for ((name, own), (_, here)) in self.words.iter().zip(&other.words) {
            if own != here {
                found.push(format!("{name} {own}, here {here}"));
            }
        }
        for ((name, own), (_, here)) in self.numbers.iter().zip(&other.numbers) {
            if (own - here).abs() > 1e-6 * own.abs().max(here.abs()) {
                found.push(format!("{name} {own}, here {here}"));
            }
        }
        found
    }
}

/// One point of a learning curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurvePoint {
    /// TTIs of training so far.
    pub ttis: u64,
    /// Mean r(k) of the episode, per TTI.
    pub reward: f64,
    /// Information per event of the episode, `[0, Ψ]`; 0 without events.
    pub information: f64,
    /// Units spent per device and TTI.
    pub energy: f64,
}

/// The tables for one density of devices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// N of the training.
    pub devices: u32,
    /// The area ξ of the training, m².
    pub surface: f64,
    /// Who senses.
    pub duty: DutyTable,
    /// Whom to wake, candidates by `P_4,2`.
    pub wake_p42: WakeTable,
    /// Whom to wake, candidates by the belief over the epicentre.
    pub wake_posterior: WakeTable,
    /// How the training went.
    pub curve: Vec<CurvePoint>,
}

impl Entry {
    /// The optimistic start for the devices and the ground of `scenario`: what an action brings at once is known, `optimism`
    /// times that for sensing; what it costs later is not. Every wake-up is worth a try.
    pub fn optimistic(scenario: &Scenario, weights: &Weights, window: u32, optimism: f64) -> Self {
        let (devices, surface) = (scenario.devices, scenario.area.surface());
        let disc = std::f64::consts::PI * scenario.sensing.d_max * scenario.sensing.d_max;
        let whole = optimism * weights.covering(devices, scenario.events.alpha, window) * disc / surface;
        Self {
            devices,
            surface,
            duty: DutyTable::optimistic(1.0 / (1.0 - weights.zeta), |area| whole * area_edge(area)),
            wake_p42: WakeTable::optimistic(optimism),
            wake_posterior: WakeTable::optimistic(optimism),
            curve: Vec::new(),
        }
    }

    /// Devices per m².
    pub fn density(&self) -> f64 {
        f64::from(self.devices) / self.surface
    }
}

/// How tables were trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Training {
    /// Episodes for each N, each on a deployment of its own, ≥ 1.
    pub episodes: u64,
    /// Length of an episode, TTIs, ≥ 10.
    pub ttis: u64,
    /// Probability that a decision is made at random, in the first episode and in the last, `[0, 1)`.
    pub epsilon: (f64, f64),
    /// The seed of the scenario, from which those of the episodes come.
    pub seed: u64,
}

/// Everything in a file of learned tables.
#[derive(Clone, Debug, PartialEq)]
pub struct Learned {
    /// The version of Reveille that learned it.
    pub made_by: String,
    /// SHA-256 of the training's scenario at its first N, hexadecimal.
    pub scenario: String,
    /// What it was learned for.
    pub weights: Weights,
    /// TTIs within which the area was to be covered once.
    pub window: u32,
    /// How values were learned.
    pub schedule: Schedule,
    /// How it was trained.
    pub training: Training,
    /// What it was learned on.
    pub setting: Setting,
    /// At least one, by rising density.
    pub entries: Vec<Entry>,
}

impl Learned {
    /// The entry for `devices` on `surface` m²: the nearest density, if it is within a factor of 2.
    pub fn closest(&self, devices: u32, surface: f64) -> Option<&Entry> {
        let density = f64::from(devices) / surface;
        let apart = |entry: &Entry| libm::log(entry.density() / density).abs();
        let nearest = self.entries.iter().min_by(|a, b| apart(a).total_cmp(&apart(b)))?;
        (apart(nearest) <= libm::log(REACH) + 1e-9).then_some(nearest)
    }

    /// The least and the largest N on `surface` m² that some entry serves.
    pub fn range(&self, surface: f64) -> (u32, u32) {
        let at = |entry: Option<&Entry>| entry.map_or(0.0, Entry::density) * surface;
        let (least, most) = (at(self.entries.first()), at(self.entries.last()));
        ((least / REACH).ceil().max(1.0) as u32, (most * REACH).floor() as u32)
    }
}
