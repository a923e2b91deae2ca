//! What the `q-learning` policy has learned: its tables, and the file that they are kept in.
//!
//! The joint action of N devices is factorised (docs/q-learning.md): one table for duty cycling and one for each
//! wake-up ranking serve all devices of a deployment. They depend on how dense the devices stand and on
//! the window within which the area is to be covered, so a file holds an [`Entry`] for each window, or for
//! ages, and each N that was trained.

mod file;
mod lookback;
mod tables;

pub use file::{FORMAT, LearnedError, VERSION};
pub use lookback::{LONGEST_WINDOW, Lookback};
pub use tables::{
    ABLE, AREAS, BATTERIES, Cell, DutyTable, INFORMATIONS, NODES, REPORTS, Rates, SCORES, Schedule, WakeTable,
    area_bucket, area_edge, battery_bucket, information_bucket, score_bucket, score_edge,
};

use std::fmt::Display;

use serde::{Deserialize, Serialize};

use reveille_common::scenario::Site;

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
    /// What covering the whole area once is worth in N r(k), where it then counts as covered for `window` TTIs and an
    /// event starts with probability `alpha`: N α μ1 Σ ζ^i, i = 0 .. `window`.
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
    /// The setting of `site`.
    pub fn of(site: &Site<'_>) -> Self {
        let word = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        let number = |name: &str, value: f64| (name.to_owned(), value);
        let sensing = site.sensing;
        let mut numbers = vec![
            number("events.alpha", site.alpha),
            number("sensing.d_max", sensing.d_max),
            number("sensing.eta", sensing.eta),
            number("sensing.psi", sensing.psi),
        ];
        let is_lone = site.classes.len() == 1;
        for class in &site.classes {
            let energy = &class.energy;
            let of = |name: &str, value: f64| {
                if is_lone {
                    number(name, value)
                } else {
                    (format!("class.{}.{name}", class.name), value)
                }
            };
            numbers.extend([
                of("energy.e_max", energy.e_max.units()),
                of("energy.e_idle", energy.e_idle.units()),
                of("energy.e_wur", energy.e_wur.units()),
                of("energy.e_tx", energy.e_tx.units()),
                of("mean harvest", class.mean_harvest.units()),
            ]);
            if !is_lone {
                numbers.push(of("share", class.share));
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

    /// Where `here` differs, a phrase each: "events.alpha 0.2, here 0.3".
    pub fn differences(&self, here: &Self) -> Vec<String> {
        let words = differences(&self.words, &here.words, |own, here| own == here);
        let is_close = |own: &f64, here: &f64| (own - here).abs() <= 1e-6 * own.abs().max(here.abs());
        words
            .into_iter()
            .chain(differences(&self.numbers, &here.numbers, is_close))
            .collect()
    }
}

/// The fields in which `own` and `here` are not the same, a phrase each.
fn differences<T: Display>(own: &[(String, T)], here: &[(String, T)], is_same: impl Fn(&T, &T) -> bool) -> Vec<String> {
    let in_other = |fields: &'_ [(String, T)], name: &str| fields.iter().position(|(other, _)| other == name);
    let mut found = Vec::new();
    for (name, value) in own {
        match in_other(here, name).map(|at| &here[at].1) {
            Some(other) if is_same(value, other) => {}
            Some(other) => found.push(format!("{name} {value}, here {other}")),
            None => found.push(format!("{name} {value}, not known here")),
        }
    }
    for (name, value) in here.iter().filter(|(name, _)| in_other(own, name).is_none()) {
        found.push(format!("{name} not known there, here {value}"));
    }
    found
}

/// One point of a learning curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurvePoint {
    /// TTIs of training so far.
    pub ttis: u64,
    /// Mean r(k) of the episode, per TTI.
    pub reward: f64,
    /// Information of the episode by the objective of P1, `info_p1`, `[0, Ψ]` or a little above; 0 without events.
    pub information: f64,
    /// Units spent per device and TTI.
    pub energy: f64,
}

/// The tables for one window and one density of devices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// N of the training.
    pub devices: u32,
    /// The area ξ of the training, m².
    pub surface: f64,
    /// What a look counted for later.
    #[serde(rename = "window")]
    pub lookback: Lookback,
    /// The table of who senses.
    pub duty: DutyTable,
    /// The table of whom to wake, for candidates ranked by `P_4,2`.
    pub wake_p42: WakeTable,
    /// Whom to wake, candidates by the belief over the epicentre.
    pub wake_posterior: WakeTable,
    /// How the training went.
    pub curve: Vec<CurvePoint>,
}

impl Entry {
    /// The optimistic start for the devices of `site`: what an action brings at once is known,
    /// `optimism` times that for sensing; what it costs later is not. Every wake-up is worth a try.
    pub fn optimistic(site: &Site<'_>, weights: &Weights, lookback: Lookback, optimism: f64) -> Self {
        let (devices, surface) = (site.devices, site.area.surface());
        let disc = std::f64::consts::PI * site.sensing.d_max * site.sensing.d_max;
        let whole = optimism * weights.covering(devices, site.alpha, lookback.window()) * disc / surface;
        Self {
            devices,
            surface,
            lookback,
            duty: DutyTable::optimistic(1.0 / (1.0 - weights.zeta), |area| whole * lookback.edge(area)),
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
    /// What it went on from, in words; nothing for a training from the start.
    pub begun_from: Option<String>,
    /// How values were learned.
    pub schedule: Schedule,
    /// How it was trained.
    pub training: Training,
    /// What it was learned on.
    pub setting: Setting,
    /// At least one, by rising window, those with ages last, and for each by rising density.
    pub entries: Vec<Entry>,
}

impl Learned {
    /// What was learned, in a few words, for those who go on from it.
    pub fn in_words(&self, entry: &Entry) -> String {
        let Weights { mu1, mu2, zeta } = self.weights;
        let ttis = entry.curve.last().map_or(0, |point| point.ttis);
        let before = self
            .begun_from
            .as_ref()
            .map_or_else(String::new, |from| format!(", begun from {from}"));
        format!(
            "tables for N = {}, μ1 = {mu1}, μ2 = {mu2}, ζ = {zeta} and {}, learned in {ttis} TTIs{before}",
            entry.devices,
            entry.lookback.in_words()
        )
    }

    /// Whether it is the checkpoint of a training that has not come to its end.
    pub fn is_cut_short(&self) -> bool {
        let is_short = |entry: &Entry| (entry.curve.len() as u64) < self.training.episodes;
        self.entries.iter().any(is_short)
    }

    /// What there are tables for, by rising window, ages last.
    pub fn lookbacks(&self) -> Vec<Lookback> {
        let mut lookbacks: Vec<Lookback> = self.entries.iter().map(|entry| entry.lookback).collect();
        lookbacks.dedup();
        lookbacks
    }

    /// Of the windows that there are tables for, the one that is nearest to `window` in ratio.
    pub fn nearest_window(&self, window: u32) -> Option<u32> {
        let apart = |own: &u32| libm::log(f64::from(*own) / f64::from(window)).abs();
        let windows = self
            .lookbacks()
            .into_iter()
            .filter(|lookback| *lookback != Lookback::Ages);
        windows
            .map(Lookback::window)
            .min_by(|a, b| apart(a).total_cmp(&apart(b)))
    }

    fn of(&self, lookback: Lookback) -> impl Iterator<Item = &Entry> {
        self.entries.iter().filter(move |entry| entry.lookback == lookback)
    }

    /// The entry for `lookback` and `devices` on `surface` m²: the nearest density, if it is within a factor of 2.
    pub fn closest(&self, lookback: Lookback, devices: u32, surface: f64) -> Option<&Entry> {
        let density = f64::from(devices) / surface;
        let apart = |entry: &Entry| libm::log(entry.density() / density).abs();
        let nearest = self.of(lookback).min_by(|a, b| apart(a).total_cmp(&apart(b)))?;
        (apart(nearest) <= libm::log(REACH) + 1e-9).then_some(nearest)
    }

    /// The least and the largest N on `surface` m² that some entry for `lookback` serves.
    pub fn range(&self, lookback: Lookback, surface: f64) -> (u32, u32) {
        let at = |entry: Option<&Entry>| entry.map_or(0.0, Entry::density) * surface;
        let (least, most) = (at(self.of(lookback).next()), at(self.of(lookback).last()));
        ((least / REACH).ceil().max(1.0) as u32, (most * REACH).floor() as u32)
    }
}

#[cfg(test)]
mod tests {
    use crate::scenario::{Override, load};

    use super::*;

    fn setting(set: &[&str]) -> Setting {
        let set: Vec<Override> = set
            .iter()
            .map(|set| Override::parse(set).expect("an override"))
            .collect();
        Setting::of(&load("paper", &set).expect("a scenario").site())
    }

    #[test]
    fn what_is_covered_is_worth_its_discounted_sum_and_the_start_a_disc_of_it() {
        for (mu1, zeta, window) in [(14.0, 0.95, 4), (2.0, 0.5, 1), (3.0, 0.0, 7), (1.0, 0.999, 1000)] {
            let weights = Weights { mu1, mu2: 1.0, zeta };
            let expected = 250.0 * 0.2 * mu1 * (1.0 - libm::pow(zeta, f64::from(window))) / (1.0 - zeta);
            let found = weights.covering(250, 0.2, window);
            assert!((found - expected).abs() < 1e-9 * expected, "{found} is not {expected}");
            let set = Override::parse("devices=250").expect("an override");
            let scenario = load("paper", &[set]).expect("a scenario");
            for optimism in [0.0, 0.5, 2.0] {
                let entry = Entry::optimistic(&scenario.site(), &weights, Lookback::Window(window), optimism);
                // A whole disc of 4 m radius on 20 m × 20 m, with α = 0.2.
                let most = optimism * expected * std::f64::consts::PI * 16.0 / 400.0;
                for battery in 0..BATTERIES {
                    let [off, on] = [false, true].map(|delta| entry.duty.at(battery, AREAS - 1, delta).value);
                    assert!(
                        (off - 1.0).abs() < 1e-12 && (on - most).abs() < 1e-9 * expected,
                        "{on}, not {most}"
                    );
                }
            }
        }
    }

    #[test]
    fn settings_differ_in_what_changes_the_worth_of_doing_something() {
        let own = setting(&[]);
        assert!(
            own.differences(&setting(&["seed=3", "devices=7", "ttis=99"]))
                .is_empty()
        );
        for (set, phrase) in [
            ("events.alpha=0.3", "events.alpha 0.2, here 0.3"),
            ("sensing.psi=0.5", "sensing.psi 1, here 0.5"),
            ("sensing.g=sum-saturation", "sensing.g max, here sum-saturation"),
            ("layout.kind=uniform", "layout.kind jittered-grid, here uniform"),
            ("energy.e_tx=9", "energy.e_tx 10, here 9"),
        ] {
            assert_eq!(own.differences(&setting(&[set])), [phrase]);
        }
        // A field that only one of them has differs too.
        let mut fewer = own.clone();
        let lost = fewer.numbers.remove(0);
        assert_eq!(
            own.differences(&fewer),
            [format!("{} {}, not known here", lost.0, lost.1)]
        );
        assert_eq!(
            fewer.differences(&own),
            [format!("{} not known there, here {}", lost.0, lost.1)]
        );
    }
}
