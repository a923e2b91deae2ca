//! Checks the rules of ARCHITECTURE.md: allowed dependencies, forbidden names in pure code, and limits on the length of
//! files and lines.

mod tree;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

pub(super) use tree::root;
use tree::{CRATES, Crate, Mention, Module, SourceFile, sources};

/// Crates of the workspace that each crate may use in its code.
const MAY_USE: [(&str, &[&str]); 9] = [
    ("common", &[]),
    ("device", &["common"]),
    ("bs", &["common"]),
    ("lab", &["common", "device", "bs"]),
    ("study", &["common", "device", "bs", "lab"]),
    ("view", &["common", "device", "bs"]),
    ("deploy", &["common", "device", "bs", "lab", "study", "view"]),
    ("tests", &["common", "device", "bs", "lab", "study", "view"]),
    ("python", &["common", "bs", "lab", "study"]),
];

/// Layers of `common`: a module may use modules of its line and of the lines above it. A file or folder directly in
/// `common/src` is a module here.
const LAYERS_OF_COMMON: [&[&str]; 13] = [
    &["codec", "encoding", "units"],
    &["ids", "totals"],
    &["phases", "plan", "rng", "secret", "state"],
    &["columns", "declare", "io", "parquet"],
    &["energy", "geometry"],
    &["harvest", "radio", "sensing"],
    &["event"],
    &["scenario"],
    &["message"],
    &["deployment", "keys"],
    &["world"],
    &["score"],
    &["bus", "logging"],
];

/// Code that may do input and output, read clocks and hold global state. All other code is pure: its result depends
/// only on its arguments, so one scenario and seed give one digest.
const SHELLS: [&str; 17] = [
    "common/src/bus/",
    "common/src/io.rs",
    "common/src/logging.rs",
    "device/src/host/",
    "bs/src/server/",
    "bs/src/scenario/disk.rs",
    "lab/src/io.rs",
    "lab/src/sweep/folder.rs",
    "lab/src/sweep/journal/io/mod.rs",
    "lab/src/table/io.rs",
    "lab/src/training/io.rs",
    "lab/src/trajectories/io.rs",
    "lab/src/tuning/tuner.rs",
    "view/src/batch_receiver.rs",
    "view/src/recording/recorder.rs",
    "deploy/",
    "python/",
];

/// Paths that pure code may not name, including everything below them.
const SHELL_PATHS: [&str; 18] = [
    "getrandom",
    "rand::random",
    "rand::rng",
    "std::collections::hash_map",
    "std::env",
    "std::fs",
    "std::hash::RandomState",
    "std::io::stderr",
    "std::io::stdin",
    "std::io::stdout",
    "std::net",
    "std::path::absolute",
    "std::process",
    "std::thread",
    "std::time",
    "tempfile",
    "tokio",
    "zenoh",
];

/// Methods of `Path` that access the disk. None of them takes an argument.
const PATH_METHODS: [&str; 10] = [
    "canonicalize",
    "exists",
    "is_dir",
    "is_file",
    "is_symlink",
    "metadata",
    "read_dir",
    "read_link",
    "symlink_metadata",
    "try_exists",
];

/// Methods with these names that do not belong to `Path`: the metadata of bytes that are already in memory.
const OTHER_METHODS: [(&str, &str); 6] = [
    ("common/src/columns/parquet.rs", "metadata"),
    ("common/src/parquet.rs", "metadata"),
    ("lab/src/table/parquet.rs", "metadata"),
    ("lab/src/trajectories/parquet.rs", "metadata"),
    ("lab/src/transformer/checkpoint.rs", "metadata"),
    ("bs/src/policy/dt/model/weights.rs", "metadata"),
];

/// Types that make a `static` global state, through which one run could affect the next.
const CHANGEABLE: [&str; 10] = [
    "Mutex",
    "RwLock",
    "OnceLock",
    "LazyLock",
    "OnceCell",
    "LazyCell",
    "Cell",
    "RefCell",
    "thread_local",
    "mut",
];

/// Violations of a rule: names of files or the like, each with its faults.
type Offenders = BTreeSet<(String, String)>;

/// Checks that there are no violations of a rule.
#[track_caller]
fn assert_none(rule: &str, offenders: &Offenders) {
    let report: Vec<String> = offenders.iter().map(|(name, what)| format!("{name}: {what}")).collect();
    assert!(report.is_empty(), "{rule}\n  {}", report.join("\n  "));
}

/// Returns every crate with its modules.
fn crates() -> &'static [(&'static str, Crate)] {
    static READ: OnceLock<Vec<(&'static str, Crate)>> = OnceLock::new();
    READ.get_or_init(|| {
        let sources = sources();
        CRATES.map(|member| (member, Crate::read(member, &sources))).into()
    })
}

/// Returns the part of a crate that contains a file: its folder or file directly in `src`.
fn part(file: &str) -> &str {
    place(file).first().copied().unwrap_or("lib")
}

/// Returns the folders that contain a file, and the file: `["policy", "knn"]` for both `bs/src/policy/knn/mod.rs` and
/// `bs/src/policy/knn.rs`.
fn place(file: &str) -> Vec<&str> {
    let inner = file.split_once("/src/").map_or(file, |(_, inner)| inner);
    let mut place: Vec<&str> = inner.trim_end_matches(".rs").split('/').collect();
    place.pop_if(|last| ["mod", "lib", "main"].contains(last));
    place
}

/// Protects: a file can be understood, tested and moved with its dependencies and without its dependants.
#[test]
fn no_circle_of_files() {
    let mut found = Offenders::new();
    for (_, tree) in crates() {
        let graph: Graph = tree
            .uses()
            .into_iter()
            .map(|(file, uses)| (file, uses.into_keys().collect()))
            .collect();
        found.extend(circles(&graph));
    }
    assert_none("files use each other in a circle", &found);
}

/// Returns the dependencies within each folder: between the files and folders directly in it and its own file
/// (`mod.rs`).
fn folders(tree: &Crate) -> BTreeMap<Vec<String>, Graph> {
    let mut folders: BTreeMap<Vec<String>, Graph> = BTreeMap::new();
    for (file, uses) in tree.uses() {
        let own = place(&file);
        for used in uses.keys() {
            let other = place(used);
            let shared = own.iter().zip(&other).take_while(|(a, b)| a == b).count();
            let within = |file: &str, place: &[&str]| match place.get(shared) {
                Some(_) => format!("{}/src/{}", tree.member, place[..=shared].join("/")),
                None => file.to_owned(),
            };
            let folder = own[..shared].iter().map(|&name| name.to_owned()).collect();
            let graph = folders.entry(folder).or_default();
            graph
                .entry(within(&file, &own))
                .or_default()
                .insert(within(used, &other));
        }
    }
    folders
}

/// Protects: the folders of a crate and their contents have an order in which they can be read.
#[test]
fn no_circle_of_folders() {
    let graphs = crates().iter().flat_map(|(_, tree)| folders(tree).into_values());
    let found = graphs.flat_map(|graph| circles(&graph)).collect();
    assert_none("folders use each other in a circle", &found);
}

/// Protects: the order of the crates. A device must not depend on the base station, nor a model on the command that
/// runs it.
#[test]
fn no_crate_is_used_from_below() {
    let mut found = Offenders::new();
    for (member, tree) in crates() {
        let (_, lower) = MAY_USE.iter().find(|(name, _)| name == member).expect("a crate");
        let is_allowed = |name: &str| {
            let used = name
                .strip_prefix("reveille_")
                .or_else(|| name.strip_prefix("reveille-"));
            used.is_none_or(|used| used == *member || lower.contains(&used) || !CRATES.contains(&used))
        };
        for module in tree.modules.values() {
            for mention in module.mentions.iter().filter(|mention| !is_allowed(&mention.words[0])) {
                found.insert((module.file.clone(), mention.words.join("::")));
            }
        }
        let manifest = fs::read_to_string(root().join(member).join("Cargo.toml")).expect("a manifest");
        let manifest: toml::Table = manifest.parse().expect("TOML");
        let dependencies = manifest["dependencies"].as_table().expect("a table");
        for name in dependencies.keys().filter(|name| !is_allowed(name)) {
            found.insert((format!("{member}/Cargo.toml"), name.clone()));
        }
    }
    assert_none("a crate uses one above it", &found);
}

/// Protects: the vocabulary builds up from units to messages, so each part can be read after only the parts before it.
#[test]
fn common_keeps_to_its_layers() {
    let sources = sources();
    let level = |part: &str| {
        LAYERS_OF_COMMON
            .iter()
            .position(|layer| layer.contains(&part))
            .unwrap_or_else(|| panic!("common/src/{part} is missing in LAYERS_OF_COMMON"))
    };
    let mut found = Offenders::new();
    let (_, tree) = crates()
        .iter()
        .find(|(member, _)| *member == "common")
        .expect("a crate");
    for (file, uses) in tree.uses().into_iter().filter(|(file, _)| part(file) != "lib") {
        let own = level(part(&file));
        for (used, path) in uses {
            if part(&used) == "lib" || level(part(&used)) > own {
                found.insert((file.clone(), format!("uses {path}, which is in a layer above")));
            }
        }
    }
    assert_none("common has an order", &found);
    for part in LAYERS_OF_COMMON.iter().flat_map(|layer| layer.iter()) {
        let names = [format!("common/src/{part}.rs"), format!("common/src/{part}/mod.rs")];
        let is_there = sources.iter().any(|source| names.contains(&source.name));
        assert!(is_there, "LAYERS_OF_COMMON names {part}, which does not exist");
    }
}

fn is_shell(file: &str) -> bool {
    SHELLS.iter().any(|shell| file.starts_with(shell))
}

/// Returns the modules of pure code, each with its crate and path.
fn pure_modules() -> impl Iterator<Item = (&'static Crate, &'static [String], &'static Module)> {
    let members = crates()
        .iter()
        .filter(|(member, _)| !["deploy", "tests"].contains(member));
    let modules = members.flat_map(|(_, tree)| tree.modules.iter().map(move |(path, module)| (tree, path, module)));
    let modules = modules.map(|(tree, path, module)| (tree, path.as_slice(), module));
    modules.filter(|(_, _, module)| !is_shell(&module.file))
}

/// Protects: one scenario and seed give one digest, however the run is driven. Code that reads files, clocks or
/// entropy, or waits for others, could make two runs differ.
#[test]
fn pure_code_does_no_io() {
    let mut found = Offenders::new();
    for (tree, path, module) in pure_modules() {
        for mention in &module.mentions {
            let words = tree.written_out(path, &mention.words);
            let written = words.join("::");
            let is_below = |shell: &str| {
                written
                    .strip_prefix(shell)
                    .is_some_and(|r| r.is_empty() || r.starts_with("::"))
            };
            let asks_the_disk = match words.as_slice() {
                [.., owner, method] => {
                    ["Path", "PathBuf"].contains(&owner.as_str()) && PATH_METHODS.contains(&method.as_str())
                }
                _ => false,
            };
            // A single word is a variable or an imported name.
            if mention.words.len() > 1 && (asks_the_disk || SHELL_PATHS.iter().any(|shell| is_below(shell))) {
                found.insert((module.file.clone(), format!("names {written}")));
            }
        }
        for method in module.calls.iter().map(String::as_str) {
            let is_another = OTHER_METHODS.contains(&(module.file.as_str(), method));
            if PATH_METHODS.contains(&method) && !is_another {
                found.insert((module.file.clone(), format!("calls .{method}()")));
            }
        }
    }
    assert_none("pure code does no input or output", &found);
    for shell in SHELLS {
        assert!(
            root().join(shell).exists(),
            "SHELLS names {shell}, which does not exist"
        );
    }
}

/// Protects: one digest, also against input and output through functions of a shell. A folder's `mod.rs` may re-export
/// items of its shell; the check finds modules that use such items.
#[test]
fn pure_code_uses_no_shell() {
    let mut found = Offenders::new();
    for (tree, path, module) in pure_modules() {
        let is_own = |mention: &&Mention| !tree.hands_on(path, mention);
        for mention in module.mentions.iter().filter(is_own) {
            if let Some(file) = declaring_file(tree, path, mention).filter(|file| is_shell(file)) {
                let name = mention.words.join("::");
                found.insert((module.file.clone(), format!("names {name}, which is of {file}")));
            }
        }
    }
    assert_none("pure code uses no shell", &found);
}

/// Returns the file of this workspace that declares the target of `mention` in the module at `path`.
fn declaring_file(tree: &Crate, path: &[String], mention: &Mention) -> Option<String> {
    let words = tree.written_out(path, &mention.words);
    let of = |member: &str| format!("reveille_{member}");
    match crates().iter().find(|(member, _)| of(member) == words[0]) {
        Some((_, other)) => other.file_at(&words[1..]),
        None => tree.file_of(path, &mention.words),
    }
}

/// Protects: a run depends on its arguments, not on earlier runs in the same process.
#[test]
fn pure_code_has_no_global_state() {
    let mut found = Offenders::new();
    for (_, _, module) in pure_modules() {
        for written in &module.statics {
            let words = || written.split(' ');
            if words().any(|word| CHANGEABLE.contains(&word) || word.starts_with("Atomic")) {
                found.insert((module.file.clone(), format!("has a static of type {written}")));
            }
        }
    }
    assert_none("pure code has no global state", &found);
}

/// Protects: bincode, which is unmaintained, and zenoh can each be replaced in one place.
#[test]
fn bincode_and_zenoh_are_used_in_one_module() {
    let mut found = Offenders::new();
    for (_, tree) in crates() {
        for module in tree.modules.values() {
            for mention in &module.mentions {
                let door = match mention.words[0].as_str() {
                    "bincode" => "common/src/codec.rs",
                    "zenoh" => "common/src/bus/",
                    _ => continue,
                };
                if !module.file.starts_with(door) {
                    found.insert((module.file.clone(), format!("names {}", mention.words.join("::"))));
                }
            }
        }
    }
    assert_none("bincode and zenoh have one door each", &found);
}

/// Protects: a file is short enough for a reader to keep in mind. Clippy limits the length of functions
/// (`too-many-lines-threshold`).
#[test]
fn files_have_a_limited_length() {
    let mut found = Offenders::new();
    for source in sources().iter().filter(|source| !source.is_test()) {
        let lines = source.code().len();
        if lines > 500 {
            found.insert((
                source.name.clone(),
                format!("{lines} lines of code: is it still one room?"),
            ));
        }
    }
    assert_none("a file has at most 500 lines without tests and comments", &found);
}

/// Protects: two files fit side by side on a screen. rustfmt wraps only code.
#[test]
fn lines_fit_on_a_screen() {
    let mut found = Offenders::new();
    for source in sources() {
        let numbered = (1..).zip(source.text.lines());
        for (number, line) in numbered.filter(|(_, line)| line.chars().count() > 120) {
            let columns = line.chars().count();
            found.insert((source.name.clone(), format!("line {number} has {columns} columns")));
        }
    }
    assert_none("a line has at most 120 columns, comments too", &found);
}

/// Protects: sources cite the paper or a reason, never a document that readers do not have.
#[test]
fn no_unavailable_document_is_cited() {
    let mut found = Offenders::new();
    let word = ["MO", "DEL"].concat();
    for source in sources() {
        let is_part = |c: char| c.is_alphanumeric() || c == '_';
        let names = |line: &str| line.split(|c| !is_part(c)).any(|found| found == word);
        for (number, _) in (1..).zip(source.text.lines()).filter(|(_, line)| names(line)) {
            found.insert((
                source.name.clone(),
                format!("line {number} says {word}: which section, or why?"),
            ));
        }
    }
    assert_none("sources cite available documents", &found);
}

/// Protects: the tree builds and runs wherever it is cloned.
#[test]
fn no_path_of_a_machine_is_named() {
    let mut found = Offenders::new();
    for source in sources() {
        for folder in ["home", "root", "work"] {
            let path = format!("/{folder}/");
            for (number, _) in (1..).zip(source.text.lines()).filter(|(_, line)| line.contains(&path)) {
                found.insert((source.name.clone(), format!("line {number} names {path}")));
            }
        }
    }
    assert_none("no source names a folder of one machine", &found);
}

/// Returns the files that a source declares as modules: `name.rs` or `name/mod.rs`, of which clippy allows one.
fn declared_files(source: &SourceFile) -> Vec<String> {
    let (folder, _) = source.name.rsplit_once('/').expect("a folder");
    let files = source.text.lines().flat_map(|line| {
        let name = line.strip_suffix(';').and_then(|line| line.rsplit_once("mod "));
        match name {
            Some(("" | "pub " | "pub(crate) ", name)) => {
                vec![format!("{folder}/{name}.rs"), format!("{folder}/{name}/mod.rs")]
            }
            Some(_) | None => Vec::new(),
        }
    });
    files.collect()
}

/// Protects: code and tests, from files without a `mod` line, which the compiler ignores.
#[test]
fn every_file_is_a_module() {
    let sources = sources();
    let declared: BTreeSet<String> = sources.iter().flat_map(declared_files).collect();
    // A page includes docs/patrol.rs, and each fuzz target is a program.
    let is_root = |name: &str| {
        let is_elsewhere = name.starts_with("docs/") || name.starts_with("tests/fuzz/");
        is_elsewhere || name.ends_with("/lib.rs") || name.ends_with("/main.rs")
    };
    let left_out = sources
        .iter()
        .filter(|source| !is_root(&source.name) && !declared.contains(&source.name));
    let found = left_out
        .map(|source| (source.name.clone(), "is no module of its crate".to_owned()))
        .collect();
    assert_none("every file is named by a `mod` line", &found);
}

/// Protects: readers of pages, from placeholders of figures that were never filled in.
#[test]
fn no_page_has_a_gap_to_be_filled_in() {
    let pages = fs::read_dir(root().join("docs")).expect("docs");
    let pages = pages.map(|entry| entry.expect("an entry").path());
    let tops = ["README.md", "CHANGELOG.md", "ARCHITECTURE.md"].map(|name| root().join(name));
    let mut found = Offenders::new();
    let is_gap = |word: &str| word.len() > 1 && word.chars().all(|c| c.is_ascii_uppercase() || c == '_');
    let (mut seen, is_page) = (0, |path: &PathBuf| {
        path.extension().is_some_and(|ending| ending == "md")
    });
    for path in pages.chain(tops).filter(is_page) {
        let text = fs::read_to_string(&path).expect("a page");
        seen += 1;
        // The name of a figure stands between two of these signs.
        for word in text.split('@').skip(1).filter(|word| is_gap(word)) {
            found.insert((path.display().to_string(), format!("@{word}@")));
        }
    }
    assert!(seen > 10, "{seen} pages");
    assert_none("pages have no gaps", &found);
}

/// Protects: releases, from a file that still names another version of Reveille or of Rust.
#[test]
fn versions_agree() {
    let (version, rust) = (env!("CARGO_PKG_VERSION"), env!("CARGO_PKG_RUST_VERSION"));
    let mut found = Offenders::new();
    for (file, expected) in [
        ("CHANGELOG.md", format!("\n## {version} (")),
        ("CITATION.cff", format!("\nversion: {version}\n")),
        ("tests/fuzz/Cargo.toml", format!("\nversion = \"{version}\"\n")),
        ("tests/fuzz/Cargo.toml", format!("\nrust-version = \"{rust}\"\n")),
        ("rust-toolchain.toml", format!("\nchannel = \"{rust}.")),
        ("deploy/docker/Dockerfile", format!("rust:{rust}-")),
        ("docker-compose.yml", format!("rust:{rust}-")),
        ("README.md", format!("Rust {rust} ")),
    ] {
        let text = fs::read_to_string(root().join(file)).expect("a file of the repository");
        if !text.contains(&expected) {
            found.insert((file.to_owned(), format!("does not contain {expected:?}")));
        }
    }
    assert_none("all files name the versions of Cargo.toml", &found);
}

/// Protects: ARCHITECTURE.md, which newcomers use to find the file for a change.
#[test]
fn the_code_map_names_real_files() {
    let text = fs::read_to_string(root().join("ARCHITECTURE.md")).expect("ARCHITECTURE.md");
    let mut folder = String::new();
    let mut found = Offenders::new();
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
            if !exists {
                found.insert((word.to_owned(), "does not exist".to_owned()));
            }
        }
    }
    assert_none("ARCHITECTURE.md names existing files", &found);
}

/// Dependency graph: files or folders, each with its dependencies.
pub(super) type Graph = BTreeMap<String, BTreeSet<String>>;

/// Returns every name that can be reached from itself, with a shortest cycle: `a → b → a`.
pub(super) fn circles(graph: &Graph) -> BTreeMap<String, String> {
    let with_way = |name: &String| way_back(graph, name).map(|way| (name.clone(), way.join(" → ")));
    graph.keys().filter_map(with_way).collect()
}

fn way_back(graph: &Graph, start: &str) -> Option<Vec<String>> {
    let mut reached_from: BTreeMap<&str, &str> = BTreeMap::new();
    let mut waiting = VecDeque::from([start]);
    while let Some(at) = waiting.pop_front() {
        for next in graph.get(at).into_iter().flatten() {
            if next == start {
                let mut way = vec![start.to_owned(), at.to_owned()];
                let mut step = at;
                while step != start {
                    step = reached_from[step];
                    way.push(step.to_owned());
                }
                way.reverse();
                return Some(way);
            }
            if !reached_from.contains_key(next.as_str()) {
                reached_from.insert(next, at);
                waiting.push_back(next);
            }
        }
    }
    None
}
