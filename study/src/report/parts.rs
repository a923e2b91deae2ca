//! Tables and lists of a report as parts of a page that somebody writes around them.
//!
//! A page has a pair of marks for each part that it shows, `<!-- report NAME -->` and `<!-- /report NAME -->`, each
//! in a line of its own. What stands between them is replaced; everything else stays.

use thiserror::Error;

/// The widest line of text, columns. Tables and marks may be wider.
const WIDTH: usize = 118;

/// A part of a page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Part {
    /// Its name in the marks.
    pub name: &'static str,
    /// What stands between them.
    pub body: String,
}

/// A page whose marks cannot be filled.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum PartError {
    /// No end of a part.
    #[error("line {line}: <!-- report {name} --> without <!-- /report {name} --> after it")]
    Open {
        /// The line of the mark, from 1.
        line: usize,
        /// The part.
        name: String,
    },
    /// No mark of any of the parts.
    #[error("has no mark <!-- report NAME --> of a part that this command makes; they are {known}")]
    Unmarked {
        /// The names of the parts.
        known: String,
    },
}

impl Part {
    /// A part of this name.
    pub const fn new(name: &'static str, body: String) -> Self {
        Self { name, body }
    }

    /// A part that is a list.
    pub fn list(name: &'static str, items: impl IntoIterator<Item = String>) -> Self {
        let items = items.into_iter().map(|item| wrapped(&format!("- {item}"), "  "));
        Self::new(name, items.collect())
    }
}

/// The page `text` with `parts` between their marks. Marks of parts that are not among them stay as they are: several
/// commands may fill one page.
///
/// # Errors
/// A mark without its end, or no mark of any part.
pub fn fill(text: &str, parts: &[Part]) -> Result<String, PartError> {
    let mut out = String::new();
    let mut filled = 0;
    let mut lines = (1..).zip(text.lines());
    while let Some((number, line)) = lines.next() {
        out.push_str(line);
        out.push('\n');
        let name = line
            .strip_prefix("<!-- report ")
            .and_then(|rest| rest.strip_suffix(" -->"));
        let part = name.and_then(|name| parts.iter().find(|part| part.name == name));
        let Some(part) = part else { continue };
        let end = format!("<!-- /report {} -->", part.name);
        if !lines.any(|(_, line)| line == end) {
            return Err(PartError::Open {
                line: number,
                name: part.name.to_owned(),
            });
        }
        filled += 1;
        out.push('\n');
        out.push_str(part.body.trim());
        out.push_str("\n\n");
        out.push_str(&end);
        out.push('\n');
    }
    if filled == 0 {
        let known: Vec<&str> = parts.iter().map(|part| part.name).collect();
        return Err(PartError::Unmarked {
            known: known.join(", "),
        });
    }
    Ok(out)
}

/// `text` in lines that are not too wide, those after the first with `indent` in front.
pub fn wrapped(text: &str, indent: &str) -> String {
    let mut out = String::new();
    let mut width = 0;
    for word in text.split(' ') {
        let length = word.chars().count();
        if width > indent.len() && width + 1 + length > WIDTH {
            out.push('\n');
            out.push_str(indent);
            width = indent.len();
        } else if width > 0 {
            out.push(' ');
            width += 1;
        }
        out.push_str(word);
        width += length;
    }
    out.push('\n');
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: &str = "# Ours\n\n<!-- report a -->\nold\n<!-- /report a -->\ntext\n<!-- report z -->\n\
        kept\n<!-- /report z -->\n";

    #[test]
    fn a_part_stands_between_its_marks_and_all_else_stays() {
        let parts = [
            Part::new("a", "| new |\n".to_owned()),
            Part::new("b", "nowhere".to_owned()),
        ];
        let filled = fill(PAGE, &parts).expect("marks");
        let expected = PAGE.replace("old\n", "\n| new |\n\n");
        assert_eq!(filled, expected);
        assert_eq!(
            fill(&filled, &parts).expect("marks"),
            filled,
            "filled again it is the same"
        );
    }

    #[test]
    fn marks_that_cannot_be_filled_are_told() {
        let parts = [Part::new("a", String::new()), Part::new("b", String::new())];
        let open = fill("text\n<!-- report a -->\n", &parts)
            .expect_err("no end")
            .to_string();
        assert!(open.contains("line 2") && open.contains("<!-- /report a -->"), "{open}");
        let none = fill("text\n<!-- report z -->\n<!-- /report z -->\n", &parts)
            .expect_err("no mark")
            .to_string();
        assert!(none.contains("they are a, b"), "{none}");
    }

    #[test]
    fn lists_are_no_wider_than_a_page() {
        let item = "word ".repeat(60);
        let Part { body, .. } = Part::list("a", [item.trim().to_owned(), "short".to_owned()]);
        assert!(body.lines().all(|line| line.chars().count() <= WIDTH), "{body}");
        assert_eq!(body.matches("\n  word").count(), 2, "{body}");
        assert_eq!(body.matches("word").count(), 60);
        assert!(body.starts_with("- word") && body.ends_with("- short\n"), "{body}");
    }
}
