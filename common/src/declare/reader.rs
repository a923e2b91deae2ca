//! Reads the values of declared fields from the merged layers, and rejects invalid ones with their origin. The reader
//! of a policy gives access to the fields of that policy only. Values are normalised here (-0 becomes 0), so the
//! scenario hash depends on it.

use std::cell::RefCell;
use std::fmt::Display;
use std::path::{Path, PathBuf};

use toml::de::{DeTable, DeValue};

use super::declaration::{Declaration, Scope};
use super::error::{ScenarioError, truncate};
use super::field::{Field, FieldCondition, FieldDefault, FieldType, Section};
use super::files::{FileError, Files};
use super::join_path;
use super::layers::Merged;
use super::names::{to_float, to_integer};
use super::origins::{ValueOrigin, ValueOrigins};
use super::value::{FieldRepr, FieldValue};
use crate::units::{Energy, ROUNDING_RULE, is_changed_by_rounding};

/// Settings that [`crate::declare!`] declares and reads.
pub trait Settings: Sized {
    /// The section with the declared fields.
    const SECTION: &'static Section;

    /// Reads the settings.
    ///
    /// # Errors
    /// If a value is out of its range or a required one is missing.
    fn read(reader: &FieldReader<'_>) -> Result<Self, ScenarioError>;
}

/// The access to files that a configuration names.
#[derive(Clone, Copy)]
pub struct FileContext<'a> {
    /// The interface that reads the files.
    pub files: &'a dyn Files,
    /// The folder for relative paths in the file. Paths on the command line are relative to the working directory.
    pub base_dir: &'a Path,
}

/// The values of a whole file, or of one item of its list.
///
/// Fields have their full paths at the top level (`energy.e_max`); fields that only an item has use the path of the
/// list (`class.share`). The merged layers have passed the check of names and types (`names.rs`).
pub struct FieldReader<'a> {
    declaration: &'a Declaration,
    table: &'a DeTable<'a>,
    origins: &'a ValueOrigins,
    file_context: FileContext<'a>,
    warnings: &'a RefCell<Vec<String>>,
    /// The index of the item and its name in messages.
    item: Option<(usize, String)>,
    /// The prefix of the paths that may be read, with its dot; `None` allows all.
    readable_prefix: Option<String>,
}

impl<'a> FieldReader<'a> {
    /// Creates a reader of the top level. Its warnings go to `warnings`.
    pub fn new(
        declaration: &'a Declaration,
        merged: &'a Merged<'a>,
        file_context: FileContext<'a>,
        warnings: &'a RefCell<Vec<String>>,
    ) -> Self {
        Self {
            declaration,
            table: &merged.table,
            origins: &merged.origins,
            file_context,
            warnings,
            item: None,
            readable_prefix: None,
        }
    }

    /// Returns the readers of the list's items, each named by its number in messages.
    pub fn items(&self) -> Vec<Self> {
        let items = self.table.get(self.declaration.list.name());
        let items = items.and_then(|items| items.get_ref().as_array());
        let tables = items.into_iter().flat_map(|items| items.iter());
        tables
            .filter_map(|item| item.get_ref().as_table())
            .enumerate()
            .map(|(index, table)| Self {
                table,
                item: Some((index, (index + 1).to_string())),
                readable_prefix: self.readable_prefix.clone(),
                ..*self
            })
            .collect()
    }

    /// Returns this reader of an item, which messages then call `name`.
    #[must_use]
    pub(crate) fn with_name(self, name: &str) -> Self {
        let item = self.item.map(|(index, _)| (index, name.to_owned()));
        Self { item, ..self }
    }

    /// Returns this reader for the policy `name`, restricted to the fields below `policy.NAME`: a policy must not read
    /// the seed or the event process. Its section must have this path. Errors may name any field.
    #[must_use]
    pub fn for_policy(&self, name: &str) -> Self {
        Self {
            item: self.item.clone(),
            readable_prefix: Some(format!("policy.{name}.")),
            ..*self
        }
    }

    /// # Panics
    /// If this reader must not read the field at `path`.
    fn assert_readable(&self, path: &str) {
        let is_readable = self
            .readable_prefix
            .as_ref()
            .is_none_or(|prefix| path.starts_with(prefix));
        assert!(is_readable, "a policy may read only its own fields, not {path}");
    }

    /// Returns the value of a field, or its default.
    ///
    /// # Errors
    /// If the value is out of its range, or neither set nor given by a default.
    ///
    /// # Panics
    /// If a policy reads a field that is not its own.
    pub fn field<T: FieldRepr>(&self, section: &'static Section, field: &'static Field) -> Result<T, ScenarioError> {
        if let Some(value) = self.optional_field(section, field)? {
            return Ok(value);
        }
        let default = match field.default {
            FieldDefault::Value(value) => T::from_value(value),
            FieldDefault::Derived(_) | FieldDefault::None => T::absent(),
        };
        default.ok_or_else(|| self.missing_required(&section.path_of(field.name), section.condition(field)))
    }

    /// Returns the value of a field if it is set.
    ///
    /// # Errors
    /// If the value is out of its range.
    ///
    /// # Panics
    /// If a policy reads a field that is not its own.
    pub fn optional_field<T: FieldRepr>(
        &self,
        section: &'static Section,
        field: &'static Field,
    ) -> Result<Option<T>, ScenarioError> {
        let path = section.path_of(field.name);
        self.assert_readable(&path);
        let Some(value) = self.value(&path) else {
            return Ok(None);
        };
        let (field_type, refuse) = (&field.field_type, |shown: &dyn Display| {
            self.invalid_value(&path, shown, format!("must be {}", field.field_type.describe_range()))
        });
        let parsed = match field_type {
            FieldType::Whole { min, max } => {
                let whole = to_integer(value).and_then(|whole| u64::try_from(whole).ok());
                let whole = whole.ok_or_else(|| refuse(&format_value(value)))?;
                if !(*min..=*max).contains(&whole) {
                    return Err(refuse(&whole));
                }
                T::from_value(FieldValue::Whole(whole))
            }
            FieldType::Number(range) => {
                let number = to_float(value).ok_or_else(|| refuse(&format_value(value)))?;
                if !range.contains(number) {
                    return Err(refuse(&number));
                }
                // Adding 0 turns -0 into 0: both are equal, but differ in text and in the hash.
                T::from_value(FieldValue::Number(number + 0.0))
            }
            FieldType::Energy { is_positive } => {
                let units = to_float(value).ok_or_else(|| refuse(&format_value(value)))?;
                let energy = Energy::from_units(units).filter(|energy| !is_positive || *energy > Energy::ZERO);
                let energy = energy.ok_or_else(|| refuse(&units))?;
                if is_changed_by_rounding(units, energy.units()) {
                    let rounded = energy.units();
                    self.warn(format!(
                        "{path} = {units} is rounded to {rounded}, since {ROUNDING_RULE}"
                    ));
                }
                T::from_value(FieldValue::Energy(energy))
            }
            FieldType::Switch => value
                .as_bool()
                .and_then(|is_on| T::from_value(FieldValue::Switch(is_on))),
            FieldType::Choice(_)
            | FieldType::Registered
            | FieldType::Text
            | FieldType::File
            | FieldType::WordOrFile(_) => value.as_str().and_then(|text| T::from_value(FieldValue::Text(text))),
            FieldType::Wholes { min, max, max_len } => {
                let list: Vec<i128> = elements(value).filter_map(to_integer).collect();
                let range = i128::from(*min)..=i128::from(*max);
                if list.is_empty() || list.len() > *max_len || list.iter().any(|item| !range.contains(item)) {
                    return Err(refuse(&format!("{list:?}")));
                }
                // The limits of the field are `u32`, so each item fits.
                let list: Vec<u32> = list.into_iter().map(|item| item as u32).collect();
                T::from_value(FieldValue::Wholes(&list))
            }
            FieldType::Texts => {
                let list: Vec<String> = elements(value).filter_map(|v| Some(v.as_str()?.to_owned())).collect();
                if list.is_empty() {
                    return Err(self.invalid_value(&path, "[]", "must name at least one"));
                }
                T::from_value(FieldValue::Texts(&list))
            }
        };
        parsed.map(Some).ok_or_else(|| refuse(&format_value(value)))
    }

    /// Returns the value at `path`, own or inherited.
    fn value(&self, path: &str) -> Option<&'a DeValue<'a>> {
        let path = self.path_in_table(path);
        let mut names = path.split('.');
        let mut value = self.table.get(names.next()?)?.get_ref();
        for name in names {
            value = value.as_table()?.get(name)?.get_ref();
        }
        Some(value)
    }

    /// Converts `path` to this table: fields that only an item has lose the name of the list.
    fn path_in_table<'p>(&self, path: &'p str) -> &'p str {
        let below_list = path.strip_prefix(self.declaration.list.name());
        match (&self.item, below_list.and_then(|suffix| suffix.strip_prefix('.'))) {
            (Some(_), Some(path_in_item)) => path_in_item,
            (Some(_), None) | (None, _) => path,
        }
    }

    /// Returns the word of the field at `path`, or its default.
    fn word_at(&self, path: &str) -> Option<&'a str> {
        if let Some(value) = self.value(path) {
            return value.as_str();
        }
        match self.declaration.field_by_path(path)?.1.default {
            FieldDefault::Value(FieldValue::Text(word)) => Some(word),
            FieldDefault::Value(_) | FieldDefault::Derived(_) | FieldDefault::None => None,
        }
    }

    /// Whether `condition` holds for this reader. A default counts as a set value.
    ///
    /// # Panics
    /// If a policy reads a field that is not its own.
    pub fn condition_holds(&self, condition: &FieldCondition) -> bool {
        self.assert_readable(condition.field);
        self.word_at(condition.field)
            .is_some_and(|word| condition.values.contains(&word))
    }

    /// Whether a file or the command line sets the field at `path` in this table, not a preset or inheritance.
    pub fn is_set(&self, path: &str) -> bool {
        matches!(
            self.own_origin(path),
            Some(ValueOrigin::File { .. } | ValueOrigin::Flag(_))
        )
    }

    /// Returns the origin of the value at `path` in this table, inherited values excluded.
    fn own_origin(&self, path: &str) -> Option<&'a ValueOrigin> {
        let path = self.path_in_table(path);
        match &self.item {
            None => self.origins.get(path),
            Some((index, _)) => self
                .origins
                .get(&format!("{}.{index}.{path}", self.declaration.list.name())),
        }
    }

    /// Returns the full path of a field for messages, and the origin of its value: the path in the item if the item
    /// sets the value, the path at the top level if the item inherits it.
    pub(crate) fn locate(&self, path: &str) -> (String, ValueOrigin) {
        let has_default = || {
            let field = self.declaration.field_by_path(path);
            field.is_some_and(|(_, field)| matches!(field.default, FieldDefault::Value(_)))
        };
        let default = || {
            if has_default() {
                ValueOrigin::Preset(self.declaration.default_preset())
            } else {
                ValueOrigin::Unset
            }
        };
        let Some((_, item_name)) = &self.item else {
            return (path.to_owned(), self.own_origin(path).cloned().unwrap_or_else(default));
        };
        let list = self.declaration.list;
        let path_with_item = join_path(&join_path(list.name(), item_name), self.path_in_table(path));
        let inherited = list.inherits_section(path).then(|| self.origins.get(path));
        match (self.own_origin(path), inherited) {
            (Some(origin), _) => (path_with_item, origin.clone()),
            (None, Some(Some(origin))) => (path.to_owned(), origin.clone()),
            (None, Some(None)) if has_default() => (path.to_owned(), default()),
            (None, Some(None) | None) => (path_with_item, default()),
        }
    }

    /// Returns the origin of the item; unset for the top level.
    pub fn item_origin(&self) -> ValueOrigin {
        let index = self.item.as_ref().map(|(index, _)| index);
        let path = index.map(|index| format!("{}.{index}", self.declaration.list.name()));
        let origin = path.and_then(|path| self.origins.get(&path));
        origin.cloned().unwrap_or(ValueOrigin::Unset)
    }

    /// Returns the error for an invalid value.
    pub fn invalid_value(&self, path: &str, value: impl Display, allowed: impl Into<String>) -> ScenarioError {
        let (field, origin) = self.locate(path);
        ScenarioError::Invalid {
            field,
            value: truncate(&value.to_string()),
            allowed: allowed.into(),
            origin,
        }
    }

    /// Returns the error for a missing value at `path` that the field at `required_by` requires.
    pub fn missing_value(&self, path: &str, required_by: &str) -> ScenarioError {
        let (reason, origin) = self.locate(required_by);
        ScenarioError::Missing {
            field: self.locate(path).0,
            why: format!("because of {reason}, {origin}"),
        }
    }

    fn missing_required(&self, path: &str, condition: Option<FieldCondition>) -> ScenarioError {
        match condition {
            Some(condition) => self.missing_value(path, condition.field),
            None => ScenarioError::Missing {
                field: self.locate(path).0,
                why: "in every scenario".to_owned(),
            },
        }
    }

    /// Returns the error that `file` cannot be used. The field at `path` names the file.
    pub fn file_error(&self, path: &str, file: PathBuf, reason: impl Into<String>) -> ScenarioError {
        let (field, origin) = self.locate(path);
        ScenarioError::InvalidFile {
            field,
            file,
            reason: reason.into(),
            origin,
        }
    }

    /// Returns the absolute path of `file`, the value of the field at `path`.
    ///
    /// # Errors
    /// If `file` is empty, or there is no working directory.
    pub fn absolute_path(&self, path: &str, file: &str) -> Result<PathBuf, ScenarioError> {
        let (_, origin) = self.locate(path);
        let full = match origin {
            ValueOrigin::Flag(_) => PathBuf::from(file),
            ValueOrigin::File { .. } | ValueOrigin::Preset(_) | ValueOrigin::Unset => {
                self.file_context.base_dir.join(file)
            }
        };
        if file.is_empty() {
            return Err(self.invalid_value(path, "\"\"", "must be the path of a file"));
        }
        let absolute = self.file_context.files.absolute(&full);
        absolute.map_err(|error| self.file_error(path, full, error.to_string()))
    }

    /// Returns the interface that reads the files of a scenario.
    pub const fn files(&self) -> &'a dyn Files {
        self.file_context.files
    }

    /// Returns the bytes of the file at `file`, a path from [`Self::absolute_path`], if it has at most `max_bytes`
    /// bytes.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn read_bytes(&self, file: &Path, max_bytes: u64) -> Result<Vec<u8>, FileError> {
        self.file_context.files.read(file, max_bytes)
    }

    /// Adds a warning for the user: a sentence without its full stop.
    pub fn warn(&self, sentence: impl Into<String>) {
        self.warnings.borrow_mut().push(sentence.into());
    }

    /// Returns the value at `path` for messages, nearly as the user wrote it.
    fn written_value(&self, path: &str) -> String {
        self.value(path)
            .map_or_else(String::new, |value| truncate(&format_value(value)))
    }

    /// Rejects fields that are set in this table without effect, because their condition does not hold. A field with a
    /// default only causes a warning, because it may be part of a file that several runs share.
    ///
    /// # Errors
    /// If there is such a field.
    pub(crate) fn reject_unused_fields(&self) -> Result<(), ScenarioError> {
        let (scope, items) = match self.item {
            Some(_) => (Scope::Item, Vec::new()),
            None => (Scope::Top, self.items()),
        };
        for header in self.declaration.headers() {
            for section in self.declaration.sections_at(scope, header) {
                for field in section.fields {
                    self.check_field(section, field, &items)?;
                }
            }
        }
        Ok(())
    }

    /// Checks one field as [`Self::reject_unused_fields`] does; `items` are the readers of the list's items, none in an
    /// item.
    fn check_field(&self, section: &'static Section, field: &Field, items: &[Self]) -> Result<(), ScenarioError> {
        let path = section.path_of(field.name);
        let Some(origin) = self.own_origin(&path) else {
            return Ok(());
        };
        let condition = section.condition(field);
        let is_effective = |reader: &Self| condition.is_none_or(|condition| reader.condition_holds(&condition));
        if !items.is_empty() && self.declaration.list.inherits_section(section.path) {
            // A field of the top level has an effect if at least one item inherits it and meets its condition.
            let affects = |item: &Self| item.own_origin(&path).is_none() && is_effective(item);
            if self.is_set(&path) && !items.iter().any(affects) {
                let list = self.declaration.list.name();
                let reason = match condition {
                    None => "each sets its own value".to_owned(),
                    Some(condition) => format!("each sets its own value or does not meet {condition}"),
                };
                let value = self.written_value(&path);
                self.warn(format!(
                    "{path} = {value} has no effect on any {list}: {reason}; {origin}"
                ));
            }
            return Ok(());
        }
        let Some(condition) = condition.filter(|condition| !self.condition_holds(condition)) else {
            return Ok(());
        };
        if matches!(field.default, FieldDefault::Value(_)) {
            if self.is_set(&path) {
                let (shown, value) = (self.locate(&path).0, self.written_value(&path));
                self.warn(format!(
                    "{shown} = {value} has an effect only with {condition}; {origin}"
                ));
            }
            return Ok(());
        }
        Err(ScenarioError::UnusedField {
            field: self.locate(&path).0,
            condition: condition.to_string(),
            origin: origin.clone(),
        })
    }
}

fn elements<'v>(value: &'v DeValue<'v>) -> impl Iterator<Item = &'v DeValue<'v>> {
    let list = value.as_array().into_iter().flat_map(|list| list.iter());
    list.map(toml::Spanned::get_ref)
}

fn format_value(value: &DeValue<'_>) -> String {
    match value {
        DeValue::String(text) => format!("\"{}\"", text.escape_debug()),
        DeValue::Integer(whole) => whole.as_str().to_owned(),
        DeValue::Float(number) => number.as_str().to_owned(),
        DeValue::Boolean(is_on) => is_on.to_string(),
        DeValue::Datetime(time) => time.to_string(),
        DeValue::Array(list) => {
            let items: Vec<String> = list.iter().map(|item| format_value(item.get_ref())).collect();
            format!("[{}]", items.join(", "))
        }
        DeValue::Table(_) => "a table".to_owned(),
    }
}
