//! The fingerprint of a configuration.

use sha2::{Digest, Sha256};

use super::dotted;
use super::field::{Field, FieldSink, Section};
use super::value::FieldValue;

/// A SHA-256 hash over the paths and values of all active fields, in the order of declaration. The contents of files
/// replace their paths.
#[derive(Clone, Debug)]
pub struct ScenarioHasher {
    sum: Sha256,
    /// The prefix of the paths of the current item.
    item: String,
    /// The path of the field that is not hashed.
    omitted: &'static str,
}

impl ScenarioHasher {
    /// Creates a hasher before the first field. `form` identifies the version of the format; `left_out` is the path of
    /// a field that is not hashed.
    pub fn new(form: &str, left_out: &'static str) -> Self {
        let mut made = Self {
            sum: Sha256::new(),
            item: String::new(),
            omitted: left_out,
        };
        made.text(form);
        made
    }

    /// Returns the hash of all fields received so far.
    pub fn finish(self) -> [u8; 32] {
        self.sum.finalize().into()
    }

    /// Hashes a text after its length, so that different sequences cannot give the same bytes.
    fn text(&mut self, text: &str) {
        self.number(text.len() as u64);
        self.sum.update(text.as_bytes());
    }

    fn number(&mut self, number: u64) {
        self.sum.update(number.to_le_bytes());
    }
}

impl FieldSink for ScenarioHasher {
    fn item(&mut self, name: &str) {
        self.text("item");
        self.text(name);
        name.clone_into(&mut self.item);
    }

    fn field(&mut self, section: &'static Section, field: &'static Field, value: FieldValue<'_>) {
        let path = dotted(&self.item, &section.path_of(field.name));
        if path == self.omitted {
            return;
        }
        self.text(&path);
        match value {
            FieldValue::Whole(whole) => self.number(whole),
            FieldValue::Number(number) => self.number(number.to_bits()),
            FieldValue::Energy(energy) => self.number(energy.micro()),
            FieldValue::Switch(is_on) => self.number(u64::from(is_on)),
            FieldValue::Text(text) => self.text(text),
            // The content of the file follows, see `content`.
            FieldValue::Path(_) => {}
            FieldValue::Wholes(list) => {
                self.number(list.len() as u64);
                for &whole in list {
                    self.number(u64::from(whole));
                }
            }
            FieldValue::Texts(list) => {
                self.number(list.len() as u64);
                for text in list {
                    self.text(text);
                }
            }
        }
    }

    fn content(&mut self, bytes: &[u8]) {
        self.number(bytes.len() as u64);
        self.sum.update(bytes);
    }
}
