//! The reference page of all fields, in Markdown: `docs/scenario.md`, which a test compares. Every text here is part of
//! the page; [`FieldType::describe_type`] and [`FieldType::describe_range`] are the other forms for messages.

use std::fmt::Write as _;

use toml::de::{DeTable, DeValue};

use super::declaration::Declaration;
use super::field::{Field, FieldDefault, FieldType, Section, energy_range};
use super::join_path;
use super::toml_page::format_toml;

/// Returns the page: `head` (`bs/src/scenario/head.md`), a table for each section, the words of choices, and each
/// preset with its values.
pub fn reference_page(declaration: &Declaration, head: &str) -> String {
    let mut page = format!("{}\n", head.trim_end());
    for header in declaration.headers() {
        let sections: Vec<&'static Section> = declaration
            .sections
            .iter()
            .copied()
            .filter(|s| s.path == header)
            .collect();
        let title = if header.is_empty() {
            "Top level".to_owned()
        } else {
            format!("`[{header}]`")
        };
        write_sections(&mut page, declaration, &title, &sections);
    }
    let list = declaration.list;
    write_sections(
        &mut page,
        declaration,
        &format!("`[[{}]]`", list.name()),
        &[list.section],
    );
    let inherited: Vec<String> = list
        .inherits
        .iter()
        .map(|name| format!("`[{}.{name}]`", list.name()))
        .collect();
    let _ = writeln!(
        page,
        "\nEach may override single fields of the sections above: {}. Omitted fields keep the values set there.",
        inherited.join(", ")
    );
    write_presets(&mut page, declaration);
    page
}

fn write_sections(page: &mut String, declaration: &Declaration, title: &str, sections: &[&'static Section]) {
    let _ = writeln!(page, "\n## {title}");
    for section in sections {
        let _ = writeln!(page, "\n{}", section.about.replace('\n', " "));
    }
    let fields = || {
        sections
            .iter()
            .flat_map(|section| section.fields.iter().map(move |field| (section, field)))
    };
    page.push_str("\n| field | type, unit | range | default | meaning | source |\n|---|---|---|---|---|---|\n");
    for (section, field) in fields() {
        let type_text = match field.unit {
            "" => type_cell(&field.field_type).to_owned(),
            unit => format!("{}, {unit}", type_cell(&field.field_type)),
        };
        let mut meaning = field.help.replace('\n', " ");
        if let Some(condition) = section.condition(field) {
            let _ = write!(meaning, " Only with `{condition}`.");
        }
        if let Some(other) = field.instead_of {
            let _ = write!(meaning, " Instead of `{other}`.");
        }
        let cells = [
            &format!("`{}`", field.name),
            &type_text,
            &range_cell(field),
            &default_cell(field),
            &meaning,
            field.source,
        ];
        let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
        let _ = writeln!(page, "| {} |", cells.join(" | "));
    }
    for (_, field) in fields() {
        let words = declaration.words_of(&field.field_type);
        if !words.is_empty() {
            let _ = writeln!(page, "\nValues of `{}`:\n", field.name);
            for word in words {
                let _ = writeln!(page, "- `\"{}\"`: {}", word.name, word.about.replace('\n', " "));
            }
            if matches!(field.field_type, FieldType::WordOrFile(_)) {
                page.push_str("- any other text: the path of a file.\n");
            }
        }
    }
}

const fn type_cell(field_type: &FieldType) -> &'static str {
    match field_type {
        FieldType::Whole { .. } => "whole number",
        FieldType::Number(_) | FieldType::Energy { .. } => "number",
        FieldType::Switch => "true or false",
        FieldType::Choice(_) | FieldType::Registered => "one of the values below",
        FieldType::Text => "text",
        FieldType::File => "path of a file",
        FieldType::WordOrFile(_) => "a value below, or the path of a file",
        FieldType::Wholes { .. } => "list of whole numbers",
        FieldType::Texts => "list of texts",
    }
}

fn range_cell(field: &Field) -> String {
    match field.field_type {
        FieldType::Whole { min, max: u64::MAX } => format!("at least {min}"),
        FieldType::Whole { min, max } => format!("{min} to {max}"),
        FieldType::Number(range) => range.interval(),
        FieldType::Energy { is_positive } => {
            let ((min, _), (max, _)) = energy_range(is_positive).ends();
            format!("{min} to {max}")
        }
        FieldType::Wholes { min, max, max_len } => format!("1 to {max_len} of them, each {min} to {max}"),
        FieldType::Texts => "at least one".to_owned(),
        FieldType::Switch
        | FieldType::Choice(_)
        | FieldType::Registered
        | FieldType::Text
        | FieldType::File
        | FieldType::WordOrFile(_) => String::new(),
    }
}

fn default_cell(field: &Field) -> String {
    match field.default {
        FieldDefault::Value(value) => format!("`{}`", format_toml(&value)),
        FieldDefault::Derived(rule) => rule.to_owned(),
        FieldDefault::None => "none".to_owned(),
    }
}

/// Writes the values in which each preset differs from the defaults.
fn write_presets(page: &mut String, declaration: &Declaration) {
    page.push_str("\n## Presets\n\n| preset | meaning | changes to the defaults |\n|---|---|---|\n");
    for preset in declaration.presets {
        let mut changes = Vec::new();
        if let Ok(table) = DeTable::parse(preset.text) {
            collect_values(table.get_ref(), "", preset.text, &mut changes);
        }
        let changes = if changes.is_empty() {
            "nothing".to_owned()
        } else {
            changes.join(", ")
        };
        let _ = writeln!(page, "| `{}` | {} | {changes} |", preset.name, preset.about);
    }
}

/// Adds every value of `table`, below `path`, to `changes` as it is written in `text`.
fn collect_values(table: &DeTable<'_>, path: &str, text: &str, changes: &mut Vec<String>) {
    for (name, value) in table {
        let path = join_path(path, name.get_ref());
        if let DeValue::Table(inner) = value.get_ref() {
            collect_values(inner, &path, text, changes);
        } else {
            let written = text.get(value.span()).unwrap_or_default();
            changes.push(format!("`{path} = {written}`"));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::declare::{energy, positive_energy};
    use crate::units::Energy;

    #[test]
    fn the_range_of_an_energy_is_what_its_type_accepts() {
        for (field, smallest) in [(energy(1.0), 0), (positive_energy(1.0), 1)] {
            let range = range_cell(&field);
            let ends: Vec<f64> = range.split(" to ").map(|end| end.parse().expect("a number")).collect();
            assert_eq!(
                Energy::from_units(ends[0]),
                Some(Energy::from_micro(smallest)),
                "{range}"
            );
            let accepts = |units| Energy::from_units(units).is_some();
            assert!(accepts(ends[1]) && !accepts(ends[1] + 1.0), "{range}");
        }
    }
}
