//! Information, the objective of P1, against energy: what each policy buys with what it spends, a line through rising
//! N.

use std::fmt::Write as _;

use reveille_common::score::Metrics;

use super::chart::{Chart, Interval, Mark, Sample, Series, Stated};
use super::note::Note;
use super::results::Condition;
use super::scale::Scale;
use super::stated::said;
use super::study::{csv_cell, csv_half, runs_in_words, title};
use super::style::Style;
use crate::claims::{Claim, Sites, on};

/// Its name in commands and files.
pub const NAME: &str = "pareto";
/// What its title begins with.
pub const TITLE: &str = "Information against energy";
/// Styles to choose from for a policy's other lines.
const STYLES: usize = 6;
/// The metrics of x and y.
const METRICS: [&str; 2] = ["energy_per_device_tti", "info_p1"];

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

/// The lines of `conditions`, each policy's side by side. Runs that two of them share count once.
fn lines<'a>(conditions: &[&'a Condition]) -> Vec<Line<'a>> {
    let mut lines: Vec<Line<'a>> = Vec::new();
    for condition in conditions {
        for policy in condition.policies() {
            let points = points(condition, policy);
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

/// The picture for the runs of `conditions`, which have preset and K in common; `None` if no policy has both metrics at
/// any N.
pub fn chart(conditions: &[&Condition]) -> Option<Chart> {
    let lines = lines(conditions);
    let notes: Vec<Vec<Note>> = lines
        .iter()
        .map(|line| line.points.iter().map(|(n, s)| note(*n, s)).collect())
        .collect();
    let series: Vec<Series> = lines
        .iter()
        .map(|line| Series {
            name: line.name.clone(),
            style: line.style,
            joined: true,
            marked: true,
            interval: Interval::Crosses,
            samples: line.points.iter().map(|(_, sample)| *sample).collect(),
        })
        .collect();
    let (stated, marks): (Vec<u32>, Vec<Mark>) = marks(&lines).into_iter().unzip();
    let samples = || series.iter().flat_map(|s| &s.samples);
    let ends = |at: f64, half: f64| {
        let half = if half.is_finite() { half } else { 0.0 };
        // Neither can be negative, whatever an interval says.
        [(at - half).max(0.0), at + half]
    };
    let xs = samples().flat_map(|s| ends(s.x, s.across));
    let ys = samples().flat_map(|s| ends(s.y, s.half));
    let first = lines.first()?;
    Some(Chart {
        title: match conditions {
            [one] => title(TITLE, "Figs. 7 and 8", one),
            _ => TITLE.to_owned(),
        },
        x_label: Metrics::axis(METRICS[0]).to_owned(),
        y_label: Metrics::axis(METRICS[1]).to_owned(),
        x: Scale::linear(xs.chain(marks.iter().map(|m| m.x)), true),
        y: Scale::linear(ys.chain(marks.iter().flat_map(|m| m.stated.values())), true),
        caption: caption(first.condition, conditions, stated),
        notes: in_turn(&notes),
        series,
        marks,
        spans: Vec::new(),
        zero_below: false,
    })
}

/// The points of `policy` by rising N.
fn points(condition: &Condition, policy: &str) -> Vec<(u32, Sample)> {
    let point = |n: u32| {
        let [x, y] = METRICS.map(|metric| condition.estimate(policy, n, metric));
        let (x, y) = (x?, y?);
        let sample = Sample {
            x: x.mean,
            y: y.mean,
            half: y.half_width,
            across: x.half_width,
        };
        Some((n, sample))
    };
    condition.sizes(policy).into_iter().filter_map(point).collect()
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
    let (energies, informations) = (on("Fig. 8", METRICS[0]), on("Fig. 7", "info_per_event"));
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

fn caption(condition: &Condition, conditions: &[&Condition], mut stated: Vec<u32>) -> String {
    let what = match conditions {
        [one] => one.label(),
        _ => format!("{}, also changed as the legend says", condition.preset),
    };
    let counts = || conditions.iter().map(|s| s.runs_per_cell());
    let (least, most) = (counts().map(|c| c.0).min(), counts().map(|c| c.1).max());
    let mut text = format!(
        "Preset {what}; {} of {} TTIs a point, means with their 95 % intervals in both directions. Lines join rising \
         N, which stands beside some points. Up and to the left is better.",
        runs_in_words((least.unwrap_or(0), most.unwrap_or(0))),
        condition.ttis
    );
    stated.sort_unstable();
    stated.dedup();
    let stated: Vec<String> = stated.iter().map(ToString::to_string).collect();
    if !stated.is_empty() {
        let _ = write!(
            text,
            " Hollow marks are for N = {}; the paper states information per event, which in its model is the same on \
             the mean.",
            stated.join(", ")
        );
    }
    text
}

/// What is drawn, as CSV.
pub fn csv(conditions: &[&Condition]) -> String {
    let mut out =
        String::from("setting,policy,n,energy_per_device_tti,energy_half_width_95,info_p1,info_half_width_95,runs\n");
    for Line {
        condition,
        policy,
        points,
        ..
    } in lines(conditions)
    {
        let label = csv_cell(&condition.label());
        for (n, sample) in points {
            let Sample { x, y, half, across } = sample;
            let runs = condition.runs(policy, n).count();
            let (half, across) = (csv_half(half), csv_half(across));
            let _ = writeln!(out, "{label},{policy},{n},{x},{across},{y},{half},{runs}");
        }
    }
    out
}
