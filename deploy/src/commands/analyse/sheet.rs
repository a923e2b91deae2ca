//! Output of the `reveille analyse` commands: tables and notes, as text, JSON and CSV. Names of sheets and columns are
//! keys in JSON and headers in CSV, which programs of users and `tests/program/analyse.rs` read.

use anyhow::Context;
use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use reveille_common::digits::format_significant;
use reveille_lab::io::write_output;
use reveille_study::report::page_sections::wrap_text;
use serde_json::{Map, Value};

use crate::cli::StudyArgs;
use crate::display;

/// A value of a table, in the column of the same position.
#[derive(Clone, Debug)]
pub(super) enum SheetValue {
    /// A text.
    Text(String),
    /// A whole number.
    Whole(u64),
    /// Any other number. NaN stands for an undefined number: a dash in text, empty in CSV. It is null in JSON, as are
    /// infinities, which are `inf` in text and CSV.
    Number(f64),
}

impl From<&str> for SheetValue {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

impl From<String> for SheetValue {
    fn from(text: String) -> Self {
        Self::Text(text)
    }
}

impl From<u64> for SheetValue {
    fn from(n: u64) -> Self {
        Self::Whole(n)
    }
}

impl From<u32> for SheetValue {
    fn from(n: u32) -> Self {
        Self::Whole(n.into())
    }
}

impl From<f64> for SheetValue {
    fn from(x: f64) -> Self {
        Self::Number(x)
    }
}

impl SheetValue {
    /// Returns the value as text; a number has four significant digits.
    fn to_display_text(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Whole(n) => n.to_string(),
            Self::Number(x) => format_significant(*x, 4),
        }
    }

    /// Returns the value with full precision for CSV; empty if undefined.
    fn to_csv_text(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Whole(n) => n.to_string(),
            Self::Number(x) if x.is_nan() => String::new(),
            Self::Number(x) => x.to_string(),
        }
    }

    fn to_json(&self) -> Value {
        match self {
            Self::Text(text) => text.as_str().into(),
            Self::Whole(n) => (*n).into(),
            // serde_json turns NaN and infinities into null.
            Self::Number(x) => (*x).into(),
        }
    }
}

/// A table.
#[derive(Clone, Debug)]
pub(super) struct Sheet {
    /// Its key in JSON; programs of users read it, so do not rename it. Unique, and neither `title` nor `notes`, which
    /// are keys of [`Findings`].
    pub name: &'static str,
    /// Its heading, which names the content of a row.
    pub title: String,
    /// Its columns: keys in JSON and headers elsewhere, which programs of users read.
    pub columns: &'static [&'static str],
    /// Its rows, each with one value per column, in the order of `columns`. A shorter row panics in the text and fails
    /// in the CSV; JSON drops its columns.
    pub rows: Vec<Vec<SheetValue>>,
}

impl Sheet {
    /// # Panics
    /// If a row is shorter than the header.
    fn to_text_table(&self) -> String {
        let mut table = Table::new();
        table
            .load_style(UTF8_FULL_CONDENSED)
            .set_header(self.columns.iter().copied());
        for row in &self.rows {
            table.add_row(row.iter().map(SheetValue::to_display_text));
        }
        for index in 0..self.columns.len() {
            let has_number_in_column = |row: &Vec<SheetValue>| !matches!(row[index], SheetValue::Text(_));
            if self.rows.iter().any(has_number_in_column)
                && let Some(column) = table.column_mut(index)
            {
                column.set_cell_alignment(CellAlignment::Right);
            }
        }
        table.to_string()
    }

    fn to_json(&self) -> Value {
        let object = |row: &Vec<SheetValue>| {
            let pairs = self.columns.iter().zip(row);
            Value::Object(pairs.map(|(key, cell)| ((*key).to_owned(), cell.to_json())).collect())
        };
        self.rows.iter().map(object).collect()
    }

    fn to_csv(&self) -> anyhow::Result<Vec<u8>> {
        let mut writer = csv::Writer::from_writer(Vec::new());
        writer.write_record(self.columns)?;
        for row in &self.rows {
            writer.write_record(row.iter().map(SheetValue::to_csv_text))?;
        }
        Ok(writer.into_inner()?)
    }
}

/// The results of a study.
#[derive(Clone, Debug)]
pub(super) struct Findings {
    /// One line that names the studied setup.
    pub title: String,
    /// The tables; --csv writes the first one.
    pub sheets: Vec<Sheet>,
    /// Explanations of the tables.
    pub notes: Vec<String>,
}

impl Findings {
    /// Prints the results, and writes the requested files.
    ///
    /// # Errors
    /// If a file or standard output cannot be written.
    pub(super) fn present(&self, args: &StudyArgs) -> anyhow::Result<()> {
        if let (Some(path), Some(first)) = (&args.csv, self.sheets.first()) {
            // `write_output` writes into links and devices such as /dev/stdout, which a rename would replace.
            let written = write_output(path, &first.to_csv()?);
            written.with_context(|| {
                format!(
                    "--csv {}: cannot write this file; name a file in a folder that exists",
                    path.display()
                )
            })?;
        }
        let text = if args.json { self.to_json()? } else { self.to_text() };
        display::print_stdout(&text)
    }

    fn to_json(&self) -> anyhow::Result<String> {
        let mut all = Map::new();
        all.insert("title".to_owned(), self.title.as_str().into());
        for sheet in &self.sheets {
            all.insert(sheet.name.to_owned(), sheet.to_json());
        }
        all.insert("notes".to_owned(), self.notes.iter().map(String::as_str).collect());
        Ok(serde_json::to_string_pretty(&Value::Object(all))? + "\n")
    }

    fn to_text(&self) -> String {
        let mut text = format!("{}\n", self.title);
        for sheet in &self.sheets {
            text.extend(["\n", &sheet.title, "\n", &sheet.to_text_table(), "\n"]);
        }
        if !self.notes.is_empty() {
            text.push('\n');
        }
        for note in &self.notes {
            text += &wrap_text(&format!("- {note}"), "  ");
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undefined_numbers_are_empty_in_csv_and_null_in_json() {
        let sheet = Sheet {
            name: "points",
            title: "Points.".to_owned(),
            columns: &["x", "y"],
            rows: vec![vec!["a,b".into(), 0.1.into()], vec![7_u64.into(), f64::NAN.into()]],
        };
        let csv = String::from_utf8(sheet.to_csv().expect("CSV")).expect("UTF-8");
        assert_eq!(csv, "x,y\n\"a,b\",0.1\n7,\n");
        assert_eq!(sheet.to_json().to_string(), r#"[{"x":"a,b","y":0.1},{"x":7,"y":null}]"#);
        assert!(sheet.to_text_table().contains("0.1 "));
    }
}
