//! The reference page of all fields, Markdown.

use std::fmt::Write as _;

use toml::de::{DeTable, DeValue};

use super::declaration::Declaration;
use super::dotted;
use super::field::{Default, Field, Form, Section};
use super::page::in_toml;

/// The page: a table for each section, the words of choices, and what each preset sets. `head` stands in front.
pub fn reference(declaration: &Declaration, head: &str) -> String {
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
        "\nEach may override single fields of the sections above: {}. What it leaves out it takes from there.",
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
        let kind = match field.unit {
            "" => kind(&field.form).to_owned(),
            unit => format!("{}, {unit}", kind(&field.form)),
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
            &kind,
            &range(field),
            &default(field),
            &meaning,
            field.source,
        ];
        let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
        let _ = writeln!(page, "| {} |", cells.join(" | "));
    }
    for (_, field) in fields() {
        let words = declaration.words(&field.form);
        if !words.is_empty() {
            let _ = writeln!(page, "\nValues of `{}`:\n", field.name);
            for word in words {
                let _ = writeln!(page, "- `\"{}\"`: {}", word.name, word.about.replace('\n', " "));
            }
            if matches!(field.form, Form::Source(_)) {
                page.push_str("- any other text: the path of a file.\n");
            }
        }
    }
}

const fn kind(form: &Form) -> &'static str {
    match form {
        Form::Whole { .. } => "whole number",
        Form::Number(_) | Form::Energy { .. } => "number",
        Form::Switch => "true or false",
        Form::Choice(_) | Form::Registered => "one of the values below",
        Form::Text => "text",
        Form::File => "path of a file",
        Form::Source(_) => "a value below, or the path of a file",
        Form::Wholes { .. } => "list of whole numbers",
        Form::Texts => "list of texts",
    }
}

fn range(field: &Field) -> String {
    match field.form {
        Form::Whole { least, most: u64::MAX } => format!("at least {least}"),
        Form::Whole { least, most } => format!("{least} to {most}"),
        Form::Number(range) => range.interval(),
        Form::Energy { is_positive: false } => "0 to 10000".to_owned(),
        Form::Energy { is_positive: true } => "0.000001 to 10000".to_owned(),
        Form::Wholes { least, most, longest } => format!("1 to {longest} of them, each {least} to {most}"),
        Form::Texts => "at least one".to_owned(),
        Form::Switch | Form::Choice(_) | Form::Registered | Form::Text | Form::File | Form::Source(_) => String::new(),
    }
}

fn default(field: &Field) -> String {
    match field.default {
        Default::Is(value) => format!("`{}`", in_toml(&value)),
        Default::Derived(rule) => rule.to_owned(),
        Default::None => "none".to_owned(),
    }
}

/// What each preset sets beside the defaults.
fn write_presets(page: &mut String, declaration: &Declaration) {
    page.push_str("\n## Presets\n\n| preset | what it is | what it sets beside the defaults |\n|---|---|---|\n");
    for preset in declaration.presets {
        let mut set = Vec::new();
        if let Ok(table) = DeTable::parse(preset.text) {
            collect(table.get_ref(), "", preset.text, &mut set);
        }
        let set = if set.is_empty() {
            "nothing".to_owned()
        } else {
            set.join(", ")
        };
        let _ = writeln!(page, "| `{}` | {} | {set} |", preset.name, preset.about);
    }
}

fn collect(table: &DeTable<'_>, path: &str, text: &str, set: &mut Vec<String>) {
    for (name, value) in table {
        let path = dotted(path, name.get_ref());
        if let DeValue::Table(inner) = value.get_ref() {
            collect(inner, &path, text, set);
        } else {
            let written = text.get(value.span()).unwrap_or_default();
            set.push(format!("`{path} = {written}`"));
        }
    }
}
