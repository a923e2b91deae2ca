//! Trade-offs of policies against energy, with a line through rising N: information, the objective of P1, and the delay
//! of detection.

use std::fmt::Write as _;

use reveille_common::score::Metrics;

use super::chart::{Chart, ChartPoint, Interval, Series, StatedMark, StatedValue};
use super::floor;
use super::note::Note;
use super::results::RunCondition;
use super::scale::Scale;
use super::stated::stated_value;
use super::study::{csv_cell, csv_half, runs_in_words, title};
use super::style::Style;
use crate::claims::{Claim, DeviceCounts, on};

/// Metric along x.
pub const ENERGY: &str = "energy_per_device_tti";
/// Name of the policy that wakes only the best device.
pub const GENIE: &str = "genie";
/// Metric along y for which larger values are better.
pub const P1: &str = "info_p1";
/// Number of styles available for a policy's other lines.
const STYLES: usize = 6;

/// A quantity plotted against energy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Trade {
    /// Name in commands and files.
    pub name: &'static str,
    /// Start of the title.
    pub title: &'static str,
    /// Metric along y.
    pub y: &'static str,
    /// Caption text that tells in which direction policies are better.
    better: &'static str,
}

/// Information against energy.
pub(crate) const INFORMATION: Trade = Trade {
    name: "pareto",
    title: "Information against energy",
    y: P1,
    better: "Up and to the left is better.",
};

/// Delay of detection against energy.
pub(crate) const DELAY: Trade = Trade {
    name: "delay",
    title: "Delay of detection against energy",
    y: "detection_delay_ttis",
    better: "Down and to the left is better. Delays cover reported events only, so a policy that misses more events \
        can look faster.",
};

/// All trade-off figures.
pub const TRADES: [Trade; 2] = [INFORMATION, DELAY];

/// A policy under a condition.
struct Line<'a> {
    condition: &'a RunCondition,
    policy: &'a str,
    /// Name of the line. With several conditions it includes the changes of its condition.
    name: String,
    style: Style,
    /// Points, in ascending order of N.
    points: Vec<(u32, ChartPoint)>,
}

/// Returns the lines of `conditions` with `y`, grouped by policy. Runs that two conditions share count once.
fn lines<'a>(y: &str, conditions: &[&'a RunCondition]) -> Vec<Line<'a>> {
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
            // Lines of one policy share its colour, so they must differ from it in both marker and dashes.
            let looks = |variant: &Style| variant.marker != style.marker && variant.dashes != style.dashes;
            let mut variants = (0..STYLES).map(Style::nth).filter(looks).cycle();
            lines.push(Line {
                condition,
                policy,
                // The caption names a lone condition.
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
    // A stable sort keeps the lines of a policy in the order of their conditions.
    lines.sort_by_key(place);
    lines
}

/// Returns whether the runs of `policy` are the same in both conditions.
fn has_same_runs(a: &RunCondition, b: &RunCondition, policy: &str) -> bool {
    let digests = |condition: &RunCondition| {
        let cells = condition.sizes(policy).into_iter();
        let of = |n: u32| condition.runs(policy, n).map(|row| row.digest).collect::<Vec<_>>();
        cells.map(|n| (n, of(n))).collect::<Vec<_>>()
    };
    digests(a) == digests(b)
}

/// Returns the name of the policy, followed by the changes of its condition.
fn name(policy: &str, condition: &RunCondition) -> String {
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
    /// Draws the chart for the runs of `conditions`, which share preset and K. `None` if no policy has both metrics at
    /// any N.
    pub fn chart(&self, conditions: &[&RunCondition]) -> Option<Chart> {
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
        let (stated, marks): (Vec<u32>, Vec<StatedMark>) = self.marks(&lines).into_iter().unzip();
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

    fn heading(&self, conditions: &[&RunCondition]) -> String {
        match conditions {
            [one] if self.y == P1 => title(self.title, "Figs. 7 and 8", one),
            [one] if !one.is_plain() => title(self.title, "", one),
            _ => self.title.to_owned(),
        }
    }

    /// Returns the energy floor for sensing the whole area in every TTI, with one point for each N at the genie's
    /// information. Empty unless there is exactly one condition with cover data for at least two N.
    fn floor(&self, conditions: &[&RunCondition]) -> Vec<(u32, ChartPoint)> {
        let ([condition], P1) = (conditions, self.y) else {
            return Vec::new();
        };
        let sample = |n: u32| {
            let floor = floor::affordable(condition.scenario.as_ref()?, n)?;
            let best = condition.estimate(GENIE, n, P1)?.mean;
            Some((n, floor::sample(floor, best)))
        };
        let points: Vec<(u32, ChartPoint)> = condition.sizes(GENIE).into_iter().filter_map(sample).collect();
        if points.len() > 1 { points } else { Vec::new() }
    }

    fn caption(
        &self,
        condition: &RunCondition,
        conditions: &[&RunCondition],
        mut stated: Vec<u32>,
        has_floor: bool,
    ) -> String {
        let what = match conditions {
            [one] => one.label(),
            _ => format!("{}, with the changes in the legend", condition.preset),
        };
        let counts = || conditions.iter().map(|s| s.runs_per_cell());
        let (least, most) = (counts().map(|c| c.0).min(), counts().map(|c| c.1).max());
        let mut text = format!(
            "Preset {what}; {} of {} TTIs per point, means with 95 % intervals in both directions. Lines join points \
             in order of N, which labels some points. {}",
            runs_in_words((least.unwrap_or(0), most.unwrap_or(0))),
            condition.ttis,
            self.better
        );
        if has_floor {
            let _ = write!(
                text,
                " {} It is drawn at the genie's information for the same N.",
                floor::NOTE
            );
        }
        stated.sort_unstable();
        stated.dedup();
        let stated: Vec<String> = stated.iter().map(ToString::to_string).collect();
        if !stated.is_empty() {
            let _ = write!(
                text,
                " Hollow marks are for N = {}; the paper states information per event, which has the same mean in its \
                 model.",
                stated.join(", ")
            );
        }
        text
    }

    /// Returns marks for values that the paper states at one N for both metrics of a drawn policy.
    fn marks(&self, lines: &[Line<'_>]) -> Vec<(u32, StatedMark)> {
        if self.y == P1 { marks(lines) } else { Vec::new() }
    }

    /// Formats the plotted data as CSV.
    pub fn csv(&self, conditions: &[&RunCondition]) -> String {
        let column = if self.y == P1 { "info" } else { "delay" };
        let mut out = format!(
            "setting,policy,n,{ENERGY},energy_half_width_95,{},{column}_half_width_95,runs\n",
            self.y
        );
        for line in lines(self.y, conditions) {
            let label = csv_cell(&line.condition.label());
            for (n, sample) in line.points {
                let ChartPoint { x, y, half, across } = sample;
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

/// Creates axes from zero that hold all points with their intervals, and all marks.
pub(crate) fn scales(series: &[Series], marks: &[StatedMark]) -> [Scale; 2] {
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

/// Returns the points of `policy` in ascending order of N.
fn points(y: &str, condition: &RunCondition, policy: &str) -> Vec<(u32, ChartPoint)> {
    let sizes = condition.sizes(policy).into_iter();
    let points = sizes.filter_map(|n| Some((n, point(y, condition, policy, n)?)));
    points.collect()
}

/// Returns the point of energy and `y` for `policy` with `n` devices; `None` unless both metrics are defined.
pub fn point(y: &str, condition: &RunCondition, policy: &str, n: u32) -> Option<ChartPoint> {
    let [x, y] = [ENERGY, y].map(|metric| condition.estimate(policy, n, metric));
    let (x, y) = (x?, y?);
    Some(ChartPoint {
        x: x.mean,
        y: y.mean,
        half: y.half_width,
        across: x.half_width,
    })
}

fn note(n: u32, sample: &ChartPoint) -> Note {
    Note {
        x: sample.x,
        y: sample.y,
        text: n.to_string(),
    }
}

/// Returns the labels ordered by importance: the last N of each line, then the first, then one halfway.
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

/// Returns marks for values that the paper states at one N for both metrics of a drawn policy.
fn marks(lines: &[Line<'_>]) -> Vec<(u32, StatedMark)> {
    let (energies, informations) = (on("Fig. 8", ENERGY), on("Fig. 7", "info_per_event"));
    let value = |claim: &Claim, claims: &[Claim]| match (stated_value(claim, claims), claim.sites) {
        (Some(StatedValue::Value(value)), DeviceCounts::At(n)) => Some((n, value)),
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
            let mark = StatedMark {
                x,
                aside: 0.0,
                stated: StatedValue::Value(y),
                style: drawn.style,
            };
            (n, mark)
        }));
    }
    marks
}
