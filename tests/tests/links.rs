//! Checks that links in Markdown pages lead to existing files and headings. Links to web pages are not checked; the
//! links of the built book are checked in `tests/book/`.

use std::fs;
use std::path::{Path, PathBuf};

use crate::tidy::root;

/// Returns the pages in the root folder, and all pages in and below the documentation folders.
fn pages() -> Vec<PathBuf> {
    let mut pages = pages_in(&root(), false);
    for folder in ["docs", "deploy", "tests"] {
        pages.extend(pages_in(&root().join(folder), true));
    }
    for folder in [
        "docs",
        "deploy/docker",
        "deploy/examples",
        "deploy/scenarios",
        "tests/fuzz",
    ] {
        let is_in_folder = |page: &PathBuf| page.parent() == Some(&root().join(folder));
        assert!(pages.iter().any(is_in_folder), "no page of {folder} was found");
    }
    pages
}

/// Returns the pages in `folder`; with `is_recursive` also in subfolders, except build output.
fn pages_in(folder: &Path, is_recursive: bool) -> Vec<PathBuf> {
    let mut pages = Vec::new();
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if is_recursive && path.is_dir() && !path.ends_with("target") {
            pages.extend(pages_in(&path, is_recursive));
        } else if path.extension().is_some_and(|e| e == "md") {
            pages.push(path);
        }
    }
    pages.sort();
    pages
}

/// Returns the text without code, in which `](` is not a link.
fn without_code(text: &str) -> String {
    // Every second part is outside code.
    let outside_blocks: String = text.split("```").step_by(2).collect();
    outside_blocks.split('`').step_by(2).collect()
}

/// Returns the targets of all links in a page, including pictures.
fn targets(text: &str) -> Vec<String> {
    let text = without_code(text);
    let markdown_targets = text
        .split("](")
        .skip(1)
        .filter_map(|rest| rest.split([')', ' ']).next());
    let html_targets = text.split("src=\"").skip(1).filter_map(|rest| rest.split('"').next());
    markdown_targets.chain(html_targets).map(str::to_owned).collect()
}

/// Returns the anchor of a heading: lower case, spaces as hyphens, without punctuation.
fn anchor(heading: &str) -> String {
    let heading = heading.trim_start_matches('#').trim().to_lowercase().replace(' ', "-");
    heading
        .chars()
        .filter(|&c| c.is_alphanumeric() || c == '-' || c == '_')
        .collect()
}

/// Protects: readers, from broken links.
#[test]
fn links_have_existing_targets() {
    let (mut link_count, mut broken) = (0, Vec::new());
    for page in pages() {
        let text = fs::read_to_string(&page).expect("a page");
        for target in targets(&text).into_iter().filter(|target| !target.contains("://")) {
            link_count += 1;
            let (path, fragment) = target.split_once('#').unwrap_or((&target, ""));
            let target_path = if path.is_empty() {
                page.clone()
            } else {
                page.parent().expect("a folder").join(path)
            };
            let has_heading = || {
                let text = fs::read_to_string(&target_path).unwrap_or_default();
                text.lines()
                    .any(|line| line.starts_with('#') && anchor(line) == fragment)
            };
            if !target_path.exists() || (!fragment.is_empty() && !has_heading()) {
                let page = page.strip_prefix(root()).unwrap_or(&page);
                broken.push(format!("{}: {target}", page.display()));
            }
        }
    }
    assert!(link_count > 5, "only {link_count} links were found");
    assert!(broken.is_empty(), "broken links:\n  {}", broken.join("\n  "));
}
