//! All sections of a configuration together.

use super::choice::Alternative;
use super::field::{Field, Form, Section};

/// A list of tables (`[[class]]`), each of which may override the fields of some sections.
#[derive(Clone, Copy, Debug)]
pub struct List {
    /// The fields of an item that are its own; their path is the name of the list.
    pub section: &'static Section,
    /// The headers, with all below them, that an item takes from the top level and may override.
    pub inherits: &'static [&'static str],
}

impl List {
    /// The name of the list.
    pub const fn name(&self) -> &'static str {
        self.section.path
    }

    /// Whether an item takes over the section at `path`.
    pub fn takes(&self, path: &str) -> bool {
        self.inherits.iter().any(|own| is_within(path, own))
    }
}

/// Everything that may be said in a file.
#[derive(Clone, Debug)]
pub struct Declaration {
    /// What the file is called.
    pub title: &'static str,
    /// The sections in the order of files.
    pub sections: Vec<&'static Section>,
    /// The list of items.
    pub list: List,
    /// The words of a field of the form [`Registered`](super::Form::Registered).
    pub registered: Vec<Alternative>,
    /// The presets: name, what it is, its text. The first is the defaults and nothing else.
    pub presets: &'static [Preset],
}

/// A set of values with a name.
#[derive(Clone, Copy, Debug)]
pub struct Preset {
    /// Its name.
    pub name: &'static str,
    /// What it is, a phrase.
    pub about: &'static str,
    /// What it sets beside the defaults, TOML.
    pub text: &'static str,
}

/// A table that is looked at: the whole file, or one item of its list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// The whole file.
    Top,
    /// An item of the list.
    Item,
}

impl Declaration {
    /// The sections whose header is exactly `path` in `scope`.
    pub fn at(&self, scope: Scope, path: &str) -> Vec<&'static Section> {
        match (scope, path) {
            (Scope::Item, "") => vec![self.list.section],
            (Scope::Item, path) if !self.list.takes(path) => Vec::new(),
            (Scope::Top | Scope::Item, path) => self.sections.iter().copied().filter(|s| s.path == path).collect(),
        }
    }

    /// The headers right below `path` in `scope`, by their last names.
    pub fn below(&self, scope: Scope, path: &str) -> Vec<&'static str> {
        let mut found: Vec<&'static str> = Vec::new();
        for section in &self.sections {
            if scope == Scope::Item && !self.list.takes(section.path) {
                continue;
            }
            let rest = match (path, section.path) {
                ("", "") => None,
                ("", other) => Some(other),
                (path, other) => other.strip_prefix(path).and_then(|rest| rest.strip_prefix('.')),
            };
            let name = rest.and_then(|rest| rest.split('.').next());
            if let Some(name) = name.filter(|name| !found.contains(name)) {
                found.push(name);
            }
        }
        if scope == Scope::Top && path.is_empty() {
            found.push(self.list.name());
        }
        found
    }

    /// The field `name` below the header `path` in `scope`, with its section.
    pub fn field(&self, scope: Scope, path: &str, name: &str) -> Option<(&'static Section, &'static Field)> {
        let sections = self.at(scope, path);
        sections
            .into_iter()
            .find_map(|section| section.field(name).map(|field| (section, field)))
    }

    /// The field at the full path `path` of the top level.
    pub fn field_at(&self, path: &str) -> Option<(&'static Section, &'static Field)> {
        let (section, name) = path.rsplit_once('.').unwrap_or(("", path));
        if section == self.list.name() {
            return self.list.section.field(name).map(|field| (self.list.section, field));
        }
        self.field(Scope::Top, section, name)
    }

    /// The words that a field of this form may hold; none if it holds something else.
    pub fn words(&self, form: &Form) -> &[Alternative] {
        match form {
            Form::Choice(words) | Form::Source(words) => words,
            Form::Registered => &self.registered,
            Form::Whole { .. }
            | Form::Number(_)
            | Form::Energy { .. }
            | Form::Switch
            | Form::Text
            | Form::File
            | Form::Wholes { .. }
            | Form::Texts => &[],
        }
    }

    /// The headers in the order of files, each once.
    pub fn headers(&self) -> Vec<&'static str> {
        let mut paths: Vec<&'static str> = Vec::new();
        for section in &self.sections {
            if !paths.contains(&section.path) {
                paths.push(section.path);
            }
        }
        paths
    }

    /// The full paths of all fields of the top level.
    pub fn paths(&self) -> impl Iterator<Item = String> + '_ {
        let fields = |section: &&'static Section| section.fields.iter().map(|field| section.path_of(field.name));
        self.sections.iter().flat_map(fields)
    }

    /// The name of the preset that is nothing but the defaults.
    pub fn base(&self) -> &'static str {
        self.presets.first().map_or("", |preset| preset.name)
    }
}

/// Whether `path` is `header` or below it.
pub fn is_within(path: &str, header: &str) -> bool {
    path.strip_prefix(header)
        .is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}
