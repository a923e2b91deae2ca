//! The paper's Figs. 7 to 12: a metric against N, with a line for each policy. Figs. 13 and 14 are in
//! [`super::energy`]. Titles, captions and CSV cells are shared with the other charts from tables. Names are values of
//! `--only` and parts of file names, listed in docs/figures-and-report.md. The columns of the CSV are a file format.
//! Claims are found by `paper_figure` and `claims_metric`: without a match, no value of the paper is drawn. The
//! captions repeat rules of `reveille_lab::metric_estimate`.

use std::fmt::Write as _;

use reveille_common::score::Metrics;

use super::chart::{Chart, ChartPoint, Interval, Series, StatedMark, StatedSpan, StatedValue};
use super::error::FigureError;
use super::results::RunCondition;
use super::scale::Scale;
use super::stated::{stated_marks, stated_spans, stated_value};
use super::style::Style;
use crate::claims::{Claim, DeviceCounts, claims_on};
use reveille_lab::metric_estimate::MetricEstimate;

/// One of the paper's figures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PaperFigure {
    /// Name in commands and files.
    pub name: &'static str,
    /// Metric along y, from `Metrics::NAMES`.
    pub metric: &'static str,
    /// Whether the metric is divided by N.
    pub is_per_device: bool,
    /// Title, by which `reveille report` recognises the picture and orders it. It must not begin with another title.
    pub title: &'static str,
    /// Corresponding figure of the paper.
    pub paper_figure: &'static str,
    /// Metric of the claims that are drawn as the paper's values; with `paper_figure`, the key of [`claims_on`].
    pub claims_metric: &'static str,
    /// Whether y is logarithmic. The caption then assumes a share of events in which 0 means no case.
    pub is_log: bool,
}

/// Figures against N, in the paper's order.
pub const PAPER_FIGURES: [PaperFigure; 8] = {
    const fn figure(name: &'static str, metric: &'static str, title: &'static str, paper: &'static str) -> PaperFigure {
        PaperFigure {
            name,
            metric,
            is_per_device: false,
            title,
            paper_figure: paper,
            claims_metric: metric,
            is_log: false,
        }
    }
    [
        PaperFigure {
            claims_metric: "info_per_event",
            ..figure("information", "info_p1", "Information, objective of P1", "Fig. 7")
        },
        figure(
            "information-per-event",
            "info_per_event",
            "Information per event",
            "Fig. 7",
        ),
        figure("energy", "energy_per_device_tti", "Energy consumption", "Fig. 8"),
        PaperFigure {
            is_log: true,
            ..figure("misdetection", "misdetection_pct", "Misdetections", "Fig. 9")
        },
        figure("low-energy", "low_energy_pct", "Devices too low to transmit", "Fig. 10"),
        figure("battery", "mean_battery", "Mean battery level", "Fig. 11"),
        figure("wrong", "wrong_activations_per_event", "Wrong activations", "Fig. 12a"),
        PaperFigure {
            is_per_device: true,
            ..figure(
                "wasted",
                "wasted_energy_per_event",
                "Energy wasted per device",
                "Fig. 12b",
            )
        },
    ]
};

/// Returns the figures called `names`, or all if `names` is empty, in the paper's order. `others` are valid names of
/// figures drawn elsewhere.
///
/// # Errors
/// A name is in neither list.
pub fn select_figures(names: &[String], others: &[&str]) -> Result<Vec<PaperFigure>, FigureError> {
    let is_known = |name: &String| PAPER_FIGURES.iter().any(|f| f.name == name) || others.contains(&name.as_str());
    if let Some(unknown) = names.iter().find(|name| !is_known(name)) {
        let all_names: Vec<&str> = PAPER_FIGURES
            .iter()
            .map(|f| f.name)
            .chain(others.iter().copied())
            .collect();
        return Err(FigureError::UnknownFigure {
            name: unknown.clone(),
            known: all_names.join(", "),
        });
    }
    let is_chosen = |f: &PaperFigure| names.is_empty() || names.iter().any(|name| name == f.name);
    Ok(PAPER_FIGURES.into_iter().filter(is_chosen).collect())
}

/// A figure ready to be drawn, with the policies that it lacks.
#[derive(Clone, Debug)]
pub struct Drawing {
    /// The chart.
    pub chart: Chart,
    /// Policies that were run but have no value of the metric.
    pub policies_without_value: Vec<String>,
}

impl PaperFigure {
    /// Draws the runs of `condition`, with a line for each policy. `None` if no run has a value of the metric.
    pub fn draw(&self, condition: &RunCondition) -> Option<Drawing> {
        let mut series = Vec::new();
        let mut without_value = Vec::new();
        for policy in condition.policies() {
            let points = self.points(condition, policy);
            if points.is_empty() {
                without_value.push(policy.to_owned());
                continue;
            }
            series.push(Series {
                name: policy.to_owned(),
                style: Style::of_policy(policy),
                is_joined: true,
                has_markers: true,
                interval: Interval::Bars,
                points,
            });
        }
        if series.is_empty() {
            return None;
        }
        let claims = self.claims(condition);
        let marks = stated_marks(claims, &series);
        let spans = stated_spans(claims, &series);
        let run_ns = series.iter().flat_map(|s| &s.points).map(|p| p.x);
        let largest_n = run_ns.chain(marks.iter().map(|m| m.x)).fold(0.0, f64::max);
        let chart = Chart {
            title: figure_title(self.title, &format!("{} of the paper", self.paper_figure), condition),
            x_label: "number of devices N".to_owned(),
            y_label: self.y_label(),
            x: Scale::Linear {
                // Room at both ends for markers, and for marks that are moved aside.
                from: -0.06 * largest_n,
                to: 1.07 * largest_n,
            },
            y: self.y_scale(&series, &marks, &spans),
            caption: self.caption(condition, (&series, &marks, &spans), &without_value),
            notes: Vec::new(),
            has_zero_at_border: self.is_log && has_zero_mean(&series),
            series,
            marks,
            spans,
        };
        Some(Drawing {
            chart,
            policies_without_value: without_value,
        })
    }

    /// Label of the y axis.
    fn y_label(&self) -> String {
        let axis = Metrics::axis_label(self.metric);
        if self.is_per_device {
            format!("{axis} and device")
        } else {
            axis.to_owned()
        }
    }

    /// Claims of the paper about the figure. Empty for changed presets, about which the paper states nothing.
    fn claims(&self, condition: &RunCondition) -> &'static [Claim] {
        if condition.is_unchanged_preset() {
            claims_on(self.paper_figure, self.claims_metric)
        } else {
            &[]
        }
    }

    /// Returns the estimate of the figure's metric for `policy` with `n` devices.
    fn metric_estimate(&self, condition: &RunCondition, policy: &str, n: u32) -> Option<MetricEstimate> {
        let estimate = condition.metric_estimate(policy, n, self.metric)?;
        Some(if self.is_per_device {
            estimate.divided_by(f64::from(n))
        } else {
            estimate
        })
    }

    fn points(&self, condition: &RunCondition, policy: &str) -> Vec<ChartPoint> {
        let device_counts = condition.device_counts(policy).into_iter();
        let point = |n: u32| {
            let estimate = self.metric_estimate(condition, policy, n)?;
            Some(ChartPoint {
                x: f64::from(n),
                y: estimate.mean_estimate.mean,
                y_half_width: estimate.half_width(),
                x_half_width: f64::NAN,
            })
        };
        device_counts.filter_map(point).collect()
    }

    fn y_scale(&self, series: &[Series], marks: &[StatedMark], spans: &[StatedSpan]) -> Scale {
        let ends = |p: &ChartPoint| {
            let half_width = if p.y_half_width.is_finite() {
                p.y_half_width
            } else {
                0.0
            };
            possible_values(self.metric, [p.y - half_width, p.y + half_width])
        };
        let measured = series.iter().flat_map(|s| &s.points);
        let stated = marks.iter().map(|m| m.stated).chain(spans.iter().map(|s| s.stated));
        let stated = stated.flat_map(StatedValue::values);
        if !self.is_log {
            return Scale::linear(measured.flat_map(ends).chain(stated), true);
        }
        // The lower ends of intervals may go below zero; the axis holds all means.
        let values = measured.clone().flat_map(|p| [p.y, ends(p)[1]]).chain(stated);
        let scale = Scale::log(values).unwrap_or(Scale::Log { from: 0.01, to: 100.0 });
        let (from, to) = scale.ends();
        Scale::Log {
            // Values of 0 have no logarithm; the axis begins a decade lower, and they are drawn on its border.
            from: if has_zero_mean(series) { from / 10.0 } else { from },
            to,
        }
    }

    fn caption(
        &self,
        condition: &RunCondition,
        (series, marks, spans): (&[Series], &[StatedMark], &[StatedSpan]),
        without_value: &[String],
    ) -> String {
        let runs = runs_in_words(condition.runs_per_cell());
        let mut text = format!(
            "Preset {}; {runs} of {} TTIs per point, mean with its 95 % interval as band and bar.",
            condition.label(),
            condition.ttis
        );
        if !marks.is_empty() {
            text.push_str(" Hollow marks next to an N: values stated in the paper; box: a range, arrow: a bound.");
        }
        if self.claims_metric != self.metric && !marks.is_empty() {
            text.push_str(" The paper states information per event, which has the same mean in its model.");
        }
        if !spans.is_empty() {
            text.push_str(" Hatched: values stated for a range of N.");
        }
        if self.is_log && has_zero_mean(series) {
            text.push_str(
                " At the lower border: none of the events; bars then end at 300 / Σ events %, the rule of three.",
            );
        }
        if !without_value.is_empty() {
            let _ = write!(text, " Not defined for {}.", without_value.join(", "));
        }
        text
    }

    /// Formats the plotted data of `drawing`, which shows `condition`, as CSV: measured means and the paper's
    /// statements at one N, also about policies without runs.
    pub fn csv(&self, condition: &RunCondition, drawing: &Drawing) -> String {
        let mut out = String::from("kind,setting,policy,n,metric,mean,half_width_95,runs,paper_low,paper_high\n");
        let label = csv_cell(&condition.label());
        let metric = if self.is_per_device {
            format!("{}/n", self.metric)
        } else {
            self.metric.to_owned()
        };
        for series in &drawing.chart.series {
            for n in condition.device_counts(&series.name) {
                if let Some(metric_estimate) = self.metric_estimate(condition, &series.name, n) {
                    let half_width = half_width_cell(metric_estimate.half_width());
                    let (policy, estimate) = (&series.name, metric_estimate.mean_estimate);
                    let _ = writeln!(
                        out,
                        "measured,{label},{policy},{n},{metric},{},{half_width},{},,",
                        estimate.mean, estimate.runs
                    );
                }
            }
        }
        let claims = self.claims(condition);
        for claim in claims {
            if let (Some(stated), DeviceCounts::At(n)) = (stated_value(claim, claims), claim.device_counts) {
                let (low, high) = match stated {
                    StatedValue::Value(v) => (v.to_string(), v.to_string()),
                    StatedValue::Range(low, high) => (low.to_string(), high.to_string()),
                    StatedValue::Below(v) => (String::new(), v.to_string()),
                    StatedValue::Above(v) => (v.to_string(), String::new()),
                };
                let _ = writeln!(out, "paper,,{},{n},{metric},,,,{low},{high}", claim.policy);
            }
        }
        out
    }
}

/// Returns the title of a figure, with its figure in the paper for an unchanged preset, or else the changed fields. It
/// begins with `subject`, by which `reveille report` orders pictures.
pub(super) fn figure_title(subject: &str, paper_figure: &str, condition: &RunCondition) -> String {
    if condition.is_unchanged_preset() {
        return format!("{subject} ({paper_figure})");
    }
    let changed = condition
        .all_changes()
        .map(|(path, value)| format!(", {path} = {value}"));
    format!("{subject}{}", changed.collect::<String>())
}

/// Formats the smallest and the largest number of runs per point as text.
pub(super) fn runs_in_words(per_cell: (usize, usize)) -> String {
    match per_cell {
        (1, 1) => "one run".to_owned(),
        (least, most) if least == most => format!("{most} runs"),
        (least, most) => format!("{least} to {most} runs"),
    }
}

/// Escapes text without line breaks for a CSV cell.
pub(super) fn csv_cell(text: &str) -> String {
    if text.contains([',', '"']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

/// Returns the part of an interval of `metric` that its values can have: no drawn metric is negative, and none in % is
/// above 100.
pub(super) fn possible_values(metric: &str, [low, high]: [f64; 2]) -> [f64; 2] {
    let most = if metric.ends_with("_pct") { 100.0 } else { f64::INFINITY };
    [low.max(0.0), high.min(most)]
}

/// Formats the half-width of an interval as a CSV cell; empty for NaN, as after a single run.
pub(super) fn half_width_cell(half_width: f64) -> String {
    if half_width.is_nan() {
        String::new()
    } else {
        half_width.to_string()
    }
}

/// Whether a mean is 0, which a logarithmic axis cannot hold.
fn has_zero_mean(series: &[Series]) -> bool {
    series.iter().flat_map(|s| &s.points).any(|p| p.y <= 0.0)
}
