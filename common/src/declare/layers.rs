//! The layers of a configuration (presets, file, command line), laid over one another with a memory of where each value
//! was set.

use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::declaration::{Declaration, Scope};
use super::error::{ScenarioError, listed, shortened};
use super::layer::{Layer, key};
use super::names;
use super::places::{Origin, Places};

/// All layers so far.
#[derive(Debug)]
pub struct Layers<'a> {
    declaration: &'a Declaration,
    table: DeTable<'a>,
    places: Places,
}

/// All layers together: every item of the list has the sections that it inherits.
#[derive(Debug)]
pub struct Merged<'a> {
    /// The table.
    pub table: DeTable<'a>,
    /// Where its values were set.
    pub places: Places,
}

impl<'a> Layers<'a> {
    /// No layer yet.
    pub fn new(declaration: &'a Declaration) -> Self {
        Self {
            declaration,
            table: DeTable::new(),
            places: Places::new(),
        }
    }

    /// Lays `layer` over those before it, after a check of its names and types.
    ///
    /// # Errors
    /// There is no such field, or a value is of the wrong type.
    pub fn add(&mut self, layer: Layer<'a>) -> Result<(), ScenarioError> {
        names::check(&layer, self.declaration)?;
        let list = self.declaration.list.name();
        let Layer {
            table, origin, item, ..
        } = layer;
        match item {
            None => {
                record(&table, "", &origin, &mut self.places);
                overlay(self.declaration, (Scope::Top, ""), &mut self.table, table);
            }
            Some(name) => {
                let (index, base) = item_named(&mut self.table, list, name, &origin)?;
                record(&table, &format!("{list}.{index}."), &origin, &mut self.places);
                overlay(self.declaration, (Scope::Item, ""), base, table);
            }
        }
        Ok(())
    }

    /// The whole, each item of the list with its sections laid over those of the top level.
    pub fn finish(mut self) -> Merged<'a> {
        let list = self.declaration.list;
        let inherited: Vec<(&str, DeTable<'a>)> = list
            .inherits
            .iter()
            .filter_map(|section| Some((*section, table_mut(&mut self.table, section)?.clone())))
            .collect();
        for item in items_mut(&mut self.table, list.name()) {
            for (section, base) in &inherited {
                let mut full = base.clone();
                if let Some(own) = table_mut(item, section) {
                    overlay(self.declaration, (Scope::Item, section), &mut full, std::mem::take(own));
                }
                item.insert(key(section), Spanned::new(0..0, DeValue::Table(full)));
            }
        }
        Merged {
            table: self.table,
            places: self.places,
        }
    }
}

/// Sets in `base`, the table at a path of `declaration`, what `above` sets, tables field by field.
fn overlay<'a>(declaration: &Declaration, at: (Scope, &str), base: &mut DeTable<'a>, above: DeTable<'a>) {
    let (scope, path) = at;
    let field = |name: &str| declaration.field(scope, path, name).map(|(_, field)| field);
    for other in above.keys().filter_map(|name| field(name.get_ref())?.instead_of) {
        base.remove(other);
    }
    for (name, value) in above {
        let span = value.span();
        let value = value.into_inner();
        let value = if let DeValue::Table(inner) = value {
            if let Some(below) = table_mut(base, name.get_ref()) {
                let path = super::dotted(path, name.get_ref());
                overlay(declaration, (scope, &path), below, inner);
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
                // Items are replaced as a whole; no other list holds tables.
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

/// The item called `name` of `list`, with its number.
fn item_named<'t, 'a>(
    table: &'t mut DeTable<'a>,
    list: &str,
    name: &str,
    origin: &Origin,
) -> Result<(usize, &'t mut DeTable<'a>), ScenarioError> {
    let names: Vec<String> = items_mut(table, list).map(|item| item_name(item).to_owned()).collect();
    let found = items_mut(table, list)
        .enumerate()
        .find(|(_, item)| item_name(item) == name);
    found.ok_or_else(|| ScenarioError::Invalid {
        field: list.to_owned(),
        value: shortened(name),
        allowed: format!(
            "must be the name of a {list}; there are {}",
            listed(names.iter().map(String::as_str))
        ),
        place: origin.place(0),
    })
}

/// The name of an item, or "".
fn item_name<'t>(item: &'t DeTable<'_>) -> &'t str {
    item.get("name")
        .and_then(|name| name.get_ref().as_str())
        .unwrap_or_default()
}

/// The tables of `list`.
fn items_mut<'t, 'a>(
    table: &'t mut DeTable<'a>,
    list: &str,
) -> impl Iterator<Item = &'t mut DeTable<'a>> + use<'t, 'a> {
    let items = table.get_mut(list).map(Spanned::get_mut);
    let items = if let Some(DeValue::Array(items)) = items {
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
