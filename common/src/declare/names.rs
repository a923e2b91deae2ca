//! Names and types of a layer, checked against the declaration.

use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::choice::Alternative;
use super::declaration::{Declaration, Scope};
use super::dotted;
use super::error::{ScenarioError, did_you_mean, listed, shortened};
use super::field::Form;
use super::layer::Layer;

/// Refuses a layer with a name that there is not or a value of the wrong type.
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
    /// The table at `path` in `scope`, which a user knows as `shown`.
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
                    return Err(self.invalid(shown, &Wrong::of(value, "must be a table".to_owned())));
                };
                self.table(inner, scope, &dotted(path, known), &shown)?;
            } else {
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

    /// The list of items.
    fn list(&self, value: &Spanned<DeValue<'_>>, shown: &str) -> Result<(), ScenarioError> {
        let DeValue::Array(items) = value.get_ref() else {
            return Err(self.invalid(
                shown.to_owned(),
                &Wrong::of(value, format!("must be a list: write [[{shown}]] for each item")),
            ));
        };
        for (index, item) in items.iter().enumerate() {
            let name = item.get_ref().get("name").and_then(|name| name.get_ref().as_str());
            let shown = dotted(shown, &name.map_or_else(|| (index + 1).to_string(), shortened));
            let DeValue::Table(table) = item.get_ref() else {
                return Err(self.invalid(shown, &Wrong::of(item, "must be a table".to_owned())));
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
            format!("; `{name}` has no fields of its own")
        } else {
            did_you_mean(name, candidates)
        };
        ScenarioError::UnknownField {
            field: shown,
            hint,
            valid: listed(valid.iter().copied()),
            place: self.layer.origin.place(offset),
        }
    }

    fn invalid(&self, field: String, wrong: &Wrong) -> ScenarioError {
        let written = self.layer.text.get(wrong.span.clone()).map_or("", str::trim);
        // Of a table under a heading of its own, the text is the heading.
        let value = if wrong.is_table {
            "{…}".to_owned()
        } else {
            shortened(written)
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
struct Wrong {
    span: Range<usize>,
    is_table: bool,
    allowed: String,
}

impl Wrong {
    fn of(value: &Spanned<DeValue<'_>>, allowed: String) -> Self {
        Self {
            span: value.span(),
            is_table: value.get_ref().is_table(),
            allowed,
        }
    }
}

/// Whether `value` is of the type of `form`.
fn fits(form: &Form, value: &Spanned<DeValue<'_>>, registered: &[Alternative]) -> Result<(), Wrong> {
    let wrong = || Wrong::of(value, format!("must be {}", form.kind()));
    let word = |words: &[Alternative]| match value.get_ref().as_str() {
        Some(word) => one_of(word, words).map_err(|allowed| Wrong::of(value, allowed)),
        None => Err(wrong()),
    };
    let holds = |is_it: bool| if is_it { Ok(()) } else { Err(wrong()) };
    match form {
        Form::Whole { .. } => match integer(value.get_ref()) {
            Some(whole) if whole > i128::from(u64::MAX) => Err(Wrong::of(value, format!("must be {}", form.allowed()))),
            whole => holds(whole.is_some_and(|whole| whole >= 0)),
        },
        Form::Number(_) | Form::Energy { .. } => holds(float(value.get_ref()).is_some()),
        Form::Switch => holds(value.get_ref().is_bool()),
        Form::Choice(words) => word(words),
        Form::Registered => word(registered),
        Form::Text | Form::File | Form::Source(_) => holds(value.get_ref().is_str()),
        Form::Wholes { .. } => items(
            value,
            wrong,
            &Form::Whole {
                least: 0,
                most: u64::MAX,
            },
        ),
        Form::Texts => items(value, wrong, &Form::Text),
    }
}

/// Whether `value` is a list whose items all are of the type of `form`.
fn items(value: &Spanned<DeValue<'_>>, wrong: impl Fn() -> Wrong, form: &Form) -> Result<(), Wrong> {
    let list = value.get_ref().as_array().ok_or_else(wrong)?;
    list.iter().try_for_each(|item| fits(form, item, &[]))
}

/// Refuses a word that is none of `words`, and says which there are.
pub(super) fn one_of(word: &str, words: &[Alternative]) -> Result<(), String> {
    let names = || words.iter().map(|known| known.name);
    if names().any(|name| name == word) {
        return Ok(());
    }
    Err(format!(
        "must be one of {}{}",
        listed(names()),
        did_you_mean(word, names())
    ))
}

/// The whole number that `value` is.
pub(super) fn integer(value: &DeValue<'_>) -> Option<i128> {
    let integer = value.as_integer()?;
    i128::from_str_radix(integer.as_str(), integer.radix()).ok()
}

/// The number that `value` is.
pub(super) fn float(value: &DeValue<'_>) -> Option<f64> {
    match integer(value) {
        Some(whole) => Some(whole as f64),
        None => value.as_float()?.as_str().parse().ok(),
    }
}
