//! Checks that commands in the README and the documentation exist.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use reveille_tests::process::Folder;

/// Returns README.md and the pages of docs/.
fn pages() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let docs = fs::read_dir(root.join("docs"))
        .expect("docs/")
        .map(|entry| entry.expect("an entry").path());
    let mut pages: Vec<PathBuf> = docs
        .filter(|path| path.extension().is_some_and(|e| e == "md"))
        .collect();
    pages.push(root.join("README.md"));
    pages
}

/// Returns the code of a page: text between backquotes, inline or in blocks.
fn code(text: &str) -> impl Iterator<Item = &str> {
    text.split('`')
        .skip(1)
        .step_by(2)
        .chain(text.split("```").skip(1).step_by(2))
}

/// Returns the two words after each `reveille` in a page's code.
fn commands(text: &str) -> Vec<(&str, Option<&str>)> {
    let is_word = |word: &&str| word.chars().all(|c| c.is_ascii_lowercase() || c == '-') && !word.starts_with('-');
    let lines = code(text).flat_map(str::lines);
    lines
        .filter_map(|line| {
            // `cargo run -- up` and a path to the binary start the same command.
            let words: Vec<&str> = line.split_whitespace().collect();
            let is_start = |word: &str| word == "reveille" || word.ends_with("/reveille");
            let is_cargo = words.starts_with(&["cargo", "run"]);
            let at = words
                .iter()
                .position(|word| is_start(word) || is_cargo && *word == "--")?;
            let after = |n: usize| words.get(at + n).copied().filter(is_word);
            after(1).map(|first| (first, after(2)))
        })
        .collect()
}

/// Returns the subcommands in the help of `reveille ARGS`, if it requires a subcommand.
fn subcommands(folder: &Folder, args: &str) -> BTreeSet<String> {
    let help = folder.run(&format!("{args} --help"));
    assert!(help.is_success(), "{help}");
    let usage = help.stdout.lines().find(|line| line.starts_with("Usage: "));
    if usage.is_none_or(|usage| !usage.ends_with("<COMMAND>")) {
        // The next word may be an argument.
        return BTreeSet::new();
    }
    let list = help.stdout.split("Commands:\n").nth(1).unwrap_or_default();
    let list = list.lines().take_while(|line| !line.is_empty());
    let names = list.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    names
        .filter_map(|line| line.split_whitespace().next().map(str::to_owned))
        .collect()
}

#[test]
fn runs_of_the_pages_do_not_meet_in_a_folder() {
    let mut seen = BTreeSet::new();
    for page in pages() {
        let text = fs::read_to_string(&page).expect("a page");
        for line in text.lines().filter_map(|line| line.strip_prefix("$ reveille ")) {
            let words: Vec<&str> = line.split_whitespace().collect();
            let out = words.windows(2).find(|pair| pair[0] == "--out").map(|pair| pair[1]);
            if let (true, Some(out)) = (["run", "up", "bs"].contains(&words[0]), out) {
                assert!(
                    seen.insert(out.to_owned()),
                    "{}: {line}: {out} holds a run already",
                    page.display()
                );
            }
        }
    }
    assert!(seen.len() > 1, "{seen:?}");
}

#[test]
fn every_subcommand_that_is_named_exists() {
    let folder = Folder::new();
    let known = subcommands(&folder, "");
    assert!(known.contains("run") && known.contains("up"), "{known:?}");
    let mut seen = 0;
    for page in pages() {
        let text = fs::read_to_string(&page).expect("a page");
        let commands = commands(&text);
        seen += commands.len();
        let page = page.display();
        for (first, second) in commands {
            assert!(
                known.contains(first),
                "{page} names `reveille {first}`; there are {known:?}"
            );
            let below = subcommands(&folder, first);
            if let Some(second) = second.filter(|second| !below.is_empty() && !below.contains(*second)) {
                // Developer commands are not listed.
                let help = folder.run(&format!("{first} {second} --help"));
                assert!(
                    help.is_success(),
                    "{page} names `reveille {first} {second}`; there are {below:?}"
                );
            }
        }
    }
    assert!(seen > 10, "only {seen} commands were found in the pages");
}
