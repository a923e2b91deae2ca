//! The fingerprint of a configuration.

use sha2::{Digest, Sha256};

use super::dotted;
use super::field::{Field, Section};
use super::sink::Sink;
use super::value::Value;

/// SHA-256 over the paths and values of all fields in force, in the order of declaration, with the contents of files in
/// place of their paths.
#[derive(Clone, Debug)]
pub struct Fingerprint {
    sum: Sha256,
    /// The prefix of the paths of the current item.
    item: String,
}

impl Fingerprint {
    /// The fingerprint before the first field. `form` names the version of its form.
    pub fn new(form: &str) -> Self {
        let mut made = Self {
            sum: Sha256::new(),
            item: String::new(),
        };
        made.text(form);
        made
    }

    /// The fingerprint of all fields so far.
    pub fn finish(self) -> [u8; 32] {
        self.sum.finalize().into()
    }

    /// A text with its length in front, so that no two sequences read the same.
    fn text(&mut self, text: &str) {
        self.number(text.len() as u64);
        self.sum.update(text.as_bytes());
    }

    fn number(&mut self, number: u64) {
        self.sum.update(number.to_le_bytes());
    }
}

impl Sink for Fingerprint {
    fn item(&mut self, name: &str) {
        self.text("item");
        self.text(name);
        name.clone_into(&mut self.item);
    }

    fn field(&mut self, section: &'static Section, field: &'static Field, value: Value<'_>) {
        let path = dotted(&self.item, &section.path_of(field.name));
        self.text(&path);
        match value {
            Value::Whole(whole) => self.number(whole),
            Value::Number(number) => self.number(number.to_bits()),
            Value::Energy(energy) => self.number(energy.micro()),
            Value::Switch(is_on) => self.number(u64::from(is_on)),
            Value::Text(text) => self.text(text),
            // The content follows.
            Value::Path(_) => {}
            Value::Wholes(list) => {
                self.number(list.len() as u64);
                for &whole in list {
                    self.number(u64::from(whole));
                }
            }
            Value::Texts(list) => {
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
