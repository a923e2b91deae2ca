//! Declared fields: type, range, default, unit, help and condition, with a constructor per type for `declare!`. Schema
//! and reference page show all of it; a test compares `docs/scenario.md`. The hash covers paths and values only, so a
//! new active field, a new name or a new default changes it. A new name also belongs in `tests/fuzz/scenario.dict`.

use std::fmt;

use super::choice::{Alternative, ChoiceType};
use super::value::FieldValue;
use crate::units::{Energy, MAX_UNITS};

/// A range of numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    min: f64,
    includes_min: bool,
    max: f64,
    includes_max: bool,
}

impl Range {
    /// Returns the range from `min` to `max`, both included.
    pub const fn closed(min: f64, max: f64) -> Self {
        Self {
            min,
            includes_min: true,
            max,
            includes_max: true,
        }
    }

    /// Returns the range above `min` and at most `max`.
    pub const fn above(min: f64, max: f64) -> Self {
        Self {
            includes_min: false,
            ..Self::closed(min, max)
        }
    }

    /// Returns the range from `min` to below `max`.
    pub const fn below(min: f64, max: f64) -> Self {
        Self {
            includes_max: false,
            ..Self::closed(min, max)
        }
    }

    /// Whether `x` lies within the range.
    pub fn contains(&self, x: f64) -> bool {
        let meets_min = x > self.min || (self.includes_min && x >= self.min);
        let meets_max = x < self.max || (self.includes_max && x <= self.max);
        meets_min && meets_max
    }

    /// Returns both ends, and whether each is included.
    pub const fn ends(&self) -> ((f64, bool), (f64, bool)) {
        ((self.min, self.includes_min), (self.max, self.includes_max))
    }

    /// Formats the range as an interval, for example "(0, 1]".
    pub fn interval(&self) -> String {
        let (open, close) = (
            if self.includes_min { '[' } else { '(' },
            if self.includes_max { ']' } else { ')' },
        );
        format!("{open}{}, {}{close}", format_number(self.min), format_number(self.max))
    }
}

impl fmt::Display for Range {
    /// Writes for example "greater than 0 and at most 1".
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let from = if self.includes_min { "at least" } else { "greater than" };
        let to = if self.includes_max { "at most" } else { "less than" };
        write!(
            f,
            "{from} {} and {to} {}",
            format_number(self.min),
            format_number(self.max)
        )
    }
}

/// Formats the number, with an exponent if it is large.
fn format_number(x: f64) -> String {
    if x.abs() >= 1e9 {
        format!("{x:e}")
    } else {
        x.to_string()
    }
}

/// Above 0 and at most 10⁶, so that squares and sums do not overflow.
pub const POSITIVE: Range = Range::above(0.0, 1e6);
/// 0 to 10⁶, so that squares and sums do not overflow.
pub const NOT_NEGATIVE: Range = Range::closed(0.0, 1e6);
/// A share of at least 0 and below 1.
pub const SHARE_BELOW_ONE: Range = Range::below(0.0, 1.0);
/// A share or probability from 0 to 1, both included.
pub const PROBABILITY: Range = Range::closed(0.0, 1.0);
/// A share or probability above 0 and at most 1; [`POSITIVE`] has no limit of 1.
pub const SHARE_ABOVE_ZERO: Range = Range::above(0.0, 1.0);

/// Returns the range of a field of the type [`FieldType::Energy`], in units.
pub(super) fn energy_range(is_positive: bool) -> Range {
    let min = Energy::from_micro(u64::from(is_positive));
    Range::closed(min.units(), MAX_UNITS)
}

/// The type of a field with its bounds. The Rust type of the field must hold every allowed value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FieldType {
    /// A whole number from `min` to `max`.
    Whole {
        /// Smallest allowed value.
        min: u64,
        /// Largest allowed value.
        max: u64,
    },
    /// A number within a range.
    Number(Range),
    /// An amount of energy in units, 0 to [`MAX_UNITS`].
    Energy {
        /// Whether the amount must be more than 0.
        is_positive: bool,
    },
    /// True or false.
    Switch,
    /// A word from a fixed list.
    Choice(&'static [Alternative]),
    /// The name of a registered variant, see [`super::Declaration::registered`].
    Registered,
    /// Any text.
    Text,
    /// The path of a file. The field must be an `Option`, which is `None` in [`Visit`], because [`crate::declare!`]
    /// would hash the path as text. The owner passes it by hand as [`FieldValue::Path`] with the content.
    File,
    /// A word from a fixed list, or the path of a file; visited like [`Self::File`].
    WordOrFile(&'static [Alternative]),
    /// A list of whole numbers.
    Wholes {
        /// Smallest allowed element.
        min: u32,
        /// Largest allowed element.
        max: u32,
        /// Maximum length of the list; it has at least one element.
        max_len: usize,
    },
    /// A list of at least one text.
    Texts,
}

impl FieldType {
    /// Describes the allowed values, as the end of "must be …".
    pub fn describe_range(&self) -> String {
        match self {
            Self::Whole { min, max } => format!("at least {min} and at most {max}"),
            Self::Number(range) => range.to_string(),
            Self::Energy { is_positive } => format!("{} units", energy_range(*is_positive)),
            Self::Wholes { min, max, max_len } => {
                format!("a list of 1 to {max_len} whole numbers from {min} to {max}")
            }
            Self::Switch
            | Self::Choice(_)
            | Self::Registered
            | Self::Text
            | Self::File
            | Self::WordOrFile(_)
            | Self::Texts => self.describe_type().to_owned(),
        }
    }

    /// Describes the TOML type, as the end of "must be …".
    pub const fn describe_type(&self) -> &'static str {
        match self {
            Self::Whole { .. } => "a whole number that is not negative",
            Self::Number(_) | Self::Energy { .. } => "a number",
            Self::Switch => "true or false",
            Self::Choice(_) | Self::Registered | Self::Text | Self::File | Self::WordOrFile(_) => "a string",
            Self::Wholes { .. } | Self::Texts => "a list",
        }
    }
}

/// The value of a field that is not set.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FieldDefault {
    /// This value.
    Value(FieldValue<'static>),
    /// A value derived from other fields, described as text.
    Derived(&'static str),
    /// No value: the field must be set wherever it has an effect. For the type `Option`, the code that reads the
    /// section checks this.
    None,
}

/// The setting under which a field has an effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldCondition {
    /// The full path at the top level of the field that decides (`harvest.kind`). Under an unknown path the
    /// condition never holds.
    pub field: &'static str,
    /// The values of that field under which this field has an effect.
    pub values: &'static [&'static str],
}

impl fmt::Display for FieldCondition {
    /// Writes `harvest.kind = "mpp"`, or several values joined by "or".
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} = ", self.field)?;
        for (index, value) in self.values.iter().enumerate() {
            write!(f, "{}\"{value}\"", if index == 0 { "" } else { " or " })?;
        }
        Ok(())
    }
}

/// The declaration of a field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Field {
    /// The name within its section.
    pub name: &'static str,
    /// The type with its bounds.
    pub field_type: FieldType,
    /// The value if it is not set.
    pub default: FieldDefault,
    /// Its unit; "" for none.
    pub unit: &'static str,
    /// The meaning, in full sentences.
    pub help: &'static str,
    /// The place in the paper; "" without one.
    pub source: &'static str,
    /// The setting under which the field has an effect, in place of its section's.
    pub only_with: Option<FieldCondition>,
    /// An alternative field of the same section for the same quantity. The later layer decides which one applies. Both
    /// fields must name each other.
    pub instead_of: Option<&'static str>,
    /// A former name, which is still accepted with a warning.
    pub former_name: Option<&'static str>,
}

impl Field {
    const fn new(field_type: FieldType, default: FieldDefault) -> Self {
        Self {
            name: "",
            field_type,
            default,
            unit: "",
            help: "",
            source: "",
            only_with: None,
            instead_of: None,
            former_name: None,
        }
    }

    /// Returns the field with this unit.
    #[must_use]
    pub const fn unit(self, unit: &'static str) -> Self {
        Self { unit, ..self }
    }

    /// Returns the field with this place in the paper.
    #[must_use]
    pub const fn source(self, source: &'static str) -> Self {
        Self { source, ..self }
    }

    /// Returns the field with a default that is derived from other fields, described as text.
    #[must_use]
    pub const fn derived(self, rule: &'static str) -> Self {
        Self {
            default: FieldDefault::Derived(rule),
            ..self
        }
    }

    /// Returns the field without a default.
    #[must_use]
    pub const fn required(self) -> Self {
        Self {
            default: FieldDefault::None,
            ..self
        }
    }

    /// Returns the field with the condition that `field` has one of `values`.
    #[must_use]
    pub(crate) const fn only_with(self, field: &'static str, values: &'static [&'static str]) -> Self {
        Self {
            only_with: Some(FieldCondition { field, values }),
            ..self
        }
    }

    /// Returns the field as an alternative to the field `name`.
    #[must_use]
    pub const fn instead_of(self, name: &'static str) -> Self {
        Self {
            instead_of: Some(name),
            ..self
        }
    }

    /// Returns the field with a former name.
    #[must_use]
    pub const fn formerly(self, name: &'static str) -> Self {
        Self {
            former_name: Some(name),
            ..self
        }
    }

    /// Returns the field with its name and help; [`crate::declare!`] calls this.
    #[must_use]
    pub const fn with_name_and_help(self, name: &'static str, help: &'static str) -> Self {
        Self { name, help, ..self }
    }
}

/// Declares a whole number from `min` to `max`. No constructor checks that its default is an allowed value.
pub const fn whole(min: u64, max: u64, default: u64) -> Field {
    Field::new(
        FieldType::Whole { min, max },
        FieldDefault::Value(FieldValue::Whole(default)),
    )
}

/// Declares a number within `range`.
pub const fn number(range: Range, default: f64) -> Field {
    Field::new(
        FieldType::Number(range),
        FieldDefault::Value(FieldValue::Number(default)),
    )
}

/// Declares an amount of energy, with `default` in units.
pub const fn energy(default: f64) -> Field {
    Field::new(
        FieldType::Energy { is_positive: false },
        FieldDefault::Value(FieldValue::Energy(Energy::from_default(default))),
    )
}

/// Declares an amount of energy above 0, with `default` in units.
pub(crate) const fn positive_energy(default: f64) -> Field {
    Field {
        field_type: FieldType::Energy { is_positive: true },
        ..energy(default)
    }
}

/// Declares a field that is true or false.
pub const fn switch(default: bool) -> Field {
    Field::new(FieldType::Switch, FieldDefault::Value(FieldValue::Switch(default)))
}

/// Declares a field that holds one of the words of `T`.
pub const fn choice<T: ChoiceType>(default: &'static str) -> Field {
    Field::new(
        FieldType::Choice(T::ALTERNATIVES),
        FieldDefault::Value(FieldValue::Text(default)),
    )
}

/// Declares a field that holds the name of a registered variant.
pub const fn registered(default: &'static str) -> Field {
    Field::new(FieldType::Registered, FieldDefault::Value(FieldValue::Text(default)))
}

/// Declares a field that holds one of `words`.
pub const fn word(words: &'static [Alternative], default: &'static str) -> Field {
    Field::new(FieldType::Choice(words), FieldDefault::Value(FieldValue::Text(default)))
}

/// Declares a field that holds one of `words`, or the path of a file.
pub const fn word_or_file(words: &'static [Alternative], default: &'static str) -> Field {
    Field::new(
        FieldType::WordOrFile(words),
        FieldDefault::Value(FieldValue::Text(default)),
    )
}

/// Declares a field that holds any text.
pub const fn text() -> Field {
    Field::new(FieldType::Text, FieldDefault::None)
}

/// Declares a field that holds the path of a file.
pub const fn file() -> Field {
    Field::new(FieldType::File, FieldDefault::None)
}

/// Declares a list of 1 to `max_len` whole numbers from `min` to `max`.
pub const fn wholes(min: u32, max: u32, max_len: usize, default: &'static [u32]) -> Field {
    Field::new(
        FieldType::Wholes { min, max, max_len },
        FieldDefault::Value(FieldValue::Wholes(default)),
    )
}

/// Declares a list of texts.
pub const fn texts() -> Field {
    Field::new(FieldType::Texts, FieldDefault::None)
}

/// The fields under one header of the file. Several sections may share a path, each with its own fields.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Section {
    /// The path of the header at the top level; "" for fields without a header.
    pub path: &'static str,
    /// The subject of the fields.
    pub about: &'static str,
    /// The fields in the order in which a file shows them.
    pub fields: &'static [Field],
    /// The setting under which the fields have an effect, except fields with their own; `None` if they always have one.
    pub only_with: Option<FieldCondition>,
}

impl Section {
    /// Returns the field with the name `name`.
    pub fn field(&self, name: &str) -> Option<&'static Field> {
        self.fields.iter().find(|field| field.name == name)
    }

    /// Returns the setting under which `field` of this section has an effect.
    pub fn condition(&self, field: &Field) -> Option<FieldCondition> {
        field.only_with.or(self.only_with)
    }

    /// Returns the full path of the field `name`.
    pub fn path_of(&self, name: &str) -> String {
        super::join_path(self.path, name)
    }
}

/// A receiver of every active field with its value, in the order of declaration: writes, hashes or compares them.
/// Active fields are those with a value, in the settings that the choices of a scenario select.
pub trait FieldSink {
    /// Starts the list item `name` (a device class). The following fields belong to it, so the fields of the top level
    /// come first.
    fn item(&mut self, name: &str);

    /// Receives the value of `field` in `section`.
    fn field(&mut self, section: &'static Section, field: &'static Field, value: FieldValue<'_>);

    /// Receives the contents of the file that the last field names, the values read from it, or their fingerprint. The
    /// hash depends on the division into calls.
    fn content(&mut self, bytes: &[u8]);
}

/// A value with declared fields. [`crate::declare!`] implements it.
pub trait Visit {
    /// Passes every active field to `sink`, in the order of declaration. The scenario hash depends on this order.
    fn visit(&self, sink: &mut dyn FieldSink);
}
