//! The layers of a scenario (presets, file, command line), laid over one another with a memory of where each value was set.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use serde::Deserialize;
use toml::Spanned;
use toml::de::{DeArray, DeTable, DeValue, Deserializer};

use super::error::{Place, ScenarioError, listed, shortened};
use super::explain;
use super::overrides::Override;
use super::raw::RawScenario;

/// Bytes of the longest scenario text that is read.
pub(super) const LONGEST_TEXT: u64 = 1 << 20;

/// Where values were set, by path; classes are numbered there (`class.0.energy.e_max`).
pub(super) type Places = BTreeMap<String, Place>;

/// Who speaks in a layer.
#[derive(Clone, Debug)]
pub(super) enum Origin {
    Preset(&'static str),
    File { name: Arc<str>, line_starts: Vec<usize> },
    Flag(Arc<str>),
}

impl Origin {
    /// A file whose text is `text`.
    pub(super) fn file(name: &str, text: &str) -> Self {
        let breaks = text.bytes().enumerate().filter(|&(_, byte)| byte == b'\n');
        Self::File {
            name: Arc::from(name),
            line_starts: breaks.map(|(at, _)| at + 1).collect(),
        }
    }

    /// The place of the byte at `offset` of the layer's text.
    pub(super) fn place(&self, offset: usize) -> Place {
        match self {
            Self::Preset(name) => Place::Preset(name),
            Self::File { name, line_starts } => Place::File {
                name: Arc::clone(name),
                line: line_starts.partition_point(|&start| start <= offset) + 1,
            },
            Self::Flag(flag) => Place::Flag(Arc::clone(flag)),
        }
    }
}

/// One layer: a table, and the class that it is for where a path on the command line names one.
pub(super) struct Layer<'a> {
    pub(super) table: DeTable<'a>,
    pub(super) text: &'a str,
    pub(super) origin: Origin,
    /// The path that the command line gave.
    pub(super) path: Option<&'a [String]>,
    class: Option<&'a str>,
}

impl<'a> Layer<'a> {
    /// A layer from the text of a preset or a file.
    pub(super) fn from_text(text: &'a str, origin: Origin) -> Result<Self, ScenarioError> {
        if text.len() as u64 > LONGEST_TEXT {
            return Err(syntax(&origin, 0, format!("longer than {LONGEST_TEXT} bytes")));
        }
        match DeTable::parse(text) {
            Ok(table) => Ok(Self {
                table: table.into_inner(),
                text,
                origin,
                path: None,
                class: None,
            }),
            Err(error) => {
                let offset = error.span().map_or(0, |span| span.start);
                Err(syntax(&origin, offset, error.message().to_owned()))
            }
        }
    }

    /// A layer from an override. A path `class.NAME.…` is for the class of that name.
    pub(super) fn from_override(given: &'a Override) -> Result<Self, ScenarioError> {
        let (class, path) = match given.path.as_slice() {
            [section, name, rest @ ..] if section == "class" && !rest.is_empty() => (Some(name.as_str()), rest),
            path => (None, path),
        };
        let mut value = given.toml()?;
        let span = value.span();
        for name in path.iter().rev() {
            value = Spanned::new(span.clone(), DeValue::Table(single(name, value)));
        }
        let DeValue::Table(table) = value.into_inner() else {
            return Ok(Self::empty(given));
        };
        Ok(Self {
            table,
            class,
            ..Self::empty(given)
        })
    }

    fn empty(given: &'a Override) -> Self {
        Self {
            table: DeTable::new(),
            text: &given.value,
            origin: Origin::Flag(Arc::clone(&given.flag)),
            path: Some(&given.path),
            class: None,
        }
    }

    /// The preset that the layer asks for, with the place where it does.
    pub(super) fn preset(&self) -> Option<(&str, Place)> {
        let value = self.table.get("preset").filter(|_| self.class.is_none())?;
        Some((value.get_ref().as_str()?, self.origin.place(value.span().start)))
    }

    /// The layer in the form of a whole scenario.
    fn whole(&self) -> DeTable<'a> {
        if self.class.is_none() {
            return self.table.clone();
        }
        let mut classes = DeArray::default();
        classes.push(Spanned::new(0..0, DeValue::Table(self.table.clone())));
        single("class", Spanned::new(0..0, DeValue::Array(classes)))
    }
}

/// All layers so far.
#[derive(Default)]
pub(super) struct Layers<'a> {
    table: DeTable<'a>,
    places: Places,
}

impl<'a> Layers<'a> {
    /// Lays `layer` over those before it, after a check of its names and types.
    pub(super) fn add(&mut self, layer: Layer<'a>) -> Result<(), ScenarioError> {
        let whole = Spanned::new(0..layer.text.len(), layer.whole());
        if let Err(error) = RawScenario::deserialize(Deserializer::from(whole)) {
            return Err(explain::explain(&layer, &error, &self.places));
        }
        let Layer {
            table, origin, class, ..
        } = layer;
        match class {
            None => {
                record(&table, "", &origin, &mut self.places);
                overlay(&mut self.table, table);
            }
            Some(name) => {
                let (index, base) = class_named(&mut self.table, name, &origin)?;
                record(&table, &format!("class.{index}."), &origin, &mut self.places);
                overlay(base, table);
            }
        }
        Ok(())
    }

    /// The raw scenario, each class with its sections laid over the top-level ones, and where its values were set.
    pub(super) fn finish(mut self) -> Result<(RawScenario, Places), ScenarioError> {
        let defaults: Vec<(&str, DeTable<'a>)> = ["energy", "harvest"]
            .into_iter()
            .filter_map(|section| Some((section, table_mut(&mut self.table, section)?.clone())))
            .collect();
        for class in classes_mut(&mut self.table) {
            for (section, default) in &defaults {
                let mut full = default.clone();
                if let Some(own) = table_mut(class, section) {
                    overlay(&mut full, std::mem::take(own));
                }
                class.insert(key(section), Spanned::new(0..0, DeValue::Table(full)));
            }
        }
        let merged = Deserializer::from(Spanned::new(0..0, self.table));
        match RawScenario::deserialize(merged) {
            Ok(raw) => Ok((raw, self.places)),
            Err(error) => Err(syntax(
                &Origin::Flag(Arc::from("all layers")),
                0,
                error.message().to_owned(),
            )),
        }
    }
}

/// Two ways to name the columns of a trace: the later layer decides which.
fn rival(name: &str) -> Option<&'static str> {
    match name {
        "column" => Some("columns"),
        "columns" => Some("column"),
        _ => None,
    }
}

/// Sets in `base` what `above` sets, tables field by field.
fn overlay<'a>(base: &mut DeTable<'a>, above: DeTable<'a>) {
    for name in above.keys().filter_map(|name| rival(name.get_ref())) {
        base.remove(name);
    }
    for (name, value) in above {
        let span = value.span();
        let value = value.into_inner();
        let value = if let DeValue::Table(inner) = value {
            if let Some(below) = table_mut(base, name.get_ref()) {
                overlay(below, inner);
                continue;
            }
            DeValue::Table(inner)
        } else {
            value
        };
        base.insert(name, Spanned::new(span, value));
    }
}

/// Remembers where everything in `table` was set, for paths that begin with `prefix`.
fn record(table: &DeTable<'_>, prefix: &str, origin: &Origin, places: &mut Places) {
    for (name, value) in table {
        let path = format!("{prefix}{}", name.get_ref());
        let inner = format!("{path}.");
        match value.get_ref() {
            DeValue::Table(table) => record(table, &inner, origin, places),
            DeValue::Array(items) => {
                // Classes are replaced as a whole; no other list holds tables.
                if prefix.is_empty() {
                    places.retain(|known, _| !known.starts_with(&inner));
                }
                for (index, item) in items.iter().enumerate() {
                    if let DeValue::Table(table) = item.get_ref() {
                        places.insert(format!("{path}.{index}"), origin.place(item.span().start));
                        record(table, &format!("{path}.{index}."), origin, places);
                    }
                }
            }
            DeValue::String(_)
            | DeValue::Integer(_)
            | DeValue::Float(_)
            | DeValue::Boolean(_)
            | DeValue::Datetime(_) => {}
        }
        places.insert(path, origin.place(start(name.span(), value.span())));
    }
}

/// A value's place is its key's, but for overrides only the value has one.
fn start(name: Range<usize>, value: Range<usize>) -> usize {
    if name.is_empty() { value.start } else { name.start }
}

/// The class called `name`, with its number.
fn class_named<'t, 'a>(
    table: &'t mut DeTable<'a>,
    name: &str,
    origin: &Origin,
) -> Result<(usize, &'t mut DeTable<'a>), ScenarioError> {
    let names: Vec<String> = classes_mut(table).map(|class| class_name(class).to_owned()).collect();
    let found = classes_mut(table)
        .enumerate()
        .find(|(_, class)| class_name(class) == name);
    found.ok_or_else(|| ScenarioError::Invalid {
        field: "class".to_owned(),
        value: shortened(name),
        allowed: format!(
            "must be the name of a class; there are {}",
            listed(names.iter().map(String::as_str))
        ),
        place: origin.place(0),
    })
}

/// The name of a class, or "".
fn class_name<'t>(class: &'t DeTable<'_>) -> &'t str {
    class
        .get("name")
        .and_then(|name| name.get_ref().as_str())
        .unwrap_or_default()
}

/// The tables of the list `class`.
fn classes_mut<'t, 'a>(table: &'t mut DeTable<'a>) -> impl Iterator<Item = &'t mut DeTable<'a>> {
    let classes = table.get_mut("class").map(Spanned::get_mut);
    let items = if let Some(DeValue::Array(items)) = classes {
        items.as_mut()
    } else {
        &mut []
    };
    items.iter_mut().filter_map(|item| as_table(item.get_mut()))
}

fn table_mut<'t, 'a>(table: &'t mut DeTable<'a>, name: &str) -> Option<&'t mut DeTable<'a>> {
    as_table(table.get_mut(name)?.get_mut())
}

fn as_table<'t, 'a>(value: &'t mut DeValue<'a>) -> Option<&'t mut DeTable<'a>> {
    if let DeValue::Table(table) = value {
        Some(table)
    } else {
        None
    }
}

fn key<'a>(name: &str) -> Spanned<std::borrow::Cow<'a, str>> {
    Spanned::new(0..0, std::borrow::Cow::Owned(name.to_owned()))
}

fn single<'a>(name: &str, value: Spanned<DeValue<'a>>) -> DeTable<'a> {
    std::iter::once((key(name), value)).collect()
}

fn syntax(origin: &Origin, offset: usize, reason: String) -> ScenarioError {
    let (name, line) = match origin.place(offset) {
        Place::File { name, line } => (name.to_string(), line),
        Place::Preset(name) => (name.to_owned(), 1),
        Place::Flag(flag) => (flag.to_string(), 1),
        Place::Nowhere => (String::new(), 1),
    };
    ScenarioError::Syntax { name, line, reason }
}
