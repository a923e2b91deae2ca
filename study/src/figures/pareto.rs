//! Trade-offs of policies against energy, with a line through rising N: information, the objective of P1, and the delay
//! of detection. [`super::front`] shows the trade-off at one N. The names in [`TRADE_OFFS`] are values of `--only` and
//! parts of file names, listed in docs/figures-and-report.md. The columns of the CSV are a file format. A third
//! trade-off also needs a place in `deploy/src/cli/figures.rs` and a CSV column in [`TradeOff::csv`].

use std::fmt::Write as _;

use reveille_common::score::Metrics;

use super::chart::{Chart, ChartPoint, Interval, Series, StatedMark, StatedValue};
use super::floor;
use super::note::Note;
use super::results::RunCondition;
use super::scale::Scale;
use super::stated::stated_value;
use super::study::{csv_cell, figure_title, half_width_cell, runs_in_words};
use super::style::Style;
use crate::claims::{Claim, DeviceCounts, claims_on};

/// Metric along x.
pub const ENERGY_METRIC: &str = "energy_per_device_tti";
/// Name of the policy that knows events in the registry; the energy floor is drawn at its information.
pub const GENIE: &str = "genie";
/// Information, the objective of P1: the metric along y of the first trade-off.
pub const P1_METRIC: &str = "info_p1";
/// Number of styles of [`Style::from_palette`], which lend markers and dashes to a policy's other lines.
const PALETTE_SIZE: usize = 6;

/// A quantity plotted against energy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TradeOff {
    /// Name in commands and files.
    pub name: &'static str,
    /// Start of the title, by which `reveille report` recognises the picture and orders it. It must not begin with the
    /// title of another figure.
    pub title: &'static str,
    /// Metric along y.
    pub metric: &'static str,
    /// Caption text that tells in which direction policies are better.
    direction_caption: &'static str,
}

/// Information against energy.
pub(crate) const INFORMATION_TRADE_OFF: TradeOff = TradeOff {
    name: "pareto",
    title: "Information against energy",
    metric: P1_METRIC,
    direction_caption: "Up and to the left is better.",
};

/// Delay of detection against energy.
pub(crate) const DELAY_TRADE_OFF: TradeOff = TradeOff {
    name: "delay",
    title: "Delay of detection against energy",
    metric: "detection_delay_ttis",
    direction_caption: "Down and to the left is better. Delays cover reported events only, so a policy that misses \
        more events can look faster.",
};

/// All trade-off figures.
pub const TRADE_OFFS: [TradeOff; 2] = [INFORMATION_TRADE_OFF, DELAY_TRADE_OFF];

/// A policy under a condition.
struct TradeOffLine<'a> {
    condition: &'a RunCondition,
    policy: &'a str,
    /// Name of the line. With several conditions it includes the changes of its condition.
    name: String,
    style: Style,
    /// Points, in ascending order of N.
    points: Vec<(u32, ChartPoint)>,
}

/// Returns the lines of `conditions` with `metric`, grouped by policy. Runs that two conditions share count once.
fn trade_off_lines<'a>(metric: &str, conditions: &[&'a RunCondition]) -> Vec<TradeOffLine<'a>> {
    let mut lines: Vec<TradeOffLine<'a>> = Vec::new();
    for condition in conditions {
        for policy in condition.policies() {
            let points = trade_off_points(metric, condition, policy);
            let is_same =
                |line: &TradeOffLine<'_>| line.policy == policy && has_same_runs(line.condition, condition, policy);
            if points.is_empty() || lines.iter().any(is_same) {
                continue;
            }
            let earlier_count = lines.iter().filter(|line| line.policy == policy).count();
            let style = Style::of_policy(policy);
            // Lines of one policy share its colour, so they must differ from it in both marker and dashes.
            let differs = |variant: &Style| variant.marker != style.marker && variant.dashes != style.dashes;
            let mut variants = (0..PALETTE_SIZE).map(Style::from_palette).filter(differs).cycle();
            lines.push(TradeOffLine {
                condition,
                policy,
                // The caption names a lone condition.
                name: match conditions {
                    [_] => policy.to_owned(),
                    _ => line_name(policy, condition),
                },
                style: match earlier_count {
                    0 => style,
                    _ => Style {
                        paint: style.paint,
                        ..variants.nth(earlier_count - 1).unwrap_or(style)
                    },
                },
                points,
            });
        }
    }
    let policy_rank = |line: &TradeOffLine<'_>| {
        conditions
            .iter()
            .flat_map(|condition| condition.policies())
            .position(|p| p == line.policy)
    };
    // A stable sort keeps the lines of a policy in the order of their conditions.
    lines.sort_by_key(policy_rank);
    lines
}

/// Returns whether the runs of `policy` are the same in both conditions.
fn has_same_runs(a: &RunCondition, b: &RunCondition, policy: &str) -> bool {
    let digests = |condition: &RunCondition| {
        let device_counts = condition.device_counts(policy).into_iter();
        let digests_at = |n: u32| condition.runs(policy, n).map(|row| row.digest).collect::<Vec<_>>();
        device_counts.map(|n| (n, digests_at(n))).collect::<Vec<_>>()
    };
    digests(a) == digests(b)
}

/// Returns the name of the policy, followed by the changes of its condition.
fn line_name(policy: &str, condition: &RunCondition) -> String {
    let mut name = policy.to_owned();
    for (path, value) in condition.all_changes() {
        let policy_field = path.strip_prefix("policy.").and_then(|rest| rest.split_once('.'));
        let field = policy_field.map_or(path.as_str(), |(_, field)| field);
        let value = value
            .strip_suffix(".json")
            .filter(|_| field == "table")
            .unwrap_or(value);
        let _ = write!(name, ", {field} {value}");
    }
    name + &condition.table_changes_text()
}

impl TradeOff {
    /// Draws the chart for the runs of `conditions`, which share preset and K, as the groups of
    /// `Results::by_preset_and_length` do. `None` if no policy has both metrics at any N.
    pub fn chart(&self, conditions: &[&RunCondition]) -> Option<Chart> {
        let lines = trade_off_lines(self.metric, conditions);
        let first = lines.first()?;
        let floor_points = self.floor_points(conditions);
        let point_lists = lines.iter().map(|line| &line.points).chain([&floor_points]);
        let point_lists = point_lists.filter(|points| !points.is_empty());
        let notes: Vec<Vec<Note>> = point_lists
            .map(|points| points.iter().map(|(n, point)| n_label(*n, point)).collect())
            .collect();
        let mut series: Vec<Series> = lines.iter().map(TradeOffLine::series).collect();
        let has_floor = !floor_points.is_empty();
        if has_floor {
            series.push(floor::floor_series(
                floor_points.into_iter().map(|(_, point)| point).collect(),
            ));
        }
        let (stated_ns, marks): (Vec<u32>, Vec<StatedMark>) = self.marks(&lines).into_iter().unzip();
        let [x, y] = scales_from_zero(&series, &marks);
        Some(Chart {
            title: self.heading(conditions),
            x_label: Metrics::axis_label(ENERGY_METRIC).to_owned(),
            y_label: Metrics::axis_label(self.metric).to_owned(),
            x,
            y,
            caption: self.caption(first.condition, conditions, stated_ns, has_floor),
            notes: by_importance(&notes),
            series,
            marks,
            spans: Vec::new(),
            has_zero_at_border: false,
        })
    }

    fn heading(&self, conditions: &[&RunCondition]) -> String {
        match conditions {
            [single] if self.metric == P1_METRIC => figure_title(self.title, "Figs. 7 and 8", single),
            [single] if !single.is_unchanged_preset() => figure_title(self.title, "", single),
            _ => self.title.to_owned(),
        }
    }

    /// Returns the energy floor for sensing the whole area in every TTI, with one point for each N at the genie's
    /// information. Empty unless the metric is P1 and there is exactly one condition, with a floor for at least two N.
    fn floor_points(&self, conditions: &[&RunCondition]) -> Vec<(u32, ChartPoint)> {
        let ([condition], P1_METRIC) = (conditions, self.metric) else {
            return Vec::new();
        };
        let point = |n: u32| {
            let least_energy = floor::floor_within_harvest(condition.scenario.as_ref()?, n)?;
            let information = condition.estimate(GENIE, n, P1_METRIC)?.mean;
            Some((n, floor::exact_point(least_energy, information)))
        };
        let points: Vec<(u32, ChartPoint)> = condition.device_counts(GENIE).into_iter().filter_map(point).collect();
        if points.len() > 1 { points } else { Vec::new() }
    }

    /// Returns the caption. `conditions` have the preset and the K of `first`, one of them.
    fn caption(
        &self,
        first: &RunCondition,
        conditions: &[&RunCondition],
        mut stated_ns: Vec<u32>,
        has_floor: bool,
    ) -> String {
        let settings = match conditions {
            [single] => single.label(),
            _ => format!("{}, with the changes in the legend", first.preset),
        };
        let run_counts = || conditions.iter().map(|c| c.runs_per_cell());
        let (least, most) = (run_counts().map(|c| c.0).min(), run_counts().map(|c| c.1).max());
        let mut text = format!(
            "Preset {settings}; {} of {} TTIs per point, means with 95 % intervals in both directions. Lines join \
             points in order of N, which labels some points. {}",
            runs_in_words((least.unwrap_or(0), most.unwrap_or(0))),
            first.ttis,
            self.direction_caption
        );
        if has_floor {
            let _ = write!(
                text,
                " {} It is drawn at the genie's information for the same N.",
                floor::FLOOR_CAPTION
            );
        }
        stated_ns.sort_unstable();
        stated_ns.dedup();
        let stated_ns: Vec<String> = stated_ns.iter().map(ToString::to_string).collect();
        if !stated_ns.is_empty() {
            let _ = write!(
                text,
                " Hollow marks are for N = {}; the paper states information per event, which has the same mean in its \
                 model.",
                stated_ns.join(", ")
            );
        }
        text
    }

    /// Returns the marks of the first trade-off; the paper states no delays.
    fn marks(&self, lines: &[TradeOffLine<'_>]) -> Vec<(u32, StatedMark)> {
        if self.metric == P1_METRIC {
            p1_marks(lines)
        } else {
            Vec::new()
        }
    }

    /// Formats the plotted data of [`Self::chart`] as CSV, without floor and marks.
    pub fn csv(&self, conditions: &[&RunCondition]) -> String {
        let column = if self.metric == P1_METRIC { "info" } else { "delay" };
        let mut out = format!(
            "setting,policy,n,{ENERGY_METRIC},energy_half_width_95,{},{column}_half_width_95,runs\n",
            self.metric
        );
        for line in trade_off_lines(self.metric, conditions) {
            let label = csv_cell(&line.condition.label());
            for (n, point) in line.points {
                let ChartPoint {
                    x,
                    y,
                    y_half_width,
                    x_half_width,
                } = point;
                let runs = line.condition.runs(line.policy, n).count();
                let (y_half_width, x_half_width) = (half_width_cell(y_half_width), half_width_cell(x_half_width));
                let _ = writeln!(
                    out,
                    "{label},{},{n},{x},{x_half_width},{y},{y_half_width},{runs}",
                    line.policy
                );
            }
        }
        out
    }
}

impl TradeOffLine<'_> {
    fn series(&self) -> Series {
        Series {
            name: self.name.clone(),
            style: self.style,
            is_joined: true,
            has_markers: true,
            interval: Interval::Crosses,
            points: self.points.iter().map(|(_, point)| *point).collect(),
        }
    }
}

/// Creates axes from zero that hold all points with their intervals, and all marks.
pub(crate) fn scales_from_zero(series: &[Series], marks: &[StatedMark]) -> [Scale; 2] {
    let points = || series.iter().flat_map(|s| &s.points);
    let ends = |mean: f64, half_width: f64| {
        let half_width = if half_width.is_finite() { half_width } else { 0.0 };
        // None of these metrics can be negative, whatever an interval says.
        [(mean - half_width).max(0.0), mean + half_width]
    };
    let xs = points().flat_map(|p| ends(p.x, p.x_half_width));
    let ys = points().flat_map(|p| ends(p.y, p.y_half_width));
    [
        Scale::linear(xs.chain(marks.iter().map(|m| m.x)), true),
        Scale::linear(ys.chain(marks.iter().flat_map(|m| m.stated.values())), true),
    ]
}

/// Returns the points of `policy` in ascending order of N.
fn trade_off_points(metric: &str, condition: &RunCondition, policy: &str) -> Vec<(u32, ChartPoint)> {
    let device_counts = condition.device_counts(policy).into_iter();
    let points = device_counts.filter_map(|n| Some((n, trade_off_point(metric, condition, policy, n)?)));
    points.collect()
}

/// Returns the point of energy and `metric` for `policy` with `n` devices; `None` unless both metrics are defined.
pub fn trade_off_point(metric: &str, condition: &RunCondition, policy: &str, n: u32) -> Option<ChartPoint> {
    let [x, y] = [ENERGY_METRIC, metric].map(|metric| condition.estimate(policy, n, metric));
    let (x, y) = (x?, y?);
    Some(ChartPoint {
        x: x.mean,
        y: y.mean,
        y_half_width: y.half_width,
        x_half_width: x.half_width,
    })
}

fn n_label(n: u32, point: &ChartPoint) -> Note {
    Note {
        x: point.x,
        y: point.y,
        text: n.to_string(),
    }
}

/// Returns the labels ordered by importance: the last N of each line, then the first, then one halfway. No line is
/// empty.
fn by_importance(lines: &[Vec<Note>]) -> Vec<Note> {
    let indices_by_importance: [fn(usize) -> Option<usize>; 3] = [
        |count| Some(count - 1),
        |count| (count > 1).then_some(0),
        |count| (count > 2).then_some(count / 2),
    ];
    let notes_at = |index_of_note: fn(usize) -> Option<usize>| {
        let note_of = move |line: &Vec<Note>| index_of_note(line.len()).map(|index| line[index].clone());
        lines.iter().filter_map(note_of)
    };
    indices_by_importance.into_iter().flat_map(notes_at).collect()
}

/// Returns marks, each with its N, for values that the paper states at one N for both metrics of a drawn policy.
fn p1_marks(lines: &[TradeOffLine<'_>]) -> Vec<(u32, StatedMark)> {
    let (energy_claims, information_claims) = (
        claims_on("Fig. 8", ENERGY_METRIC),
        claims_on("Fig. 7", "info_per_event"),
    );
    let value_at_n = |claim: &Claim, claims: &[Claim]| match (stated_value(claim, claims), claim.device_counts) {
        (Some(StatedValue::Value(value)), DeviceCounts::At(n)) => Some((n, value)),
        _ => None,
    };
    let mut marks = Vec::new();
    for information in information_claims {
        let is_drawn =
            |line: &&TradeOffLine<'_>| line.policy == information.policy && line.condition.is_unchanged_preset();
        let drawn = lines.iter().find(is_drawn);
        let (Some(drawn), Some((n, y))) = (drawn, value_at_n(information, information_claims)) else {
            continue;
        };
        let energy_claims_of_policy = energy_claims
            .iter()
            .filter(|energy| energy.policy == information.policy);
        let energies_at_same_n = energy_claims_of_policy
            .filter_map(|energy| value_at_n(energy, energy_claims))
            .filter(|(claim_n, _)| *claim_n == n);
        marks.extend(energies_at_same_n.map(|(_, x)| {
            let mark = StatedMark {
                x,
                x_offset: 0.0,
                stated: StatedValue::Value(y),
                style: drawn.style,
            };
            (n, mark)
        }));
    }
    marks
}
