//! The points of a tuning and their file: CSV with what the tuning is in lines of comment, one line for each point.

use std::fmt::Write as _;

use super::evaluation::{Evaluation, Point};
use super::ranges::Pair;

/// The first line of a history.
const FIRST: &str = "# reveille tuning 1";

/// The line above the points.
fn columns() -> String {
    format!("number,mu1,mu2,{}", Evaluation::NAMES.join(","))
}

/// The points of a tuning, in the order in which they were tried.
#[derive(Clone, Debug, PartialEq)]
pub struct History {
    /// What the tuning is, by name.
    pub header: Vec<(String, String)>,
    /// The points.
    pub points: Vec<Point>,
}

impl History {
    /// The history of a tuning that has not begun.
    pub const fn new(header: Vec<(String, String)>) -> Self {
        Self {
            header,
            points: Vec::new(),
        }
    }

    /// The pairs with the objective of each.
    pub fn objectives(&self) -> Vec<(Pair, f64)> {
        let points = self.points.iter();
        points
            .map(|point| (point.weights, point.evaluation.objective))
            .collect()
    }

    /// The numbers of the points, best first; of equals the earlier first.
    pub fn ranked(&self) -> Vec<usize> {
        let mut numbers: Vec<usize> = (0..self.points.len()).collect();
        let objective = |number: usize| self.points[number].evaluation.objective;
        numbers.sort_by(|&a, &b| objective(b).total_cmp(&objective(a)));
        numbers
    }

    /// What the header says of `name`; nothing if it does not.
    pub fn says(&self, name: &str) -> &str {
        let own = self.header.iter().find(|(own, _)| own == name);
        own.map_or("", |(_, value)| value)
    }

    /// The two numbers of a range in the header.
    pub fn range(&self, name: &str) -> Option<(f64, f64)> {
        let (from, to) = self.says(name).split_once(" to ")?;
        Some((from.parse().ok()?, to.parse().ok()?))
    }

    /// Why this is not the history of a tuning with `header` and `design`, a phrase for each reason.
    pub fn differences(&self, header: &[(String, String)], design: &[Pair]) -> Vec<String> {
        let other = header.iter().filter(|(name, value)| self.says(name) != value);
        let mut why: Vec<String> = other
            .map(|(name, value)| format!("{name}: {} there, {value} here", self.says(name)))
            .collect();
        let bits = |pair: &Pair| pair.map(f64::to_bits);
        let mut first = self.points.iter().zip(design);
        if why.is_empty() && first.any(|(point, pair)| bits(&point.weights) != bits(pair)) {
            why.push("other pairs at the start".to_owned());
        }
        why
    }

    /// The file. Numbers are written in full: reading them gives the same bits.
    pub fn to_csv(&self) -> String {
        let mut out = format!("{FIRST}\n");
        for (name, value) in &self.header {
            let _ = writeln!(out, "# {name} = {value}");
        }
        let _ = writeln!(out, "{}", columns());
        for (number, Point { weights, evaluation }) in self.points.iter().enumerate() {
            let _ = write!(out, "{number}");
            for value in weights.iter().chain(&evaluation.values()) {
                let _ = write!(out, ",{value}");
            }
            out.push('\n');
        }
        out
    }

    /// The history in `text`, and whether half a line at its end was left out.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn parse(text: &str) -> Result<(Self, bool), String> {
        let torn = !text.ends_with('\n');
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        let mut lines = whole.lines();
        if lines.next() != Some(FIRST) {
            return Err(format!("it does not begin with `{FIRST}`"));
        }
        let mut history = Self::new(Vec::new());
        let found = loop {
            match lines.next() {
                Some(line) if line.starts_with('#') => {
                    let pair = line.trim_start_matches("# ").split_once(" = ");
                    let (name, value) = pair.ok_or_else(|| format!("`{line}` says nothing"))?;
                    history.header.push((name.to_owned(), value.to_owned()));
                }
                other => break other,
            }
        };
        if found != Some(columns().as_str()) {
            return Err("its columns are not those of a history".to_owned());
        }
        for (number, line) in lines.enumerate() {
            let point = point(number, line).ok_or_else(|| format!("point {number} reads `{line}`"))?;
            history.points.push(point);
        }
        Ok((history, torn))
    }
}

/// The point `number` that `line` tells of.
fn point(number: usize, line: &str) -> Option<Point> {
    let (own, rest) = line.split_once(',')?;
    let values: Vec<f64> = rest
        .split(',')
        .map(str::parse)
        .collect::<Result<_, _>>()
        .ok()
        .filter(|_| own.parse() == Ok(number))?;
    let (weights, values) = values.split_first_chunk::<2>()?;
    let evaluation = Evaluation::of(values.try_into().ok()?);
    let is_finite = weights
        .iter()
        .chain([&evaluation.objective])
        .all(|value| value.is_finite());
    (is_finite && weights.iter().all(|weight| *weight > 0.0)).then_some(Point {
        weights: *weights,
        evaluation,
    })
}
