//! The cells of tables as points with named fields.

use reveille_lab::reading::Reading;

use super::super::results::{Condition, Results};

/// The field that every table has for N.
pub const DEVICES: &str = "devices";
/// The field that every table has for the policy.
pub const POLICY: &str = "policy";

/// One cell.
pub struct Point<'r> {
    condition: &'r Condition,
    policy: &'r str,
    n: u32,
    /// All that is known of it: fields with their values.
    pub fields: Vec<(String, String)>,
}

impl Point<'_> {
    /// The value of `field`.
    pub fn value(&self, field: &str) -> Option<&str> {
        let known = self.fields.iter().find(|(path, _)| path == field);
        known.map(|(_, value)| value.as_str())
    }

    /// The value of `field`, if it is a number.
    pub fn number(&self, field: &str) -> Option<f64> {
        let number: f64 = self.value(field)?.parse().ok()?;
        number.is_finite().then_some(number)
    }

    /// What its runs tell of `metric`.
    pub fn reading(&self, metric: &str) -> Option<Reading> {
        self.condition.reading(self.policy, self.n, metric)
    }

    /// How many runs it has.
    pub fn runs(&self) -> usize {
        self.condition.runs(self.policy, self.n).count()
    }
}

/// The cells of `results`. Where policies have the lines, those with another ranking of wake-ups are lines of their
/// own; otherwise the ranking is a field like others.
pub fn points<'r>(results: &'r Results, by: &str) -> Vec<Point<'r>> {
    let conditions = if by == POLICY {
        &results.conditions
    } else {
        &results.by_ranking
    };
    let mut points = Vec::new();
    for condition in conditions {
        for policy in condition.policies() {
            for n in condition.sizes(policy) {
                points.push(Point {
                    condition,
                    policy,
                    n,
                    fields: fields(condition, policy, n),
                });
            }
        }
    }
    points
}

fn fields(condition: &Condition, policy: &str, n: u32) -> Vec<(String, String)> {
    let own = [
        ("preset", condition.preset.clone()),
        (POLICY, policy.to_owned()),
        (DEVICES, n.to_string()),
        ("ttis", condition.ttis.to_string()),
    ];
    let own = own.map(|(field, value)| (field.to_owned(), value)).into_iter();
    let table = condition
        .changed_in
        .clone()
        .map(|table| ("changed as in".to_owned(), table));
    own.chain(condition.changed().cloned()).chain(table).collect()
}
