//! The check of a layer's names and types against the declaration. The reader checks ranges later, after the merge, and
//! relies on the types. The Python package recognises warnings by [`FORMER_NAME_NOTICE`], which
//! `deploy/src/cli/former.rs` repeats for options.

use std::fmt::Display;
use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::choice::Alternative;
use super::declaration::{Declaration, Scope};
use super::error::{ScenarioError, did_you_mean, quoted_list, truncate};
use super::field::FieldType;
use super::join_path;
use super::layer::{Layer, origin_offset};
use super::origins::ValueOrigin;
use super::toml_error::whole_number_hint;

/// The end of each warning about a former name.
pub const FORMER_NAME_NOTICE: &str = "the former name will be removed in a later version";

/// Returns the warning about the path `former` of the field that is now at `current`, for example "set by --set …".
pub fn former_name_warning(former: &str, current: &str, origin: impl Display) -> String {
    format!("{former} is now called {current} ({origin}); {FORMER_NAME_NOTICE}")
}

/// Replaces the former names of fields in `layer` by their names of today, and adds a warning for each. A former name
/// next to the name of today stays, so that [`check_layer`] rejects it.
pub(super) fn replace_former(layer: &mut Layer<'_>, declaration: &Declaration, warnings: &mut Vec<String>) {
    let (scope, origin) = (
        layer.item_name.map_or(Scope::Top, |_| Scope::Item),
        layer.origin.clone(),
    );
    let mut renamed = Vec::new();
    replace_former_in(&mut layer.table, declaration, (scope, ""), &mut renamed);
    warnings.extend(
        renamed
            .into_iter()
            .map(|(former, name, offset)| former_name_warning(&former, &name, origin.origin_at(offset))),
    );
}

/// Replaces former names in the table at a path; `renamed` receives both paths and the offset of each.
fn replace_former_in(
    table: &mut DeTable<'_>,
    declaration: &Declaration,
    (scope, path): (Scope, &str),
    renamed: &mut Vec<(String, String, usize)>,
) {
    let names: Vec<_> = table.keys().cloned().collect();
    for name in names {
        let key = name.get_ref().as_ref();
        if let Some(field) = declaration
            .field_by_former_name(scope, path, key)
            .filter(|field| !table.contains_key(field.name))
            && let Some(value) = table.remove(key)
        {
            let offset = origin_offset(&name, &value);
            renamed.push((join_path(path, key), join_path(path, field.name), offset));
            table.insert(Spanned::new(name.span(), field.name.into()), value);
            continue;
        }
        let is_list = scope == Scope::Top && path.is_empty() && key == declaration.list.name();
        match table.get_mut(key).map(Spanned::get_mut) {
            Some(DeValue::Table(inner)) => {
                replace_former_in(inner, declaration, (scope, &join_path(path, key)), renamed);
            }
            Some(DeValue::Array(items)) if is_list => {
                for item in items.iter_mut() {
                    if let DeValue::Table(inner) = item.get_mut() {
                        replace_former_in(inner, declaration, (Scope::Item, ""), renamed);
                    }
                }
            }
            Some(_) | None => {}
        }
    }
}

/// Rejects a layer with an unknown name or a value of the wrong type.
pub(super) fn check_layer(layer: &Layer<'_>, declaration: &Declaration) -> Result<(), ScenarioError> {
    let check = NameCheck { layer, declaration };
    match layer.item_name {
        None => check.check_table(&layer.table, Scope::Top, "", ""),
        Some(name) => {
            let shown_path = join_path(declaration.list.name(), name);
            check.check_table(&layer.table, Scope::Item, "", &shown_path)
        }
    }
}

struct NameCheck<'c, 'a> {
    layer: &'c Layer<'a>,
    declaration: &'c Declaration,
}

impl NameCheck<'_, '_> {
    /// Checks the table at `path` in `scope`; messages call it `shown_path`.
    fn check_table(
        &self,
        table: &DeTable<'_>,
        scope: Scope,
        path: &str,
        shown_path: &str,
    ) -> Result<(), ScenarioError> {
        let headers = self.declaration.child_names(scope, path);
        for (name, value) in table {
            let (key, shown_path) = (name.get_ref().as_ref(), join_path(shown_path, name.get_ref()));
            if let Some((_, field)) = self.declaration.field(scope, path, key) {
                if let Err(mismatch) = check_type(&field.field_type, value, &self.declaration.registered) {
                    return Err(self.invalid_value(shown_path, &mismatch));
                }
            } else if scope == Scope::Top && path.is_empty() && key == self.declaration.list.name() {
                self.check_list(value, &shown_path)?;
            } else if headers.contains(&key) {
                let DeValue::Table(inner) = value.get_ref() else {
                    return Err(self.invalid_value(shown_path, &TypeMismatch::new(value, "must be a table".to_owned())));
                };
                self.check_table(inner, scope, &join_path(path, key), &shown_path)?;
            } else {
                let origin = self.layer.origin.origin_at(origin_offset(name, value));
                return Err(match self.declaration.field_by_former_name(scope, path, key) {
                    // `replace_former` leaves a former name only next to the name of today.
                    Some(field) => former_name_error(shown_path, field.name, origin),
                    None => self.unknown_field(key, shown_path, origin, scope, path),
                });
            }
        }
        Ok(())
    }

    fn check_list(&self, value: &Spanned<DeValue<'_>>, shown_path: &str) -> Result<(), ScenarioError> {
        let DeValue::Array(items) = value.get_ref() else {
            return Err(self.invalid_value(
                shown_path.to_owned(),
                &TypeMismatch::new(value, format!("must be a list: write [[{shown_path}]] for each item")),
            ));
        };
        for (index, item) in items.iter().enumerate() {
            let name = item.get_ref().get("name").and_then(|name| name.get_ref().as_str());
            let shown_path = join_path(shown_path, &name.map_or_else(|| (index + 1).to_string(), truncate));
            let DeValue::Table(table) = item.get_ref() else {
                return Err(self.invalid_value(shown_path, &TypeMismatch::new(item, "must be a table".to_owned())));
            };
            self.check_table(table, Scope::Item, "", &shown_path)?;
        }
        Ok(())
    }

    /// Returns the error for the unknown field `name` below the header `path` in `scope`; messages call it
    /// `shown_path`.
    fn unknown_field(
        &self,
        name: &str,
        shown_path: String,
        origin: ValueOrigin,
        scope: Scope,
        path: &str,
    ) -> ScenarioError {
        let sections = self.declaration.sections_at(scope, path);
        let field_names = sections
            .iter()
            .flat_map(|section| section.fields)
            .map(|field| field.name);
        let valid: Vec<&str> = field_names.chain(self.declaration.child_names(scope, path)).collect();
        let elsewhere: Vec<String> = self
            .declaration
            .field_paths()
            .filter(|known| known.rsplit('.').next() == Some(name))
            .collect();
        // Candidates of the same section come first: of equally near names, users mean one of these.
        let parent = shown_path.strip_suffix(name).unwrap_or_default().trim_end_matches('.');
        let here: Vec<String> = valid.iter().map(|known| join_path(parent, known)).collect();
        let candidates = here.iter().chain(&elsewhere).map(String::as_str);
        let is_policy = self.declaration.registered.iter().any(|word| word.name == name);
        let hint = if is_policy {
            format!("; the policy `{name}` has no fields")
        } else if elsewhere.len() > 1 {
            // Each fits equally well, such as the prices of several policies.
            format!(
                "; did you mean one of {}?",
                quoted_list(elsewhere.iter().map(String::as_str))
            )
        } else {
            did_you_mean(name, candidates)
        };
        ScenarioError::UnknownField {
            field: shown_path,
            hint,
            valid: quoted_list(valid.iter().copied()),
            origin,
        }
    }

    fn invalid_value(&self, field: String, mismatch: &TypeMismatch) -> ScenarioError {
        let written = self.layer.text.get(mismatch.span.clone()).map_or("", str::trim);
        // The text of a table with its own heading is only that heading.
        let value = if mismatch.is_table {
            "{…}".to_owned()
        } else {
            truncate(written)
        };
        ScenarioError::Invalid {
            field,
            value,
            allowed: mismatch.allowed.clone(),
            origin: self.layer.origin.origin_at(mismatch.span.start),
        }
    }
}

/// Returns the error for the former name at `former` of a field that the layer also sets as `name`.
fn former_name_error(former: String, name: &str, origin: ValueOrigin) -> ScenarioError {
    let section = former.rsplit_once('.').map_or("", |(section, _)| section);
    ScenarioError::FormerName {
        current: join_path(section, name),
        former,
        layer: match origin {
            ValueOrigin::Flag(_) => "the option",
            ValueOrigin::File { .. } | ValueOrigin::Preset(_) | ValueOrigin::Unset => "the file",
        },
        origin,
    }
}

struct TypeMismatch {
    span: Range<usize>,
    is_table: bool,
    allowed: String,
}

impl TypeMismatch {
    fn new(value: &Spanned<DeValue<'_>>, allowed: String) -> Self {
        Self {
            span: value.span(),
            is_table: value.get_ref().is_table(),
            allowed,
        }
    }
}

/// Checks the TOML type of `value`, and the words of a choice; `registered` are the names of policies. Ranges are
/// checked only where a number does not fit its Rust type.
fn check_type(
    field_type: &FieldType,
    value: &Spanned<DeValue<'_>>,
    registered: &[Alternative],
) -> Result<(), TypeMismatch> {
    let mismatch = || TypeMismatch::new(value, format!("must be {}", field_type.describe_type()));
    let check_choice = |words: &[Alternative]| match value.get_ref().as_str() {
        Some(word) => check_word(word, words).map_err(|allowed| TypeMismatch::new(value, allowed)),
        None => Err(mismatch()),
    };
    let require = |is_valid: bool| if is_valid { Ok(()) } else { Err(mismatch()) };
    match field_type {
        FieldType::Whole { .. } => match to_integer(value.get_ref()) {
            Some(whole) if whole > i128::from(u64::MAX) => Err(TypeMismatch::new(
                value,
                format!("must be {}", field_type.describe_range()),
            )),
            Some(whole) => require(whole >= 0),
            None => {
                let hint = value
                    .get_ref()
                    .as_float()
                    .map(|number| whole_number_hint(number.as_str()));
                let allowed = format!("must be {}{}", field_type.describe_type(), hint.unwrap_or_default());
                Err(TypeMismatch::new(value, allowed))
            }
        },
        FieldType::Number(_) | FieldType::Energy { .. } => require(to_float(value.get_ref()).is_some()),
        FieldType::Switch => require(value.get_ref().is_bool()),
        FieldType::Choice(words) => check_choice(words),
        FieldType::Registered => check_choice(registered),
        FieldType::Text | FieldType::File | FieldType::WordOrFile(_) => require(value.get_ref().is_str()),
        FieldType::Wholes { .. } => check_items(value, mismatch, &FieldType::Whole { min: 0, max: u64::MAX }),
        FieldType::Texts => check_items(value, mismatch, &FieldType::Text),
    }
}

/// Checks that `value` is a list, or else returns `mismatch`, and that its items have the type `field_type`.
fn check_items(
    value: &Spanned<DeValue<'_>>,
    mismatch: impl Fn() -> TypeMismatch,
    field_type: &FieldType,
) -> Result<(), TypeMismatch> {
    let list = value.get_ref().as_array().ok_or_else(mismatch)?;
    list.iter().try_for_each(|item| check_type(field_type, item, &[]))
}

/// Checks that `word` is one of `words`; the error lists them.
pub(super) fn check_word(word: &str, words: &[Alternative]) -> Result<(), String> {
    let names = || words.iter().map(|known| known.name);
    if names().any(|name| name == word) {
        return Ok(());
    }
    Err(format!(
        "must be one of {}{}",
        quoted_list(names()),
        did_you_mean(word, names())
    ))
}

/// Returns `value` as a whole number, if it is one.
pub(super) fn to_integer(value: &DeValue<'_>) -> Option<i128> {
    let integer = value.as_integer()?;
    i128::from_str_radix(integer.as_str(), integer.radix()).ok()
}

/// Returns `value` as a number, if it is one.
pub(super) fn to_float(value: &DeValue<'_>) -> Option<f64> {
    // TOML does not count a whole number without a point as a float.
    match to_integer(value) {
        Some(whole) => Some(whole as f64),
        None => value.as_float()?.as_str().parse().ok(),
    }
}
