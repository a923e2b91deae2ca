//! Wireshark dissector in Lua, generated from the message schemas so that it reads the messages of this version.
//!
//! Every kind has a filter, such as `reveille.wake`, and every field has its own: `reveille.`, the kind and the path to
//! the field, such as `reveille.wake.device`. The variant name of a choice is in `….is`. Labels of fields end with
//! their units. `dissector.lua` reads the keys of the generated tables and the names of forms, such as `seq`: change
//! both. `inspect export --dissector` writes the script. `tests/recordings/check.py` checks it with tshark and repeats
//! the names of fields; docs/inspecting.md shows filters.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use reveille_common::codec::WIRE_VERSION;
use reveille_common::message::{Addressee, MessageKind};
use serde_reflection::{ContainerFormat, Format, Named, VariantFormat};

use super::pcapng::kind_number;
use crate::schemas::MessageSchemas;

/// Part common to all dissectors. Comments that begin with `--@` mark the places of the generated parts.
const LUA_CORE: &str = include_str!("dissector.lua");

/// Generates the script.
pub fn lua_script() -> String {
    let schemas = MessageSchemas::trace_all();
    let mut script = ScriptBuilder {
        schemas: &schemas,
        fields: BTreeMap::new(),
    };
    let mut kinds = String::new();
    for kind in MessageKind::ALL {
        let (plane, name, addressee) = (kind.plane().name(), kind.name(), kind.addressee().name());
        let lua_form = script.form(schemas.type_of(*kind), name);
        // The number in the message's key gets a field, except for a kind without a number. A report's payload holds
        // the device too, so the field with this path exists already.
        let path = format!("{name}.{addressee}");
        let needs_number_field = kind.addressee() != Addressee::Unaddressed && !script.fields.contains_key(&path);
        if needs_number_field {
            script.add_field(&path, "uint32");
        }
        let (from, to) = kind.direction().split_once(" → ").unwrap_or((kind.direction(), ""));
        let _infallible = writeln!(
            kinds,
            "kinds[{}] = {{plane = {plane:?}, name = {name:?}, addressee = {addressee:?}, \
             needs_number_field = {needs_number_field}, from = {from:?}, to = {to:?}, form = {lua_form}}}",
            kind_number(*kind)
        );
    }
    let mut fields = String::new();
    for kind in MessageKind::ALL {
        let (name, about) = (kind.name(), kind.about());
        let _infallible = writeln!(
            fields,
            "fields[{name:?}] = ProtoField.none(\"reveille.{name}\", {name:?}, {about:?})"
        );
    }
    for (path, (lua_type, unit)) in &script.fields {
        let name = path.rsplit('.').next().unwrap_or(path);
        let label = unit.map_or_else(|| name.to_owned(), |unit| format!("{name} ({unit})"));
        let _infallible = writeln!(
            fields,
            "fields[{path:?}] = ProtoField.{lua_type}(\"reveille.{path}\", {label:?})"
        );
    }
    LUA_CORE
        .replace("--@fields", &fields)
        .replace("--@kinds", &kinds)
        .replace("--@version", &format!("local version = {WIRE_VERSION}"))
}

/// Schemas, and the fields that the Lua tables need.
struct ScriptBuilder<'a> {
    schemas: &'a MessageSchemas,
    /// Types and units of fields by path.
    fields: BTreeMap<String, (&'static str, Option<&'static str>)>,
}

/// The unit of energies in messages.
const ENERGY_UNIT: &str = "micro-units";

/// Returns the unit of the number at `path`. Units follow from serialised names: energies and TTIs are plain numbers in
/// messages. A renamed field needs its new name here, or loses its unit.
fn unit_of(path: &str, lua_type: &str) -> Option<&'static str> {
    let mut names = path.rsplit('.');
    let (name, parent) = (names.next()?, names.next());
    match name {
        _ if parent == Some("spent") => Some(ENERGY_UNIT),
        // The second part of `Change::AddEnergy`; the first is the range of devices.
        "1" if parent == Some("add_energy") => Some(ENERGY_UNIT),
        "battery" | "battery_sum" | "drained" | "spent" | "initial" | "harvested" | "overflow" | "wasted" => {
            Some(ENERGY_UNIT)
        }
        // TTIs have 64 bits. `first` of removed devices is an id of 32 bits.
        "tti" | "first" | "last" | "until" | "start" | "run_to" if lua_type == "uint64" => Some("TTI"),
        "from" if parent == Some("plan") => Some("TTI"),
        "plan" if parent == Some("grant") => Some("TTI"),
        "at" if parent == Some("act") => Some("TTI"),
        "step" | "t_on" | "t_drx" | "offset" | "longest_outage" => Some("TTIs"),
        name if name.ends_with("_ttis") => Some("TTIs"),
        "x" | "y" => Some("m"),
        "information_pico" => Some("10⁻¹² information"),
        "real_time" => Some("µs"),
        _ => None,
    }
}

impl ScriptBuilder<'_> {
    fn add_field(&mut self, path: &str, lua_type: &'static str) {
        self.fields.insert(path.to_owned(), (lua_type, unit_of(path, lua_type)));
    }

    /// Adds the field of a single value and returns its form. `reader` is the name of a function in `dissector.lua`.
    fn add_leaf(&mut self, path: &str, reader: &str, lua_type: &'static str) -> String {
        self.add_field(path, lua_type);
        format!("{{{reader:?}, {path:?}}}")
    }

    /// Returns the form of a type as a Lua table, which `dissector.lua` interprets, and adds its fields below `path`.
    /// Signed bytes, which no message holds, would be shown without sign.
    ///
    /// # Panics
    /// If the type is a map, which no message holds.
    fn form(&mut self, format: &Format, path: &str) -> String {
        match format {
            Format::TypeName(name) => {
                let container = self.schemas.type_named(name).expect("a type that was traced").clone();
                self.container_form(&container, path)
            }
            Format::Unit | Format::Variable(_) => "{\"nothing\"}".to_owned(),
            Format::Bool => self.add_leaf(path, "bool", "bool"),
            Format::U8 | Format::I8 => self.add_leaf(path, "byte", "uint8"),
            Format::U16 | Format::U32 => self.add_leaf(path, "unsigned", "uint32"),
            Format::U64 => self.add_leaf(path, "long", "uint64"),
            Format::U128 | Format::I128 => self.add_leaf(path, "longest", "string"),
            Format::I16 | Format::I32 | Format::I64 => self.add_leaf(path, "signed", "int64"),
            Format::F32 => self.add_leaf(path, "single", "float"),
            Format::F64 => self.add_leaf(path, "double", "double"),
            Format::Char | Format::Str => self.add_leaf(path, "text", "string"),
            Format::Bytes => self.add_leaf(path, "bytes", "bytes"),
            Format::Option(inner) => format!("{{\"option\", {}}}", self.form(inner, path)),
            Format::Seq(inner) if **inner == Format::U8 => self.add_leaf(path, "bytes", "bytes"),
            Format::Seq(inner) => format!("{{\"seq\", {}}}", self.form(inner, path)),
            Format::TupleArray { content, size } => self.tuple_form(&vec![(**content).clone(); *size], path),
            Format::Tuple(parts) => self.tuple_form(parts, path),
            Format::Map { .. } => panic!("messages hold no maps"),
        }
    }

    fn container_form(&mut self, container: &ContainerFormat, path: &str) -> String {
        match container {
            ContainerFormat::UnitStruct => "{\"nothing\"}".to_owned(),
            ContainerFormat::NewTypeStruct(inner) => self.form(inner, path),
            ContainerFormat::TupleStruct(parts) => self.tuple_form(parts, path),
            ContainerFormat::Struct(fields) => self.struct_form(fields, path),
            ContainerFormat::Enum(variants) => {
                self.add_field(&format!("{path}.is"), "string");
                let mut variant_forms = String::new();
                for (index, variant) in variants {
                    let inner = format!("{path}.{}", snake_case(&variant.name));
                    let form = match &variant.value {
                        VariantFormat::Unit | VariantFormat::Variable(_) => "{\"nothing\"}".to_owned(),
                        VariantFormat::NewType(format) => self.form(format, &inner),
                        VariantFormat::Tuple(parts) => self.tuple_form(parts, &inner),
                        VariantFormat::Struct(fields) => self.struct_form(fields, &inner),
                    };
                    let _infallible = write!(variant_forms, "[{index}] = {{{:?}, {form}}}, ", variant.name);
                }
                format!("{{\"choice\", {:?}, {{{variant_forms}}}}}", format!("{path}.is"))
            }
        }
    }

    fn struct_form(&mut self, fields: &[Named<Format>], path: &str) -> String {
        let forms = fields
            .iter()
            .map(|field| self.form(&field.value, &format!("{path}.{}", field.name)));
        format!("{{\"all\", {}}}", forms.collect::<Vec<_>>().join(", "))
    }

    fn tuple_form(&mut self, parts: &[Format], path: &str) -> String {
        let forms = (0..)
            .zip(parts)
            .map(|(index, part)| self.form(part, &format!("{path}.{index}")));
        format!("{{\"all\", {}}}", forms.collect::<Vec<_>>().join(", "))
    }
}

/// Converts the name of a variant, such as `GrantDone`, to the name of a field, `grant_done`. [`unit_of`] and
/// `tests/recordings/check.py` rely on this form.
fn snake_case(name: &str) -> String {
    let mut text = String::new();
    for (index, letter) in name.char_indices() {
        if letter.is_uppercase() && index > 0 {
            text.push('_');
        }
        text.extend(letter.to_lowercase());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_script_names_every_kind_and_sample_fields() {
        let script = lua_script();
        for kind in MessageKind::ALL {
            assert!(script.contains(&format!("name = {:?}", kind.name())), "{}", kind.name());
        }
        for field in [
            "wake.device",
            "report.information",
            "clock.is",
            "answer.grant_done.reports",
        ] {
            assert!(script.contains(&format!("\"reveille.{field}\"")), "{field}");
        }
        for named in [
            "ProtoField.none(\"reveille.wake\", \"wake\", ",
            "\"reveille.report.battery\", \"battery (micro-units)\"",
            "\"reveille.clock.grant.last\", \"last (TTI)\"",
            "\"reveille.belief.places.x\", \"x (m)\"",
            "from = \"device\", to = \"BS\"",
        ] {
            assert!(script.contains(named), "no {named}: {script}");
        }
        assert!(!script.contains("--@"), "a place holder is left");
    }
}
