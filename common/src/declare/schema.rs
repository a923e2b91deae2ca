//! A JSON Schema (draft 2020-12) of the file, for editors and validators.

use serde_json::{Map, Value as Json, json};

use super::choice::Alternative;
use super::declaration::{Declaration, Scope};
use super::field::{Field, FieldCondition, FieldDefault, FieldType, Section};
use super::value::FieldValue;
use crate::units::MAX_UNITS;

/// Returns the indented schema of files that follow `declaration`.
pub fn schema(declaration: &Declaration) -> String {
    let list = declaration.list;
    let mut root = table(declaration, Scope::Top, "", "");
    let mut item = table(declaration, Scope::Item, "", list.section.about);
    item.insert("required".to_owned(), json!(["name"]));
    item.insert("allOf".to_owned(), rules(declaration, Scope::Item));
    let properties = root.get_mut("properties").and_then(Json::as_object_mut);
    if let Some(properties) = properties {
        let items = json!({ "type": "array", "description": list.section.about, "items": item });
        properties.insert(list.name().to_owned(), items);
    }
    // If the file has a list, its items have these rules instead, because each item may complete the top level.
    let alone = json!({
        "if": { "not": { "required": [list.name()] } },
        "then": { "allOf": rules(declaration, Scope::Top) },
    });
    root.insert("allOf".to_owned(), json!([alone]));
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
fn table(declaration: &Declaration, scope: Scope, path: &str, about: &str) -> Map<String, Json> {
    let mut properties = Map::new();
    let sections = declaration.at(scope, path);
    for section in &sections {
        for field in section.fields {
            properties.insert(field.name.to_owned(), property(declaration, section, field));
        }
    }
    for name in declaration.below(scope, path) {
        if scope == Scope::Top && path.is_empty() && name == declaration.list.name() {
            continue;
        }
        let path = super::dotted(path, name);
        let about = declaration.at(scope, &path).first().map_or("", |section| section.about);
        properties.insert(name.to_owned(), Json::Object(table(declaration, scope, &path, about)));
    }
    let mut made = Map::new();
    if !about.is_empty() {
        made.insert("description".to_owned(), json!(about));
    }
    made.insert("type".to_owned(), json!("object"));
    made.insert("additionalProperties".to_owned(), json!(false));
    made.insert("properties".to_owned(), Json::Object(properties));
    made
}

fn property(declaration: &Declaration, section: &Section, field: &Field) -> Json {
    let Json::Object(mut made) = form(declaration, &field.form) else {
        return Json::Null;
    };
    let mut about = field.help.replace('\n', " ");
    if !field.unit.is_empty() {
        about = format!("{about} Unit: {}.", field.unit);
    }
    match field.default {
        FieldDefault::Is(value) => {
            made.insert("default".to_owned(), literal(&value));
        }
        FieldDefault::Derived(rule) => about = format!("{about} Default: {rule}."),
        FieldDefault::None => {}
    }
    if let Some(condition) = section.condition(field) {
        about = format!("{about} Only with {condition}.");
    }
    if !field.source.is_empty() {
        about = format!("{about} Source: {}.", field.source);
    }
    made.insert("description".to_owned(), json!(about));
    Json::Object(made)
}

/// Returns the schema of a field type: type and bounds.
fn form(declaration: &Declaration, form: &FieldType) -> Json {
    match form {
        FieldType::Whole { least, most } => json!({ "type": "integer", "minimum": least, "maximum": most }),
        FieldType::Number(range) => {
            let ((least, holds_least), (most, holds_most)) = range.ends();
            let lower = if holds_least { "minimum" } else { "exclusiveMinimum" };
            let upper = if holds_most { "maximum" } else { "exclusiveMaximum" };
            json!({ "type": "number", lower: least, upper: most })
        }
        FieldType::Energy { is_positive: false } => json!({ "type": "number", "minimum": 0.0, "maximum": MAX_UNITS }),
        FieldType::Energy { is_positive: true } => {
            json!({ "type": "number", "exclusiveMinimum": 0.0, "maximum": MAX_UNITS })
        }
        FieldType::Switch => json!({ "type": "boolean" }),
        FieldType::Choice(words) => choice(words),
        FieldType::Registered => choice(&declaration.registered),
        FieldType::Text | FieldType::File => json!({ "type": "string", "minLength": 1 }),
        FieldType::Source(words) => {
            let path = json!({ "type": "string", "minLength": 1, "description": "The path of a file." });
            json!({ "anyOf": [choice(words), path] })
        }
        FieldType::Wholes { least, most, longest } => json!({
            "type": "array",
            "minItems": 1,
            "maxItems": longest,
            "items": { "type": "integer", "minimum": least, "maximum": most },
        }),
        FieldType::Texts => json!({ "type": "array", "minItems": 1, "items": { "type": "string" } }),
    }
}

/// Returns the schema of a choice: each word with its meaning, which editors show.
fn choice(words: &[Alternative]) -> Json {
    let words: Vec<Json> = words
        .iter()
        .map(|word| json!({ "const": word.name, "description": word.about }))
        .collect();
    json!({ "type": "string", "oneOf": words })
}

fn literal(value: &FieldValue<'_>) -> Json {
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

/// Returns the condition that a table has a value at `path`; `then` is the schema of that value.
fn has(path: &str, then: Option<Json>) -> Json {
    match path.split_once('.') {
        Some((first, rest)) => json!({ "required": [first], "properties": { first: has(rest, then) } }),
        None => match then {
            Some(then) => json!({ "required": [path], "properties": { path: then } }),
            None => json!({ "required": [path] }),
        },
    }
}

/// Returns the rules that connect fields with settings. A field without a default has an effect only under its
/// condition, and is required there. At the top level the condition must be set; an item may inherit it.
fn rules(declaration: &Declaration, scope: Scope) -> Json {
    let mut rules = Vec::new();
    for header in declaration.headers() {
        for section in declaration.at(scope, header) {
            for field in section.fields {
                let path = section.path_of(field.name);
                if let Some(other) = field.instead_of {
                    let both = json!({ "allOf": [has(&path, None), has(&section.path_of(other), None)] });
                    rules.push(json!({ "not": both }));
                }
                let condition = section.condition(field);
                if let Some(condition) = condition.filter(|_| !matches!(field.default, FieldDefault::Is(_))) {
                    rules.extend(of_condition(scope, section, field, &condition));
                }
            }
        }
    }
    Json::Array(rules)
}

/// Returns the rules of a field without a default that has an effect only under `condition`.
fn of_condition(scope: Scope, section: &Section, field: &Field, condition: &FieldCondition) -> Vec<Json> {
    let path = section.path_of(field.name);
    let is_so = has(condition.field, Some(json!({ "enum": condition.values })));
    let is_otherwise = has(condition.field, Some(json!({ "not": { "enum": condition.values } })));
    let counts = match scope {
        Scope::Top => is_so.clone(),
        Scope::Item => json!({ "not": is_otherwise }),
    };
    let mut rules = vec![json!({ "if": has(&path, None), "then": counts })];
    if scope == Scope::Top && field.default == FieldDefault::None {
        let mut ways = vec![has(&path, None)];
        ways.extend(field.instead_of.map(|other| has(&section.path_of(other), None)));
        rules.push(json!({ "if": is_so, "then": { "anyOf": ways } }));
    }
    rules
}
