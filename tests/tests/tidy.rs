//! The tree is as ARCHITECTURE.md says.

use std::fs;
use std::path::{Path, PathBuf};

/// Files that may know tokio, zenoh and the wall clock.
const SHELLS: [&str; 8] = [
    "common/src/bus/",
    "common/src/logging.rs",
    "device/src/actor.rs",
    "device/src/host.rs",
    "device/src/round.rs",
    "device/src/uplink.rs",
    "bs/src/actor",
    "deploy/",
];

/// Words that only shells may use.
const SHELL_WORDS: [&str; 5] = [
    "tokio",
    "zenoh::",
    "std::time::Instant",
    "std::time::SystemTime",
    "std::process",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// All Rust files below the crates' `src` folders, with their paths from the root.
fn sources() -> Vec<(String, String)> {
    let mut found = Vec::new();
    for member in ["common", "device", "bs", "lab", "deploy"] {
        collect(&root().join(member).join("src"), &format!("{member}/src"), &mut found);
    }
    assert!(found.len() > 40, "only {} source files were found", found.len());
    found
}

fn collect(folder: &Path, name: &str, found: &mut Vec<(String, String)>) {
    for entry in fs::read_dir(folder).expect("a source folder") {
        let path = entry.expect("an entry").path();
        let name = format!("{name}/{}", path.file_name().expect("a name").to_string_lossy());
        if path.is_dir() {
            collect(&path, &name, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push((name, fs::read_to_string(&path).expect("UTF-8")));
        }
    }
}

/// The code of a file: without comments and without its unit tests at the end.
fn code(text: &str) -> String {
    let text = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
    text.lines()
        .filter(|line| !line.trim_start().starts_with("//"))
        .collect::<Vec<_>>()
        .join("\n")
}

#[test]
fn only_shells_do_io() {
    for (name, text) in sources() {
        if name.ends_with("tests.rs") || SHELLS.iter().any(|shell| name.starts_with(shell)) {
            continue;
        }
        for word in SHELL_WORDS {
            assert!(
                !code(&text).contains(word),
                "{name} uses {word}: it belongs into a shell, see ARCHITECTURE.md"
            );
        }
    }
}

#[test]
fn device_and_base_station_do_not_know_each_other() {
    for (name, text) in sources() {
        if name.starts_with("device/") {
            assert!(!text.contains("reveille_bs"), "{name}");
        }
        if name.starts_with("bs/") {
            assert!(!text.contains("reveille_device"), "{name}");
        }
        if name.starts_with("common/") {
            assert!(
                !text.contains("reveille_bs") && !text.contains("reveille_device"),
                "{name}"
            );
        }
    }
}

#[test]
fn bincode_and_zenoh_stay_behind_one_door() {
    for (name, text) in sources() {
        assert!(
            name == "common/src/codec.rs" || !code(&text).contains("bincode::"),
            "{name} names bincode"
        );
        assert!(
            name.starts_with("common/src/bus/") || !code(&text).contains("zenoh::"),
            "{name} names zenoh"
        );
    }
}

#[test]
fn files_can_be_held_in_mind() {
    for (name, text) in sources() {
        let lines = code(&text).lines().count();
        assert!(
            lines <= 500,
            "{name} has {lines} lines without tests and comments: is it still one room?"
        );
    }
}

#[test]
fn no_path_of_a_machine_is_named() {
    for (name, text) in sources() {
        for folder in ["home", "root", "work"] {
            let path = format!("/{folder}/");
            assert!(!text.contains(&path), "{name} names {path}");
        }
    }
}

#[test]
fn the_code_map_names_real_files() {
    let text = fs::read_to_string(root().join("ARCHITECTURE.md")).expect("ARCHITECTURE.md");
    let mut folder = String::new();
    for line in text.lines().filter(|line| line.starts_with("| ")) {
        for word in line.split('`').skip(1).step_by(2) {
            if let Some((first, _)) = word
                .trim_end_matches('/')
                .rsplit_once('/')
                .filter(|_| root().join(word).exists())
            {
                folder = if word.ends_with('/') {
                    word.to_owned()
                } else {
                    first.to_owned()
                };
            }
            let exists = Path::new(&folder).ancestors().any(|above| {
                root().join(above).join(word).exists() || root().join(above).join(format!("{word}.rs")).exists()
            });
            assert!(exists, "ARCHITECTURE.md names `{word}`, which is not there");
        }
    }
}
