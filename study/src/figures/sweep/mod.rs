//! Figures of arbitrary sweeps: a metric against a scenario field, with a line for each value of another field.
//!
//! A [`SweepFigureSpec`] names the fields and the metric. [`SweepFigureSpec::draw`] draws a figure for each combination
//! of the values of all other fields in which the runs differ. The caption names these values. The figures show
//! nothing from the paper. `reveille figures`, also without `sweep`, and the Python package draw them.
//!
//! The columns of the CSV are a file format, and users' scripts read the file names. Names of fields are parts of both.

mod points;

use std::fmt::Write as _;

use reveille_common::score::Metrics;

use self::points::{SweepPoint, sweep_points};
use super::chart::{Chart, ChartPoint, Interval, Series};
use super::error::FigureError;
use super::font::{Weight, has_all_glyphs, text_width};
use super::results::Results;
use super::scale::Scale;
use super::study::{csv_cell, half_width_cell, runs_in_words};
use super::style::{COLUMN_WIDTH, Style, TEXT_SIZE};
use super::to_file_name;
use crate::first_letter::{lower_first, upper_first};

pub use self::points::{DEVICES, POLICY, SweptNumbers};

/// Largest number of figures per request.
const MAX_FIGURES: usize = 24;
/// Largest number of lines in a figure, unless the lines are policies: the number of styles of
/// [`Style::from_palette`].
const MAX_LINES: usize = 6;

/// Specification of a sweep figure. Fields have the names that [`canonical_field`] returns.
#[derive(Clone, Debug)]
pub struct SweepFigureSpec {
    /// Field along x.
    pub x_field: String,
    /// Metric along y.
    pub metric: String,
    /// Field with one line for each of its values.
    pub line_field: String,
    /// Filter: only runs with these values of these fields.
    pub filter: Vec<(String, String)>,
    /// Whether x is logarithmic.
    pub is_log_x: bool,
    /// Whether y is logarithmic.
    pub is_log_y: bool,
}

/// Fields with their values that distinguish one figure from the others.
pub(crate) type Facet = Vec<(String, String)>;

/// A sweep figure.
#[derive(Clone, Debug)]
pub struct SweepFigure {
    /// Facet of the figure; empty if the runs differ in no other field.
    pub facet: Facet,
    /// The chart.
    pub chart: Chart,
    /// The plotted data as CSV.
    pub csv: String,
    /// Lines without a value of the metric.
    pub lines_without_value: Vec<String>,
}

impl SweepFigureSpec {
    /// Draws the figures, in the order in which the tables introduce their facets.
    ///
    /// # Errors
    /// A field, value or metric does not exist, or the field along x has non-numeric values. Also returned for too many
    /// lines or figures.
    pub fn draw(&self, results: &Results) -> Result<Vec<SweepFigure>, FigureError> {
        if Metrics::find(&self.metric).is_none() {
            let known = Metrics::ALL.map(|metric| metric.name).join(", ");
            return Err(FigureError::UnknownMetric {
                name: self.metric.clone(),
                known,
            });
        }
        let points = self.select_points(sweep_points(results, &self.line_field))?;
        let other_fields = facet_fields(&points, [&self.x_field, &self.line_field]);
        let mut groups: Vec<(Facet, Vec<&SweepPoint<'_>>)> = Vec::new();
        for point in &points {
            let facet: Facet = other_fields
                .iter()
                .map(|field| (field.clone(), point.value(field).unwrap_or("–").to_owned()))
                .collect();
            let count = groups.len();
            match groups.iter_mut().find(|(known, _)| *known == facet) {
                Some((_, group)) => group.push(point),
                None if count == MAX_FIGURES => return Err(self.too_many_figures(&other_fields)),
                None => groups.push((facet, vec![point])),
            }
        }
        let figures = groups.into_iter().map(|(facet, group)| self.draw_facet(facet, &group));
        let figures: Vec<SweepFigure> = figures.collect::<Result<Vec<_>, _>>()?.into_iter().flatten().collect();
        if figures.is_empty() {
            return Err(FigureError::Undefined {
                metric: self.metric.clone(),
            });
        }
        Ok(figures)
    }

    /// Returns the file name, without extension, of the figure with this `facet`.
    pub fn file_name(&self, facet: &[(String, String)]) -> String {
        let mut name = format!("sweep-{}-{}", self.metric, self.x_field);
        if self.line_field != POLICY {
            let _ = write!(name, "-by-{}", self.line_field);
        }
        for (field, value) in facet {
            let _ = write!(name, "-{field}-{value}");
        }
        to_file_name(&name)
    }

    fn too_many_figures(&self, other_fields: &[String]) -> FigureError {
        FigureError::TooManyFacets {
            most: MAX_FIGURES,
            fields: other_fields.join(", "),
            x: self.x_field.clone(),
            by: self.line_field.clone(),
        }
    }

    /// Checks all fields and returns the points that pass the filter and have a value of the field along x.
    fn select_points<'r>(&self, points: Vec<SweepPoint<'r>>) -> Result<Vec<SweepPoint<'r>>, FigureError> {
        let check_field = |field: &str| {
            let is_known = points.iter().any(|point| point.value(field).is_some());
            is_known.then_some(()).ok_or_else(|| FigureError::UnvariedField {
                name: field.to_owned(),
                known: field_names(&points).join(", "),
            })
        };
        check_field(&self.x_field)?;
        check_field(&self.line_field)?;
        if self.x_field == self.line_field {
            return Err(FigureError::SameField {
                field: self.x_field.clone(),
            });
        }
        for (field, value) in &self.filter {
            check_field(field)?;
            if !points.iter().any(|point| equals(point.value(field), value)) {
                return Err(FigureError::UnknownValue {
                    field: field.clone(),
                    value: value.clone(),
                    known: distinct_values(&points, field).join(", "),
                });
            }
        }
        let is_wanted = |point: &SweepPoint<'_>| {
            let mut filters = self.filter.iter();
            filters.all(|(field, value)| equals(point.value(field), value)) && point.value(&self.x_field).is_some()
        };
        let points: Vec<SweepPoint<'r>> = points.into_iter().filter(is_wanted).collect();
        if points.is_empty() {
            let filters = self.filter.iter().map(|(field, value)| format!("{field} = {value}"));
            return Err(FigureError::NoMatchingRun {
                x: self.x_field.clone(),
                only: filters.collect::<Vec<_>>().join(", "),
            });
        }
        if let Some(non_numeric) = points.iter().find(|point| point.number(&self.x_field).is_none()) {
            return Err(FigureError::NotNumeric {
                field: self.x_field.clone(),
                value: non_numeric.value(&self.x_field).unwrap_or_default().to_owned(),
            });
        }
        Ok(points)
    }

    /// Draws the figure of `points`; `None` if the metric is undefined in all of them.
    fn draw_facet(&self, facet: Facet, points: &[&SweepPoint<'_>]) -> Result<Option<SweepFigure>, FigureError> {
        let mut lines: Vec<(&str, Vec<(f64, &SweepPoint<'_>)>)> = Vec::new();
        for point in points {
            let (name, x) = (
                point.value(&self.line_field).unwrap_or("–"),
                point.number(&self.x_field),
            );
            let Some(x) = x else { continue };
            match lines.iter_mut().find(|(known, _)| *known == name) {
                Some((_, line)) => line.push((x, point)),
                None => lines.push((name, vec![(x, point)])),
            }
        }
        if self.line_field != POLICY && lines.len() > MAX_LINES {
            return Err(FigureError::TooManyLines {
                field: self.line_field.clone(),
                count: lines.len(),
                most: MAX_LINES,
            });
        }
        let (mut series, mut without_value) = (Vec::new(), Vec::new());
        for (index, (name, line)) in lines.iter_mut().enumerate() {
            line.sort_by(|a, b| a.0.total_cmp(&b.0));
            let line_series = self.series(index, name, line);
            if line_series.points.is_empty() {
                without_value.push((*name).to_owned());
            } else {
                series.push(line_series);
            }
        }
        if series.is_empty() {
            return Ok(None);
        }
        let csv = self.csv(&facet, &lines);
        let chart = self.chart(&facet, points, series, &without_value);
        Ok(Some(SweepFigure {
            facet,
            chart,
            csv,
            lines_without_value: without_value,
        }))
    }

    fn series(&self, palette_index: usize, name: &str, line: &[(f64, &SweepPoint<'_>)]) -> Series {
        let point = |(x, point): &(f64, &SweepPoint<'_>)| {
            let estimate = point.metric_estimate(&self.metric)?;
            Some(ChartPoint {
                x: *x,
                y: estimate.mean_estimate.mean,
                y_half_width: estimate.half_width(),
                x_half_width: f64::NAN,
            })
        };
        let is_of_policies = self.line_field == POLICY;
        Series {
            name: if is_of_policies {
                name.to_owned()
            } else {
                format!("{} {name}", self.line_field)
            },
            style: if is_of_policies {
                Style::of_policy(name)
            } else {
                Style::from_palette(palette_index)
            },
            is_joined: true,
            has_markers: true,
            interval: Interval::Bars,
            points: line.iter().filter_map(point).collect(),
        }
    }

    fn chart(
        &self,
        facet: &[(String, String)],
        points: &[&SweepPoint<'_>],
        series: Vec<Series>,
        without_value: &[String],
    ) -> Chart {
        let all_points = || series.iter().flat_map(|s| &s.points);
        let is_difference = Metrics::find(&self.metric).is_some_and(|metric| metric.is_difference);
        let ends = |p: &ChartPoint| {
            let half_width = if p.y_half_width.is_finite() {
                p.y_half_width
            } else {
                0.0
            };
            let low = p.y - half_width;
            [
                if is_difference { low } else { low.max(p.y.min(0.0)) },
                p.y + half_width,
            ]
        };
        let has_zero = all_points().any(|p| p.y <= 0.0);
        let axis = Metrics::axis_label(&self.metric);
        Chart {
            title: self.title(),
            x_label: x_label(&self.x_field),
            y_label: axis.to_owned(),
            x: x_scale(all_points().map(|p| p.x), self.is_log_x),
            y: if self.is_log_y {
                // The lower end of a wide interval near 0 would stretch the axis.
                log_y_scale(
                    all_points().flat_map(|p| [ends(p)[0].max(0.5 * p.y), ends(p)[1]]),
                    has_zero,
                )
            } else {
                Scale::linear(all_points().flat_map(ends), true)
            },
            marks: Vec::new(),
            spans: Vec::new(),
            notes: Vec::new(),
            has_zero_at_border: self.is_log_y && has_zero,
            caption: self.caption(facet, points, without_value, self.is_log_y && has_zero),
            series,
        }
    }

    /// Names the metric and the field along x, each with its identifier in brackets.
    fn title(&self) -> String {
        let axis = Metrics::axis_label(&self.metric);
        let x = match field_in_words(&self.x_field) {
            Some((words, _)) => format!("{words} ({})", self.x_field),
            None => self.x_field.clone(),
        };
        format!("{} ({}) against {x}", upper_first(axis), self.metric)
    }

    fn caption(
        &self,
        facet: &[(String, String)],
        points: &[&SweepPoint<'_>],
        without_value: &[String],
        has_zero: bool,
    ) -> String {
        let counts = || points.iter().map(|point| point.run_count());
        let runs = runs_in_words((counts().min().unwrap_or(0), counts().max().unwrap_or(0)));
        let mut text = format!("{runs} per point, mean with its 95 % interval as band and bar.");
        let values: Vec<String> = self.common_values(facet, points);
        if !values.is_empty() {
            let _ = write!(text, " With {}.", values.join(", "));
        }
        if has_zero {
            text.push_str(" At the lower border: zero.");
        }
        if !without_value.is_empty() {
            let _ = write!(text, " Not defined for {}.", without_value.join(", "));
        }
        text
    }

    /// Returns the fields with equal values in all runs of a figure, as text: first the facet, then the others.
    fn common_values(&self, facet: &[(String, String)], points: &[&SweepPoint<'_>]) -> Vec<String> {
        let mut texts: Vec<String> = facet
            .iter()
            .map(|(field, value)| format!("{field} = {value}"))
            .collect();
        let Some(first) = points.first() else { return texts };
        for (field, value) in &first.fields {
            let is_listed = [&self.x_field, &self.line_field].contains(&field)
                || facet.iter().any(|(facet_field, _)| facet_field == field);
            if !is_listed {
                texts.push(format!("{field} = {value}"));
            }
        }
        texts
    }

    fn csv(&self, facet: &[(String, String)], lines: &[(&str, Vec<(f64, &SweepPoint<'_>)>)]) -> String {
        let fields: Vec<String> = facet.iter().map(|(field, _)| csv_cell(field)).collect();
        let values: Vec<String> = facet.iter().map(|(_, value)| csv_cell(value)).collect();
        let row = |cells: &[String], last_cells: &str| {
            let mut row = cells.join(",");
            if !cells.is_empty() {
                row.push(',');
            }
            format!("{row}{last_cells}\n")
        };
        let head = format!(
            "{},{},metric,mean,half_width_95,runs",
            csv_cell(&self.line_field),
            csv_cell(&self.x_field)
        );
        let mut out = row(&fields, &head);
        for (name, line) in lines {
            for (x, point) in line {
                if let Some(metric_estimate) = point.metric_estimate(&self.metric) {
                    let (mean, half_width) = (
                        metric_estimate.mean_estimate.mean,
                        half_width_cell(metric_estimate.half_width()),
                    );
                    let (name, runs) = (csv_cell(name), metric_estimate.mean_estimate.runs);
                    out.push_str(&row(
                        &values,
                        &format!("{name},{x},{},{mean},{half_width},{runs}", self.metric),
                    ));
                }
            }
        }
        out
    }
}

/// Returns a note that explains why there are several `figures`; `None` for a single one.
pub fn note_on_several(figures: &[SweepFigure]) -> Option<String> {
    let [first, _, ..] = figures else { return None };
    let fields: Vec<&str> = first.facet.iter().map(|(field, _)| field.as_str()).collect();
    Some(format!(
        "the runs also differ in {}: {} figures, one for each combination of values",
        fields.join(", "),
        figures.len()
    ))
}

/// Returns the name of a field in figures. `n` and `policy.name` are its names in tables and scenarios; renamed fields
/// have their current name.
pub fn canonical_field(field: &str) -> String {
    match field {
        "n" => DEVICES.to_owned(),
        "policy.name" => POLICY.to_owned(),
        other => reveille_bs::scenario::current_field(other),
    }
}

/// Returns the first clause of a field's help, with the device class of the field if any, and its unit; `None` without
/// a declared field, or if the figures' font lacks a letter of the clause.
fn field_in_words(field: &str) -> Option<(String, &'static str)> {
    let (of_class, path) = match field.strip_prefix("class.").and_then(|field| field.split_once('.')) {
        Some((class, path)) => (format!(" of class {class}"), path),
        None => (String::new(), field),
    };
    let (_, declared) = reveille_bs::scenario::declaration().field_by_path(path)?;
    let help = declared.help.replace('`', "");
    let ends = [". ", ": ", "; ", " ("].iter().filter_map(|end| help.find(end));
    let clause = help[..ends.min().unwrap_or(help.len())].trim_end_matches('.');
    let words = lower_first(clause) + &of_class;
    let is_legible = |weight| has_all_glyphs(&words, weight);
    (!words.is_empty() && is_legible(Weight::Regular) && is_legible(Weight::Bold)).then_some((words, declared.unit))
}

/// Returns the label of the x axis: name, unit and identifier of the field, shortened to fit below the axis. The title
/// has all three.
fn x_label(field: &str) -> String {
    /// Room below the axis, points.
    const ROOM: f64 = 0.85 * COLUMN_WIDTH;
    let Some((words, unit)) = field_in_words(field) else {
        return field.to_owned();
    };
    let unit = if unit.is_empty() {
        String::new()
    } else {
        format!(", {unit}")
    };
    let labels = [format!("{words}{unit} ({field})"), format!("{words}{unit}")];
    let fitting = labels
        .into_iter()
        .find(|label| text_width(label, Weight::Regular, TEXT_SIZE) <= ROOM);
    fitting.unwrap_or_else(|| format!("{field}{unit}"))
}

/// Creates the scale of the x axis. A linear axis has a margin at both ends, so that markers are not clipped.
fn x_scale(values: impl Iterator<Item = f64> + Clone, is_log: bool) -> Scale {
    // Without a value above 0 there is no logarithmic axis; a linear one still shows the points.
    if let Some(scale) = is_log.then(|| Scale::tight_log(values.clone())).flatten() {
        return scale;
    }
    let (from, to) = Scale::linear(values, false).ends();
    let room = 0.04 * (to - from);
    Scale::Linear {
        from: from - room,
        to: to + room,
    }
}

/// Creates the scale of a logarithmic y axis. With zero values it has whole decades and an extra one at the bottom, as
/// in `study`.
fn log_y_scale(values: impl Iterator<Item = f64> + Clone, has_zero: bool) -> Scale {
    let fallback = Scale::Log { from: 0.01, to: 1.0 };
    if !has_zero {
        return Scale::tight_log(values).unwrap_or(fallback);
    }
    let (from, to) = Scale::log(values).unwrap_or(fallback).ends();
    Scale::Log {
        // Values of 0 have no logarithm; the axis begins a decade lower, and they are drawn on its border.
        from: from / 10.0,
        to,
    }
}

/// Returns whether `value` equals `wanted`, as a number or as text; false without a value.
fn equals(value: Option<&str>, wanted: &str) -> bool {
    let Some(value) = value else { return false };
    let is_same_number = || {
        let (a, b) = (value.parse::<f64>().ok()?, wanted.parse::<f64>().ok()?);
        Some(a.total_cmp(&b).is_eq())
    };
    value == wanted || is_same_number().unwrap_or(false)
}

/// Returns the names of all fields of `points`, in order of first occurrence.
fn field_names(points: &[SweepPoint<'_>]) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for (field, _) in points.iter().flat_map(|point| &point.fields) {
        if !names.contains(field) {
            names.push(field.clone());
        }
    }
    names
}

/// Returns the values of `field` among `points`, in order of first occurrence.
fn distinct_values(points: &[SweepPoint<'_>], field: &str) -> Vec<String> {
    let mut values: Vec<String> = Vec::new();
    for value in points.iter().filter_map(|point| point.value(field)) {
        if !values.iter().any(|known| known == value) {
            values.push(value.to_owned());
        }
    }
    values
}

/// Returns the fields in which `points`, at least one, differ, except `drawn_fields`.
fn facet_fields(points: &[SweepPoint<'_>], drawn_fields: [&String; 2]) -> Vec<String> {
    let differs = |field: &String| {
        // `select_points` has rejected an empty list.
        let first = points[0].value(field);
        points.iter().any(|point| point.value(field) != first)
    };
    let names = field_names(points).into_iter();
    names
        .filter(|field| !drawn_fields.contains(&field) && differs(field))
        .collect()
}
