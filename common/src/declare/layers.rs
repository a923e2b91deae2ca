//! The layers of a configuration (presets, file, command line), merged in order by `scenario/load.rs`: a later layer
//! overrides the earlier ones. The origin of each value is kept. The reader finds origins by the same paths, with the
//! index of a list's item (`class.0.energy.e_max`).

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::declaration::{Declaration, Scope};
use super::error::{ScenarioError, quoted_list, truncate};
use super::layer::{Layer, origin_offset, owned_key};
use super::names;
use super::origins::{LayerOrigin, ValueOrigins};

/// The layers merged so far.
#[derive(Debug)]
pub struct Layers<'a> {
    declaration: &'a Declaration,
    table: DeTable<'a>,
    origins: ValueOrigins,
    warnings: Vec<String>,
}

/// The merged layers: every item of the list has the sections that it inherits. Inherited values have no origin in the
/// item, only at the top level.
#[derive(Debug)]
pub struct Merged<'a> {
    /// The merged table.
    pub table: DeTable<'a>,
    /// The origins of its values.
    pub origins: ValueOrigins,
    /// The warnings about former names of fields.
    pub warnings: Vec<String>,
}

impl<'a> Layers<'a> {
    /// Starts without any layer.
    pub fn new(declaration: &'a Declaration) -> Self {
        Self {
            declaration,
            table: DeTable::new(),
            origins: ValueOrigins::new(),
            warnings: Vec::new(),
        }
    }

    /// Checks the names and types of `layer` and puts it on top of the layers before it.
    ///
    /// # Errors
    /// If a field does not exist, or a value has the wrong type.
    pub fn add(&mut self, mut layer: Layer<'a>) -> Result<(), ScenarioError> {
        names::replace_former(&mut layer, self.declaration, &mut self.warnings);
        names::check_layer(&layer, self.declaration)?;
        let list = self.declaration.list.name();
        let Layer {
            table,
            origin,
            item_name,
            ..
        } = layer;
        match item_name {
            None => {
                record_origins(&table, "", &origin, &mut self.origins);
                overlay(self.declaration, (Scope::Top, ""), &mut self.table, table);
            }
            Some(name) => {
                let (index, base) = find_item(&mut self.table, list, name, &origin)?;
                record_origins(&table, &format!("{list}.{index}."), &origin, &mut self.origins);
                overlay(self.declaration, (Scope::Item, ""), base, table);
            }
        }
        Ok(())
    }

    /// Returns the merged table. Each item of the list gets the sections that it inherits, overridden by its own.
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
                if let Some(overrides) = table_mut(item, section) {
                    overlay(
                        self.declaration,
                        (Scope::Item, section),
                        &mut full,
                        std::mem::take(overrides),
                    );
                }
                item.insert(owned_key(section), Spanned::new(0..0, DeValue::Table(full)));
            }
        }
        Merged {
            table: self.table,
            origins: self.origins,
            warnings: self.warnings,
        }
    }
}

/// Overrides the values in `base`, the table at `location` in `declaration`, by the values in `above`, field by field.
/// `above` has passed [`names::check_layer`]. The list and other arrays are replaced as a whole.
fn overlay<'a>(declaration: &Declaration, location: (Scope, &str), base: &mut DeTable<'a>, above: DeTable<'a>) {
    let (scope, path) = location;
    let field = |name: &str| declaration.field(scope, path, name).map(|(_, field)| field);
    // Of two alternative fields, the later layer's applies, so it removes the other one from the layers below.
    for alternative in above.keys().filter_map(|name| field(name.get_ref())?.instead_of) {
        base.remove(alternative);
    }
    for (name, value) in above {
        let span = value.span();
        let value = value.into_inner();
        let value = if let DeValue::Table(inner) = value {
            if let Some(below) = table_mut(base, name.get_ref()) {
                let path = super::join_path(path, name.get_ref());
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

/// Records the origins of all values in `table`, whose paths start with `prefix`: "" or a path with a dot at its end.
fn record_origins(table: &DeTable<'_>, prefix: &str, origin: &LayerOrigin, origins: &mut ValueOrigins) {
    for (name, value) in table {
        let path = format!("{prefix}{}", name.get_ref());
        let inner = format!("{path}.");
        match value.get_ref() {
            DeValue::Table(table) => record_origins(table, &inner, origin, origins),
            DeValue::Array(items) => {
                // Items are replaced as a whole; no other list holds tables.
                if prefix.is_empty() {
                    origins.retain(|known, _| !known.starts_with(&inner));
                }
                for (index, item) in items.iter().enumerate() {
                    if let DeValue::Table(table) = item.get_ref() {
                        origins.insert(format!("{path}.{index}"), origin.origin_at(item.span().start));
                        record_origins(table, &format!("{path}.{index}."), origin, origins);
                    }
                }
            }
            DeValue::String(_)
            | DeValue::Integer(_)
            | DeValue::Float(_)
            | DeValue::Boolean(_)
            | DeValue::Datetime(_) => {}
        }
        origins.insert(path, origin.origin_at(origin_offset(name, value)));
    }
}

/// Returns the item `name` of `list`, with its index; an error names the items that exist in the layers so far.
fn find_item<'t, 'a>(
    table: &'t mut DeTable<'a>,
    list: &str,
    name: &str,
    origin: &LayerOrigin,
) -> Result<(usize, &'t mut DeTable<'a>), ScenarioError> {
    let names: Vec<String> = items_mut(table, list)
        .map(|item| name_of_item(item).to_owned())
        .collect();
    let found = items_mut(table, list)
        .enumerate()
        .find(|(_, item)| name_of_item(item) == name);
    found.ok_or_else(|| ScenarioError::Invalid {
        field: list.to_owned(),
        value: truncate(name),
        allowed: format!(
            "must be the name of a {list}; there are {}",
            quoted_list(names.iter().map(String::as_str))
        ),
        origin: origin.origin_at(0),
    })
}

/// Returns the name of an item, or "".
fn name_of_item<'t>(item: &'t DeTable<'_>) -> &'t str {
    item.get("name")
        .and_then(|name| name.get_ref().as_str())
        .unwrap_or_default()
}

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
