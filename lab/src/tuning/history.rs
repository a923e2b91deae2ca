//! The points of a tuning and their CSV file: the description of the tuning in comment lines, then one line per point.
//! A resumed tuning continues from this file; `figures tuning` draws it. Numbers read back as the same bits. `tuner`
//! reads and writes the file; `plan` defines the entries of the description.

use std::fmt::Write as _;

use super::evaluation::{Evaluation, TuningPoint};
use super::ranges::WeightPair;

/// The first line, with the version of the format: a history with another first line is refused. Raise the version with
/// a change of the columns.
const FIRST_LINE: &str = "# reveille tuning 1";

/// Returns the line with the names of the columns.
fn column_line() -> String {
    format!("number,mu1,mu2,{}", Evaluation::NAMES.join(","))
}

/// The points of a tuning, in order of evaluation.
#[derive(Clone, Debug, PartialEq)]
pub struct History {
    /// The description of the tuning: names and values, each without line breaks, and no ` = ` in a name.
    pub header: Vec<(String, String)>,
    /// The points. The number of a point is its index, from 0; people see it from 1.
    pub points: Vec<TuningPoint>,
}

impl History {
    /// Creates the history of a tuning without points.
    pub const fn new(header: Vec<(String, String)>) -> Self {
        Self {
            header,
            points: Vec::new(),
        }
    }

    /// Returns the pairs with their objectives, in order of evaluation.
    pub(crate) fn objectives(&self) -> Vec<(WeightPair, f64)> {
        let points = self.points.iter();
        points
            .map(|point| (point.weights, point.evaluation.objective))
            .collect()
    }

    /// Returns the numbers of the points, best first, and the earlier one first if equal.
    pub fn ranked(&self) -> Vec<usize> {
        let mut numbers: Vec<usize> = (0..self.points.len()).collect();
        let objective = |number: usize| self.points[number].evaluation.objective;
        // A stable sort keeps equal points in order of evaluation.
        numbers.sort_by(|&a, &b| objective(b).total_cmp(&objective(a)));
        numbers
    }

    /// The header's value of `name`; empty if it has none.
    pub fn header_value(&self, name: &str) -> &str {
        let entry = self.header.iter().find(|(key, _)| key == name);
        entry.map_or("", |(_, value)| value)
    }

    /// The two limits of a range in the header, which `TuningPlan::header` writes as `FROM to TO`.
    pub fn range(&self, name: &str) -> Option<(f64, f64)> {
        let (from, to) = self.header_value(name).split_once(" to ")?;
        Some((from.parse().ok()?, to.parse().ok()?))
    }

    /// Lists the differences from a tuning with `header` and `design`, one phrase for each. Entries of the history that
    /// `header` lacks are ignored.
    pub fn differences(&self, header: &[(String, String)], design: &[WeightPair]) -> Vec<String> {
        let differing = header.iter().filter(|(name, value)| self.header_value(name) != value);
        let mut differences: Vec<String> = differing
            .map(|(name, value)| format!("{name}: {} there, {value} here", self.header_value(name)))
            .collect();
        let bits = |pair: &WeightPair| pair.map(f64::to_bits);
        let mut points_of_design = self.points.iter().zip(design);
        // With another header the design differs for that reason alone.
        if differences.is_empty() && points_of_design.any(|(point, pair)| bits(&point.weights) != bits(pair)) {
            differences.push("other pairs at the start".to_owned());
        }
        differences
    }

    /// Returns the file's text. Numbers are written in full, so that reading restores the same bits.
    pub(crate) fn to_csv(&self) -> String {
        let mut text = format!("{FIRST_LINE}\n");
        for (name, value) in &self.header {
            let _ = writeln!(text, "# {name} = {value}");
        }
        let _ = writeln!(text, "{}", column_line());
        for (number, TuningPoint { weights, evaluation }) in self.points.iter().enumerate() {
            let _ = write!(text, "{number}");
            for value in weights.iter().chain(&evaluation.values()) {
                let _ = write!(text, ",{value}");
            }
            text.push('\n');
        }
        text
    }

    /// Parses `text`. Also returns whether an incomplete last line was dropped.
    ///
    /// # Errors
    /// If the text is not a history; the error is the cause.
    pub fn parse(text: &str) -> Result<(Self, bool), String> {
        let is_torn = !text.ends_with('\n');
        let complete_lines = text.rfind('\n').map_or("", |newline| &text[..newline]);
        let mut lines = complete_lines.lines();
        if lines.next() != Some(FIRST_LINE) {
            return Err(format!("it does not begin with `{FIRST_LINE}`"));
        }
        let mut history = Self::new(Vec::new());
        let first_other_line = loop {
            match lines.next() {
                Some(line) if line.starts_with('#') => {
                    let entry = line.trim_start_matches("# ").split_once(" = ");
                    let (name, value) = entry.ok_or_else(|| format!("`{line}` is malformed"))?;
                    history.header.push((name.to_owned(), value.to_owned()));
                }
                other => break other,
            }
        };
        if first_other_line != Some(column_line().as_str()) {
            return Err("it does not have the columns of a history".to_owned());
        }
        for (number, line) in lines.enumerate() {
            let point = parse_point(number, line).ok_or_else(|| format!("point {number} reads `{line}`"))?;
            history.points.push(point);
        }
        Ok((history, is_torn))
    }
}

/// Parses the line of the point `number`. Returns `None` if it has another number, or values that no tuning writes.
fn parse_point(number: usize, line: &str) -> Option<TuningPoint> {
    let (written_number, value_texts) = line.split_once(',')?;
    let values: Vec<f64> = value_texts
        .split(',')
        .map(str::parse)
        .collect::<Result<_, _>>()
        .ok()
        .filter(|_| written_number.parse() == Ok(number))?;
    let (weights, values) = values.split_first_chunk::<2>()?;
    let evaluation = Evaluation::from_values(values.try_into().ok()?);
    // Half-widths are NaN with a single run, and some means may be NaN too. The proposer only uses these three.
    let is_finite = weights
        .iter()
        .chain([&evaluation.objective])
        .all(|value| value.is_finite());
    (is_finite && weights.iter().all(|weight| *weight > 0.0)).then_some(TuningPoint {
        weights: *weights,
        evaluation,
    })
}
