//! The declaration of a whole configuration: sections, list and presets, with the look-ups by path that reader, schema
//! and pages share. The order of sections is the order in files and pages; hashes do not depend on it.
//! `common/src/scenario/declaration.rs` builds the only one. `tests/fuzz/scenario.dict` lists its names and words,
//! which a test of `bs/src/scenario/` compares.

use super::choice::Alternative;
use super::field::{Field, FieldType, Section};

/// A list of tables (`[[class]]`), each of which may override the fields of some sections.
#[derive(Clone, Copy, Debug)]
pub struct TableArray {
    /// The fields that only an item has; their section's path is the name of the list. One of them is `name`.
    pub section: &'static Section,
    /// The headers that an item inherits from the top level, with everything below them, and may override.
    pub inherits: &'static [&'static str],
}

impl TableArray {
    /// The name of the list.
    pub const fn name(&self) -> &'static str {
        self.section.path
    }

    /// Whether an item inherits the section at `path`.
    pub fn inherits_section(&self, path: &str) -> bool {
        self.inherits.iter().any(|header| is_within(path, header))
    }
}

/// All sections, presets and words that a file may use.
#[derive(Clone, Debug)]
pub struct Declaration {
    /// The title of the file.
    pub title: &'static str,
    /// The sections in the order in which a file shows them.
    pub sections: Vec<&'static Section>,
    /// The list of tables.
    pub list: TableArray,
    /// The words of fields of the type [`Registered`](super::FieldType::Registered): the policies.
    pub registered: Vec<Alternative>,
    /// The presets. The first one holds only the defaults.
    pub presets: &'static [Preset],
}

/// A named set of values.
#[derive(Clone, Copy, Debug)]
pub struct Preset {
    /// Its name.
    pub name: &'static str,
    /// A phrase that describes the preset.
    pub about: &'static str,
    /// The values that differ from the defaults, as TOML. The reference page shows them as written.
    pub text: &'static str,
}

/// A table of a file: the whole file, or one item of its list. Paths of headers are relative to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// The whole file.
    Top,
    /// An item of the list.
    Item,
}

impl Declaration {
    /// Returns the sections whose header is exactly `path` in `scope`.
    pub fn sections_at(&self, scope: Scope, path: &str) -> Vec<&'static Section> {
        match (scope, path) {
            (Scope::Item, "") => vec![self.list.section],
            (Scope::Item, path) if !self.list.inherits_section(path) => Vec::new(),
            (Scope::Top | Scope::Item, path) => self.sections.iter().copied().filter(|s| s.path == path).collect(),
        }
    }

    /// Returns the last parts of the headers directly below `path` in `scope`.
    pub fn child_names(&self, scope: Scope, path: &str) -> Vec<&'static str> {
        let mut names: Vec<&'static str> = Vec::new();
        for section in &self.sections {
            if scope == Scope::Item && !self.list.inherits_section(section.path) {
                continue;
            }
            let below_path = match (path, section.path) {
                ("", "") => None,
                ("", other) => Some(other),
                (path, other) => other.strip_prefix(path).and_then(|suffix| suffix.strip_prefix('.')),
            };
            let name = below_path.and_then(|below| below.split('.').next());
            if let Some(name) = name.filter(|name| !names.contains(name)) {
                names.push(name);
            }
        }
        if scope == Scope::Top && path.is_empty() {
            names.push(self.list.name());
        }
        names
    }

    /// Returns the field `name` below the header `path` in `scope`, with its section.
    pub fn field(&self, scope: Scope, path: &str, name: &str) -> Option<(&'static Section, &'static Field)> {
        let sections = self.sections_at(scope, path);
        sections
            .into_iter()
            .find_map(|section| section.field(name).map(|field| (section, field)))
    }

    /// Returns today's path of the field at the dotted path `path` from the top level. `path` may end in a former
    /// name of the field. A path into the list stays as it is.
    pub fn current_path(&self, path: &str) -> String {
        let (section, name) = path.rsplit_once('.').unwrap_or(("", path));
        let renamed = self.field_by_former_name(Scope::Top, section, name);
        renamed.map_or_else(|| path.to_owned(), |field| super::join_path(section, field.name))
    }

    /// Returns the field below the header `path` in `scope` that had the name `former`.
    pub(super) fn field_by_former_name(&self, scope: Scope, path: &str, former: &str) -> Option<&'static Field> {
        let mut fields = self
            .sections_at(scope, path)
            .into_iter()
            .flat_map(|section| section.fields);
        fields.find(|field| field.former_name == Some(former))
    }

    /// Returns the field with the dotted path `path` from the top level, and its section. A field that only an item has
    /// has the path `LIST.FIELD`, without the item.
    pub fn field_by_path(&self, path: &str) -> Option<(&'static Section, &'static Field)> {
        let (section, name) = path.rsplit_once('.').unwrap_or(("", path));
        if section == self.list.name() {
            return self.list.section.field(name).map(|field| (self.list.section, field));
        }
        self.field(Scope::Top, section, name)
    }

    /// Returns the words that a field of this type may hold; empty for a type without words.
    pub fn words_of(&self, field_type: &FieldType) -> &[Alternative] {
        match field_type {
            FieldType::Choice(words) | FieldType::WordOrFile(words) => words,
            FieldType::Registered => &self.registered,
            FieldType::Whole { .. }
            | FieldType::Number(_)
            | FieldType::Energy { .. }
            | FieldType::Switch
            | FieldType::Text
            | FieldType::File
            | FieldType::Wholes { .. }
            | FieldType::Texts => &[],
        }
    }

    /// Returns the headers in the order in which a file shows them, each once.
    pub fn headers(&self) -> Vec<&'static str> {
        let mut paths: Vec<&'static str> = Vec::new();
        for section in &self.sections {
            if !paths.contains(&section.path) {
                paths.push(section.path);
            }
        }
        paths
    }

    /// Returns the full paths of all fields of the top level.
    pub fn field_paths(&self) -> impl Iterator<Item = String> + '_ {
        let fields = |section: &&'static Section| section.fields.iter().map(|field| section.path_of(field.name));
        self.sections.iter().flat_map(fields)
    }

    /// Returns the name of the preset that holds only the defaults.
    pub fn default_preset(&self) -> &'static str {
        self.presets.first().map_or("", |preset| preset.name)
    }
}

/// Whether `path` is `header` or below it.
pub(super) fn is_within(path: &str, header: &str) -> bool {
    path.strip_prefix(header)
        .is_some_and(|suffix| suffix.is_empty() || suffix.starts_with('.'))
}
