//! A scenario written out.

use std::path::{Path, PathBuf};

use super::declaration::declaration;
use super::model::{Policies, Scenario};
use super::run::Run;
use crate::declare::{Field, Page, Section, Sink, Value};

impl Scenario {
    /// The complete scenario as TOML, with units. Loading it gives an equal scenario as long as the layout and trace
    /// files that it names are still there.
    #[must_use]
    pub fn to_toml(&self) -> String {
        self.page().in_force(&declaration(&[self.policy.kind()]))
    }

    /// As [`Self::to_toml`], with other names for the files for which `name` has one.
    #[must_use]
    pub fn to_toml_with(&self, name: impl Fn(&Path) -> Option<String>) -> String {
        let mut page = Page::default();
        let mut renamed = Renamed { page: &mut page, name };
        Run::visit_preset(&self.preset, &mut renamed);
        self.visit(&mut renamed);
        page.in_force(&declaration(&[self.policy.kind()]))
    }

    /// The files that it names, each once, in the order of declaration.
    #[must_use]
    pub fn files(&self) -> Vec<PathBuf> {
        let mut files = Named(Vec::new());
        self.visit(&mut files);
        files.0
    }

    /// As [`Self::to_toml`], with every field that does not count here commented out: those of other kinds and of other
    /// `policies`.
    #[must_use]
    pub fn to_full_toml(&self, policies: Policies<'_>) -> String {
        self.page().everything(&declaration(policies))
    }

    fn page(&self) -> Page {
        let mut page = Page::default();
        Run::visit_preset(&self.preset, &mut page);
        self.visit(&mut page);
        page
    }
}

/// Gathers the files. Their paths are absolute; what is relative is a word that stands in the place of a file.
struct Named(Vec<PathBuf>);

impl Sink for Named {
    fn item(&mut self, _: &str) {}

    fn field(&mut self, _: &'static Section, _: &'static Field, value: Value<'_>) {
        if let Value::Path(path) = value {
            let path = PathBuf::from(path);
            if path.is_absolute() && !self.0.contains(&path) {
                self.0.push(path);
            }
        }
    }

    fn content(&mut self, _: &[u8]) {}
}

/// Writes a page with other names for files.
struct Renamed<'p, N> {
    page: &'p mut Page,
    name: N,
}

impl<N: Fn(&Path) -> Option<String>> Sink for Renamed<'_, N> {
    fn item(&mut self, name: &str) {
        self.page.item(name);
    }

    fn field(&mut self, section: &'static Section, field: &'static Field, value: Value<'_>) {
        let renamed = if let Value::Path(path) = value {
            (self.name)(Path::new(path))
        } else {
            None
        };
        let value = renamed.as_deref().map_or(value, Value::Path);
        self.page.field(section, field, value);
    }

    fn content(&mut self, bytes: &[u8]) {
        self.page.content(bytes);
    }
}
