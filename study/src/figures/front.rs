//! Information, the objective of P1, against energy for one N, with a line through a policy's knob settings.
//!
//! Knobs are settings that only the base station uses: policy settings and the ranking of wake-ups. Conditions that
//! differ in any other field get separate figures. A knob must not change the floor, which is taken from one condition.
//! The columns of the CSV are a file format.

use std::fmt::Write as _;

use reveille_common::score::Metrics;
use reveille_lab::series::{self, RANKING};

use super::chart::{Chart, ChartPoint, Interval, Series};
use super::floor;
use super::note::Note;
use super::pareto::{ENERGY_METRIC, GENIE, P1_METRIC, scales_from_zero, trade_off_point};
use super::results::RunCondition;
use super::study::{csv_cell, half_width_cell, runs_in_words};
use super::style::Style;

/// Name in `--only` and in file names, which docs/figures-and-report.md lists.
pub const NAME: &str = "front";
/// Preset for which relaxed bounds exist.
const BOUND_PRESET: &str = "paper";

/// Fields with their values that differ from the preset, knobs excluded.
pub type FieldValues = Vec<(String, String)>;

/// Figure for one N.
#[derive(Clone, Debug)]
pub struct ParetoFront {
    /// Number of devices N.
    pub n: u32,
    /// Changed fields that are not knobs.
    pub other_changes: FieldValues,
    /// The chart.
    pub chart: Chart,
    /// The plotted data as CSV.
    pub csv: String,
}

/// Points of one policy, in ascending order of energy.
struct PolicyLine<'c> {
    /// Name of the series: the policy, with its ranking of wake-ups if there are several.
    name: &'c str,
    settings: Vec<KnobSetting<'c>>,
}

/// A policy with one setting of its knobs.
struct KnobSetting<'c> {
    condition: &'c RunCondition,
    /// Values of the policy's settings that differ from the preset.
    knob_values: Vec<&'c str>,
    point: ChartPoint,
}

/// Draws the figures for the runs of `conditions`, which share preset and K. There is one for each set of
/// [`FieldValues`] and each N at which a policy has several settings.
pub fn draw_fronts(conditions: &[&RunCondition]) -> Vec<ParetoFront> {
    let mut groups_by_changes: Vec<(FieldValues, Vec<&RunCondition>)> = Vec::new();
    for condition in conditions {
        let changes = changes_without_knobs(condition);
        match groups_by_changes.iter_mut().find(|(known, _)| *known == changes) {
            Some((_, group)) => group.push(condition),
            None => groups_by_changes.push((changes, vec![condition])),
        }
    }
    let fronts = groups_by_changes.into_iter().flat_map(|(other_changes, group)| {
        let mut device_counts: Vec<u32> = group
            .iter()
            .flat_map(|c| c.policies().into_iter().flat_map(|p| c.device_counts(p)))
            .collect();
        device_counts.sort_unstable();
        device_counts.dedup();
        let fronts = device_counts
            .into_iter()
            .filter_map(|n| draw_front(n, &other_changes, &group));
        fronts.collect::<Vec<_>>()
    });
    fronts.collect()
}

/// Returns the changes of `condition`, knobs excluded.
fn changes_without_knobs(condition: &RunCondition) -> FieldValues {
    let is_knob = |path: &str| path.starts_with("policy.") || path == RANKING;
    let other_fields = condition.all_changes().filter(|(path, _)| !is_knob(path)).cloned();
    other_fields.chain(condition.table_changes()).collect()
}

fn draw_front(n: u32, other_changes: &[(String, String)], group: &[&RunCondition]) -> Option<ParetoFront> {
    let lines = policy_lines(n, group);
    if lines.iter().all(|line| line.settings.len() < 2) {
        return None;
    }
    let mut series: Vec<Series> = lines.iter().map(PolicyLine::series).collect();
    let notes = lines.iter().flat_map(PolicyLine::notes).collect();
    let bound = bound_points(n, other_changes, group);
    let has_bound = !bound.is_empty();
    if has_bound {
        series.push(floor::bound_series(bound));
    }
    // The conditions of a group differ in knobs alone, which change neither layout nor energies.
    let floor_energy = group[0]
        .scenario
        .as_ref()
        .and_then(|scenario| floor::floor_within_harvest(scenario, n));
    // The floor is an upright line over the whole axis, so y is scaled before it is added.
    let [_, y] = scales_from_zero(&series, &[]);
    series.extend(
        floor_energy.map(|x| floor::floor_series(vec![floor::exact_point(x, 0.0), floor::exact_point(x, y.ends().1)])),
    );
    // Scaled a second time, since the floor may lie beyond all points.
    let [x, y] = scales_from_zero(&series, &[]);
    let caption = format_caption(n, other_changes, group, (floor_energy.is_some(), has_bound));
    Some(ParetoFront {
        n,
        other_changes: other_changes.to_vec(),
        csv: format_csv(n, &lines),
        chart: Chart {
            title: format!("Information against energy, N = {n}"),
            x_label: Metrics::axis_label(ENERGY_METRIC).to_owned(),
            y_label: Metrics::axis_label(P1_METRIC).to_owned(),
            x,
            y,
            series,
            marks: Vec::new(),
            spans: Vec::new(),
            notes,
            has_zero_at_border: false,
            caption,
        },
    })
}

/// Returns the lines at N, settings in ascending order of energy. Runs that several settings share count once.
fn policy_lines<'c>(n: u32, group: &[&'c RunCondition]) -> Vec<PolicyLine<'c>> {
    let mut lines: Vec<PolicyLine<'c>> = Vec::new();
    for condition in group {
        for name in condition.policies() {
            let Some(point) = trade_off_point(P1_METRIC, condition, name, n) else {
                continue;
            };
            let setting = KnobSetting {
                condition,
                knob_values: own_knob_values(condition, name),
                point,
            };
            match lines.iter_mut().find(|line| line.name == name) {
                None => lines.push(PolicyLine {
                    name,
                    settings: vec![setting],
                }),
                Some(line) => {
                    let is_known = |known: &KnobSetting<'_>| {
                        run_digests(known.condition, name, n) == run_digests(condition, name, n)
                    };
                    if !line.settings.iter().any(is_known) {
                        line.settings.push(setting);
                    }
                }
            }
        }
    }
    for line in &mut lines {
        line.settings.sort_by(|a, b| a.point.x.total_cmp(&b.point.x));
    }
    lines
}

fn run_digests(condition: &RunCondition, name: &str, n: u32) -> Vec<(u64, [u8; 32])> {
    condition.runs(name, n).map(|row| (row.seed, row.digest.0)).collect()
}

/// Returns the values of the policy's settings that differ from the preset: its knobs without the ranking.
fn own_knob_values<'c>(condition: &'c RunCondition, name: &str) -> Vec<&'c str> {
    let prefix = format!("policy.{}.", series::split_policy(name).0);
    let own_fields = condition.all_changes().filter(|(path, _)| path.starts_with(&prefix));
    own_fields.map(|(_, value)| value.as_str()).collect()
}

impl PolicyLine<'_> {
    /// Returns the chart's series: the points of all settings, joined by a line.
    fn series(&self) -> Series {
        Series {
            name: self.name.to_owned(),
            style: Style::of_policy(self.name),
            is_joined: true,
            has_markers: true,
            interval: Interval::Crosses,
            points: self.settings.iter().map(|setting| setting.point).collect(),
        }
    }

    /// Labels with the knob values next to the points.
    fn notes(&self) -> Vec<Note> {
        let note = |setting: &KnobSetting<'_>| Note {
            x: setting.point.x,
            y: setting.point.y,
            text: setting.knob_values.join(", "),
        };
        let labelled = self.settings.iter().filter(|_| self.settings.len() > 1);
        labelled.map(note).filter(|note| !note.text.is_empty()).collect()
    }
}

/// Returns the points of the relaxed bound; empty unless the preset is [`BOUND_PRESET`] without other changes.
fn bound_points(n: u32, other_changes: &[(String, String)], group: &[&RunCondition]) -> Vec<ChartPoint> {
    let Some(scenario) = group[0].scenario.as_ref() else {
        return Vec::new();
    };
    if group[0].preset != BOUND_PRESET || !other_changes.is_empty() {
        return Vec::new();
    }
    floor::relaxed_bounds(&scenario.layout, n)
}

/// Formats the caption. The last argument states whether the floor and the relaxed bound are drawn.
fn format_caption(
    n: u32,
    other_changes: &[(String, String)],
    group: &[&RunCondition],
    (has_floor, has_bound): (bool, bool),
) -> String {
    let mut settings = group[0].preset.clone();
    for (path, value) in other_changes {
        let _ = write!(settings, ", {path} = {value}");
    }
    let counts = || group.iter().map(|condition| condition.runs_per_cell());
    let (least, most) = (counts().map(|c| c.0).min(), counts().map(|c| c.1).max());
    let mut text = format!(
        "Preset {settings}, N = {n}; {} of {} TTIs per point, means with 95 % intervals in both directions. Lines join \
         the settings of a policy in order of energy, with labels for their differences. Up and to the left is better.",
        runs_in_words((least.unwrap_or(0), most.unwrap_or(0))),
        group[0].ttis
    );
    for (is_drawn, note) in [(has_floor, floor::FLOOR_CAPTION), (has_bound, floor::BOUND_CAPTION)] {
        if is_drawn {
            let _ = write!(text, " {note}");
        }
    }
    if group
        .iter()
        .any(|condition| condition.device_counts(GENIE).contains(&n))
    {
        text.push_str(" The genie receives the positions of events.");
    }
    text
}

fn format_csv(n: u32, lines: &[PolicyLine<'_>]) -> String {
    let mut out =
        format!("policy,setting,n,{ENERGY_METRIC},energy_half_width_95,{P1_METRIC},info_half_width_95,runs\n");
    for line in lines {
        for setting in &line.settings {
            let ChartPoint {
                x,
                y,
                y_half_width,
                x_half_width,
            } = setting.point;
            let runs = setting.condition.runs(line.name, n).count();
            let (y_half_width, x_half_width) = (half_width_cell(y_half_width), half_width_cell(x_half_width));
            let label = csv_cell(&setting.condition.label());
            let _ = writeln!(
                out,
                "{},{label},{n},{x},{x_half_width},{y},{y_half_width},{runs}",
                line.name
            );
        }
    }
    out
}
