//! Schemas of the messages, traced from the Rust types: names, order and types of their fields. Recordings embed them
//! as JSON Schema, and the Wireshark dissector is generated from them. A new enum inside messages must be traced in
//! [`MessageSchemas::trace_all`].

use std::collections::BTreeMap;

use reveille_common::message::{Change, HostOffer, MessageKind, Pace, Payload, Setting, TypeVisitor, WakeOutcome};
use reveille_common::plan::Plan;
use reveille_common::state::DeviceState;
use reveille_common::totals::MissCause;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use serde_reflection::{ContainerFormat, Format, Named, Registry, Tracer, TracerConfig, VariantFormat};

/// Schemas of all messages.
#[derive(Clone, Debug)]
pub struct MessageSchemas {
    /// Types by name.
    types: Registry,
    /// Type of the payload of each kind of message.
    payload_types: BTreeMap<MessageKind, Format>,
}

/// Traces types.
struct SchemaTracer {
    tracer: Tracer,
    payload_types: BTreeMap<MessageKind, Format>,
}

impl SchemaTracer {
    fn trace<T: DeserializeOwned>(&mut self) -> Format {
        let format = self.tracer.trace_simple_type::<T>();
        format.expect("a type of messages has one form").0
    }
}

impl TypeVisitor for SchemaTracer {
    fn visit<P: Payload>(&mut self) {
        let format = self.trace::<P>();
        self.payload_types.insert(P::KIND, format);
    }
}

impl MessageSchemas {
    /// Traces the message schemas of this version.
    ///
    /// # Panics
    /// If an enum inside messages is missing in the list below, which the test of this file finds.
    pub fn trace_all() -> Self {
        let mut tracer = SchemaTracer {
            tracer: Tracer::new(TracerConfig::default()),
            payload_types: BTreeMap::new(),
        };
        // Enums inside messages are traced first: from a message alone, the tracer sees only their first variant.
        tracer.trace::<Plan>();
        tracer.trace::<MissCause>();
        tracer.trace::<WakeOutcome>();
        tracer.trace::<DeviceState>();
        tracer.trace::<Pace>();
        tracer.trace::<Setting>();
        tracer.trace::<Change>();
        tracer.trace::<HostOffer>();
        MessageKind::visit_types(&mut tracer);
        Self {
            types: tracer.tracer.registry().expect("types of messages are finite"),
            payload_types: tracer.payload_types,
        }
    }

    /// Returns the type with the Rust name `name`. Two types of messages cannot have one name.
    pub fn type_named(&self, name: &str) -> Option<&ContainerFormat> {
        self.types.get(name)
    }

    /// Returns the type of the messages of `kind`.
    pub fn type_of(&self, kind: MessageKind) -> &Format {
        &self.payload_types[&kind]
    }

    /// Returns the JSON Schema of the JSON lines of `kind`, which [`FrameLine`](crate::frame_line::FrameLine) writes:
    /// change both.
    pub fn json_schema(&self, kind: MessageKind) -> Value {
        let number = match kind.addressee().name() {
            "" => json!({ "type": "null" }),
            addressee => json!({ "type": "integer", "minimum": 0, "description": format!("the {addressee}") }),
        };
        let malformed = object_schema([("malformed", text_schema()), ("payload", text_schema())]);
        let mut schema = object_schema([
            ("tti", natural_number_schema()),
            ("plane", json!({ "const": kind.plane().name() })),
            ("kind", json!({ "const": kind.name() })),
            ("number", number),
            ("bytes", natural_number_schema()),
            (
                "message",
                json!({ "anyOf": [self.value_schema(self.type_of(kind)), malformed] }),
            ),
        ]);
        schema["$schema"] = json!("https://json-schema.org/draft/2020-12/schema");
        schema["title"] = json!(format!("{}: {}", kind.name(), kind.direction()));
        schema["description"] = json!(kind.about());
        schema
    }

    fn value_schema(&self, format: &Format) -> Value {
        match format {
            Format::TypeName(name) => self.container_schema(&self.types[name]),
            Format::Unit => json!({ "type": "null" }),
            Format::Bool => json!({ "type": "boolean" }),
            Format::I8 | Format::I16 | Format::I32 | Format::I64 | Format::I128 => integer_schema(),
            Format::U8 | Format::U16 | Format::U32 | Format::U64 | Format::U128 => natural_number_schema(),
            Format::F32 | Format::F64 => json!({ "type": "number" }),
            Format::Char | Format::Str => text_schema(),
            Format::Bytes => json!({ "type": "array", "items": natural_number_schema() }),
            Format::Option(inner) => json!({ "anyOf": [self.value_schema(inner), { "type": "null" }] }),
            Format::Seq(inner) => json!({ "type": "array", "items": self.value_schema(inner) }),
            Format::Map { value, .. } => json!({ "type": "object", "additionalProperties": self.value_schema(value) }),
            Format::Tuple(parts) => self.tuple_schema(parts),
            Format::TupleArray { content, size } => {
                json!({ "type": "array", "items": self.value_schema(content), "minItems": size, "maxItems": size })
            }
            Format::Variable(_) => json!({}),
        }
    }

    fn container_schema(&self, container: &ContainerFormat) -> Value {
        match container {
            ContainerFormat::UnitStruct => json!({ "type": "null" }),
            ContainerFormat::NewTypeStruct(inner) => self.value_schema(inner),
            ContainerFormat::TupleStruct(parts) => self.tuple_schema(parts),
            ContainerFormat::Struct(fields) => self.fields_schema(fields),
            ContainerFormat::Enum(variants) => {
                let variants: Vec<Value> = variants.values().map(|variant| self.variant_schema(variant)).collect();
                json!({ "oneOf": variants })
            }
        }
    }

    fn variant_schema(&self, variant: &Named<VariantFormat>) -> Value {
        let inner = match &variant.value {
            VariantFormat::Unit | VariantFormat::Variable(_) => return json!({ "const": variant.name }),
            VariantFormat::NewType(inner) => self.value_schema(inner),
            VariantFormat::Tuple(parts) => self.tuple_schema(parts),
            VariantFormat::Struct(fields) => self.fields_schema(fields),
        };
        object_schema([(variant.name.as_str(), inner)])
    }

    fn fields_schema(&self, fields: &[Named<Format>]) -> Value {
        object_schema(
            fields
                .iter()
                .map(|field| (field.name.as_str(), self.value_schema(&field.value))),
        )
    }

    fn tuple_schema(&self, parts: &[Format]) -> Value {
        let items: Vec<Value> = parts.iter().map(|part| self.value_schema(part)).collect();
        json!({ "type": "array", "prefixItems": items, "minItems": items.len(), "maxItems": items.len() })
    }
}

fn text_schema() -> Value {
    json!({ "type": "string" })
}

fn integer_schema() -> Value {
    json!({ "type": "integer" })
}

fn natural_number_schema() -> Value {
    json!({ "type": "integer", "minimum": 0 })
}

/// Builds the schema of an object whose properties are all required.
fn object_schema<'a>(properties: impl IntoIterator<Item = (&'a str, Value)>) -> Value {
    let (mut required, mut schemas) = (Vec::new(), serde_json::Map::new());
    for (name, schema) in properties {
        required.push(json!(name));
        schemas.insert(name.to_owned(), schema);
    }
    json!({ "type": "object", "properties": schemas, "required": required })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_has_a_schema() {
        let schemas = MessageSchemas::trace_all();
        for kind in MessageKind::ALL {
            let schema = schemas.json_schema(*kind);
            assert_eq!(schema["properties"]["kind"]["const"], kind.name());
            assert!(schema["properties"]["message"]["anyOf"][0].is_object(), "{schema}");
        }
        let report = &schemas.json_schema(MessageKind::Report)["properties"]["message"]["anyOf"][0];
        let names: Vec<&str> = report["required"]
            .as_array()
            .expect("fields")
            .iter()
            .filter_map(Value::as_str)
            .collect();
        assert_eq!(names, ["device", "tti", "information", "battery"]);
        assert_eq!(report["properties"]["information"]["type"], "number");
    }
}
