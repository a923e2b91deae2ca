//! Checks that links in pages have existing targets.

use std::fs;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

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
        let is_in = |page: &PathBuf| page.parent() == Some(&root().join(folder));
        assert!(pages.iter().any(is_in), "no page of {folder} was found");
    }
    pages
}

/// Returns the pages in `folder`; with `deep` also in subfolders, except build output.
fn pages_in(folder: &Path, deep: bool) -> Vec<PathBuf> {
    let mut pages = Vec::new();
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if deep && path.is_dir() && !path.ends_with("target") {
            pages.extend(pages_in(&path, deep));
        } else if path.extension().is_some_and(|e| e == "md") {
            pages.push(path);
        }
    }
    pages.sort();
    pages
}

/// Returns the text without code, in which `](` is not a link.
fn prose(text: &str) -> String {
    let outside_blocks: String = text.split("```").step_by(2).collect();
    outside_blocks.split('`').step_by(2).collect()
}

/// Returns the targets of all links in a page, including pictures.
fn targets(text: &str) -> Vec<String> {
    let text = prose(text);
    let ends = text
        .split("](")
        .skip(1)
        .filter_map(|rest| rest.split([')', ' ']).next());
    let sources = text.split("src=\"").skip(1).filter_map(|rest| rest.split('"').next());
    ends.chain(sources).map(str::to_owned).collect()
}

/// Returns the anchor of a heading: lower case, spaces as hyphens, without punctuation.
fn anchor(heading: &str) -> String {
    let heading = heading.trim_start_matches('#').trim().to_lowercase().replace(' ', "-");
    heading
        .chars()
        .filter(|&c| c.is_alphanumeric() || c == '-' || c == '_')
        .collect()
}

/// Protects: readers, from broken links. Checks only links within the tree.
#[test]
fn links_lead_somewhere() {
    let (mut seen, mut broken) = (0, Vec::new());
    for page in pages() {
        let text = fs::read_to_string(&page).expect("a page");
        for target in targets(&text).into_iter().filter(|target| !target.contains("://")) {
            seen += 1;
            let (path, place) = target.split_once('#').unwrap_or((&target, ""));
            let to = if path.is_empty() {
                page.clone()
            } else {
                page.parent().expect("a folder").join(path)
            };
            let has_place = || {
                let text = fs::read_to_string(&to).unwrap_or_default();
                text.lines().any(|line| line.starts_with('#') && anchor(line) == place)
            };
            if !to.exists() || (!place.is_empty() && !has_place()) {
                let page = page.strip_prefix(root()).unwrap_or(&page);
                broken.push(format!("{}: {target}", page.display()));
            }
        }
    }
    assert!(seen > 5, "only {seen} links were found");
    assert!(broken.is_empty(), "links that lead nowhere:\n  {}", broken.join("\n  "));
}
