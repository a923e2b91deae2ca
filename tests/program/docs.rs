//! Checks the README and the pages of docs/: the subcommands that they name exist, their example runs use separate run
//! folders, links of all Markdown files resolve, and docs/SUMMARY.md lists every page. Options and outputs are not
//! checked here: `tutorial.rs` runs the commands of docs/tutorial.md. `tests/book/` checks the links of the site that
//! mdBook builds.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use reveille_tests::process::TestFolder;

/// Returns the folder of the repository.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Returns README.md and the pages of docs/.
fn pages() -> Vec<PathBuf> {
    let root = root();
    let docs = fs::read_dir(root.join("docs"))
        .expect("docs/")
        .map(|entry| entry.expect("an entry").path());
    let mut pages: Vec<PathBuf> = docs
        .filter(|path| path.extension().is_some_and(|e| e == "md"))
        .collect();
    pages.push(root.join("README.md"));
    pages
}

/// Returns the code of a page: text between backquotes, inline or in blocks. A block can occur twice.
fn code(text: &str) -> impl Iterator<Item = &str> {
    text.split('`')
        .skip(1)
        .step_by(2)
        .chain(text.split("```").skip(1).step_by(2))
}

/// Returns the one or two words after the first `reveille` in each line of a page's code: possible subcommands, not
/// options, files or values with other characters than lower-case letters and hyphens.
fn named_commands(text: &str) -> Vec<(&str, Option<&str>)> {
    let is_word = |word: &&str| word.chars().all(|c| c.is_ascii_lowercase() || c == '-') && !word.starts_with('-');
    let lines = code(text).flat_map(str::lines);
    lines
        .filter_map(|line| {
            // `cargo run -- up` and a path to the binary start the same command.
            let words: Vec<&str> = line.split_whitespace().skip_while(|word| *word == "$").collect();
            let is_start = |word: &str| word == "reveille" || word.ends_with("/reveille");
            let is_cargo = words.starts_with(&["cargo", "run"]);
            let start = words
                .iter()
                .position(|word| is_start(word) || is_cargo && *word == "--")?;
            let after = |n: usize| words.get(start + n).copied().filter(is_word);
            after(1).map(|first| (first, after(2)))
        })
        .collect()
}

/// Returns the subcommands in the help of `reveille ARGS`, or nothing if it requires no subcommand. Depends on the
/// layout of the help: `Usage: … <COMMAND>`, names indented by two spaces, then `Options:`.
fn subcommands(folder: &TestFolder, args: &str) -> BTreeSet<String> {
    let help = folder.run(&format!("{args} --help"));
    assert!(help.is_success(), "{help}");
    let usage = help.stdout.lines().find(|line| line.starts_with("Usage: "));
    if usage.is_none_or(|usage| !usage.ends_with("<COMMAND>")) {
        // The next word may be an argument.
        return BTreeSet::new();
    }
    // The top-level help lists the commands in groups.
    let after_usage = help
        .stdout
        .lines()
        .skip_while(|line| !line.starts_with("Usage: "))
        .skip(1);
    let command_list = after_usage.take_while(|line| *line != "Options:");
    let names = command_list.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    names
        .filter_map(|line| line.split_whitespace().next().map(str::to_owned))
        .collect()
}

#[test]
fn runs_of_the_pages_use_separate_folders() {
    let mut used_folders = BTreeSet::new();
    for page in pages() {
        let text = fs::read_to_string(&page).expect("a page");
        for line in text.lines().filter_map(|line| line.strip_prefix("$ reveille ")) {
            let words: Vec<&str> = line.split_whitespace().collect();
            let out = words.windows(2).find(|pair| pair[0] == "--out").map(|pair| pair[1]);
            if let (true, Some(out)) = (["run", "up", "bs"].contains(&words[0]), out) {
                assert!(
                    used_folders.insert(out.to_owned()),
                    "{}: {line}: {out} holds a run already",
                    page.display()
                );
            }
        }
    }
    assert!(used_folders.len() > 1, "{used_folders:?}");
}

#[test]
fn every_subcommand_that_is_named_exists() {
    let folder = TestFolder::new();
    let known = subcommands(&folder, "");
    assert!(known.contains("run") && known.contains("up"), "{known:?}");
    let mut command_count = 0;
    for page in pages() {
        let text = fs::read_to_string(&page).expect("a page");
        let commands = named_commands(&text);
        command_count += commands.len();
        let page = page.display();
        for (first, second) in commands {
            assert!(
                known.contains(first),
                "{page} names `reveille {first}`; there are {known:?}"
            );
            let listed = subcommands(&folder, first);
            if let Some(second) = second.filter(|second| !listed.is_empty() && !listed.contains(*second)) {
                // Developer commands are not listed.
                let help = folder.run(&format!("{first} {second} --help"));
                assert!(
                    help.is_success(),
                    "{page} names `reveille {first} {second}`; there are {listed:?}"
                );
            }
        }
    }
    assert!(
        command_count > 10,
        "only {command_count} commands were found in the pages"
    );
}

/// Returns every Markdown file of the repository.
fn markdown_files() -> Vec<PathBuf> {
    let is_skipped = |name: &str| ["target", ".git", "node_modules"].contains(&name) || name.starts_with(".venv");
    let (mut folders, mut files) = (vec![root()], Vec::new());
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("a folder") {
            let entry = entry.expect("an entry");
            let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
            // A link to a folder is not followed.
            if entry.file_type().expect("a type").is_dir() {
                if !is_skipped(&name) {
                    folders.push(path);
                }
            } else if path.extension().is_some_and(|ending| ending == "md") {
                files.push(path);
            }
        }
    }
    files
}

/// Returns the lines of a page outside fenced blocks.
fn prose(text: &str) -> impl Iterator<Item = &str> {
    let mut is_code = false;
    text.lines().filter(move |line| {
        let is_fence = line.trim_start().starts_with("```");
        is_code ^= is_fence;
        !is_code && !is_fence
    })
}

/// Returns the anchors of a page's headings, as GitHub and mdBook form them.
fn anchors(text: &str) -> BTreeSet<String> {
    let mut occurrences: BTreeMap<String, u32> = BTreeMap::new();
    let headings = prose(text).filter_map(|line| {
        line.trim_start_matches('#')
            .strip_prefix(' ')
            .filter(|_| line.starts_with('#'))
    });
    let to_anchor = |heading: &str| -> String {
        let kept = heading
            .trim()
            .chars()
            .filter(|&c| c.is_alphanumeric() || " -_".contains(c));
        kept.collect::<String>().to_lowercase().replace(' ', "-")
    };
    headings
        .map(|heading| {
            let anchor = to_anchor(heading);
            let number = occurrences.entry(anchor.clone()).or_default();
            *number += 1;
            match *number - 1 {
                0 => anchor,
                number => format!("{anchor}-{number}"),
            }
        })
        .collect()
}

/// Returns the targets of the links and pictures of a page, without links to other sites.
fn links(text: &str) -> Vec<String> {
    let text = prose(text).collect::<Vec<_>>().join("\n");
    let texts_between = |start: &'static str, end: char| {
        let texts = text
            .split(start)
            .skip(1)
            .filter_map(move |after_start| after_start.split(end).next());
        texts.map(str::to_owned).collect::<Vec<_>>()
    };
    let is_on_another_site = |link: &str| {
        ["http:", "https:", "mailto:"]
            .iter()
            .any(|scheme| link.starts_with(scheme))
    };
    let targets = [
        texts_between("](", ')'),
        texts_between("src=\"", '"'),
        texts_between("href=\"", '"'),
    ]
    .concat();
    targets.into_iter().filter(|link| !is_on_another_site(link)).collect()
}

#[test]
fn every_link_resolves() {
    let (mut link_count, mut broken) = (0, Vec::new());
    for page in markdown_files() {
        // The start of docs/scenario.md, which is generated and checked as a whole: its links start in docs/.
        if page.ends_with("bs/src/scenario/head.md") {
            continue;
        }
        let text = fs::read_to_string(&page).expect("a page");
        for link in links(&text) {
            link_count += 1;
            let (file, anchor) = link.split_once('#').unwrap_or((&link, ""));
            let target = if file.is_empty() {
                page.clone()
            } else {
                page.parent().expect("a folder").join(file)
            };
            let is_found = target.exists()
                && (anchor.is_empty() || fs::read_to_string(&target).is_ok_and(|text| anchors(&text).contains(anchor)));
            if !is_found {
                broken.push(format!("{}: {link}", page.display()));
            }
        }
    }
    assert!(broken.is_empty(), "links without a target:\n  {}", broken.join("\n  "));
    assert!(link_count > 200, "only {link_count} links were found");
}

#[test]
fn the_page_of_the_policy_port_shows_the_client_in_full() {
    let page = fs::read_to_string(root().join("docs/policy-port.md")).expect("a page");
    let client = fs::read_to_string(root().join("deploy/examples/client.py")).expect("a program");
    assert!(page.contains(&format!("```python\n{client}```\n")));
}

#[test]
fn links_and_anchors_are_read_as_on_the_site() {
    let page = "# `a` and B!\n```\n# code [no](no.md)\n```\n## Same\n## Same\n\
        [x](y.md#z) <img src=\"p.svg\"> [w](https://e.org)";
    let headings: Vec<String> = anchors(page).into_iter().collect();
    assert_eq!(headings, ["a-and-b", "same", "same-1"]);
    assert_eq!(links(page), ["y.md#z", "p.svg"]);
}

#[test]
fn the_contents_list_every_page_under_its_kind() {
    let contents = fs::read_to_string(root().join("docs/SUMMARY.md")).expect("the contents");
    // Each heading opens a group, and the title `Reveille` the first of them, without pages. The first part is the text
    // before the title.
    let groups = contents.split("# ").skip(1).map(|group| {
        let (kind, pages) = group.split_once('\n').unwrap_or((group, ""));
        (kind, links(pages))
    });
    let groups: Vec<(&str, Vec<String>)> = groups.collect();
    let kinds: Vec<&str> = groups.iter().map(|(kind, _)| *kind).collect();
    assert_eq!(
        kinds,
        ["Reveille", "Tutorial", "How-to guides", "Reference", "Explanation"]
    );
    for page in pages() {
        let name = page.file_name().and_then(|name| name.to_str()).expect("a name");
        if ["README.md", "SUMMARY.md"].contains(&name) {
            continue;
        }
        let kinds_of_page = groups.iter().flat_map(|(kind, listed)| {
            let entries_of_page = listed.iter().filter(|listed| *listed == name);
            entries_of_page.map(|_| *kind)
        });
        let kinds_of_page: Vec<&str> = kinds_of_page.collect();
        let is_of_one_kind = kinds_of_page.len() == 1 && kinds_of_page[0] != "Reveille";
        assert!(
            is_of_one_kind,
            "docs/{name} must be under one kind of page, not {kinds_of_page:?}"
        );
    }
    let entry_count: usize = groups.iter().map(|(_, listed)| listed.len()).sum();
    // README.md is not in docs/, and the contents do not list themselves.
    assert_eq!(
        entry_count,
        pages().len() - 2,
        "docs/SUMMARY.md lists pages that do not exist"
    );
}
