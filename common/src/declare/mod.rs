//! Fields of a configuration, declared once.
//!
//! A field's name, form, unit, default, help and source stand in one place, beside the type that holds its value
//! ([`crate::declare!`], [`crate::choices!`]). From the declarations come the check of names and types of every layer,
//! the errors with place and what is allowed ([`Reader`]), the TOML file of a configuration ([`Page`]), its fingerprint
//! ([`Fingerprint`]), the JSON Schema ([`schema()`]) and the reference page ([`reference()`]). Nothing here knows what
//! the fields are about.

mod choice;
mod declaration;
mod error;
mod field;
mod files;
mod fingerprint;
mod layer;
mod layers;
mod macros;
mod names;
mod overrides;
mod page;
mod places;
mod reader;
mod reference;
mod schema;
mod sink;
mod value;

pub use choice::{Alternative, Choice, choices};
pub use declaration::{Declaration, List, Preset, Scope};
pub use error::{ScenarioError, did_you_mean, listed, shortened};
pub use field::{
    ABOVE_ZERO, BELOW_ONE, Condition, Default, Field, Form, NOT_NEGATIVE, POSITIVE, PROBABILITY, Range, Section,
    choice, energy, file, number, positive_energy, registered, source, switch, text, texts, whole, wholes, word,
};
pub use files::{FileError, Files, NoFiles};
pub use fingerprint::Fingerprint;
pub use layer::{LONGEST_TEXT, Layer};
pub use layers::{Layers, Merged};
pub use overrides::Override;
pub use page::Page;
pub use places::{Origin, Place, Places};
pub use reader::{Ground, Reader};
pub use reference::reference;
pub use schema::schema;
pub use sink::Sink;
pub use value::{Declared, Value};

/// `section.name`, or `name` at the top level.
pub fn dotted(section: &str, name: &str) -> String {
    if section.is_empty() {
        name.to_owned()
    } else {
        format!("{section}.{name}")
    }
}
