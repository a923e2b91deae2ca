//! Tables and lists of a report as sections of a hand-written page.
//!
//! Each section has a pair of marks in the page, `<!-- report NAME -->` and `<!-- /report NAME -->`, each on its own
//! line. The text between them is replaced; the rest is kept. With `--page`, `reveille report` and its search call
//! [`fill_page`] with the sections of [`super::markdown`] and [`super::search::markdown`]. Their names are marks in
//! docs/reproduction.md. The notes of `reveille analyse` use [`wrap_text`].

use textwrap::{Options, WordSeparator, WordSplitter};
use thiserror::Error;

/// Maximum width of a text line, columns. Tables and marks may be wider.
const MAX_COLUMNS: usize = 118;

/// A section of a page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PageSection {
    /// Name of the section in its marks.
    pub name: &'static str,
    /// Text between the marks.
    pub body: String,
}

/// Reason why the marks of a page cannot be filled.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum PageSectionError {
    /// A section has no end mark.
    #[error("line {line}: <!-- report {name} --> has no <!-- /report {name} --> after it")]
    MissingEndMark {
        /// Line of the start mark, from 1.
        line: usize,
        /// Name of the section.
        name: String,
    },
    /// The page has no mark of any of the sections.
    #[error("no mark <!-- report NAME --> of a part of this report; use {known}")]
    NoMark {
        /// Names of the sections.
        known: String,
    },
}

impl PageSection {
    /// Creates a section of this name.
    pub const fn new(name: &'static str, body: String) -> Self {
        Self { name, body }
    }

    /// Creates a section with a list.
    pub fn list(name: &'static str, items: impl IntoIterator<Item = String>) -> Self {
        let items = items.into_iter().map(|item| wrap_text(&format!("- {item}"), "  "));
        Self::new(name, items.collect())
    }
}

/// Inserts `sections` between their marks in the page `text`. Marks of other sections are kept, since several commands
/// may fill one page.
///
/// # Errors
/// If a mark has no end mark, or no section has a mark.
pub fn fill_page(text: &str, sections: &[PageSection]) -> Result<String, PageSectionError> {
    let mut out = String::new();
    let mut filled = 0;
    let mut lines = (1..).zip(text.lines());
    while let Some((line_number, line)) = lines.next() {
        out.push_str(line);
        out.push('\n');
        let name = line
            .strip_prefix("<!-- report ")
            .and_then(|name| name.strip_suffix(" -->"));
        let section = name.and_then(|name| sections.iter().find(|section| section.name == name));
        let Some(section) = section else { continue };
        let end_mark = format!("<!-- /report {} -->", section.name);
        // `any` also consumes the lines up to the end mark, which the new body replaces.
        if !lines.any(|(_, line)| line == end_mark) {
            return Err(PageSectionError::MissingEndMark {
                line: line_number,
                name: section.name.to_owned(),
            });
        }
        filled += 1;
        out.push('\n');
        out.push_str(section.body.trim());
        out.push_str("\n\n");
        out.push_str(&end_mark);
        out.push('\n');
    }
    if filled == 0 {
        let known_names: Vec<&str> = sections.iter().map(|section| section.name).collect();
        return Err(PageSectionError::NoMark {
            known: known_names.join(", "),
        });
    }
    Ok(out)
}

/// Wraps `text` to the maximum width, with `indent` before each line after the first.
pub fn wrap_text(text: &str, indent: &str) -> String {
    // Names and formulas contain hyphens, so lines break only at spaces.
    let options = Options::new(MAX_COLUMNS)
        .subsequent_indent(indent)
        .break_words(false)
        .word_separator(WordSeparator::AsciiSpace)
        .word_splitter(WordSplitter::NoHyphenation);
    textwrap::fill(text, options) + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: &str = "# Ours\n\n<!-- report a -->\nold\n<!-- /report a -->\ntext\n<!-- report z -->\n\
        kept\n<!-- /report z -->\n";

    #[test]
    fn a_section_replaces_the_text_between_its_marks() {
        let sections = [
            PageSection::new("a", "| new |\n".to_owned()),
            PageSection::new("b", "nowhere".to_owned()),
        ];
        let filled = fill_page(PAGE, &sections).expect("marks");
        let expected = PAGE.replace("old\n", "\n| new |\n\n");
        assert_eq!(filled, expected);
        assert_eq!(
            fill_page(&filled, &sections).expect("marks"),
            filled,
            "filling twice changes nothing"
        );
    }

    #[test]
    fn missing_marks_are_errors() {
        let sections = [
            PageSection::new("a", String::new()),
            PageSection::new("b", String::new()),
        ];
        let no_end_mark = fill_page("text\n<!-- report a -->\n", &sections)
            .expect_err("no end")
            .to_string();
        assert!(
            no_end_mark.contains("line 2") && no_end_mark.contains("<!-- /report a -->"),
            "{no_end_mark}"
        );
        let no_mark = fill_page("text\n<!-- report z -->\n<!-- /report z -->\n", &sections)
            .expect_err("no mark")
            .to_string();
        assert!(no_mark.contains("use a, b"), "{no_mark}");
    }

    #[test]
    fn list_items_are_wrapped_at_spaces() {
        let item = "w-ord ".repeat(55);
        let PageSection { body, .. } = PageSection::list("a", [item.trim().to_owned(), "short".to_owned()]);
        assert!(body.lines().all(|line| line.chars().count() <= MAX_COLUMNS), "{body}");
        assert_eq!(body.matches("\n  w-ord").count(), 2, "{body}");
        assert_eq!(body.matches("w-ord").count(), 55);
        assert!(body.starts_with("- w-ord") && body.ends_with("- short\n"), "{body}");
    }
}
