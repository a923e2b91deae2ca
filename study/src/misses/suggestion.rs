//! Changes of a scenario that can reduce missed events: a text, and the values that `reveille inspect misses --try`
//! runs. Both come from one declaration, so that they cannot disagree. `docs/reading-results.md` shows some texts.

use std::collections::BTreeMap;
use std::fmt;

use reveille_bs::scenario::{Scenario, load_with_files};
use reveille_common::declare::{Field, FieldSink, FieldValue, NoFiles, Section};
use reveille_common::digits::format_significant;

/// Significant digits of proposed numbers.
const DIGITS: u32 = 3;

/// A new value of a scenario field, displayed as the argument of `--set`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FieldChange {
    /// Path of the field.
    pub field: String,
    /// Value in the format of `--set`.
    pub value: String,
}

impl fmt::Display for FieldChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.field, self.value)
    }
}

/// A change that can reduce missed events.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Suggestion {
    /// An imperative without a full stop.
    pub text: String,
    /// Alternatives to try, each a set of fields that change together. Empty if values alone cannot express the
    /// change, because it needs a file, a training or another command.
    pub trials: Vec<Vec<FieldChange>>,
}

impl Suggestion {
    /// Creates a suggestion that values alone cannot express.
    pub(super) fn without_trials(text: impl Into<String>) -> Self {
        Self {
            text: text.into(),
            trials: Vec::new(),
        }
    }

    /// Creates a suggestion to try each of `values` in `field`. `verb_phrase` names the field, and `fixed` has the
    /// changes that all trials share.
    pub(super) fn with_values(verb_phrase: &str, fixed: &[(&str, &str)], field: &str, values: &[String]) -> Self {
        let change = |field: &str, value: &str| FieldChange {
            field: field.to_owned(),
            value: value.to_owned(),
        };
        let shared = || fixed.iter().map(|(field, value)| change(field, value));
        let trial = |value: &String| shared().chain([change(field, value)]).collect();
        Self {
            text: format!("{verb_phrase}: try {}", values.join(", ")),
            trials: values.iter().map(trial).collect(),
        }
    }

    /// Adds a purpose to the text.
    #[must_use]
    pub(super) fn with_purpose(mut self, purpose: &str) -> Self {
        self.text += purpose;
        self
    }
}

/// A value of a scenario field that can be scaled.
#[derive(Clone, Debug, PartialEq)]
enum Quantity {
    Number(f64),
    Whole(u64),
    Wholes(Vec<u32>),
}

impl Quantity {
    /// Multiplies the quantity by `factor`. Whole numbers stay at least at `min_whole`, and lists have no repetitions.
    fn scale(&self, factor: f64, min_whole: u64) -> String {
        let whole = |x: u64| (x as f64 * factor).round().max(min_whole as f64) as u64;
        match self {
            Self::Number(x) => format_significant(x * factor, DIGITS),
            Self::Whole(x) => whole(*x).to_string(),
            Self::Wholes(list) => {
                let mut scaled: Vec<String> = list.iter().map(|x| whole(u64::from(*x)).to_string()).collect();
                scaled.dedup();
                format!("[{}]", scaled.join(","))
            }
        }
    }
}

/// The present values of a scenario's fields, from which suggestions are made.
pub(super) struct PresentValues {
    quantities: Quantities,
    preset_name: String,
    /// The values of the fields in the preset.
    preset: Quantities,
}

impl PresentValues {
    pub(super) fn new(scenario: &Scenario) -> Self {
        let preset = load_with_files(&scenario.run.preset, &[], &NoFiles);
        Self {
            quantities: Quantities::of(scenario),
            preset_name: scenario.run.preset.clone(),
            // A preset of another version can be unknown.
            preset: preset.map_or_else(|_| Quantities::default(), |preset| Quantities::of(&preset.scenario)),
        }
    }

    /// Returns the number that the preset has in `field`, if it is larger than the present one.
    pub(super) fn larger_in_preset(&self, field: &str) -> Option<f64> {
        match (self.quantities.0.get(field)?, self.preset.0.get(field)?) {
            (Quantity::Number(present), Quantity::Number(preset)) => Some(*preset).filter(|preset| preset > present),
            _ => None,
        }
    }

    /// Returns the path of a field of the devices in `class`; the path of the top level in a scenario without classes.
    pub(super) fn class_field(&self, class: &str, field: &str) -> String {
        let class_path = format!("class.{class}.{field}");
        if self.quantities.0.contains_key(&class_path) {
            class_path
        } else {
            field.to_owned()
        }
    }

    /// Suggests a new value in place of the present number in `field`. `effect` continues the sentence after the value.
    pub(super) fn replace(&self, verb: &str, field: &str, value: &str, effect: &str) -> Suggestion {
        let phrase = self.verb_phrase(verb, field);
        let suggestion = self.choose(verb, field, &[value.to_owned()]);
        Suggestion {
            text: format!("{phrase}: {value} {effect}"),
            ..suggestion
        }
    }

    /// Suggests each of `values` in place of the present number in `field`.
    pub(super) fn choose(&self, verb: &str, field: &str, values: &[String]) -> Suggestion {
        Suggestion::with_values(&self.verb_phrase(verb, field), &[], field, values)
    }

    /// Returns the start of a suggestion to change `field`, with its present number, and the preset's if it differs.
    fn verb_phrase(&self, verb: &str, field: &str) -> String {
        let text_in = |quantities: &Quantities| Some(quantities.0.get(field)?.scale(1.0, 0));
        let Some(present) = text_in(&self.quantities) else {
            return format!("{verb} {field}");
        };
        match text_in(&self.preset).filter(|preset| *preset != present) {
            Some(preset) => format!("{verb} {field} = {present} (preset {}: {preset})", self.preset_name),
            None => format!("{verb} {field} = {present}"),
        }
    }

    /// Suggests to multiply `field` by each of `factors`; `None` if the field is not in use or no value would change.
    pub(super) fn scale(&self, verb: &str, field: &str, factors: &[f64]) -> Option<Suggestion> {
        self.scale_from(verb, field, factors, 1)
    }

    /// Suggests a scaling as [`Self::scale`] does. Whole numbers stay at least at `min_whole`.
    pub(super) fn scale_from(&self, verb: &str, field: &str, factors: &[f64], min_whole: u64) -> Option<Suggestion> {
        let quantity = self.quantities.0.get(field)?;
        let present = quantity.scale(1.0, 0);
        let mut values: Vec<String> = factors
            .iter()
            .map(|factor| quantity.scale(*factor, min_whole))
            .filter(|value| *value != present)
            .collect();
        values.dedup();
        (!values.is_empty()).then(|| self.choose(verb, field, &values))
    }

    /// Returns the largest number in the list of whole numbers in `field`; 1 without such a list.
    pub(super) fn largest_of_list(&self, field: &str) -> u64 {
        let largest = match self.quantities.0.get(field) {
            Some(Quantity::Wholes(list)) => list.iter().max().copied(),
            Some(Quantity::Number(_) | Quantity::Whole(_)) | None => None,
        };
        u64::from(largest.unwrap_or(1))
    }
}

/// The numbers of a scenario by the path of their field.
#[derive(Default)]
struct Quantities(BTreeMap<String, Quantity>);

impl Quantities {
    fn of(scenario: &Scenario) -> Self {
        let mut collector = QuantityCollector::default();
        scenario.visit(&mut collector);
        collector.quantities
    }
}

/// Collects the numbers of a scenario.
#[derive(Default)]
struct QuantityCollector {
    quantities: Quantities,
    /// Name of the class that the visited fields belong to.
    class: Option<String>,
}

impl FieldSink for QuantityCollector {
    fn item(&mut self, name: &str) {
        self.class = Some(name.to_owned());
    }

    fn field(&mut self, section: &'static Section, field: &'static Field, value: FieldValue<'_>) {
        let quantity = match value {
            FieldValue::Whole(x) => Quantity::Whole(x),
            FieldValue::Number(x) => Quantity::Number(x),
            FieldValue::Energy(energy) => Quantity::Number(energy.units()),
            FieldValue::Wholes(list) => Quantity::Wholes(list.to_vec()),
            FieldValue::Switch(_) | FieldValue::Text(_) | FieldValue::Path(_) | FieldValue::Texts(_) => return,
        };
        let path = section.path_of(field.name);
        let path = match &self.class {
            Some(class) => format!("class.{class}.{path}"),
            None => path,
        };
        self.quantities.0.insert(path, quantity);
    }

    fn content(&mut self, _: &[u8]) {}
}
