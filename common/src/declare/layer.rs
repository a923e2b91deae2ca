//! One layer of a configuration: a preset, a file, or a command-line override, parsed but not yet checked. Positions in
//! it are byte offsets of its text, from which errors give lines.

use std::sync::Arc;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::declaration::Declaration;
use super::error::ScenarioError;
use super::origins::{LayerOrigin, ValueOrigin};
use super::overrides::Override;
use super::toml_error::explain_syntax;

/// Maximum length of the text of a configuration, in bytes. `scenario/load.rs` and sweeps limit their reading to it.
pub const MAX_TEXT_BYTES: u64 = 1 << 20;

/// One layer: a table, and the list item to which it applies if a command-line path names one.
#[derive(Debug)]
pub struct Layer<'a> {
    /// The parsed values; paths are relative to the list item if there is an item.
    pub(super) table: DeTable<'a>,
    /// The text to which offsets refer: the whole file, or only the value of an override.
    pub(super) text: &'a str,
    pub(super) origin: LayerOrigin,
    /// The name of the list item in the path of an override.
    pub(super) item_name: Option<&'a str>,
}

impl<'a> Layer<'a> {
    /// Creates a layer from the text of a preset or a file.
    ///
    /// # Errors
    /// If the text is too long or not valid TOML.
    pub(crate) fn from_text(text: &'a str, origin: LayerOrigin) -> Result<Self, ScenarioError> {
        if text.len() as u64 > MAX_TEXT_BYTES {
            return Err(syntax_error(&origin, 0, format!("longer than {MAX_TEXT_BYTES} bytes")));
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
                Err(syntax_error(&origin, offset, explain_syntax(error.message())))
            }
        }
    }

    /// Creates a layer from an override. A path `LIST.NAME.…` applies to the item NAME of the declaration's list. NAME
    /// cannot contain a dot, which separates names.
    ///
    /// # Errors
    /// If the value is not valid TOML.
    pub(crate) fn from_override(
        field_override: &'a Override,
        declaration: &Declaration,
    ) -> Result<Self, ScenarioError> {
        let list = declaration.list.name();
        let (item_name, path) = match field_override.path.as_slice() {
            [section, name, path_in_item @ ..] if section == list && !path_in_item.is_empty() => {
                (Some(name.as_str()), path_in_item)
            }
            path => (None, path),
        };
        let mut value = field_override.parse_value()?;
        let span = value.span();
        for name in path.iter().rev() {
            value = Spanned::new(span.clone(), DeValue::Table(single_entry(name, value)));
        }
        // A path has at least one name, so the value is a table here.
        let DeValue::Table(table) = value.into_inner() else {
            return Ok(Self::without_values(field_override));
        };
        Ok(Self {
            table,
            item_name,
            ..Self::without_values(field_override)
        })
    }

    fn without_values(field_override: &'a Override) -> Self {
        Self {
            table: DeTable::new(),
            text: &field_override.value,
            origin: LayerOrigin::Flag(Arc::clone(&field_override.label)),
            item_name: None,
        }
    }

    /// Returns the text value of the top-level field `name` in this layer, with its origin; `None` for a former name or
    /// another type.
    pub(crate) fn text_at(&self, name: &str) -> Option<(&str, ValueOrigin)> {
        let value = self.table.get(name).filter(|_| self.item_name.is_none())?;
        Some((value.get_ref().as_str()?, self.origin.origin_at(value.span().start)))
    }
}

/// Creates a key that has no offset in any text: its span is empty, see [`origin_offset`].
pub(super) fn owned_key<'a>(name: &str) -> Spanned<std::borrow::Cow<'a, str>> {
    Spanned::new(0..0, std::borrow::Cow::Owned(name.to_owned()))
}

/// Creates a table with one entry, under a key without an offset.
pub(super) fn single_entry<'a>(name: &str, value: Spanned<DeValue<'a>>) -> DeTable<'a> {
    std::iter::once((owned_key(name), value)).collect()
}

/// Returns the offset in the layer's text at which an entry is set: of its key, or of its value if the key has none, as
/// in overrides.
pub(super) fn origin_offset<K, V>(key: &Spanned<K>, value: &Spanned<V>) -> usize {
    let (key, value) = (key.span(), value.span());
    if key.is_empty() { value.start } else { key.start }
}

fn syntax_error(origin: &LayerOrigin, offset: usize, reason: String) -> ScenarioError {
    let (name, line) = match origin.origin_at(offset) {
        ValueOrigin::File { name, line } => (name.to_string(), line),
        ValueOrigin::Preset(name) => (name.to_owned(), 1),
        ValueOrigin::Flag(flag) => (flag.to_string(), 1),
        ValueOrigin::Unset => (String::new(), 1),
    };
    ScenarioError::Syntax { name, line, reason }
}
