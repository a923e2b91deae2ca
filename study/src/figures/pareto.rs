//! What each policy buys with what it spends, a line through rising N: information, the objective of P1, against
//! energy, and the delay of detection against energy.

use std::fmt::Write as _;

use reveille_common::score::Metrics;

use super::chart::{Chart, Interval, Mark, Sample, Series, Stated};
use super::floor;
use super::note::Note;
use super::results::Condition;
use super::scale::Scale;
use super::stated::said;
use super::study::{csv_cell, csv_half, runs_in_words, title};
use super::style::Style;
use crate::claims::{Claim, Sites, on};

/// The metric of x.
pub const ENERGY: &str = "energy_per_device_tti";
/// The policy that wakes the best device alone.
pub const GENIE: &str = "genie";
/// The metric of y that is to be large.
pub const P1: &str = "info_p1";
/// Styles to choose from for a policy's other lines.
const STYLES: usize = 6;

/// What is bought with energy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Trade {
    /// Its name in commands and files.
    pub name: &'static str,
    /// What its title begins with.
    pub title: &'static str,
    /// The metric of y.
    pub y: &'static str,
    /// Where the better policies are.
    better: &'static str,
}

/// Information.
pub const INFORMATION: Trade = Trade {
    name: "pareto",
    title: "Information against energy",
    y: P1,
    better: "Up and to the left is better.",
};

/// The delay of detection.
pub const DELAY: Trade = Trade {
    name: "delay",
    title: "Delay of detection against energy",
    y: "detection_delay_ttis",
    better: "Down and to the left is better. Delays are of reported events alone: who misses more may look faster.",
};

/// All of them.
pub const TRADES: [Trade; 2] = [INFORMATION, DELAY];

/// A policy under a condition.
struct Line<'a> {
    condition: &'a Condition,
    policy: &'a str,
    /// What it is called; with what its condition changes, if there are several conditions.
    name: String,
    style: Style,
    /// The points by rising N.
    points: Vec<(u32, Sample)>,
}

/// The lines of `conditions` with `y`, each policy's side by side. Runs that two of them share count once.
fn lines<'a>(y: &str, conditions: &[&'a Condition]) -> Vec<Line<'a>> {
    let mut lines: Vec<Line<'a>> = Vec::new();
    for condition in conditions {
        for policy in condition.policies() {
            let points = points(y, condition, policy);
            let is_known = |line: &Line<'_>| line.policy == policy && has_same_runs(line.condition, condition, policy);
            if points.is_empty() || lines.iter().any(is_known) {
                continue;
            }
            let others = lines.iter().filter(|line| line.policy == policy).count();
            let style = Style::of_policy(policy);
            let looks = |variant: &Style| variant.marker != style.marker && variant.dashes != style.dashes;
            let mut variants = (0..STYLES).map(Style::nth).filter(looks).cycle();
            lines.push(Line {
                condition,
                policy,
                // A lone condition is that of the caption.
                name: match conditions {
                    [_] => policy.to_owned(),
                    _ => name(policy, condition),
                },
                style: match others {
                    0 => style,
                    _ => Style {
                        paint: style.paint,
                        ..variants.nth(others - 1).unwrap_or(style)
                    },
                },
                points,
            });
        }
    }
    let place = |line: &Line<'_>| {
        conditions
            .iter()
            .flat_map(|s| s.policies())
            .position(|p| p == line.policy)
    };
    lines.sort_by_key(place);
    lines
}

/// Whether the runs of `policy` are the same in both.
fn has_same_runs(a: &Condition, b: &Condition, policy: &str) -> bool {
    let digests = |condition: &Condition| {
        let cells = condition.sizes(policy).into_iter();
        let of = |n: u32| condition.runs(policy, n).map(|row| row.digest).collect::<Vec<_>>();
        cells.map(|n| (n, of(n))).collect::<Vec<_>>()
    };
    digests(a) == digests(b)
}

/// The policy, and what its condition changes.
fn name(policy: &str, condition: &Condition) -> String {
    let mut name = policy.to_owned();
    for (path, value) in condition.changed() {
        let own = path.strip_prefix("policy.").and_then(|rest| rest.split_once('.'));
        let field = own.map_or(path.as_str(), |(_, field)| field);
        let value = value
            .strip_suffix(".json")
            .filter(|_| field == "table")
            .unwrap_or(value);
        let _ = write!(name, ", {field} {value}");
    }
    if let Some(table) = &condition.changed_in {
        let _ = write!(name, ", changed as in {table}");
    }
    name
}

impl Trade {
    /// The picture for the runs of `conditions`, which have preset and K in common; `None` if no policy has both
    /// metrics at any N.
    pub fn chart(&self, conditions: &[&Condition]) -> Option<Chart> {
        let lines = lines(self.y, conditions);
        let first = lines.first()?;
        let floor = self.floor(conditions);
        let rows = lines.iter().map(|line| &line.points).chain([&floor]);
        let rows = rows.filter(|points| !points.is_empty());
        let notes: Vec<Vec<Note>> = rows
            .map(|points| points.iter().map(|(n, s)| note(*n, s)).collect())
            .collect();
        let mut series: Vec<Series> = lines.iter().map(Line::series).collect();
        let has_floor = !floor.is_empty();
        if has_floor {
            series.push(floor::series(floor.into_iter().map(|(_, sample)| sample).collect()));
        }
        let (stated, marks): (Vec<u32>, Vec<Mark>) = self.marks(&lines).into_iter().unzip();
        let [x, y] = scales(&series, &marks);
        Some(Chart {
            title: self.heading(conditions),
            x_label: Metrics::axis(ENERGY).to_owned(),
            y_label: Metrics::axis(self.y).to_owned(),
            x,
            y,
            caption: self.caption(first.condition, conditions, stated, has_floor),
            notes: in_turn(&notes),
            series,
            marks,
            spans: Vec::new(),
            zero_below: false,
        })
    }

    fn heading(&self, conditions: &[&Condition]) -> String {
        match conditions {
            [one] if self.y == P1 => title(self.title, "Figs. 7 and 8", one),
            [one] if !one.is_plain() => title(self.title, "", one),
            _ => self.title.to_owned(),
        }
    }

    /// The least that it takes to look at the whole area in every TTI, a point for each N at the genie's information.
    /// Of one condition alone, where there are covers for two N.
    fn floor(&self, conditions: &[&Condition]) -> Vec<(u32, Sample)> {
        let ([condition], P1) = (conditions, self.y) else {
            return Vec::new();
        };
        let sample = |n: u32| {
            let floor = floor::affordable(condition.scenario.as_ref()?, n)?;
            let best = condition.estimate(GENIE, n, P1)?.mean;
            Some((n, floor::sample(floor, best)))
        };
        let points: Vec<(u32, Sample)> = condition.sizes(GENIE).into_iter().filter_map(sample).collect();
        if points.len() > 1 { points } else { Vec::new() }
    }

    fn caption(
        &self,
        condition: &Condition,
        conditions: &[&Condition],
        mut stated: Vec<u32>,
        has_floor: bool,
    ) -> String {
        let what = match conditions {
            [one] => one.label(),
            _ => format!("{}, also changed as the legend says", condition.preset),
        };
        let counts = || conditions.iter().map(|s| s.runs_per_cell());
        let (least, most) = (counts().map(|c| c.0).min(), counts().map(|c| c.1).max());
        let mut text = format!(
            "Preset {what}; {} of {} TTIs a point, means with their 95 % intervals in both directions. Lines join \
             rising N, which stands beside some points. {}",
            runs_in_words((least.unwrap_or(0), most.unwrap_or(0))),
            condition.ttis,
            self.better
        );
        if has_floor {
            let _ = write!(
                text,
                " {} It stands at the genie's information for the same N.",
                floor::NOTE
            );
        }
        stated.sort_unstable();
        stated.dedup();
        let stated: Vec<String> = stated.iter().map(ToString::to_string).collect();
        if !stated.is_empty() {
            let _ = write!(
                text,
                " Hollow marks are for N = {}; the paper states information per event, which in its model is the same \
                 on the mean.",
                stated.join(", ")
            );
        }
        text
    }

    /// What the paper states of both metrics for a policy that is drawn, as values at one N.
    fn marks(&self, lines: &[Line<'_>]) -> Vec<(u32, Mark)> {
        if self.y == P1 { marks(lines) } else { Vec::new() }
    }

    /// What is drawn, as CSV.
    pub fn csv(&self, conditions: &[&Condition]) -> String {
        let column = if self.y == P1 { "info" } else { "delay" };
        let mut out = format!(
            "setting,policy,n,{ENERGY},energy_half_width_95,{},{column}_half_width_95,runs\n",
            self.y
        );
        for line in lines(self.y, conditions) {
            let label = csv_cell(&line.condition.label());
            for (n, sample) in line.points {
                let Sample { x, y, half, across } = sample;
                let runs = line.condition.runs(line.policy, n).count();
                let (half, across) = (csv_half(half), csv_half(across));
                let _ = writeln!(out, "{label},{},{n},{x},{across},{y},{half},{runs}", line.policy);
            }
        }
        out
    }
}

impl Line<'_> {
    fn series(&self) -> Series {
        Series {
            name: self.name.clone(),
            style: self.style,
            joined: true,
            marked: true,
            interval: Interval::Crosses,
            samples: self.points.iter().map(|(_, sample)| *sample).collect(),
        }
    }
}

/// Axes from zero that hold all points with their intervals, and all marks.
pub fn scales(series: &[Series], marks: &[Mark]) -> [Scale; 2] {
    let samples = || series.iter().flat_map(|s| &s.samples);
    let ends = |at: f64, half: f64| {
        let half = if half.is_finite() { half } else { 0.0 };
        // None of these metrics can be negative, whatever an interval says.
        [(at - half).max(0.0), at + half]
    };
    let xs = samples().flat_map(|s| ends(s.x, s.across));
    let ys = samples().flat_map(|s| ends(s.y, s.half));
    [
        Scale::linear(xs.chain(marks.iter().map(|m| m.x)), true),
        Scale::linear(ys.chain(marks.iter().flat_map(|m| m.stated.values())), true),
    ]
}

/// The points of `policy` by rising N.
fn points(y: &str, condition: &Condition, policy: &str) -> Vec<(u32, Sample)> {
    let sizes = condition.sizes(policy).into_iter();
    let points = sizes.filter_map(|n| Some((n, point(y, condition, policy, n)?)));
    points.collect()
}

/// What `policy` with `n` devices buys of `y` with what it spends; `None` without runs that have both.
pub fn point(y: &str, condition: &Condition, policy: &str, n: u32) -> Option<Sample> {
    let [x, y] = [ENERGY, y].map(|metric| condition.estimate(policy, n, metric));
    let (x, y) = (x?, y?);
    Some(Sample {
        x: x.mean,
        y: y.mean,
        half: y.half_width,
        across: x.half_width,
    })
}

fn note(n: u32, sample: &Sample) -> Note {
    Note {
        x: sample.x,
        y: sample.y,
        text: n.to_string(),
    }
}

/// The last N of each line, then the first, then one halfway.
fn in_turn(lines: &[Vec<Note>]) -> Vec<Note> {
    let place: [fn(usize) -> Option<usize>; 3] = [
        |count| Some(count - 1),
        |count| (count > 1).then_some(0),
        |count| (count > 2).then_some(count / 2),
    ];
    let at = |place: fn(usize) -> Option<usize>| {
        let of = move |line: &Vec<Note>| place(line.len()).map(|at| line[at].clone());
        lines.iter().filter_map(of)
    };
    place.into_iter().flat_map(at).collect()
}

/// What the paper states of both metrics for a policy that is drawn, as values at one N.
fn marks(lines: &[Line<'_>]) -> Vec<(u32, Mark)> {
    let (energies, informations) = (on("Fig. 8", ENERGY), on("Fig. 7", "info_per_event"));
    let value = |claim: &Claim, claims: &[Claim]| match (said(claim, claims), claim.sites) {
        (Some(Stated::Value(value)), Sites::At(n)) => Some((n, value)),
        _ => None,
    };
    let mut marks = Vec::new();
    for information in informations {
        let is_own = |line: &&Line<'_>| line.policy == information.policy && line.condition.is_plain();
        let drawn = lines.iter().find(is_own);
        let (Some(drawn), Some((n, y))) = (drawn, value(information, informations)) else {
            continue;
        };
        let own = energies.iter().filter(|energy| energy.policy == information.policy);
        let here = own
            .filter_map(|energy| value(energy, energies))
            .filter(|(at, _)| *at == n);
        marks.extend(here.map(|(_, x)| {
            let mark = Mark {
                x,
                aside: 0.0,
                stated: Stated::Value(y),
                style: drawn.style,
            };
            (n, mark)
        }));
    }
    marks
}
