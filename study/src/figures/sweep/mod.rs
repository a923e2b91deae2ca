//! Figures of arbitrary sweeps: a metric against a scenario field, with a line for each value of another field.
//!
//! A [`SweepFigureSpec`] names the fields and the metric. [`SweepFigureSpec::draw`] draws a figure for each combination
//! of the values of all other fields in which the runs differ. The caption names these values. The figures show nothing
//! from the paper.

mod points;

use std::fmt::Write as _;

use reveille_common::score::Metrics;

use self::points::{SweepPoint, points};
use super::as_file;
use super::chart::{Chart, ChartPoint, Interval, Series};
use super::error::FigureError;
use super::results::Results;
use super::scale::Scale;
use super::study::{csv_cell, csv_half, runs_in_words};
use super::style::Style;

pub use self::points::{DEVICES, POLICY};

/// Largest number of figures per request.
const MOST_PICTURES: usize = 24;
/// Largest number of lines in a figure, unless the lines are policies.
const MOST_LINES: usize = 6;

/// Specification of a sweep figure.
#[derive(Clone, Debug)]
pub struct SweepFigureSpec {
    /// Field along x.
    pub x: String,
    /// Metric along y.
    pub y: String,
    /// Field with one line for each of its values.
    pub by: String,
    /// Filter: only runs with these values of these fields.
    pub only: Vec<(String, String)>,
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
    /// Fields with their values that distinguish the figure from the others.
    pub facet: Facet,
    /// The chart.
    pub chart: Chart,
    /// The plotted data as CSV.
    pub csv: String,
    /// Lines without a value of the metric.
    pub undefined: Vec<String>,
}

impl SweepFigureSpec {
    /// Draws the figures, in the order in which the tables introduce their facets.
    ///
    /// # Errors
    /// A field, value or metric does not exist, or the field along x has non-numeric values. Also returned for too many
    /// lines or figures.
    pub fn draw(&self, results: &Results) -> Result<Vec<SweepFigure>, FigureError> {
        if Metrics::named(&self.y).is_none() {
            let known = Metrics::ALL.map(|metric| metric.name).join(", ");
            return Err(FigureError::Metric {
                name: self.y.clone(),
                known,
            });
        }
        let points = self.chosen(points(results, &self.by))?;
        let facets = facets(&points, [&self.x, &self.by]);
        let mut groups: Vec<(Facet, Vec<&SweepPoint<'_>>)> = Vec::new();
        for point in &points {
            let own: Facet = facets
                .iter()
                .map(|field| (field.clone(), point.value(field).unwrap_or("–").to_owned()))
                .collect();
            let count = groups.len();
            match groups.iter_mut().find(|(known, _)| *known == own) {
                Some((_, group)) => group.push(point),
                None if count == MOST_PICTURES => return Err(self.too_many(&facets)),
                None => groups.push((own, vec![point])),
            }
        }
        let pictures = groups.into_iter().map(|(facet, group)| self.picture(facet, &group));
        let pictures: Vec<SweepFigure> = pictures.collect::<Result<Vec<_>, _>>()?.into_iter().flatten().collect();
        if pictures.is_empty() {
            return Err(FigureError::Undefined { metric: self.y.clone() });
        }
        Ok(pictures)
    }

    /// Returns the file name, without extension, of the figure with this `facet`.
    pub fn name(&self, facet: &[(String, String)]) -> String {
        let mut name = format!("sweep-{}-{}", self.y, self.x);
        if self.by != POLICY {
            let _ = write!(name, "-by-{}", self.by);
        }
        for (field, value) in facet {
            let _ = write!(name, "-{field}-{value}");
        }
        as_file(&name)
    }

    fn too_many(&self, facets: &[String]) -> FigureError {
        FigureError::Facets {
            most: MOST_PICTURES,
            fields: facets.join(", "),
            x: self.x.clone(),
            by: self.by.clone(),
        }
    }

    /// Checks all fields and returns the points that pass the filter.
    fn chosen<'r>(&self, points: Vec<SweepPoint<'r>>) -> Result<Vec<SweepPoint<'r>>, FigureError> {
        let known = |field: &str| {
            let is_there = points.iter().any(|point| point.value(field).is_some());
            is_there.then_some(()).ok_or_else(|| FigureError::Field {
                name: field.to_owned(),
                known: fields(&points).join(", "),
            })
        };
        known(&self.x)?;
        known(&self.by)?;
        if self.x == self.by {
            return Err(FigureError::Twice { field: self.x.clone() });
        }
        for (field, wanted) in &self.only {
            known(field)?;
            if !points.iter().any(|point| is_value(point.value(field), wanted)) {
                return Err(FigureError::Value {
                    field: field.clone(),
                    value: wanted.clone(),
                    known: values(&points, field).join(", "),
                });
            }
        }
        let is_wanted = |point: &SweepPoint<'_>| {
            let mut only = self.only.iter();
            only.all(|(field, wanted)| is_value(point.value(field), wanted)) && point.value(&self.x).is_some()
        };
        let points: Vec<SweepPoint<'r>> = points.into_iter().filter(is_wanted).collect();
        if points.is_empty() {
            let only = self.only.iter().map(|(field, wanted)| format!("{field} = {wanted}"));
            return Err(FigureError::Nothing {
                x: self.x.clone(),
                only: only.collect::<Vec<_>>().join(", "),
            });
        }
        if let Some(words) = points.iter().find(|point| point.number(&self.x).is_none()) {
            return Err(FigureError::Words {
                field: self.x.clone(),
                value: words.value(&self.x).unwrap_or_default().to_owned(),
            });
        }
        Ok(points)
    }

    /// Draws the figure of `points`; `None` if the metric is undefined in all of them.
    fn picture(&self, facet: Facet, points: &[&SweepPoint<'_>]) -> Result<Option<SweepFigure>, FigureError> {
        let mut lines: Vec<(&str, Vec<(f64, &SweepPoint<'_>)>)> = Vec::new();
        for point in points {
            let (name, x) = (point.value(&self.by).unwrap_or("–"), point.number(&self.x));
            let Some(x) = x else { continue };
            match lines.iter_mut().find(|(known, _)| *known == name) {
                Some((_, line)) => line.push((x, point)),
                None => lines.push((name, vec![(x, point)])),
            }
        }
        if self.by != POLICY && lines.len() > MOST_LINES {
            return Err(FigureError::Lines {
                field: self.by.clone(),
                count: lines.len(),
                most: MOST_LINES,
            });
        }
        let (mut series, mut undefined) = (Vec::new(), Vec::new());
        for (place, (name, line)) in lines.iter_mut().enumerate() {
            line.sort_by(|a, b| a.0.total_cmp(&b.0));
            let one = self.series(place, name, line);
            if one.samples.is_empty() {
                undefined.push((*name).to_owned());
            } else {
                series.push(one);
            }
        }
        if series.is_empty() {
            return Ok(None);
        }
        let csv = self.csv(&facet, &lines);
        let chart = self.chart(&facet, points, series, &undefined);
        Ok(Some(SweepFigure {
            facet,
            chart,
            csv,
            undefined,
        }))
    }

    fn series(&self, place: usize, name: &str, line: &[(f64, &SweepPoint<'_>)]) -> Series {
        let sample = |(x, point): &(f64, &SweepPoint<'_>)| {
            let reading = point.reading(&self.y)?;
            Some(ChartPoint {
                x: *x,
                y: reading.estimate.mean,
                half: reading.half_width(),
                across: f64::NAN,
            })
        };
        let is_of_policies = self.by == POLICY;
        Series {
            name: if is_of_policies {
                name.to_owned()
            } else {
                format!("{} {name}", self.by)
            },
            style: if is_of_policies {
                Style::of_policy(name)
            } else {
                Style::nth(place)
            },
            joined: true,
            marked: true,
            interval: Interval::Bars,
            samples: line.iter().filter_map(sample).collect(),
        }
    }

    fn chart(
        &self,
        facet: &[(String, String)],
        points: &[&SweepPoint<'_>],
        series: Vec<Series>,
        undefined: &[String],
    ) -> Chart {
        let samples = || series.iter().flat_map(|s| &s.samples);
        let is_difference = Metrics::named(&self.y).is_some_and(|metric| metric.is_difference);
        let ends = |s: &ChartPoint| {
            let half = if s.half.is_finite() { s.half } else { 0.0 };
            let low = s.y - half;
            [if is_difference { low } else { low.max(s.y.min(0.0)) }, s.y + half]
        };
        let has_zero = samples().any(|s| s.y <= 0.0);
        let axis = Metrics::axis(&self.y);
        Chart {
            title: format!("{} against {}", self.y, self.x),
            x_label: self.x.clone(),
            y_label: axis.to_owned(),
            x: x_scale(samples().map(|s| s.x), self.is_log_x),
            y: if self.is_log_y {
                y_log(samples().flat_map(|s| [s.y, ends(s)[1]]), has_zero)
            } else {
                Scale::linear(samples().flat_map(ends), true)
            },
            marks: Vec::new(),
            spans: Vec::new(),
            notes: Vec::new(),
            zero_below: self.is_log_y && has_zero,
            caption: self.caption(facet, points, undefined, self.is_log_y && has_zero),
            series,
        }
    }

    fn caption(
        &self,
        facet: &[(String, String)],
        points: &[&SweepPoint<'_>],
        undefined: &[String],
        has_zero: bool,
    ) -> String {
        let counts = || points.iter().map(|point| point.runs());
        let runs = runs_in_words((counts().min().unwrap_or(0), counts().max().unwrap_or(0)));
        let mut text = format!("{runs} per point, mean with its 95 % interval as band and bar.");
        let told: Vec<String> = self.point_rows(facet, points);
        if !told.is_empty() {
            let _ = write!(text, " With {}.", told.join(", "));
        }
        if has_zero {
            text.push_str(" At the lower border: zero.");
        }
        if !undefined.is_empty() {
            let _ = write!(text, " Not defined for {}.", undefined.join(", "));
        }
        text
    }

    /// Returns the fields with equal values in all runs of a figure, as text: first the facet, then the others.
    fn point_rows(&self, facet: &[(String, String)], points: &[&SweepPoint<'_>]) -> Vec<String> {
        let mut told: Vec<String> = facet
            .iter()
            .map(|(field, value)| format!("{field} = {value}"))
            .collect();
        let Some(first) = points.first() else { return told };
        for (field, value) in &first.fields {
            let is_told = [&self.x, &self.by].contains(&field) || facet.iter().any(|(known, _)| known == field);
            if !is_told {
                told.push(format!("{field} = {value}"));
            }
        }
        told
    }

    fn csv(&self, facet: &[(String, String)], lines: &[(&str, Vec<(f64, &SweepPoint<'_>)>)]) -> String {
        let fields: Vec<String> = facet.iter().map(|(field, _)| csv_cell(field)).collect();
        let values: Vec<String> = facet.iter().map(|(_, value)| csv_cell(value)).collect();
        let row = |cells: &[String], rest: &str| {
            let mut row = cells.join(",");
            if !cells.is_empty() {
                row.push(',');
            }
            format!("{row}{rest}\n")
        };
        let head = format!(
            "{},{},metric,mean,half_width_95,runs",
            csv_cell(&self.by),
            csv_cell(&self.x)
        );
        let mut out = row(&fields, &head);
        for (name, line) in lines {
            for (x, point) in line {
                if let Some(reading) = point.reading(&self.y) {
                    let (mean, half) = (reading.estimate.mean, csv_half(reading.half_width()));
                    let (name, runs) = (csv_cell(name), reading.estimate.runs);
                    out.push_str(&row(&values, &format!("{name},{x},{},{mean},{half},{runs}", self.y)));
                }
            }
        }
        out
    }
}

/// Returns a note that explains why there are several `pictures`; `None` for a single one.
pub fn several(pictures: &[SweepFigure]) -> Option<String> {
    let [first, _, ..] = pictures else { return None };
    let fields: Vec<&str> = first.facet.iter().map(|(field, _)| field.as_str()).collect();
    Some(format!(
        "the runs also differ in {}: {} figures, one for each combination of values",
        fields.join(", "),
        pictures.len()
    ))
}

/// Returns the canonical name of a field. `n` and `policy.name` are the names used in tables and scenarios.
pub fn named(field: &str) -> &str {
    match field {
        "n" => DEVICES,
        "policy.name" => POLICY,
        other => other,
    }
}

/// Creates the scale of the x axis. A linear axis has a margin at both ends, so that markers are not clipped.
fn x_scale(values: impl Iterator<Item = f64> + Clone, is_log: bool) -> Scale {
    // Without a value above 0 there is no logarithmic axis; a linear one still shows the points.
    if let Some(scale) = is_log.then(|| Scale::log(values.clone())).flatten() {
        return scale;
    }
    let (from, to) = Scale::linear(values, false).ends();
    let room = 0.04 * (to - from);
    Scale::Linear {
        from: from - room,
        to: to + room,
    }
}

/// Creates the scale of a logarithmic y axis, with an extra decade at the bottom if there are zero values.
fn y_log(values: impl Iterator<Item = f64>, has_zero: bool) -> Scale {
    let scale = Scale::log(values).unwrap_or(Scale::Log { from: 0.01, to: 1.0 });
    let (from, to) = scale.ends();
    Scale::Log {
        // Values of 0 have no logarithm; the axis begins a decade lower, and they are drawn on its border.
        from: if has_zero { from / 10.0 } else { from },
        to,
    }
}

/// Returns whether `value` equals `wanted`, as a number or as text.
fn is_value(value: Option<&str>, wanted: &str) -> bool {
    let Some(value) = value else { return false };
    let is_same_number = || {
        let (a, b) = (value.parse::<f64>().ok()?, wanted.parse::<f64>().ok()?);
        Some(a.total_cmp(&b).is_eq())
    };
    value == wanted || is_same_number().unwrap_or(false)
}

/// Returns the names of all fields of `points`, in order of first occurrence.
fn fields(points: &[SweepPoint<'_>]) -> Vec<String> {
    let mut fields: Vec<String> = Vec::new();
    for (field, _) in points.iter().flat_map(|point| &point.fields) {
        if !fields.contains(field) {
            fields.push(field.clone());
        }
    }
    fields
}

/// Returns the values of `field` among `points`, in order of first occurrence.
fn values(points: &[SweepPoint<'_>], field: &str) -> Vec<String> {
    let mut values: Vec<String> = Vec::new();
    for value in points.iter().filter_map(|point| point.value(field)) {
        if !values.iter().any(|known| known == value) {
            values.push(value.to_owned());
        }
    }
    values
}

/// Returns the fields in which `points` differ, except `drawn`.
fn facets(points: &[SweepPoint<'_>], drawn: [&String; 2]) -> Vec<String> {
    let differs = |field: &String| {
        // The index is valid: `chosen` has rejected an empty list.
        let first = points[0].value(field);
        points.iter().any(|point| point.value(field) != first)
    };
    let all = fields(points).into_iter();
    all.filter(|field| !drawn.contains(&field) && differs(field)).collect()
}
