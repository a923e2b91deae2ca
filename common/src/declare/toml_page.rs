//! A configuration as a TOML file, for `scenario/toml_text.rs`. [`TomlPage`] is also the way to compare two
//! configurations. Loading the file must restore every value exactly, because `scenario.toml` of a run folder is such a
//! file. The reference page shows defaults in the format of [`format_toml`].

use std::fmt::Write as _;

use super::declaration::{Declaration, Scope};
use super::field::{Field, FieldCondition, FieldDefault, FieldSink, FieldType, Section};
use super::value::FieldValue;
use crate::units::{Energy, MICRO_PER_UNIT};

/// All active fields with their values. Two pages are equal if the names of their items, their fields, values and
/// file contents are equal.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TomlPage {
    items: Vec<String>,
    lines: Vec<PageLine>,
}

#[derive(Clone, Debug, PartialEq)]
struct PageLine {
    /// The number of the item to which the line belongs, from 1; 0 for the top level.
    item_number: usize,
    path: String,
    /// The value as TOML. For a file it is the path, so pages with equal contents under other paths differ.
    value: String,
    /// The contents of the file that the field names, for comparison only.
    contents: Vec<u8>,
}

impl FieldSink for TomlPage {
    fn item(&mut self, name: &str) {
        self.items.push(name.to_owned());
    }

    fn field(&mut self, section: &'static Section, field: &'static Field, value: FieldValue<'_>) {
        self.lines.push(PageLine {
            item_number: self.items.len(),
            path: section.path_of(field.name),
            value: format_toml(&value),
            contents: Vec::new(),
        });
    }

    fn content(&mut self, bytes: &[u8]) {
        if let Some(last) = self.lines.last_mut() {
            last.contents.extend_from_slice(bytes);
        }
    }
}

/// The fields that a page shows in addition to the active ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Detail {
    /// No other field.
    ActiveOnly,
    /// Every other field, commented out.
    AllFields,
}

impl TomlPage {
    /// Returns the active fields, as a file that can be loaded.
    pub fn active_fields(&self, declaration: &Declaration) -> String {
        self.to_text(declaration, Detail::ActiveOnly)
    }

    /// Returns the active fields and, commented out, every other field with its allowed words.
    pub fn all_fields(&self, declaration: &Declaration) -> String {
        self.to_text(declaration, Detail::AllFields)
    }

    fn to_text(&self, declaration: &Declaration, detail: Detail) -> String {
        let mut text = String::new();
        for header in declaration.headers() {
            // Items hold the values of the sections that they inherit, so these are not repeated at the top.
            if self.items.is_empty() || !declaration.list.inherits_section(header) {
                self.write_section(&mut text, declaration, (Scope::Top, 0), header, detail);
            }
        }
        let list = declaration.list.name();
        for item_number in 1..=self.items.len() {
            let _ = writeln!(text, "\n[[{list}]]");
            self.write_fields(&mut text, declaration, (Scope::Item, item_number), "", detail);
            for header in declaration.headers() {
                if declaration.list.inherits_section(header) {
                    // The first item shows every field, which suffices.
                    let detail = if item_number == 1 { detail } else { Detail::ActiveOnly };
                    self.write_section(&mut text, declaration, (Scope::Item, item_number), header, detail);
                }
            }
        }
        text
    }

    /// Writes the section below `header`, if it has a line to show.
    fn write_section(
        &self,
        text: &mut String,
        declaration: &Declaration,
        location: (Scope, usize),
        header: &str,
        detail: Detail,
    ) {
        let mut body = String::new();
        let active_fields = self.write_fields(&mut body, declaration, location, header, detail);
        if body.is_empty() {
            return;
        }
        if !header.is_empty() {
            let list = declaration.list.name();
            let header = if location.0 == Scope::Item {
                format!("{list}.{header}")
            } else {
                header.to_owned()
            };
            let _ = writeln!(text, "\n{}[{header}]", if active_fields == 0 { "# " } else { "" });
        }
        text.push_str(&body);
    }

    /// Writes the lines below `header` at `location`, the scope and item number. Returns the number of active fields.
    fn write_fields(
        &self,
        text: &mut String,
        declaration: &Declaration,
        location: (Scope, usize),
        header: &str,
        detail: Detail,
    ) -> usize {
        let mut active_fields = 0;
        for section in declaration.sections_at(location.0, header) {
            for field in section.fields {
                let path = section.path_of(field.name);
                let line = self
                    .lines
                    .iter()
                    .find(|line| line.item_number == location.1 && line.path == path);
                let comment = field_comment(field, section.condition(field), declaration, line.is_some());
                if let Some(line) = line {
                    active_fields += 1;
                    let _ = writeln!(text, "{} = {} # {comment}", field.name, line.value);
                } else if detail == Detail::AllFields {
                    let default = field.default.to_toml().unwrap_or_else(|| "…".to_owned());
                    let _ = writeln!(text, "# {} = {default} # {comment}", field.name);
                }
            }
        }
        active_fields
    }
}

impl FieldDefault {
    /// Returns the value as TOML; `None` if it depends on other fields, or there is no default.
    pub fn to_toml(&self) -> Option<String> {
        match self {
            Self::Value(value) => Some(format_toml(value)),
            Self::Derived(_) | Self::None => None,
        }
    }
}

/// Returns the comment of a field: meaning, unit, allowed words, condition. The meaning is the help up to its first
/// full stop before a blank.
fn field_comment(
    field: &Field,
    condition: Option<FieldCondition>,
    declaration: &Declaration,
    is_active: bool,
) -> String {
    let meaning = field.help.split_once(". ").map_or(field.help, |(first, _)| first);
    let mut parts = vec![meaning.trim_end_matches('.').replace('\n', " ").replace('`', "")];
    if !field.unit.is_empty() {
        parts.push(field.unit.to_owned());
    }
    let words = declaration.words_of(&field.field_type);
    if !words.is_empty() {
        let mut words: Vec<String> = words.iter().map(|word| format!("\"{}\"", word.name)).collect();
        if matches!(field.field_type, FieldType::WordOrFile(_)) {
            words.push("a file".to_owned());
        }
        parts.push(words.join(" or "));
    }
    if !is_active {
        if let FieldDefault::Derived(rule) = field.default {
            parts.push(format!("by default {}", rule.replace('`', "")));
        }
        if let Some(condition) = condition {
            parts.push(format!("only with {condition}"));
        }
    }
    parts.join("; ")
}

/// Formats the value as TOML, so that reading it restores the value exactly.
pub(super) fn format_toml(value: &FieldValue<'_>) -> String {
    let quoted = |text: &str| toml::Value::String(text.to_owned()).to_string();
    match *value {
        FieldValue::Whole(whole) => whole.to_string(),
        FieldValue::Number(number) => toml::Value::Float(number).to_string(),
        FieldValue::Energy(energy) => format_units(energy),
        FieldValue::Switch(is_on) => is_on.to_string(),
        FieldValue::Text(word) | FieldValue::Path(word) => quoted(word),
        FieldValue::Wholes(list) => format!("{list:?}"),
        FieldValue::Texts(list) => {
            let items: Vec<String> = list.iter().map(|item| quoted(item)).collect();
            format!("[{}]", items.join(", "))
        }
    }
}

/// Formats the energy in units, as an exact decimal number.
fn format_units(energy: Energy) -> String {
    let (whole, micro) = (energy.micro() / MICRO_PER_UNIT, energy.micro() % MICRO_PER_UNIT);
    let digits = format!("{micro:06}");
    let decimals = digits.trim_end_matches('0');
    format!("{whole}.{}", if decimals.is_empty() { "0" } else { decimals })
}
