//! What takes the fields of a scenario one after another.

use super::field::{Field, Section};
use super::value::Value;

/// Takes every field in force with its value, in the order of declaration: to write a file, to make a fingerprint, to
/// compare.
pub trait Sink {
    /// The fields from here on are those of the item called `name` of the list (a device class); nothing ends it.
    fn item(&mut self, name: &str);

    /// The field `field` of `section` holds `value`.
    fn field(&mut self, section: &'static Section, field: &'static Field, value: Value<'_>);

    /// What the file that the last field names holds, or a fingerprint of it.
    fn content(&mut self, bytes: &[u8]);
}
