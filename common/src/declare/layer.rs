//! One layer of a configuration: a preset, a file, or a command-line override, parsed but not yet checked. Positions in
//! it are byte offsets of its text, from which errors give lines.

use std::sync::Arc;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::declaration::Declaration;
use super::error::ScenarioError;
use super::origins::{LayerOrigin, ValueOrigin};
use super::overrides::Override;

/// Maximum length of the text of a configuration, in bytes.
pub const MAX_TEXT_BYTES: u64 = 1 << 20;

/// One layer: a table, and the list item to which it applies if a command-line path names one.
#[derive(Debug)]
pub struct Layer<'a> {
    pub(super) table: DeTable<'a>,
    pub(super) text: &'a str,
    pub(super) origin: LayerOrigin,
    pub(super) item_name: Option<&'a str>,
}

impl<'a> Layer<'a> {
    /// Creates a layer from the text of a preset or a file.
    ///
    /// # Errors
    /// If the text is too long or not valid TOML.
    pub(crate) fn from_text(text: &'a str, origin: LayerOrigin) -> Result<Self, ScenarioError> {
        if text.len() as u64 > MAX_TEXT_BYTES {
            return Err(syntax(&origin, 0, format!("longer than {MAX_TEXT_BYTES} bytes")));
        }
        match DeTable::parse(text) {
            Ok(table) => Ok(Self {
                table: table.into_inner(),
                text,
                origin,
                item_name: None,
            }),
            Err(error) => {
                let offset = error.span().map_or(0, |span| span.start);
                Err(syntax(&origin, offset, error.message().to_owned()))
            }
        }
    }

    /// Creates a layer from an override. A path `LIST.NAME.…` applies to the item NAME of the declaration's list.
    ///
    /// # Errors
    /// If the value is not valid TOML.
    pub(crate) fn from_override(given: &'a Override, declaration: &Declaration) -> Result<Self, ScenarioError> {
        let list = declaration.list.name();
        let (item_name, path) = match given.path.as_slice() {
            [section, name, rest @ ..] if section == list && !rest.is_empty() => (Some(name.as_str()), rest),
            path => (None, path),
        };
        let mut value = given.parse_value()?;
        let span = value.span();
        for name in path.iter().rev() {
            value = Spanned::new(span.clone(), DeValue::Table(single_entry(name, value)));
        }
        // A path has at least one name, so the value is a table here.
        let DeValue::Table(table) = value.into_inner() else {
            return Ok(Self::empty(given));
        };
        Ok(Self {
            table,
            item_name,
            ..Self::empty(given)
        })
    }

    fn empty(given: &'a Override) -> Self {
        Self {
            table: DeTable::new(),
            text: &given.value,
            origin: LayerOrigin::Flag(Arc::clone(&given.flag)),
            item_name: None,
        }
    }

    /// Returns the text value of the top-level field `name` in this layer, with its origin.
    pub(crate) fn text_at(&self, name: &str) -> Option<(&str, ValueOrigin)> {
        let value = self.table.get(name).filter(|_| self.item_name.is_none())?;
        Some((value.get_ref().as_str()?, self.origin.origin_at(value.span().start)))
    }
}

/// Creates a key that has no offset in any text.
pub(super) fn owned_key<'a>(name: &str) -> Spanned<std::borrow::Cow<'a, str>> {
    Spanned::new(0..0, std::borrow::Cow::Owned(name.to_owned()))
}

pub(super) fn single_entry<'a>(name: &str, value: Spanned<DeValue<'a>>) -> DeTable<'a> {
    std::iter::once((owned_key(name), value)).collect()
}

fn syntax(origin: &LayerOrigin, offset: usize, reason: String) -> ScenarioError {
    let (name, line) = match origin.origin_at(offset) {
        ValueOrigin::File { name, line } => (name.to_string(), line),
        ValueOrigin::Preset(name) => (name.to_owned(), 1),
        ValueOrigin::Flag(flag) => (flag.to_string(), 1),
        ValueOrigin::Unset => (String::new(), 1),
    };
    ScenarioError::Syntax { name, line, reason }
}
