//! Gives declared fields their values, and refuses what may not be with the place where it was set.

use std::cell::RefCell;
use std::fmt::Display;
use std::path::{Path, PathBuf};

use toml::de::{DeTable, DeValue};

use super::declaration::{Declaration, Scope};
use super::dotted;
use super::error::{ScenarioError, shortened};
use super::field::{Condition, Default, Field, Form, Section};
use super::files::{FileError, Files};
use super::layers::Merged;
use super::names::{float, integer};
use super::places::{Place, Places};
use super::value::{Declared, Value};
use crate::units::Energy;

/// Where the paths of files lead.
#[derive(Clone, Copy)]
pub struct Ground<'a> {
    /// What opens the files.
    pub files: &'a dyn Files,
    /// The folder that the paths in the file are relative to; those of the command line are relative to the working
    /// directory.
    pub base_dir: &'a Path,
}

/// The values of a whole file, or of one item of its list.
///
/// Fields are named by their full paths as at the top level (`energy.e_max`), own fields of an item by those of the
/// list (`class.share`).
pub struct Reader<'a> {
    declaration: &'a Declaration,
    table: &'a DeTable<'a>,
    places: &'a Places,
    ground: Ground<'a>,
    warnings: &'a RefCell<Vec<String>>,
    /// The number of the item, and how the user knows it.
    item: Option<(usize, String)>,
    /// Where only fields below a path may be read: that path with its stop.
    scope: Option<String>,
}

impl<'a> Reader<'a> {
    /// A reader of the top level. What it has to warn of goes to `warnings`.
    pub fn new(
        declaration: &'a Declaration,
        merged: &'a Merged<'a>,
        ground: Ground<'a>,
        warnings: &'a RefCell<Vec<String>>,
    ) -> Self {
        Self {
            declaration,
            table: &merged.table,
            places: &merged.places,
            ground,
            warnings,
            item: None,
            scope: None,
        }
    }

    /// Readers of the items of the list, each known to the user by its number.
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
                scope: self.scope.clone(),
                ..*self
            })
            .collect()
    }

    /// This item under the name by which the user knows it.
    #[must_use]
    pub fn known_as(self, name: &str) -> Self {
        let item = self.item.map(|(index, _)| (index, name.to_owned()));
        Self { item, ..self }
    }

    /// The same for the policy `name`, which may read its own fields alone: the seed and the event process are none of
    /// its business.
    #[must_use]
    pub fn of_policy(&self, name: &str) -> Self {
        Self {
            item: self.item.clone(),
            scope: Some(format!("policy.{name}.")),
            ..*self
        }
    }

    /// # Panics
    /// If the field at `path` is none of those that may be read.
    fn assert_own(&self, path: &str) {
        let is_own = self.scope.as_ref().is_none_or(|scope| path.starts_with(scope));
        assert!(is_own, "a policy reads its own fields, and not {path}");
    }

    /// The value of a field that has to have one.
    ///
    /// # Errors
    /// It is out of its range, or not set.
    ///
    /// # Panics
    /// If a policy reads a field that is not its own.
    pub fn field<T: Declared>(&self, section: &'static Section, field: &'static Field) -> Result<T, ScenarioError> {
        if let Some(value) = self.given(section, field)? {
            return Ok(value);
        }
        let default = match field.default {
            Default::Is(value) => T::from_value(value),
            Default::Derived(_) | Default::None => T::absent(),
        };
        default.ok_or_else(|| self.missing(&section.path_of(field.name), section.condition(field)))
    }

    /// The value of a field if it is set.
    ///
    /// # Errors
    /// It is out of its range.
    pub fn given<T: Declared>(
        &self,
        section: &'static Section,
        field: &'static Field,
    ) -> Result<Option<T>, ScenarioError> {
        let path = section.path_of(field.name);
        self.assert_own(&path);
        let Some(value) = self.value(&path) else {
            return Ok(None);
        };
        let (form, refused) = (&field.form, |shown: &dyn Display| {
            self.refuse(&path, shown, format!("must be {}", field.form.allowed()))
        });
        let made = match form {
            Form::Whole { least, most } => {
                let whole = integer(value).and_then(|whole| u64::try_from(whole).ok());
                let whole = whole.ok_or_else(|| refused(&shown(value)))?;
                if !(*least..=*most).contains(&whole) {
                    return Err(refused(&whole));
                }
                T::from_value(Value::Whole(whole))
            }
            Form::Number(range) => {
                let number = float(value).ok_or_else(|| refused(&shown(value)))?;
                if !range.contains(number) {
                    return Err(refused(&number));
                }
                // Adding 0 turns -0 into 0, which is written and hashed otherwise.
                T::from_value(Value::Number(number + 0.0))
            }
            Form::Energy { is_positive } => {
                let units = float(value).ok_or_else(|| refused(&shown(value)))?;
                let energy = Energy::from_units(units).filter(|energy| !is_positive || *energy > Energy::ZERO);
                T::from_value(Value::Energy(energy.ok_or_else(|| refused(&units))?))
            }
            Form::Switch => value.as_bool().and_then(|is_on| T::from_value(Value::Switch(is_on))),
            Form::Choice(_) | Form::Registered | Form::Text | Form::File | Form::Source(_) => {
                value.as_str().and_then(|text| T::from_value(Value::Text(text)))
            }
            Form::Wholes { least, most, longest } => {
                let list: Vec<i128> = elements(value).filter_map(integer).collect();
                let range = i128::from(*least)..=i128::from(*most);
                if list.is_empty() || list.len() > *longest || list.iter().any(|item| !range.contains(item)) {
                    return Err(refused(&format!("{list:?}")));
                }
                let list: Vec<u32> = list.into_iter().map(|item| item as u32).collect();
                T::from_value(Value::Wholes(&list))
            }
            Form::Texts => {
                let list: Vec<String> = elements(value).filter_map(|v| Some(v.as_str()?.to_owned())).collect();
                if list.is_empty() {
                    return Err(self.refuse(&path, "[]", "must name at least one"));
                }
                T::from_value(Value::Texts(&list))
            }
        };
        made.map(Some).ok_or_else(|| refused(&shown(value)))
    }

    /// The value at `path`, its own or inherited.
    fn value(&self, path: &str) -> Option<&'a DeValue<'a>> {
        let path = self.within(path);
        let mut names = path.split('.');
        let mut value = self.table.get(names.next()?)?.get_ref();
        for name in names {
            value = value.as_table()?.get(name)?.get_ref();
        }
        Some(value)
    }

    /// `path` within this table: own fields of an item lose the name of the list.
    fn within<'p>(&self, path: &'p str) -> &'p str {
        let own = path.strip_prefix(self.declaration.list.name());
        match (&self.item, own.and_then(|rest| rest.strip_prefix('.'))) {
            (Some(_), Some(rest)) => rest,
            (Some(_), None) | (None, _) => path,
        }
    }

    /// The word that the field at `path` holds, or its default.
    fn word(&self, path: &str) -> Option<&'a str> {
        if let Some(value) = self.value(path) {
            return value.as_str();
        }
        match self.declaration.field_at(path)?.1.default {
            Default::Is(Value::Text(word)) => Some(word),
            Default::Is(_) | Default::Derived(_) | Default::None => None,
        }
    }

    /// Whether `condition` holds here.
    pub fn holds(&self, condition: &Condition) -> bool {
        self.assert_own(condition.field);
        self.word(condition.field)
            .is_some_and(|word| condition.values.contains(&word))
    }

    /// Whether anything but a preset sets the field at `path` here, not what it inherits.
    pub fn is_set(&self, path: &str) -> bool {
        matches!(self.own(path), Some(Place::File { .. } | Place::Flag(_)))
    }

    fn own(&self, path: &str) -> Option<&'a Place> {
        let path = self.within(path);
        match &self.item {
            None => self.places.get(path),
            Some((index, _)) => self
                .places
                .get(&format!("{}.{index}.{path}", self.declaration.list.name())),
        }
    }

    /// The full path of a field as the user knows it, and where it was set.
    pub fn locate(&self, path: &str) -> (String, Place) {
        let has_default = || {
            let field = self.declaration.field_at(path);
            field.is_some_and(|(_, field)| matches!(field.default, Default::Is(_)))
        };
        let default = || {
            if has_default() {
                Place::Preset(self.declaration.base())
            } else {
                Place::Nowhere
            }
        };
        let (Some((_, shown)), Some(list)) = (&self.item, Some(self.declaration.list)) else {
            return (path.to_owned(), self.own(path).cloned().unwrap_or_else(default));
        };
        let own = dotted(&dotted(list.name(), shown), self.within(path));
        let inherited = list.takes(path).then(|| self.places.get(path));
        match (self.own(path), inherited) {
            (Some(place), _) => (own, place.clone()),
            (None, Some(Some(place))) => (path.to_owned(), place.clone()),
            (None, Some(None)) if has_default() => (path.to_owned(), default()),
            (None, Some(None) | None) => (own, default()),
        }
    }

    /// Where the item was set; nowhere for the top level.
    pub fn place(&self) -> Place {
        let index = self.item.as_ref().map(|(index, _)| index);
        let path = index.map(|index| format!("{}.{index}", self.declaration.list.name()));
        let place = path.and_then(|path| self.places.get(&path));
        place.cloned().unwrap_or(Place::Nowhere)
    }

    /// The error of a value that may not be.
    pub fn refuse(&self, path: &str, value: impl Display, allowed: impl Into<String>) -> ScenarioError {
        let (field, place) = self.locate(path);
        ScenarioError::Invalid {
            field,
            value: shortened(&value.to_string()),
            allowed: allowed.into(),
            place,
        }
    }

    /// The error of a value at `path` that has to be there because of the field at `because`.
    pub fn needed(&self, path: &str, because: &str) -> ScenarioError {
        let (reason, place) = self.locate(because);
        ScenarioError::Missing {
            field: self.locate(path).0,
            why: format!("because of {reason}, {place}"),
        }
    }

    fn missing(&self, path: &str, condition: Option<Condition>) -> ScenarioError {
        match condition {
            Some(condition) => self.needed(path, condition.field),
            None => ScenarioError::Missing {
                field: self.locate(path).0,
                why: "in every scenario".to_owned(),
            },
        }
    }

    /// The error of a file, named at `path`, that cannot be used.
    pub fn data(&self, path: &str, file: PathBuf, reason: impl Into<String>) -> ScenarioError {
        let (field, place) = self.locate(path);
        ScenarioError::Data {
            field,
            file,
            reason: reason.into(),
            place,
        }
    }

    /// The absolute path of the file that the field at `path` names as `file`.
    ///
    /// # Errors
    /// The name is empty, or there is no working directory.
    pub fn file(&self, path: &str, file: &str) -> Result<PathBuf, ScenarioError> {
        let (_, place) = self.locate(path);
        let full = match place {
            Place::Flag(_) => PathBuf::from(file),
            Place::File { .. } | Place::Preset(_) | Place::Nowhere => self.ground.base_dir.join(file),
        };
        if file.is_empty() {
            return Err(self.refuse(path, "\"\"", "must be the path of a file"));
        }
        let absolute = self.ground.files.absolute(&full);
        absolute.map_err(|error| self.data(path, full, error.to_string()))
    }

    /// What opens the files that a scenario names.
    pub const fn files(&self) -> &'a dyn Files {
        self.ground.files
    }

    /// The bytes of the file at `file`, at most `most`.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn bytes(&self, file: &Path, most: u64) -> Result<Vec<u8>, FileError> {
        self.ground.files.read(file, most)
    }

    /// Says something that the user should know, a sentence without its stop.
    pub fn warn(&self, sentence: impl Into<String>) {
        self.warnings.borrow_mut().push(sentence.into());
    }

    /// The value at `path` as the user wrote it.
    fn written(&self, path: &str) -> String {
        self.value(path)
            .map_or_else(String::new, |value| shortened(&shown(value)))
    }

    /// Refuses fields that are set here and count only under a setting that does not hold. Where a field has a default,
    /// so that it may be part of a file that several runs share, a warning is enough.
    ///
    /// # Errors
    /// There is such a field.
    pub fn check_idle(&self) -> Result<(), ScenarioError> {
        let (scope, items) = match self.item {
            Some(_) => (Scope::Item, Vec::new()),
            None => (Scope::Top, self.items()),
        };
        for header in self.declaration.headers() {
            for section in self.declaration.at(scope, header) {
                for field in section.fields {
                    self.check_field(section, field, &items)?;
                }
            }
        }
        Ok(())
    }

    fn check_field(&self, section: &'static Section, field: &Field, items: &[Self]) -> Result<(), ScenarioError> {
        let path = section.path_of(field.name);
        let Some(place) = self.own(&path) else { return Ok(()) };
        let condition = section.condition(field);
        let counts = |reader: &Self| condition.is_none_or(|condition| reader.holds(&condition));
        if !items.is_empty() && self.declaration.list.takes(section.path) {
            let takes_it = |item: &Self| item.own(&path).is_none() && counts(item);
            if self.is_set(&path) && !items.iter().any(takes_it) {
                let list = self.declaration.list.name();
                let reason = match condition {
                    None => "each sets its own".to_owned(),
                    Some(condition) => format!("each sets its own or has another {} than {condition}", condition.field),
                };
                let value = self.written(&path);
                self.warn(format!(
                    "{path} = {value} has no effect on any {list}: {reason}; {place}"
                ));
            }
            return Ok(());
        }
        let Some(condition) = condition.filter(|condition| !self.holds(condition)) else {
            return Ok(());
        };
        if matches!(field.default, Default::Is(_)) {
            if self.is_set(&path) {
                let (shown, value) = (self.locate(&path).0, self.written(&path));
                self.warn(format!(
                    "{shown} = {value} has an effect only with {condition}; {place}"
                ));
            }
            return Ok(());
        }
        Err(ScenarioError::Idle {
            field: self.locate(&path).0,
            holds: condition.to_string(),
            place: place.clone(),
        })
    }
}

/// The elements of a list.
fn elements<'v>(value: &'v DeValue<'v>) -> impl Iterator<Item = &'v DeValue<'v>> {
    let list = value.as_array().into_iter().flat_map(|list| list.iter());
    list.map(toml::Spanned::get_ref)
}

/// A value in a message.
fn shown(value: &DeValue<'_>) -> String {
    match value {
        DeValue::String(text) => format!("\"{}\"", text.escape_debug()),
        DeValue::Integer(whole) => whole.as_str().to_owned(),
        DeValue::Float(number) => number.as_str().to_owned(),
        DeValue::Boolean(is_on) => is_on.to_string(),
        DeValue::Datetime(time) => time.to_string(),
        DeValue::Array(list) => {
            let items: Vec<String> = list.iter().map(|item| shown(item.get_ref())).collect();
            format!("[{}]", items.join(", "))
        }
        DeValue::Table(_) => "a table".to_owned(),
    }
}
