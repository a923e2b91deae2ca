//! The check of a layer's names and types against the declaration.

use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::choice::Alternative;
use super::declaration::{Declaration, Scope};
use super::dotted;
use super::error::{ScenarioError, did_you_mean, quoted_list, truncate};
use super::field::FieldType;
use super::layer::Layer;

/// Replaces the former names of fields in `layer` by their names of today, and adds a warning for each. A former name
/// next to the name of today stays, so that the check rejects it.
pub(super) fn replace_former(layer: &mut Layer<'_>, declaration: &Declaration, warnings: &mut Vec<String>) {
    let (scope, origin) = (layer.item.map_or(Scope::Top, |_| Scope::Item), layer.origin.clone());
    let mut found = Vec::new();
    rename(&mut layer.table, declaration, (scope, ""), &mut found);
    warnings.extend(found.into_iter().map(|(former, name, offset)| {
        let place = origin.place(offset);
        format!("{former} is now called {name} ({place}); the former name will be removed in a later version")
    }));
}

/// Replaces former names in the table at a path; `found` receives both paths and the offset of each.
fn rename(
    table: &mut DeTable<'_>,
    declaration: &Declaration,
    (scope, path): (Scope, &str),
    found: &mut Vec<(String, String, usize)>,
) {
    let names: Vec<_> = table.keys().cloned().collect();
    for name in names {
        let former = name.get_ref().as_ref();
        if let Some(field) = declaration
            .renamed(scope, path, former)
            .filter(|field| !table.contains_key(field.name))
            && let Some(value) = table.remove(former)
        {
            let offset = if name.span().is_empty() {
                value.span().start
            } else {
                name.span().start
            };
            found.push((dotted(path, former), dotted(path, field.name), offset));
            table.insert(Spanned::new(name.span(), field.name.into()), value);
            continue;
        }
        let is_list = scope == Scope::Top && path.is_empty() && former == declaration.list.name();
        match table.get_mut(former).map(Spanned::get_mut) {
            Some(DeValue::Table(inner)) => rename(inner, declaration, (scope, &dotted(path, former)), found),
            Some(DeValue::Array(items)) if is_list => {
                for item in items.iter_mut() {
                    if let DeValue::Table(inner) = item.get_mut() {
                        rename(inner, declaration, (Scope::Item, ""), found);
                    }
                }
            }
            Some(_) | None => {}
        }
    }
}

/// Rejects a layer with an unknown name or a value of the wrong type.
pub(super) fn check(layer: &Layer<'_>, declaration: &Declaration) -> Result<(), ScenarioError> {
    let check = Check { layer, declaration };
    match layer.item {
        None => check.table(&layer.table, Scope::Top, "", ""),
        Some(name) => {
            let shown = dotted(declaration.list.name(), name);
            check.table(&layer.table, Scope::Item, "", &shown)
        }
    }
}

struct Check<'c, 'a> {
    layer: &'c Layer<'a>,
    declaration: &'c Declaration,
}

impl Check<'_, '_> {
    /// Checks the table at `path` in `scope`; messages call it `shown`.
    fn table(&self, table: &DeTable<'_>, scope: Scope, path: &str, shown: &str) -> Result<(), ScenarioError> {
        let below = self.declaration.below(scope, path);
        for (name, value) in table {
            let (known, shown) = (name.get_ref().as_ref(), dotted(shown, name.get_ref()));
            if let Some((_, field)) = self.declaration.field(scope, path, known) {
                if let Err(wrong) = fits(&field.form, value, &self.declaration.registered) {
                    return Err(self.invalid(shown, &wrong));
                }
            } else if scope == Scope::Top && path.is_empty() && known == self.declaration.list.name() {
                self.list(value, &shown)?;
            } else if below.contains(&known) {
                let DeValue::Table(inner) = value.get_ref() else {
                    return Err(self.invalid(shown, &TypeMismatch::new(value, "must be a table".to_owned())));
                };
                self.table(inner, scope, &dotted(path, known), &shown)?;
            } else {
                // Names from the command line have no offset in the text, only their values have one.
                let at = if name.span().is_empty() {
                    value.span()
                } else {
                    name.span()
                };
                return Err(self.unknown(known, shown, at.start, scope, path));
            }
        }
        Ok(())
    }

    /// Checks the list of tables.
    fn list(&self, value: &Spanned<DeValue<'_>>, shown: &str) -> Result<(), ScenarioError> {
        let DeValue::Array(items) = value.get_ref() else {
            return Err(self.invalid(
                shown.to_owned(),
                &TypeMismatch::new(value, format!("must be a list: write [[{shown}]] for each item")),
            ));
        };
        for (index, item) in items.iter().enumerate() {
            let name = item.get_ref().get("name").and_then(|name| name.get_ref().as_str());
            let shown = dotted(shown, &name.map_or_else(|| (index + 1).to_string(), truncate));
            let DeValue::Table(table) = item.get_ref() else {
                return Err(self.invalid(shown, &TypeMismatch::new(item, "must be a table".to_owned())));
            };
            self.table(table, Scope::Item, "", &shown)?;
        }
        Ok(())
    }

    fn unknown(&self, name: &str, shown: String, offset: usize, scope: Scope, path: &str) -> ScenarioError {
        let sections = self.declaration.at(scope, path);
        let own = sections
            .iter()
            .flat_map(|section| section.fields)
            .map(|field| field.name);
        let valid: Vec<&str> = own.chain(self.declaration.below(scope, path)).collect();
        let elsewhere: Vec<String> = self
            .declaration
            .paths()
            .filter(|known| known.rsplit('.').next() == Some(name))
            .collect();
        let candidates = elsewhere.iter().map(String::as_str).chain(valid.iter().copied());
        let is_registered = self.declaration.registered.iter().any(|word| word.name == name);
        let hint = if is_registered {
            format!("; the policy `{name}` has no fields")
        } else {
            did_you_mean(name, candidates)
        };
        ScenarioError::UnknownField {
            field: shown,
            hint,
            valid: quoted_list(valid.iter().copied()),
            place: self.layer.origin.place(offset),
        }
    }

    fn invalid(&self, field: String, wrong: &TypeMismatch) -> ScenarioError {
        let written = self.layer.text.get(wrong.span.clone()).map_or("", str::trim);
        // The text of a table with its own heading is only that heading.
        let value = if wrong.is_table {
            "{…}".to_owned()
        } else {
            truncate(written)
        };
        ScenarioError::Invalid {
            field,
            value,
            allowed: wrong.allowed.clone(),
            place: self.layer.origin.place(wrong.span.start),
        }
    }
}

/// A value of the wrong type.
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

/// Checks that `value` has the type `form`.
fn fits(form: &FieldType, value: &Spanned<DeValue<'_>>, registered: &[Alternative]) -> Result<(), TypeMismatch> {
    let wrong = || TypeMismatch::new(value, format!("must be {}", form.kind()));
    let word = |words: &[Alternative]| match value.get_ref().as_str() {
        Some(word) => one_of(word, words).map_err(|allowed| TypeMismatch::new(value, allowed)),
        None => Err(wrong()),
    };
    let holds = |is_it: bool| if is_it { Ok(()) } else { Err(wrong()) };
    match form {
        FieldType::Whole { .. } => match integer(value.get_ref()) {
            Some(whole) if whole > i128::from(u64::MAX) => {
                Err(TypeMismatch::new(value, format!("must be {}", form.allowed())))
            }
            whole => holds(whole.is_some_and(|whole| whole >= 0)),
        },
        FieldType::Number(_) | FieldType::Energy { .. } => holds(float(value.get_ref()).is_some()),
        FieldType::Switch => holds(value.get_ref().is_bool()),
        FieldType::Choice(words) => word(words),
        FieldType::Registered => word(registered),
        FieldType::Text | FieldType::File | FieldType::Source(_) => holds(value.get_ref().is_str()),
        FieldType::Wholes { .. } => items(
            value,
            wrong,
            &FieldType::Whole {
                least: 0,
                most: u64::MAX,
            },
        ),
        FieldType::Texts => items(value, wrong, &FieldType::Text),
    }
}

/// Checks that `value` is a list whose items all have the type `form`.
fn items(value: &Spanned<DeValue<'_>>, wrong: impl Fn() -> TypeMismatch, form: &FieldType) -> Result<(), TypeMismatch> {
    let list = value.get_ref().as_array().ok_or_else(wrong)?;
    list.iter().try_for_each(|item| fits(form, item, &[]))
}

/// Checks that `word` is one of `words`; the error lists them.
pub(super) fn one_of(word: &str, words: &[Alternative]) -> Result<(), String> {
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
pub(super) fn integer(value: &DeValue<'_>) -> Option<i128> {
    let integer = value.as_integer()?;
    i128::from_str_radix(integer.as_str(), integer.radix()).ok()
}

/// Returns `value` as a number, if it is one.
pub(super) fn float(value: &DeValue<'_>) -> Option<f64> {
    // TOML does not count a whole number without a point as a float.
    match integer(value) {
        Some(whole) => Some(whole as f64),
        None => value.as_float()?.as_str().parse().ok(),
    }
}
