//! What is declared of a field: once, for everyone.

use std::fmt;

use super::choice::{Alternative, Choice};
use super::value::Value;
use crate::units::MAX_UNITS;

/// A range of numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    least: f64,
    holds_least: bool,
    most: f64,
    holds_most: bool,
}

impl Range {
    /// From `least` to `most`, both included.
    pub const fn closed(least: f64, most: f64) -> Self {
        Self {
            least,
            holds_least: true,
            most,
            holds_most: true,
        }
    }

    /// Above `least`, at most `most`.
    pub const fn above(least: f64, most: f64) -> Self {
        Self {
            holds_least: false,
            ..Self::closed(least, most)
        }
    }

    /// At least `least`, below `most`.
    pub const fn below(least: f64, most: f64) -> Self {
        Self {
            holds_most: false,
            ..Self::closed(least, most)
        }
    }

    /// Whether `x` lies within.
    pub fn contains(&self, x: f64) -> bool {
        let from_below = x > self.least || (self.holds_least && x >= self.least);
        let from_above = x < self.most || (self.holds_most && x <= self.most);
        from_below && from_above
    }

    /// Both ends, and whether each is included.
    pub const fn ends(&self) -> ((f64, bool), (f64, bool)) {
        ((self.least, self.holds_least), (self.most, self.holds_most))
    }

    /// The range as an interval: "(0, 1]".
    pub fn interval(&self) -> String {
        let (open, close) = (
            if self.holds_least { '[' } else { '(' },
            if self.holds_most { ']' } else { ')' },
        );
        format!("{open}{}, {}{close}", short(self.least), short(self.most))
    }
}

impl fmt::Display for Range {
    /// For example "greater than 0 and at most 1".
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let from = if self.holds_least { "at least" } else { "greater than" };
        let to = if self.holds_most { "at most" } else { "less than" };
        write!(f, "{from} {} and {to} {}", short(self.least), short(self.most))
    }
}

/// The number as text, with an exponent if it is long.
fn short(x: f64) -> String {
    if x.abs() >= 1e9 {
        format!("{x:e}")
    } else {
        x.to_string()
    }
}

/// Above 0, and not so large that squares and sums overflow.
pub const POSITIVE: Range = Range::above(0.0, 1e6);
/// 0 or more, and not so large that squares and sums overflow.
pub const NOT_NEGATIVE: Range = Range::closed(0.0, 1e6);
/// A share that may be 0 but not 1.
pub const BELOW_ONE: Range = Range::below(0.0, 1.0);
/// A share or probability that may be 0 and 1.
pub const PROBABILITY: Range = Range::closed(0.0, 1.0);
/// A share or probability that may be 1 but not 0.
pub const ABOVE_ZERO: Range = Range::above(0.0, 1.0);

/// What a field may hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Form {
    /// A whole number from `least` to `most`.
    Whole {
        /// The least.
        least: u64,
        /// The largest.
        most: u64,
    },
    /// A number within a range.
    Number(Range),
    /// An amount of energy in units, 0 to [`MAX_UNITS`].
    Energy {
        /// Whether it has to be more than 0.
        is_positive: bool,
    },
    /// True or false.
    Switch,
    /// One of a few words.
    Choice(&'static [Alternative]),
    /// The name of a variant that is registered beside the declaration, see [`super::Declaration::registered`].
    Registered,
    /// Any text.
    Text,
    /// The path of a file.
    File,
    /// One of a few words, or the path of a file.
    Source(&'static [Alternative]),
    /// A list of whole numbers.
    Wholes {
        /// The least of each.
        least: u32,
        /// The largest of each.
        most: u32,
        /// The most of them; at least one is needed.
        longest: usize,
    },
    /// A list of texts, at least one.
    Texts,
}

impl Form {
    /// What a value has to be if it is out of range, as the end of "must be …".
    pub fn allowed(&self) -> String {
        match self {
            Self::Whole { least, most } => format!("at least {least} and at most {most}"),
            Self::Number(range) => range.to_string(),
            Self::Energy { is_positive: false } => format!("at least 0 and at most {MAX_UNITS} units"),
            Self::Energy { is_positive: true } => format!("at least 0.000001 and at most {MAX_UNITS} units"),
            Self::Wholes { least, most, longest } => {
                format!("a list of 1 to {longest} whole numbers from {least} to {most}")
            }
            Self::Switch
            | Self::Choice(_)
            | Self::Registered
            | Self::Text
            | Self::File
            | Self::Source(_)
            | Self::Texts => self.kind().to_owned(),
        }
    }

    /// The TOML type, as the end of "must be …".
    pub const fn kind(&self) -> &'static str {
        match self {
            Self::Whole { .. } => "a whole number that is not negative",
            Self::Number(_) | Self::Energy { .. } => "a number",
            Self::Switch => "true or false",
            Self::Choice(_) | Self::Registered | Self::Text | Self::File | Self::Source(_) => "a string",
            Self::Wholes { .. } | Self::Texts => "a list",
        }
    }
}

/// What a field has where nobody sets it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Default {
    /// This value.
    Is(Value<'static>),
    /// A value that follows from others, in words.
    Derived(&'static str),
    /// Nothing: the field has to be set wherever it counts.
    None,
}

/// The setting under which a field counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Condition {
    /// The full path of the field that decides, as at the top level (`harvest.kind`).
    pub field: &'static str,
    /// Its values under which the field counts.
    pub values: &'static [&'static str],
}

impl fmt::Display for Condition {
    /// `harvest.kind = "mpp"`, or several values joined by "or".
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} = ", self.field)?;
        for (index, value) in self.values.iter().enumerate() {
            write!(f, "{}\"{value}\"", if index == 0 { "" } else { " or " })?;
        }
        Ok(())
    }
}

/// One field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Field {
    /// Its name in its section.
    pub name: &'static str,
    /// What it may hold.
    pub form: Form,
    /// What it holds where nobody sets it.
    pub default: Default,
    /// Its unit; "" for none.
    pub unit: &'static str,
    /// What it means, sentences.
    pub help: &'static str,
    /// Where the paper has it; "" for nowhere.
    pub source: &'static str,
    /// The setting under which it counts; that of its section holds too.
    pub only_with: Option<Condition>,
    /// A field of the same section that says the same in another way: the later layer decides which of the two counts.
    pub instead_of: Option<&'static str>,
}

impl Field {
    const fn of(form: Form, default: Default) -> Self {
        Self {
            name: "",
            form,
            default,
            unit: "",
            help: "",
            source: "",
            only_with: None,
            instead_of: None,
        }
    }

    /// This field with a unit.
    #[must_use]
    pub const fn unit(self, unit: &'static str) -> Self {
        Self { unit, ..self }
    }

    /// This field with its place in the paper.
    #[must_use]
    pub const fn source(self, source: &'static str) -> Self {
        Self { source, ..self }
    }

    /// This field with a default that follows from other fields, in words.
    #[must_use]
    pub const fn derived(self, words: &'static str) -> Self {
        Self {
            default: Default::Derived(words),
            ..self
        }
    }

    /// This field without a default.
    #[must_use]
    pub const fn required(self) -> Self {
        Self {
            default: Default::None,
            ..self
        }
    }

    /// This field, counting only where `field` has one of `values`.
    #[must_use]
    pub const fn only_with(self, field: &'static str, values: &'static [&'static str]) -> Self {
        Self {
            only_with: Some(Condition { field, values }),
            ..self
        }
    }

    /// This field as another way to say what the field `name` says.
    #[must_use]
    pub const fn instead_of(self, name: &'static str) -> Self {
        Self {
            instead_of: Some(name),
            ..self
        }
    }

    /// This field with its name and help; [`crate::declare!`] calls this.
    #[must_use]
    pub const fn named(self, name: &'static str, help: &'static str) -> Self {
        Self { name, help, ..self }
    }
}

/// A whole number from `least` to `most`.
pub const fn whole(least: u64, most: u64, default: u64) -> Field {
    Field::of(Form::Whole { least, most }, Default::Is(Value::Whole(default)))
}

/// A number within `range`.
pub const fn number(range: Range, default: f64) -> Field {
    Field::of(Form::Number(range), Default::Is(Value::Number(default)))
}

/// An amount of energy, `default` in units.
pub const fn energy(default: f64) -> Field {
    Field::of(
        Form::Energy { is_positive: false },
        Default::Is(Value::Energy(crate::units::Energy::rounded(default))),
    )
}

/// An amount of energy above 0, `default` in units.
pub const fn positive_energy(default: f64) -> Field {
    Field {
        form: Form::Energy { is_positive: true },
        ..energy(default)
    }
}

/// True or false.
pub const fn switch(default: bool) -> Field {
    Field::of(Form::Switch, Default::Is(Value::Switch(default)))
}

/// One of the words of `T`.
pub const fn choice<T: Choice>(default: &'static str) -> Field {
    Field::of(Form::Choice(T::ALTERNATIVES), Default::Is(Value::Text(default)))
}

/// The name of a registered variant.
pub const fn registered(default: &'static str) -> Field {
    Field::of(Form::Registered, Default::Is(Value::Text(default)))
}

/// One of `words`.
pub const fn word(words: &'static [Alternative], default: &'static str) -> Field {
    Field::of(Form::Choice(words), Default::Is(Value::Text(default)))
}

/// One of `words`, or the path of a file.
pub const fn source(words: &'static [Alternative], default: &'static str) -> Field {
    Field::of(Form::Source(words), Default::Is(Value::Text(default)))
}

/// Any text.
pub const fn text() -> Field {
    Field::of(Form::Text, Default::None)
}

/// The path of a file.
pub const fn file() -> Field {
    Field::of(Form::File, Default::None)
}

/// A list of 1 to `longest` whole numbers from `least` to `most`.
pub const fn wholes(least: u32, most: u32, longest: usize, default: &'static [u32]) -> Field {
    Field::of(
        Form::Wholes { least, most, longest },
        Default::Is(Value::Wholes(default)),
    )
}

/// A list of texts.
pub const fn texts() -> Field {
    Field::of(Form::Texts, Default::None)
}

/// Fields under one header of the file. Several sections may share a path: each concept declares its own fields.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Section {
    /// The path of the header as at the top level, "" for fields without one.
    pub path: &'static str,
    /// What the fields are about.
    pub about: &'static str,
    /// The fields in the order of files.
    pub fields: &'static [Field],
    /// The setting under which the fields count.
    pub only_with: Option<Condition>,
}

impl Section {
    /// The field called `name`.
    pub fn field(&self, name: &str) -> Option<&'static Field> {
        self.fields.iter().find(|field| field.name == name)
    }

    /// The setting under which `field` of this section counts.
    pub fn condition(&self, field: &Field) -> Option<Condition> {
        field.only_with.or(self.only_with)
    }

    /// The full path of the field `name`.
    pub fn path_of(&self, name: &str) -> String {
        super::dotted(self.path, name)
    }
}
