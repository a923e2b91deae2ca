//! Learned tables of the policy `q-learning`, and their file. The policy reads them ([`LearnedTables::closest_entry`]),
//! `lab/src/training/` learns them, and `study/src/figures/q_table.rs` draws them. Types that derive `Serialize` are
//! the format of the file ([`VERSION`]).
//!
//! The joint action of N devices is factorised (docs/q-learning.md). One table for duty cycling and one for each
//! wake-up ranking serve all devices of a deployment. They depend on the density of devices and on the window within
//! which the area must be covered. A file therefore holds a [`TableSet`] for each trained pair of N and window, or of N
//! and ages.

mod file;
mod lookback;
mod tables;

pub use file::{FORMAT, LearnedError, VERSION};
pub use lookback::{Lookback, MAX_WINDOW};
pub use tables::{
    AREA_BUCKETS, BATTERY_BUCKETS, DutyTable, FIRST_ABLE_BUCKET, INFORMATION_BUCKETS, LearningRates, QValue,
    REPORT_BUCKETS, SCORE_BUCKETS, Schedule, VALUE_NODES, WakeTable, battery_bucket, information_bucket, score_bucket,
    score_edge,
};
pub(crate) use tables::{BucketLevels, area_bucket};

use std::fmt::Display;

use serde::{Deserialize, Serialize};

use reveille_common::scenario::Site;

/// Largest allowed ratio between the density of devices and the density of the nearest entry, in both directions.
const MAX_DENSITY_RATIO: f64 = 2.0;

/// Weights for which tables are learned.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct QWeights {
    /// μ1, weight of misdetections in r(k), ≥ 0 (Sec. V-B; the paper tunes it within 0.5 and 20).
    pub mu1: f64,
    /// μ2, weight of information in r*(k), ≥ 0 (the paper tunes it within 1 and 5).
    pub mu2: f64,
    /// Discount ζ of the duty cycling, `[0, 1)`.
    pub zeta: f64,
}

impl QWeights {
    /// Returns the worth of covering the whole area once, in units of N r(k): N α μ1 Σ ζ^i, i = 0 .. `window`. The area
    /// then counts as covered for `window` TTIs, and an event starts with probability `alpha`.
    pub fn covering_worth(&self, devices: u32, alpha: f64, window: u32) -> f64 {
        let discounts = (0..window).fold(0.0, |sum, _| sum * self.zeta + 1.0);
        f64::from(devices) * alpha * self.mu1 * discounts
    }
}

/// Site on which tables were learned: the scenario fields that change the worth of actions. Energies are in units. A
/// new field of this kind changes the file of tables, and the shipped tables then differ from every site.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingSite {
    /// Layout, detection and battery knowledge by their names in scenario files.
    pub words: Vec<(String, String)>,
    /// Numbers by the paths of their fields; also the mean harvest and, with several classes, the share of each class.
    pub numbers: Vec<(String, f64)>,
}

impl TrainingSite {
    /// Extracts the training fields of `site`.
    pub fn from_site(site: &Site<'_>) -> Self {
        let word = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        let number = |name: &str, value: f64| (name.to_owned(), value);
        let sensing = site.sensing;
        let mut numbers = vec![
            number("events.alpha", site.alpha),
            number("sensing.d_max", sensing.d_max),
            number("sensing.eta", sensing.eta),
            number("sensing.psi", sensing.psi),
        ];
        let has_one_class = site.classes.len() == 1;
        for class in &site.classes {
            let energy = &class.energy;
            let class_number = |name: &str, value: f64| {
                if has_one_class {
                    number(name, value)
                } else {
                    (format!("class.{}.{name}", class.name), value)
                }
            };
            numbers.extend([
                class_number("energy.e_max", energy.e_max.units()),
                class_number("energy.e_idle", energy.e_idle.units()),
                class_number("energy.e_wur", energy.e_wur.units()),
                class_number("energy.e_tx", energy.e_tx.units()),
                class_number("mean harvest", class.mean_harvest.units()),
            ]);
            if !has_one_class {
                numbers.push(class_number("share", class.share));
            }
        }
        Self {
            words: vec![
                word("layout.kind", site.layout.name()),
                word("sensing.kind", sensing.kind.name()),
                word("sensing.g", sensing.g.name()),
                word("bs.battery_knowledge", site.bs.battery_knowledge.name()),
            ],
            numbers,
        }
    }

    /// Describes each difference from `here` in a phrase: "events.alpha 0.2, here 0.3".
    pub fn differences(&self, here: &Self) -> Vec<String> {
        let words = describe_differences(&self.words, &here.words, |trained, here| trained == here);
        let is_close = |trained: &f64, here: &f64| (trained - here).abs() <= 1e-6 * trained.abs().max(here.abs());
        words
            .into_iter()
            .chain(describe_differences(&self.numbers, &here.numbers, is_close))
            .collect()
    }
}

/// Describes each field that differs between the sites of the training and of the run in a phrase.
fn describe_differences<T: Display>(
    trained: &[(String, T)],
    here: &[(String, T)],
    is_same: impl Fn(&T, &T) -> bool,
) -> Vec<String> {
    let index_in = |fields: &'_ [(String, T)], name: &str| fields.iter().position(|(field, _)| field == name);
    let mut phrases = Vec::new();
    for (name, value) in trained {
        match index_in(here, name).map(|index| &here[index].1) {
            Some(value_here) if is_same(value, value_here) => {}
            Some(value_here) => phrases.push(format!("{name} {value}, here {value_here}")),
            None => phrases.push(format!("{name} {value}, not known here")),
        }
    }
    for (name, value) in here.iter().filter(|(name, _)| index_in(trained, name).is_none()) {
        phrases.push(format!("{name} not known there, here {value}"));
    }
    phrases
}

/// One point of a learning curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurvePoint {
    /// Training length so far, TTIs.
    pub ttis: u64,
    /// Mean r(k) of the episode, per TTI.
    pub reward: f64,
    /// Information of the episode by the objective of P1, `info_p1`: `[0, Ψ]` or slightly above, 0 without events.
    pub information: f64,
    /// Units spent per device and TTI.
    pub energy: f64,
}

/// The tables for one window and one density of devices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TableSet {
    /// N of the training.
    pub devices: u32,
    /// The area ξ of the training, m².
    pub surface: f64,
    /// Duration for which a covered place counted as covered.
    #[serde(rename = "window")]
    pub lookback: Lookback,
    /// Table of the duty cycling.
    pub duty: DutyTable,
    /// Table of the wake-ups, for candidates ranked by `P_4,2`.
    pub wake_p42: WakeTable,
    /// Table of the wake-ups, for candidates ranked by the belief over the epicentre.
    pub wake_posterior: WakeTable,
    /// Learning curve of the training, with a point for each finished episode or learning run.
    pub curve: Vec<CurvePoint>,
}

impl TableSet {
    /// Creates the optimistic start for the devices of `site`. It knows the immediate reward of an action, multiplied
    /// by `optimism` for sensing, but no later costs. Every wake-up is worth trying.
    pub fn optimistic(site: &Site<'_>, weights: &QWeights, lookback: Lookback, optimism: f64) -> Self {
        let (devices, surface) = (site.devices, site.area.surface());
        let disc = std::f64::consts::PI * site.sensing.d_max * site.sensing.d_max;
        let disc_worth = optimism * weights.covering_worth(devices, site.alpha, lookback.window()) * disc / surface;
        Self {
            devices,
            surface,
            lookback,
            duty: DutyTable::optimistic(1.0 / (1.0 - weights.zeta), |bucket| {
                disc_worth * lookback.bucket_end(bucket)
            }),
            wake_p42: WakeTable::optimistic(optimism),
            wake_posterior: WakeTable::optimistic(optimism),
            curve: Vec::new(),
        }
    }

    /// Devices per m².
    pub fn device_density(&self) -> f64 {
        f64::from(self.devices) / self.surface
    }
}

/// Training configuration of tables.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct QTrainingConfig {
    /// Episodes for each N, each on its own deployment, ≥ 1.
    pub episodes: u64,
    /// Length of an episode, TTIs, ≥ 10.
    pub ttis: u64,
    /// Exploration probability in the first and in the last episode, `[0, 1)`.
    pub epsilon: (f64, f64),
    /// Seed of the scenario, from which the seeds of the episodes derive.
    pub seed: u64,
}

/// Contents of a file of learned tables.
#[derive(Clone, Debug, PartialEq)]
pub struct LearnedTables {
    /// Version of Reveille that learned the tables.
    pub made_by: String,
    /// SHA-256 of the training's scenario at its first N, hexadecimal; `scenario` in the file.
    pub scenario: String,
    /// Weights for which the tables were learned.
    pub weights: QWeights,
    /// Description of the tables from which the training started; `None` for a training from scratch.
    pub begun_from: Option<String>,
    /// Learning schedule.
    pub schedule: Schedule,
    /// Training configuration.
    pub training: QTrainingConfig,
    /// Site of the training.
    pub site: TrainingSite,
    /// Entries, at least one, sorted by window (ages last), then by density.
    pub entries: Vec<TableSet>,
}

impl LearnedTables {
    /// Describes the learned `entry`, for trainings and runs that start from it.
    pub fn describe(&self, entry: &TableSet) -> String {
        let QWeights { mu1, mu2, zeta } = self.weights;
        let ttis = entry.curve.last().map_or(0, |point| point.ttis);
        let before = self
            .begun_from
            .as_ref()
            .map_or_else(String::new, |from| format!(", begun from {from}"));
        format!(
            "tables for N = {}, μ1 = {mu1}, μ2 = {mu2}, ζ = {zeta} and {}, learned in {ttis} TTIs{before}",
            entry.devices,
            entry.lookback.describe()
        )
    }

    /// Whether the tables are a checkpoint of an unfinished training.
    pub(crate) fn is_unfinished(&self) -> bool {
        let is_short = |entry: &TableSet| (entry.curve.len() as u64) < self.training.episodes;
        self.entries.iter().any(is_short)
    }

    /// Returns the lookbacks with tables, sorted by window, ages last, as the entries are.
    pub fn lookbacks(&self) -> Vec<Lookback> {
        let mut lookbacks: Vec<Lookback> = self.entries.iter().map(|entry| entry.lookback).collect();
        lookbacks.dedup();
        lookbacks
    }

    /// Returns the window with tables that is nearest to `window` in ratio.
    pub(crate) fn nearest_window(&self, window: u32) -> Option<u32> {
        let log_distance = |trained: &u32| libm::log(f64::from(*trained) / f64::from(window)).abs();
        let windows = self
            .lookbacks()
            .into_iter()
            .filter(|lookback| *lookback != Lookback::Ages);
        windows
            .map(Lookback::window)
            .min_by(|a, b| log_distance(a).total_cmp(&log_distance(b)))
    }

    fn entries_for(&self, lookback: Lookback) -> impl Iterator<Item = &TableSet> {
        self.entries.iter().filter(move |entry| entry.lookback == lookback)
    }

    /// Returns the entry for `lookback` nearest in density to `devices` on `surface` m², at most a factor of 2 away.
    pub fn closest_entry(&self, lookback: Lookback, devices: u32, surface: f64) -> Option<&TableSet> {
        let density = f64::from(devices) / surface;
        let log_distance = |entry: &TableSet| libm::log(entry.device_density() / density).abs();
        let nearest = self
            .entries_for(lookback)
            .min_by(|a, b| log_distance(a).total_cmp(&log_distance(b)))?;
        // The slack accepts a density at exactly the limit despite rounding.
        (log_distance(nearest) <= libm::log(MAX_DENSITY_RATIO) + 1e-9).then_some(nearest)
    }

    /// Returns the least and the largest N on `surface` m² that the entries for `lookback` serve; (1, 0) without an
    /// entry.
    pub fn served_devices(&self, lookback: Lookback, surface: f64) -> (u32, u32) {
        let devices_of = |entry: Option<&TableSet>| entry.map_or(0.0, TableSet::device_density) * surface;
        let (fewest, most) = (
            devices_of(self.entries_for(lookback).next()),
            devices_of(self.entries_for(lookback).last()),
        );
        (
            (fewest / MAX_DENSITY_RATIO).ceil().max(1.0) as u32,
            (most * MAX_DENSITY_RATIO).floor() as u32,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::tests::load_paper;

    fn training_site(fields: &[&str]) -> TrainingSite {
        TrainingSite::from_site(&load_paper(fields).site())
    }

    #[test]
    fn covering_is_worth_its_discounted_sum_and_tables_start_at_a_share_of_a_disc() {
        for (mu1, zeta, window) in [(14.0, 0.95, 4), (2.0, 0.5, 1), (3.0, 0.0, 7), (1.0, 0.999, 1000)] {
            let weights = QWeights { mu1, mu2: 1.0, zeta };
            let expected = 250.0 * 0.2 * mu1 * (1.0 - libm::pow(zeta, f64::from(window))) / (1.0 - zeta);
            let worth = weights.covering_worth(250, 0.2, window);
            assert!(
                (worth - expected).abs() < 1e-9 * expected,
                "worth {worth}, not {expected}"
            );
            let scenario = load_paper(&["devices=250"]);
            for optimism in [0.0, 0.5, 2.0] {
                let entry = TableSet::optimistic(&scenario.site(), &weights, Lookback::Window(window), optimism);
                // A whole disc of 4 m radius on 20 m × 20 m, with α = 0.2.
                let initial_value = optimism * expected * std::f64::consts::PI * 16.0 / 400.0;
                for battery in 0..BATTERY_BUCKETS {
                    let [sleep_value, sense_value] =
                        [false, true].map(|delta| entry.duty.at(battery, AREA_BUCKETS - 1, delta).value);
                    assert!(
                        (sleep_value - 1.0).abs() < 1e-12 && (sense_value - initial_value).abs() < 1e-9 * expected,
                        "values {sleep_value} and {sense_value}, not 1 and {initial_value}"
                    );
                }
            }
        }
    }

    #[test]
    fn sites_differ_only_in_fields_that_change_values() {
        let site = training_site(&[]);
        assert!(
            site.differences(&training_site(&["seed=3", "devices=7", "ttis=99"]))
                .is_empty()
        );
        for (field, phrase) in [
            ("events.alpha=0.3", "events.alpha 0.2, here 0.3"),
            ("sensing.psi=0.5", "sensing.psi 1, here 0.5"),
            ("sensing.g=sum-saturation", "sensing.g max, here sum-saturation"),
            ("layout.kind=uniform", "layout.kind jittered-grid, here uniform"),
            ("energy.e_tx=9", "energy.e_tx 10, here 9"),
        ] {
            assert_eq!(site.differences(&training_site(&[field])), [phrase]);
        }
        // A field that only one of the two sites has also counts as a difference.
        let mut fewer = site.clone();
        let removed = fewer.numbers.remove(0);
        assert_eq!(
            site.differences(&fewer),
            [format!("{} {}, not known here", removed.0, removed.1)]
        );
        assert_eq!(
            fewer.differences(&site),
            [format!("{} not known there, here {}", removed.0, removed.1)]
        );
    }
}
