//! Fields of a configuration, each declared once. All scenario fields and all policy fields use it.
//!
//! A declaration holds a field's name, type, unit, default, help and source next to the Rust type of its value
//! ([`crate::declare!`], [`crate::choices!`]). From the declarations the module derives the check of names and types,
//! errors with origin and allowed values ([`FieldReader`]), and the TOML file of a configuration ([`TomlPage`]). It
//! also derives the scenario hash ([`ScenarioHasher`]), the JSON Schema ([`json_schema()`]) and the reference page
//! ([`reference_page()`]). None of this depends on the meaning of the fields.
//!
//! Reading, in order: `overrides` and `layer` parse, `names` checks, `layers` merges, `reader` checks ranges.
//!
//! A new or renamed field or word changes `docs/scenario.md`, `tests/fuzz/scenario.dict` and, for the scenarios in
//! which it is active, the scenario hash. Tests in `bs/src/scenario/tests/pages.rs` compare the two files.

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
mod origins;
mod overrides;
mod reader;
mod reference;
mod schema;
mod toml_error;
mod toml_page;
mod value;

pub use choice::{Alternative, ChoiceType, choices};
pub use declaration::{Declaration, Preset, Scope, TableArray};
pub(crate) use error::did_you_mean;
pub use error::{ScenarioError, quoted_list, truncate};
pub(crate) use field::positive_energy;
pub use field::{
    Field, FieldCondition, FieldDefault, FieldType, NOT_NEGATIVE, POSITIVE, PROBABILITY, Range, SHARE_ABOVE_ZERO,
    SHARE_BELOW_ONE, Section, choice, energy, file, number, registered, switch, text, texts, whole, wholes, word,
    word_or_file,
};
pub use field::{FieldSink, Visit};
pub use files::{FileError, Files, NoFiles, describe_read_error};
pub use fingerprint::ScenarioHasher;
pub use layer::{Layer, MAX_TEXT_BYTES};
pub use layers::{Layers, Merged};
pub use names::{FORMER_NAME_NOTICE, former_name_warning};
pub use origins::{LayerOrigin, ValueOrigin, ValueOrigins};
pub use overrides::Override;
pub use reader::{FieldReader, FileContext, Settings};
pub use reference::reference_page;
pub use schema::json_schema;
pub use toml_error::{TomlError, parse_toml};
pub use toml_page::TomlPage;
pub use value::{FieldRepr, FieldValue};

/// Returns `section.name`, or `name` at the top level.
pub fn join_path(section: &str, name: &str) -> String {
    if section.is_empty() {
        name.to_owned()
    } else {
        format!("{section}.{name}")
    }
}
