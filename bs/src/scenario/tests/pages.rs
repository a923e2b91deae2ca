//! Tests of output generated from the declarations: reference page, schema, complete scenario file; and of the first
//! part of the fuzz dictionary, which is written by hand.

use std::collections::BTreeSet;
use std::path::Path;

use reveille_common::declare::FieldType;

use super::*;

#[test]
fn the_reference_page_is_current() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/scenario.md");
    let page = std::fs::read_to_string(path).expect("the page");
    assert!(
        page == reference(),
        "docs/scenario.md differs from the declarations: reveille scenario reference --out docs/scenario.md"
    );
}

#[test]
fn the_schema_and_the_complete_file_contain_every_field() {
    let schema: serde_json::Value = serde_json::from_str(&schema()).expect("JSON");
    let complete_file = load("paper", &[])
        .expect("a preset")
        .scenario
        .to_full_toml(&registry::all_policies());
    for path in declaration().field_paths() {
        let pointer = path
            .split('.')
            .fold(String::new(), |at, name| format!("{at}/properties/{name}"));
        assert!(schema.pointer(&pointer).is_some(), "{path} is not in the schema");
        let name = path.rsplit('.').next().expect("a name");
        let sets_field = |line: &str| line.trim_start_matches("# ").starts_with(&format!("{name} = "));
        assert!(
            complete_file.lines().any(sets_field),
            "{path} is not in the complete file"
        );
    }
    assert_eq!(
        load_text(&complete_file).expect("the complete file loads"),
        load("paper", &[]).expect("a preset").scenario
    );
    let lambda = schema
        .pointer("/properties/harvest/properties/lambda")
        .expect("a field");
    assert_eq!(lambda["minimum"], 0.0);
    assert_eq!(schema["properties"]["sensing"]["additionalProperties"], false);
    assert_eq!(schema["properties"]["devices"]["default"], 50);
}

#[test]
fn the_fuzz_dictionary_contains_exactly_the_declared_words() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fuzz/scenario.dict");
    let dictionary = std::fs::read_to_string(path).expect("the dictionary");
    let syntax_heading = "# Syntax and values, which no declaration has.\n";
    let (declared_part, _) = dictionary.split_once(syntax_heading).expect("both parts");
    let dictionary_words: Vec<&str> = declared_part.lines().filter(|line| !line.starts_with('#')).collect();
    let declared = declaration();
    let mut words: BTreeSet<&str> = declared.registered.iter().map(|policy| policy.name).collect();
    words.extend(declared.presets.iter().map(|preset| preset.name));
    words.extend(declared.sections.iter().flat_map(|section| section.path.split('.')));
    words.insert(declared.list.name());
    let list_section = std::iter::once(&declared.list.section);
    for field in declared
        .sections
        .iter()
        .chain(list_section)
        .flat_map(|section| section.fields)
    {
        words.insert(field.name);
        if let FieldType::Choice(alternatives) | FieldType::WordOrFile(alternatives) = field.field_type {
            words.extend(alternatives.iter().map(|alternative| alternative.name));
        }
    }
    let expected: Vec<String> = words
        .into_iter()
        .filter(|word| !word.is_empty())
        .map(|word| format!("\"{word}\""))
        .collect();
    assert_eq!(
        dictionary_words, expected,
        "words of tests/fuzz/scenario.dict, in their order"
    );
}
