//! A JSON Schema (draft 2020-12) of the file, for editors and validators. `reveille scenario schema` prints it.
//! `tests/schema/check.py` validates presets and shipped scenarios against it, and broken ones. Former names of fields
//! are not part of it, although loading accepts them.

use serde_json::{Map, Value as Json, json};

use super::choice::Alternative;
use super::declaration::{Declaration, Scope};
use super::field::{Field, FieldCondition, FieldDefault, FieldType, Section};
use super::value::FieldValue;
use crate::units::MAX_UNITS;

/// Returns the indented schema of files that follow `declaration`.
pub fn json_schema(declaration: &Declaration) -> String {
    let list = declaration.list;
    let mut root = table_schema(declaration, Scope::Top, "", "");
    let mut item = table_schema(declaration, Scope::Item, "", list.section.about);
    item.insert("required".to_owned(), json!(["name"]));
    item.insert("allOf".to_owned(), condition_rules(declaration, Scope::Item));
    let properties = root.get_mut("properties").and_then(Json::as_object_mut);
    if let Some(properties) = properties {
        let items = json!({ "type": "array", "description": list.section.about, "items": item });
        properties.insert(list.name().to_owned(), items);
    }
    // If the file has a list, its items have these rules instead, because each item may complete the top level.
    let without_list = json!({
        "if": { "not": { "required": [list.name()] } },
        "then": { "allOf": condition_rules(declaration, Scope::Top) },
    });
    root.insert("allOf".to_owned(), json!([without_list]));
    let mut schema = Map::new();
    schema.insert(
        "$schema".to_owned(),
        json!("https://json-schema.org/draft/2020-12/schema"),
    );
    schema.insert("title".to_owned(), json!(declaration.title));
    schema.append(&mut root);
    let mut text = serde_json::to_string_pretty(&Json::Object(schema)).expect("a tree of texts and numbers");
    text.push('\n');
    text
}

/// Returns the schema of the table below `path`.
fn table_schema(declaration: &Declaration, scope: Scope, path: &str, about: &str) -> Map<String, Json> {
    let mut properties = Map::new();
    let sections = declaration.sections_at(scope, path);
    for section in &sections {
        for field in section.fields {
            properties.insert(field.name.to_owned(), field_schema(declaration, section, field));
        }
    }
    for name in declaration.child_names(scope, path) {
        if scope == Scope::Top && path.is_empty() && name == declaration.list.name() {
            continue;
        }
        let path = super::join_path(path, name);
        let about = declaration
            .sections_at(scope, &path)
            .first()
            .map_or("", |section| section.about);
        properties.insert(
            name.to_owned(),
            Json::Object(table_schema(declaration, scope, &path, about)),
        );
    }
    let mut schema = Map::new();
    if !about.is_empty() {
        schema.insert("description".to_owned(), json!(about));
    }
    schema.insert("type".to_owned(), json!("object"));
    schema.insert("additionalProperties".to_owned(), json!(false));
    schema.insert("properties".to_owned(), Json::Object(properties));
    schema
}

fn field_schema(declaration: &Declaration, section: &Section, field: &Field) -> Json {
    let Json::Object(mut schema) = type_schema(declaration, &field.field_type) else {
        return Json::Null;
    };
    let mut description = field.help.replace('\n', " ");
    if !field.unit.is_empty() {
        description = format!("{description} Unit: {}.", field.unit);
    }
    match field.default {
        FieldDefault::Value(value) => {
            schema.insert("default".to_owned(), json_value(&value));
        }
        FieldDefault::Derived(rule) => description = format!("{description} Default: {rule}."),
        FieldDefault::None => {}
    }
    if let Some(condition) = section.condition(field) {
        description = format!("{description} Only with {condition}.");
    }
    if !field.source.is_empty() {
        description = format!("{description} Source: {}.", field.source);
    }
    schema.insert("description".to_owned(), json!(description));
    Json::Object(schema)
}

/// Returns the schema of a field type: type and bounds. The bounds of energies repeat `energy_range` in `field.rs`.
fn type_schema(declaration: &Declaration, field_type: &FieldType) -> Json {
    match field_type {
        FieldType::Whole { min, max } => json!({ "type": "integer", "minimum": min, "maximum": max }),
        FieldType::Number(range) => {
            let ((min, includes_min), (max, includes_max)) = range.ends();
            let lower = if includes_min { "minimum" } else { "exclusiveMinimum" };
            let upper = if includes_max { "maximum" } else { "exclusiveMaximum" };
            json!({ "type": "number", lower: min, upper: max })
        }
        FieldType::Energy { is_positive: false } => json!({ "type": "number", "minimum": 0.0, "maximum": MAX_UNITS }),
        FieldType::Energy { is_positive: true } => {
            json!({ "type": "number", "exclusiveMinimum": 0.0, "maximum": MAX_UNITS })
        }
        FieldType::Switch => json!({ "type": "boolean" }),
        FieldType::Choice(words) => choice_schema(words),
        FieldType::Registered => choice_schema(&declaration.registered),
        FieldType::Text | FieldType::File => json!({ "type": "string", "minLength": 1 }),
        FieldType::WordOrFile(words) => {
            let path = json!({ "type": "string", "minLength": 1, "description": "The path of a file." });
            json!({ "anyOf": [choice_schema(words), path] })
        }
        FieldType::Wholes { min, max, max_len } => json!({
            "type": "array",
            "minItems": 1,
            "maxItems": max_len,
            "items": { "type": "integer", "minimum": min, "maximum": max },
        }),
        FieldType::Texts => json!({ "type": "array", "minItems": 1, "items": { "type": "string" } }),
    }
}

/// Returns the schema of a choice: each word with its meaning, which editors show.
fn choice_schema(words: &[Alternative]) -> Json {
    let words: Vec<Json> = words
        .iter()
        .map(|word| json!({ "const": word.name, "description": word.about }))
        .collect();
    json!({ "type": "string", "oneOf": words })
}

fn json_value(value: &FieldValue<'_>) -> Json {
    match *value {
        FieldValue::Whole(whole) => json!(whole),
        FieldValue::Number(number) => json!(number),
        FieldValue::Energy(energy) => json!(energy.units()),
        FieldValue::Switch(is_on) => json!(is_on),
        FieldValue::Text(text) | FieldValue::Path(text) => json!(text),
        FieldValue::Wholes(list) => json!(list),
        FieldValue::Texts(list) => json!(list),
    }
}

/// Returns the condition that a table has a value at `path`, which fits the optional `value_schema`.
fn value_condition(path: &str, value_schema: Option<Json>) -> Json {
    match path.split_once('.') {
        Some((first, rest)) => {
            json!({ "required": [first], "properties": { first: value_condition(rest, value_schema) } })
        }
        None => match value_schema {
            Some(value_schema) => json!({ "required": [path], "properties": { path: value_schema } }),
            None => json!({ "required": [path] }),
        },
    }
}

/// Returns the rules for fields that exclude each other, and for fields whose condition allows an effect only for some
/// values of another field.
///
/// At the top level, the other field must be set to one of these values. In an item of the list, such as a class, the
/// other field may be missing, since the item inherits the value of the top level.
fn condition_rules(declaration: &Declaration, scope: Scope) -> Json {
    let mut rules = Vec::new();
    for header in declaration.headers() {
        for section in declaration.sections_at(scope, header) {
            for field in section.fields {
                let path = section.path_of(field.name);
                if let Some(other) = field.instead_of {
                    let conditions = [&path, &section.path_of(other)].map(|path| value_condition(path, None));
                    let both_are_set = json!({ "allOf": conditions });
                    rules.push(json!({ "not": both_are_set }));
                }
                let condition = section.condition(field);
                if let Some(condition) = condition.filter(|_| !matches!(field.default, FieldDefault::Value(_))) {
                    rules.extend(rules_of_field(scope, section, field, &condition));
                }
            }
        }
    }
    Json::Array(rules)
}

/// Returns the rules of a field without a default that has an effect only under `condition`.
fn rules_of_field(scope: Scope, section: &Section, field: &Field, condition: &FieldCondition) -> Vec<Json> {
    let path = section.path_of(field.name);
    let is_met = value_condition(condition.field, Some(json!({ "enum": condition.values })));
    let is_unmet = value_condition(condition.field, Some(json!({ "not": { "enum": condition.values } })));
    let effective = match scope {
        Scope::Top => is_met.clone(),
        Scope::Item => json!({ "not": is_unmet }),
    };
    let mut rules = vec![json!({ "if": value_condition(&path, None), "then": effective })];
    if scope == Scope::Top && field.default == FieldDefault::None {
        let mut ways = vec![value_condition(&path, None)];
        ways.extend(
            field
                .instead_of
                .map(|other| value_condition(&section.path_of(other), None)),
        );
        rules.push(json!({ "if": is_met, "then": { "anyOf": ways } }));
    }
    rules
}
