//! Information, the objective of P1, against energy for one N, with a line through a policy's knob settings.
//!
//! Knobs are settings that only the base station uses: policy settings and the ranking of wake-ups. Conditions that
//! differ in any other field get separate figures.

use std::fmt::Write as _;

use reveille_common::score::Metrics;
use reveille_lab::series::{RANKING, policy};

use super::chart::{Chart, ChartPoint, Interval, Series};
use super::floor;
use super::note::Note;
use super::pareto::{ENERGY, GENIE, P1, point, scales};
use super::results::RunCondition;
use super::study::{csv_cell, csv_half, runs_in_words};
use super::style::Style;

/// Name in commands and files.
pub const NAME: &str = "front";
/// Preset for which relaxed bounds exist.
const BOUNDED: &str = "paper";

/// Fields with their values that differ from the preset, knobs excluded.
pub type FieldValues = Vec<(String, String)>;

/// Figure for one N.
#[derive(Clone, Debug)]
pub struct ParetoFront {
    /// Number of devices N.
    pub n: u32,
    /// Changed fields that are not knobs.
    pub world: FieldValues,
    /// The chart.
    pub chart: Chart,
    /// The plotted data as CSV.
    pub csv: String,
}

/// Points of one policy, in ascending order of energy.
struct Line<'c> {
    name: &'c str,
    points: Vec<Setting<'c>>,
}

/// A policy with one setting of its knobs.
struct Setting<'c> {
    condition: &'c RunCondition,
    knobs: Vec<&'c str>,
    sample: ChartPoint,
}

/// Draws the figures for the runs of `conditions`, which share preset and K. There is one for each set of
/// [`FieldValues`] and each N at which a policy has several settings.
pub fn fronts(conditions: &[&RunCondition]) -> Vec<ParetoFront> {
    let mut worlds: Vec<(FieldValues, Vec<&RunCondition>)> = Vec::new();
    for condition in conditions {
        let own = world(condition);
        match worlds.iter_mut().find(|(known, _)| *known == own) {
            Some((_, group)) => group.push(condition),
            None => worlds.push((own, vec![condition])),
        }
    }
    let fronts = worlds.into_iter().flat_map(|(world, group)| {
        let mut sizes: Vec<u32> = group
            .iter()
            .flat_map(|c| c.policies().into_iter().flat_map(|p| c.sizes(p)))
            .collect();
        sizes.sort_unstable();
        sizes.dedup();
        let fronts = sizes.into_iter().filter_map(|n| front(n, &world, &group));
        fronts.collect::<Vec<_>>()
    });
    fronts.collect()
}

/// Returns the changes of `condition`, knobs excluded.
fn world(condition: &RunCondition) -> FieldValues {
    let is_knob = |path: &str| path.starts_with("policy.") || path == RANKING;
    let rest = condition.changed().filter(|(path, _)| !is_knob(path)).cloned();
    let table = condition
        .changed_in
        .clone()
        .map(|table| ("changed as in".to_owned(), table));
    rest.chain(table).collect()
}

fn front(n: u32, world: &[(String, String)], group: &[&RunCondition]) -> Option<ParetoFront> {
    let lines = lines(n, group);
    if lines.iter().all(|line| line.points.len() < 2) {
        return None;
    }
    let mut series: Vec<Series> = lines.iter().map(Line::series).collect();
    let notes = lines.iter().flat_map(Line::notes).collect();
    let bound = bound(n, world, group);
    let has_bound = !bound.is_empty();
    if has_bound {
        series.push(floor::bound_series(bound));
    }
    let floor = group[0]
        .scenario
        .as_ref()
        .and_then(|scenario| floor::affordable(scenario, n));
    // The floor is an upright line over the whole axis, so y is scaled before it is added.
    let [_, y] = scales(&series, &[]);
    series.extend(floor.map(|x| floor::series(vec![floor::sample(x, 0.0), floor::sample(x, y.ends().1)])));
    // Scaled a second time, since the floor may lie beyond all points.
    let [x, y] = scales(&series, &[]);
    let caption = caption(n, world, group, (floor.is_some(), has_bound));
    Some(ParetoFront {
        n,
        world: world.to_vec(),
        csv: csv(n, &lines),
        chart: Chart {
            title: format!("Information against energy, N = {n}"),
            x_label: Metrics::axis(ENERGY).to_owned(),
            y_label: Metrics::axis(P1).to_owned(),
            x,
            y,
            series,
            marks: Vec::new(),
            spans: Vec::new(),
            notes,
            zero_below: false,
            caption,
        },
    })
}

/// Returns the lines at N, settings in ascending order of energy. Runs that several settings share count once.
fn lines<'c>(n: u32, group: &[&'c RunCondition]) -> Vec<Line<'c>> {
    let mut lines: Vec<Line<'c>> = Vec::new();
    for condition in group {
        for name in condition.policies() {
            let Some(sample) = point(P1, condition, name, n) else {
                continue;
            };
            let setting = Setting {
                condition,
                knobs: knobs(condition, name),
                sample,
            };
            match lines.iter_mut().find(|line| line.name == name) {
                None => lines.push(Line {
                    name,
                    points: vec![setting],
                }),
                Some(line) => {
                    let is_known =
                        |known: &Setting<'_>| digests(known.condition, name, n) == digests(condition, name, n);
                    if !line.points.iter().any(is_known) {
                        line.points.push(setting);
                    }
                }
            }
        }
    }
    for line in &mut lines {
        line.points.sort_by(|a, b| a.sample.x.total_cmp(&b.sample.x));
    }
    lines
}

fn digests(condition: &RunCondition, name: &str, n: u32) -> Vec<(u64, [u8; 32])> {
    condition.runs(name, n).map(|row| (row.seed, row.digest.0)).collect()
}

/// Returns the values of the policy's own knobs.
fn knobs<'c>(condition: &'c RunCondition, name: &str) -> Vec<&'c str> {
    let prefix = format!("policy.{}.", policy(name).0);
    let own = condition.changed().filter(|(path, _)| path.starts_with(&prefix));
    own.map(|(_, value)| value.as_str()).collect()
}

impl Line<'_> {
    fn series(&self) -> Series {
        Series {
            name: self.name.to_owned(),
            style: Style::of_policy(self.name),
            joined: true,
            marked: true,
            interval: Interval::Crosses,
            samples: self.points.iter().map(|setting| setting.sample).collect(),
        }
    }

    /// Labels with the knob values next to the points.
    fn notes(&self) -> Vec<Note> {
        let note = |setting: &Setting<'_>| Note {
            x: setting.sample.x,
            y: setting.sample.y,
            text: setting.knobs.join(", "),
        };
        let several = self.points.iter().filter(|_| self.points.len() > 1);
        several.map(note).filter(|note| !note.text.is_empty()).collect()
    }
}

/// Returns the points of the relaxed bound; empty unless the preset is [`BOUNDED`] without other changes.
fn bound(n: u32, world: &[(String, String)], group: &[&RunCondition]) -> Vec<ChartPoint> {
    let Some(scenario) = group[0].scenario.as_ref() else {
        return Vec::new();
    };
    if group[0].preset != BOUNDED || !world.is_empty() {
        return Vec::new();
    }
    floor::bounds(&scenario.layout, n)
}

fn caption(n: u32, world: &[(String, String)], group: &[&RunCondition], (floor, bound): (bool, bool)) -> String {
    let mut what = group[0].preset.clone();
    for (path, value) in world {
        let _ = write!(what, ", {path} = {value}");
    }
    let counts = || group.iter().map(|condition| condition.runs_per_cell());
    let (least, most) = (counts().map(|c| c.0).min(), counts().map(|c| c.1).max());
    let mut text = format!(
        "Preset {what}, N = {n}; {} of {} TTIs per point, means with 95 % intervals in both directions. Lines join the \
         settings of a policy in order of energy, with labels for their differences. Up and to the left is better.",
        runs_in_words((least.unwrap_or(0), most.unwrap_or(0))),
        group[0].ttis
    );
    for (is_drawn, note) in [(floor, floor::NOTE), (bound, floor::BOUND_NOTE)] {
        if is_drawn {
            let _ = write!(text, " {note}");
        }
    }
    if group.iter().any(|condition| condition.sizes(GENIE).contains(&n)) {
        text.push_str(" The genie receives the positions of events.");
    }
    text
}

fn csv(n: u32, lines: &[Line<'_>]) -> String {
    let mut out = format!("policy,setting,n,{ENERGY},energy_half_width_95,{P1},info_half_width_95,runs\n");
    for line in lines {
        for setting in &line.points {
            let ChartPoint { x, y, half, across } = setting.sample;
            let runs = setting.condition.runs(line.name, n).count();
            let (half, across) = (csv_half(half), csv_half(across));
            let label = csv_cell(&setting.condition.label());
            let _ = writeln!(out, "{},{label},{n},{x},{across},{y},{half},{runs}", line.name);
        }
    }
    out
}
