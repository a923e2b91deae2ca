//! Whether a binary of tests has all of its folder: its modules are found when it is compiled, and cargo does not
//! compile it again for a file that it does not know yet.

use std::fs;
use std::process::Command;

/// Checks that the running binary has at least one test of each Rust file in `folder`, `main.rs` aside.
///
/// # Panics
/// If a file has none.
pub fn assert_all_of(folder: &str) {
    let binary = std::env::current_exe().expect("a test has a path");
    let listing = Command::new(binary)
        .arg("--list")
        .output()
        .expect("a test can be started");
    let listing = String::from_utf8(listing.stdout).expect("names of tests are UTF-8");
    let mut files = 0;
    for entry in fs::read_dir(folder).expect("the folder of the tests is there") {
        let name = entry.expect("an entry").file_name().to_string_lossy().into_owned();
        let Some(module) = name.strip_suffix(".rs").filter(|&module| module != "main") else {
            continue;
        };
        files += 1;
        let tests = format!("{module}::");
        assert!(
            listing.lines().any(|line| line.starts_with(&tests)),
            "{folder}/{name} has no test in this binary: touch main.rs beside it and test again"
        );
    }
    assert!(files > 1, "{folder} has {files} files of tests");
}
