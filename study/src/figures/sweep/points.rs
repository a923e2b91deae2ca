//! Cells of the merged tables as points with named fields, the input of [`super::SweepFigureSpec`]. The names that
//! `point_fields` adds to the fields of scenarios are values of options, and parts of file names and CSV files.

use reveille_lab::metric_estimate::MetricEstimate;

use super::super::results::{Results, RunCondition};

/// Name of the field for N in every table.
pub const DEVICES: &str = "devices";
/// Name of the field for the policy in every table.
pub const POLICY: &str = "policy";

/// One cell of a result table.
pub(super) struct SweepPoint<'r> {
    condition: &'r RunCondition,
    policy: &'r str,
    n: u32,
    /// All fields of the cell that can be drawn, with their values.
    pub fields: Vec<(String, String)>,
}

impl SweepPoint<'_> {
    /// Returns the value of `field`.
    pub(super) fn value(&self, field: &str) -> Option<&str> {
        let known = self.fields.iter().find(|(path, _)| path == field);
        known.map(|(_, value)| value.as_str())
    }

    /// Returns the value of `field`, if it is a finite number.
    pub(super) fn number(&self, field: &str) -> Option<f64> {
        let number: f64 = self.value(field)?.parse().ok()?;
        number.is_finite().then_some(number)
    }

    /// Returns the estimate of `metric` over the runs.
    pub(super) fn metric_estimate(&self, metric: &str) -> Option<MetricEstimate> {
        self.condition.metric_estimate(self.policy, self.n, metric)
    }

    /// Number of runs.
    pub(super) fn run_count(&self) -> usize {
        self.condition.runs(self.policy, self.n).count()
    }
}

/// Returns the cells of `results` as points. If lines are policies, a policy with another ranking of wake-ups gets its
/// own line. Otherwise the ranking is an ordinary field.
pub(super) fn sweep_points<'r>(results: &'r Results, line_field: &str) -> Vec<SweepPoint<'r>> {
    let conditions = if line_field == POLICY {
        &results.conditions
    } else {
        &results.by_ranking
    };
    let mut points = Vec::new();
    for condition in conditions {
        for policy in condition.policies() {
            for n in condition.device_counts(policy) {
                points.push(SweepPoint {
                    condition,
                    policy,
                    n,
                    fields: point_fields(condition, policy, n),
                });
            }
        }
    }
    points
}

fn point_fields(condition: &RunCondition, policy: &str, n: u32) -> Vec<(String, String)> {
    let of_every_cell = [
        ("preset", condition.preset.clone()),
        (POLICY, policy.to_owned()),
        (DEVICES, n.to_string()),
        ("ttis", condition.ttis.to_string()),
    ];
    let of_every_cell = of_every_cell
        .map(|(field, value)| (field.to_owned(), value))
        .into_iter();
    of_every_cell
        .chain(condition.all_changes().cloned())
        .chain(condition.table_changes())
        .collect()
}

/// A scenario field that sweeps vary over several numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct SweptNumbers {
    /// The path of the field.
    pub field: String,
    /// Its values, ascending, at least two.
    pub values: Vec<f64>,
}

impl SweptNumbers {
    /// Returns the swept fields of `results` that take several values, all of them numbers.
    pub fn of_results(results: &Results) -> Vec<Self> {
        let mut swept: Vec<(&str, Vec<Option<f64>>)> = Vec::new();
        for (path, value) in results.conditions.iter().flat_map(|condition| &condition.swept_fields) {
            let number = value.parse().ok().filter(|number: &f64| number.is_finite());
            match swept.iter_mut().find(|(known, _)| known == path) {
                Some((_, values)) => values.push(number),
                None => swept.push((path, vec![number])),
            }
        }
        let numeric = swept.into_iter().filter_map(|(field, values)| {
            let mut values: Vec<f64> = values.into_iter().collect::<Option<_>>()?;
            values.sort_by(f64::total_cmp);
            values.dedup();
            (values.len() > 1).then(|| Self {
                field: field.to_owned(),
                values,
            })
        });
        numeric.collect()
    }

    /// Whether `condition` has a value of this field from a sweep.
    pub fn is_varied_in(&self, condition: &RunCondition) -> bool {
        condition.swept_fields.iter().any(|(path, _)| *path == self.field)
    }

    /// Whether the values suit a logarithmic axis better: all above 0, and the largest more than 30 times the smallest.
    pub fn is_wide(&self) -> bool {
        let (first, last) = (self.values[0], self.values[self.values.len() - 1]);
        first > 0.0 && last / first > 30.0
    }
}
