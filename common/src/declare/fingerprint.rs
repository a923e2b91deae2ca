//! The hash of a scenario, which `common/src/scenario/model.rs` computes. Run folders, result tables and learned files
//! store it, so the bytes hashed for a field must not change unless the format's version does: `HASH_FORMAT` there.

use sha2::{Digest, Sha256};

use super::field::{Field, FieldSink, Section};
use super::join_path;
use super::value::FieldValue;

/// A SHA-256 hash over the paths and values of all active fields, in the order of declaration. The contents of files
/// replace their paths.
#[derive(Clone, Debug)]
pub struct ScenarioHasher {
    hasher: Sha256,
    /// The name of the current list item, which prefixes its paths; empty at the top level.
    item_name: String,
    /// The path of the only field that is not hashed.
    omitted_path: &'static str,
}

impl ScenarioHasher {
    /// Creates a hasher before the first field. `format_version` starts the hashed bytes; `omitted_path` is the path of
    /// a field of the top level that is not hashed.
    pub fn new(format_version: &str, omitted_path: &'static str) -> Self {
        let mut hasher = Self {
            hasher: Sha256::new(),
            item_name: String::new(),
            omitted_path,
        };
        hasher.hash_text(format_version);
        hasher
    }

    /// Returns the hash of all fields received so far.
    pub fn finish(self) -> [u8; 32] {
        self.hasher.finalize().into()
    }

    /// Hashes a text after its length, so that different sequences cannot give the same bytes.
    fn hash_text(&mut self, text: &str) {
        self.hash_number(text.len() as u64);
        self.hasher.update(text.as_bytes());
    }

    fn hash_number(&mut self, number: u64) {
        self.hasher.update(number.to_le_bytes());
    }
}

impl FieldSink for ScenarioHasher {
    fn item(&mut self, name: &str) {
        self.hash_text("item");
        self.hash_text(name);
        name.clone_into(&mut self.item_name);
    }

    fn field(&mut self, section: &'static Section, field: &'static Field, value: FieldValue<'_>) {
        let path = join_path(&self.item_name, &section.path_of(field.name));
        if path == self.omitted_path {
            return;
        }
        self.hash_text(&path);
        match value {
            FieldValue::Whole(whole) => self.hash_number(whole),
            FieldValue::Number(number) => self.hash_number(number.to_bits()),
            FieldValue::Energy(energy) => self.hash_number(energy.micro()),
            FieldValue::Switch(is_on) => self.hash_number(u64::from(is_on)),
            FieldValue::Text(text) => self.hash_text(text),
            // The content of the file follows, see `content`. Without that call, the hash would not depend on the file.
            FieldValue::Path(_) => {}
            FieldValue::Wholes(list) => {
                self.hash_number(list.len() as u64);
                for &whole in list {
                    self.hash_number(u64::from(whole));
                }
            }
            FieldValue::Texts(list) => {
                self.hash_number(list.len() as u64);
                for text in list {
                    self.hash_text(text);
                }
            }
        }
    }

    fn content(&mut self, bytes: &[u8]) {
        self.hash_number(bytes.len() as u64);
        self.hasher.update(bytes);
    }
}
