//! Scenarios written as TOML: the file `scenario.toml` of a run folder (`deploy/src/scenario_files.rs`), and the
//! templates of `reveille scenario`. Loading such a file must restore an equal scenario with an equal hash: resuming
//! and replay rely on it, and the fuzz target `scenario` checks it.

use std::path::{Path, PathBuf};

use super::declaration::declaration;
use super::model::Scenario;
use super::policy::{Policies, PolicyChoice, PolicyKind};
use crate::declare::{Field, FieldSink, FieldValue, Section, TomlPage};

impl<K: PolicyKind> Scenario<PolicyChoice<K>> {
    /// Returns the complete scenario as TOML, with units. Loading it restores an equal scenario as long as the layout
    /// and trace files that it names still exist.
    #[must_use]
    pub fn to_toml(&self) -> String {
        self.page().active_fields(&declaration(&[self.policy.kind()]))
    }

    /// Returns the TOML of [`Self::to_toml`], with new names for the files for which `rename` returns one.
    #[must_use]
    pub fn to_toml_with_files(&self, rename: impl Fn(&Path) -> Option<String>) -> String {
        let mut page = TomlPage::default();
        let mut renamer = FileRenamer {
            page: &mut page,
            rename,
        };
        self.visit(&mut renamer);
        page.active_fields(&declaration(&[self.policy.kind()]))
    }

    /// Returns the files that the scenario names, each once, in the order of declaration.
    #[must_use]
    pub fn files(&self) -> Vec<PathBuf> {
        let mut files = FileCollector(Vec::new());
        self.visit(&mut files);
        files.0
    }

    /// Returns the TOML of [`Self::to_toml`] with every unused field commented out, including the fields of other
    /// kinds and other `policies`.
    #[must_use]
    pub fn to_full_toml(&self, policies: Policies<'_, K>) -> String {
        self.page().all_fields(&declaration(policies))
    }

    fn page(&self) -> TomlPage {
        let mut page = TomlPage::default();
        self.visit(&mut page);
        page
    }
}

/// A sink that collects file paths. Files have absolute paths; a relative one is a word that a field allows in place
/// of a file.
struct FileCollector(Vec<PathBuf>);

impl FieldSink for FileCollector {
    fn item(&mut self, _: &str) {}

    fn field(&mut self, _: &'static Section, _: &'static Field, value: FieldValue<'_>) {
        if let FieldValue::Path(path) = value {
            let path = PathBuf::from(path);
            if path.is_absolute() && !self.0.contains(&path) {
                self.0.push(path);
            }
        }
    }

    fn content(&mut self, _: &[u8]) {}
}

/// A sink that writes a page with new names for files.
struct FileRenamer<'p, N> {
    page: &'p mut TomlPage,
    rename: N,
}

impl<N: Fn(&Path) -> Option<String>> FieldSink for FileRenamer<'_, N> {
    fn item(&mut self, name: &str) {
        self.page.item(name);
    }

    fn field(&mut self, section: &'static Section, field: &'static Field, value: FieldValue<'_>) {
        let renamed = if let FieldValue::Path(path) = value {
            (self.rename)(Path::new(path))
        } else {
            None
        };
        let value = renamed.as_deref().map_or(value, FieldValue::Path);
        self.page.field(section, field, value);
    }

    fn content(&mut self, bytes: &[u8]) {
        self.page.content(bytes);
    }
}
