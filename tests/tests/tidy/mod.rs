//! Checks the source tree against the rules of ARCHITECTURE.md: dependencies of crates, folders and files, forbidden
//! names in pure code, the length of files and lines, and versions. It reads source text only; clippy and rustfmt check
//! the rest. The tables below repeat ARCHITECTURE.md, which no test compares with them: change both.

mod tree;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use tree::{CRATES, Crate, Mention, Module, SourceFile, root, sources};

/// Crates of the workspace that each crate may use in its code, for each of [`CRATES`]. ARCHITECTURE.md shows this
/// order.
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

/// Layers of `common`, the lowest in the first line: a module may use its own layer and lower ones. A file or folder
/// directly in `common/src` is a module here.
const LAYERS_OF_COMMON: [&[&str]; 13] = [
    &["codec", "digits", "encoding", "units"],
    &["ids", "totals"],
    &["phases", "plan", "rng", "secret", "state"],
    &["columns", "declare", "io", "parquet"],
    &["energy", "geometry"],
    &["harvest", "radio", "sensing"],
    &["event"],
    &["scenario"],
    &["message"],
    &["deployment", "keys"],
    &["energy_balance", "world"],
    &["score"],
    &["bus", "logging"],
];

/// Code that may do input and output, read clocks and hold global state. All other code is pure: its result depends
/// only on its arguments, so one scenario and seed give one digest. ARCHITECTURE.md lists the shells under "Purity".
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

/// Methods of `Path` that access the disk. None of them takes an argument: [`Module::calls`] lists only such calls.
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

/// Files with methods of these names that do not belong to `Path`: the metadata of bytes that are already in memory. An
/// entry for a file that no longer exists is not reported.
const IN_MEMORY_METHODS: [(&str, &str); 6] = [
    ("common/src/columns/parquet.rs", "metadata"),
    ("common/src/parquet.rs", "metadata"),
    ("lab/src/table/parquet.rs", "metadata"),
    ("lab/src/trajectories/parquet.rs", "metadata"),
    ("lab/src/transformer/checkpoint.rs", "metadata"),
    ("bs/src/policy/dt/model/weights.rs", "metadata"),
];

/// Names in the type of a `static` that make it global state, through which one run could affect the next:
/// [`Module::statics`] records `mut` and `thread_local` like types.
const MUTABLE_TYPES: [&str; 10] = [
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

/// Maximum length of a file without comments and unit tests. [`SourceFile::code`] counts.
const MAX_LINES_OF_CODE: usize = 500;
/// Maximum length of a line, as in `rustfmt.toml`.
const MAX_COLUMNS: usize = 120;

/// Violations of a rule: the name of a file or page, and its fault.
type Violations = BTreeSet<(String, String)>;

/// Checks that there are no violations of `rule`.
#[track_caller]
fn assert_none(rule: &str, violations: &Violations) {
    let report: Vec<String> = violations
        .iter()
        .map(|(name, fault)| format!("{name}: {fault}"))
        .collect();
    assert!(report.is_empty(), "violated rule: {rule}\n  {}", report.join("\n  "));
}

/// Returns every crate with its modules.
fn crates() -> &'static [(&'static str, Crate)] {
    static CRATES_READ: OnceLock<Vec<(&'static str, Crate)>> = OnceLock::new();
    CRATES_READ.get_or_init(|| {
        let sources = sources();
        CRATES.map(|member| (member, Crate::read(member, &sources))).into()
    })
}

/// Returns the module directly in `src` that contains a file.
fn top_module(file: &str) -> &str {
    module_path(file).first().copied().unwrap_or("lib")
}

/// Returns the path of a file's module: `["policy", "knn"]` for both `bs/src/policy/knn/mod.rs` and
/// `bs/src/policy/knn.rs`.
fn module_path(file: &str) -> Vec<&str> {
    let inner = file.split_once("/src/").map_or(file, |(_, inner)| inner);
    let mut path: Vec<&str> = inner.trim_end_matches(".rs").split('/').collect();
    path.pop_if(|last| ["mod", "lib", "main"].contains(last));
    path
}

/// Protects: a file can be understood, tested and moved with its dependencies and without its dependants.
#[test]
fn files_use_each_other_without_cycles() {
    let mut violations = Violations::new();
    for (_, member_crate) in crates() {
        let graph: Graph = member_crate
            .uses()
            .into_iter()
            .map(|(file, uses)| (file, uses.into_keys().collect()))
            .collect();
        violations.extend(cycles(&graph));
    }
    assert_none("files do not use each other in a cycle", &violations);
}

/// Returns the dependencies within each folder: between the files and folders directly in it and its own file
/// (`mod.rs`).
fn dependencies_by_folder(member_crate: &Crate) -> BTreeMap<Vec<String>, Graph> {
    let mut folders: BTreeMap<Vec<String>, Graph> = BTreeMap::new();
    for (file, uses) in member_crate.uses() {
        let user_path = module_path(&file);
        for used in uses.keys() {
            let used_path = module_path(used);
            let shared = user_path.iter().zip(&used_path).take_while(|(a, b)| a == b).count();
            let entry_of_folder = |file: &str, path: &[&str]| match path.get(shared) {
                Some(_) => format!("{}/src/{}", member_crate.member, path[..=shared].join("/")),
                None => file.to_owned(),
            };
            let folder = user_path[..shared].iter().map(|&name| name.to_owned()).collect();
            let graph = folders.entry(folder).or_default();
            graph
                .entry(entry_of_folder(&file, &user_path))
                .or_default()
                .insert(entry_of_folder(used, &used_path));
        }
    }
    folders
}

/// Protects: the folders of a crate and their contents have an order in which they can be read.
#[test]
fn folders_use_each_other_without_cycles() {
    let graphs = crates()
        .iter()
        .flat_map(|(_, member_crate)| dependencies_by_folder(member_crate).into_values());
    let violations = graphs.flat_map(|graph| cycles(&graph)).collect();
    assert_none("folders do not use each other in a cycle", &violations);
}

/// Protects: the order of the crates. A device must not depend on the base station, nor a model on the command that
/// runs it.
#[test]
fn crates_use_only_lower_crates() {
    let mut violations = Violations::new();
    for (member, member_crate) in crates() {
        let (_, lower) = MAY_USE.iter().find(|(name, _)| name == member).expect("a crate");
        let is_allowed = |name: &str| {
            let used = name
                .strip_prefix("reveille_")
                .or_else(|| name.strip_prefix("reveille-"));
            used.is_none_or(|used| used == *member || lower.contains(&used) || !CRATES.contains(&used))
        };
        for module in member_crate.modules.values() {
            for mention in module.mentions.iter().filter(|mention| !is_allowed(&mention.words[0])) {
                violations.insert((module.file.clone(), mention.words.join("::")));
            }
        }
        let manifest = fs::read_to_string(root().join(member).join("Cargo.toml")).expect("a manifest");
        let manifest: toml::Table = manifest.parse().expect("TOML");
        let dependencies = manifest["dependencies"].as_table().expect("a table");
        for name in dependencies.keys().filter(|name| !is_allowed(name)) {
            violations.insert((format!("{member}/Cargo.toml"), name.clone()));
        }
    }
    assert_none("a crate uses only crates below it", &violations);
}

/// Protects: the vocabulary builds up from units to messages, so each part can be read after only the parts before it.
#[test]
fn modules_of_common_use_no_higher_layers() {
    let sources = sources();
    let layer_index = |module: &str| {
        LAYERS_OF_COMMON
            .iter()
            .position(|layer| layer.contains(&module))
            .unwrap_or_else(|| panic!("common/src/{module} is missing in LAYERS_OF_COMMON"))
    };
    let mut violations = Violations::new();
    let (_, member_crate) = crates()
        .iter()
        .find(|(member, _)| *member == "common")
        .expect("a crate");
    for (file, uses) in member_crate
        .uses()
        .into_iter()
        .filter(|(file, _)| top_module(file) != "lib")
    {
        let own_layer = layer_index(top_module(&file));
        for (used, path) in uses {
            let used_module = top_module(&used);
            if used_module == "lib" || layer_index(used_module) > own_layer {
                violations.insert((file.clone(), format!("uses {path}, which is in a layer above")));
            }
        }
    }
    assert_none(
        "a module of common uses only its layer and the layers below",
        &violations,
    );
    for module in LAYERS_OF_COMMON.iter().flat_map(|layer| layer.iter()) {
        let names = [format!("common/src/{module}.rs"), format!("common/src/{module}/mod.rs")];
        let exists = sources.iter().any(|source| names.contains(&source.name));
        assert!(exists, "LAYERS_OF_COMMON names {module}, which does not exist");
    }
}

fn is_shell(file: &str) -> bool {
    SHELLS.iter().any(|shell| file.starts_with(shell))
}

/// Returns the modules of pure code, each with its crate and path. `tests` has no pure code, although [`SHELLS`]
/// omits it.
fn pure_modules() -> impl Iterator<Item = (&'static Crate, &'static [String], &'static Module)> {
    let members = crates()
        .iter()
        .filter(|(member, _)| !["deploy", "tests"].contains(member));
    let modules = members.flat_map(|(_, member_crate)| {
        member_crate
            .modules
            .iter()
            .map(move |(path, module)| (member_crate, path, module))
    });
    let modules = modules.map(|(member_crate, path, module)| (member_crate, path.as_slice(), module));
    modules.filter(|(_, _, module)| !is_shell(&module.file))
}

/// Protects: one scenario and seed give one digest, however the run is driven. Code that reads files, clocks or
/// entropy, or waits for others, could make two runs differ.
#[test]
fn pure_code_performs_no_io() {
    let mut violations = Violations::new();
    for (member_crate, path, module) in pure_modules() {
        for mention in &module.mentions {
            let words = member_crate.expand_imports(path, &mention.words);
            let full_path = words.join("::");
            let is_below = |shell_path: &str| {
                full_path
                    .strip_prefix(shell_path)
                    .is_some_and(|rest| rest.is_empty() || rest.starts_with("::"))
            };
            let accesses_disk = match words.as_slice() {
                [.., owner, method] => {
                    ["Path", "PathBuf"].contains(&owner.as_str()) && PATH_METHODS.contains(&method.as_str())
                }
                _ => false,
            };
            // A single word is a variable or an imported name.
            let is_forbidden = accesses_disk || SHELL_PATHS.iter().any(|shell_path| is_below(shell_path));
            if mention.words.len() > 1 && is_forbidden {
                violations.insert((module.file.clone(), format!("names {full_path}")));
            }
        }
        for method in module.calls.iter().map(String::as_str) {
            let is_in_memory = IN_MEMORY_METHODS.contains(&(module.file.as_str(), method));
            if PATH_METHODS.contains(&method) && !is_in_memory {
                violations.insert((module.file.clone(), format!("calls .{method}()")));
            }
        }
    }
    assert_none("pure code performs no input or output", &violations);
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
    let mut violations = Violations::new();
    for (member_crate, path, module) in pure_modules() {
        let is_use = |mention: &&Mention| !member_crate.is_re_export(path, mention);
        for mention in module.mentions.iter().filter(is_use) {
            if let Some(file) = declaring_file(member_crate, path, mention).filter(|file| is_shell(file)) {
                let name = mention.words.join("::");
                violations.insert((
                    module.file.clone(),
                    format!("names {name}, which is declared in {file}"),
                ));
            }
        }
    }
    assert_none("pure code uses no shell", &violations);
}

/// Returns the file of this workspace that declares the target of `mention` in the module at `path`.
fn declaring_file(member_crate: &Crate, path: &[String], mention: &Mention) -> Option<String> {
    let words = member_crate.expand_imports(path, &mention.words);
    match crates()
        .iter()
        .find(|(member, _)| words[0] == format!("reveille_{member}"))
    {
        Some((_, other)) => other.file_from_root(&words[1..]),
        None => member_crate.file_from_module(path, &mention.words),
    }
}

/// Protects: a run depends on its arguments, not on earlier runs in the same process.
#[test]
fn pure_code_has_no_global_state() {
    let mut violations = Violations::new();
    for (_, _, module) in pure_modules() {
        for type_names in &module.statics {
            let is_mutable = |name: &str| MUTABLE_TYPES.contains(&name) || name.starts_with("Atomic");
            if type_names.split(' ').any(is_mutable) {
                violations.insert((module.file.clone(), format!("has a static of type {type_names}")));
            }
        }
    }
    assert_none("pure code has no global state", &violations);
}

/// Protects: bincode, which is unmaintained, and zenoh can each be replaced in one place.
#[test]
fn bincode_and_zenoh_are_used_in_one_module() {
    let mut violations = Violations::new();
    for (_, member_crate) in crates() {
        for module in member_crate.modules.values() {
            for mention in &module.mentions {
                let only_user = match mention.words[0].as_str() {
                    "bincode" => "common/src/codec.rs",
                    "zenoh" => "common/src/bus/",
                    _ => continue,
                };
                if !module.file.starts_with(only_user) {
                    violations.insert((module.file.clone(), format!("names {}", mention.words.join("::"))));
                }
            }
        }
    }
    assert_none("bincode and zenoh are each used in one module", &violations);
}

/// Protects: a file is short enough for a reader to keep in mind. Clippy limits the length of functions
/// (`too-many-lines-threshold`).
#[test]
fn files_have_a_limited_length() {
    let mut violations = Violations::new();
    for source in sources().iter().filter(|source| !source.is_test()) {
        let lines = source.code().len();
        if lines > MAX_LINES_OF_CODE {
            violations.insert((source.name.clone(), format!("{lines} lines of code")));
        }
    }
    let rule = format!("a file has at most {MAX_LINES_OF_CODE} lines without tests and comments");
    assert_none(&rule, &violations);
}

/// Protects: two files fit side by side on a screen. rustfmt wraps only code.
#[test]
fn lines_have_a_limited_length() {
    let mut violations = Violations::new();
    for source in sources() {
        for (number, line) in (1..).zip(source.text.lines()) {
            let columns = line.chars().count();
            if columns > MAX_COLUMNS {
                violations.insert((source.name.clone(), format!("line {number} has {columns} columns")));
            }
        }
    }
    let rule = format!("a line has at most {MAX_COLUMNS} columns, comments too");
    assert_none(&rule, &violations);
}

/// Protects: sources cite the paper or a reason, never a document that readers do not have.
#[test]
fn no_unavailable_document_is_cited() {
    let mut violations = Violations::new();
    // In two parts, so that this file does not contain it.
    let document = ["MO", "DEL"].concat();
    for source in sources() {
        let is_part_of_word = |c: char| c.is_alphanumeric() || c == '_';
        let cites = |line: &str| line.split(|c| !is_part_of_word(c)).any(|word| word == document);
        for (number, _) in (1..).zip(source.text.lines()).filter(|(_, line)| cites(line)) {
            violations.insert((
                source.name.clone(),
                format!("line {number} cites {document}; cite the paper or give the reason"),
            ));
        }
    }
    assert_none("sources cite available documents", &violations);
}

/// Protects: the tree builds and runs wherever it is cloned.
#[test]
fn no_path_of_one_machine_is_named() {
    let mut violations = Violations::new();
    for source in sources() {
        for folder in ["home", "root", "work"] {
            let path = format!("/{folder}/");
            for (number, _) in (1..).zip(source.text.lines()).filter(|(_, line)| line.contains(&path)) {
                violations.insert((source.name.clone(), format!("line {number} names {path}")));
            }
        }
    }
    assert_none("no source names a folder of one machine", &violations);
}

/// Returns the files that a source declares as modules: `name.rs` or `name/mod.rs`, of which clippy allows one. Only
/// lines without indentation and with one of the visibilities below count.
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
    // docs/patrol.rs is included by its path, and each fuzz target is a program.
    let is_root = |name: &str| {
        let is_elsewhere = name.starts_with("docs/") || name.starts_with("tests/fuzz/");
        is_elsewhere || name.ends_with("/lib.rs") || name.ends_with("/main.rs")
    };
    let undeclared = sources
        .iter()
        .filter(|source| !is_root(&source.name) && !declared.contains(&source.name));
    let violations = undeclared
        .map(|source| (source.name.clone(), "is not a module of its crate".to_owned()))
        .collect();
    assert_none("a `mod` line names every file", &violations);
}

/// Protects: readers of pages, from placeholders of numbers that were never filled in.
#[test]
fn no_page_has_an_unfilled_placeholder() {
    let entries = fs::read_dir(root().join("docs")).expect("docs");
    let files_of_docs = entries.map(|entry| entry.expect("an entry").path());
    let pages_of_root = ["README.md", "CHANGELOG.md", "ARCHITECTURE.md"].map(|name| root().join(name));
    let mut violations = Violations::new();
    let is_placeholder = |word: &str| word.len() > 1 && word.chars().all(|c| c.is_ascii_uppercase() || c == '_');
    let is_page = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "md");
    let mut page_count = 0;
    for path in files_of_docs.chain(pages_of_root).filter(is_page) {
        let text = fs::read_to_string(&path).expect("a page");
        page_count += 1;
        // A placeholder is the name of a figure between two of these signs.
        for word in text.split('@').skip(1).filter(|word| is_placeholder(word)) {
            violations.insert((path.display().to_string(), format!("@{word}@")));
        }
    }
    assert!(page_count > 10, "only {page_count} pages were found");
    assert_none("pages have no placeholders", &violations);
}

/// Protects: releases, from a file that still names another version of Reveille or of Rust. A new file with a version
/// needs a line here.
#[test]
fn versions_agree() {
    let (version, rust) = (env!("CARGO_PKG_VERSION"), env!("CARGO_PKG_RUST_VERSION"));
    let mut violations = Violations::new();
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
            violations.insert((file.to_owned(), format!("does not contain {expected:?}")));
        }
    }
    assert_none("all files name the versions of Cargo.toml", &violations);
}

/// Protects: ARCHITECTURE.md, which newcomers use to find the file for a change.
#[test]
fn the_code_map_names_real_files() {
    let text = fs::read_to_string(root().join("ARCHITECTURE.md")).expect("ARCHITECTURE.md");
    // Names without a folder are relative to the folder of an earlier name. Only lines of tables are read.
    let mut folder = String::new();
    let mut violations = Violations::new();
    for line in text.lines().filter(|line| line.starts_with("| ")) {
        for word in line.split('`').skip(1).step_by(2) {
            if let Some((parent, _)) = word
                .trim_end_matches('/')
                .rsplit_once('/')
                .filter(|_| root().join(word).exists())
            {
                folder = if word.ends_with('/') {
                    word.to_owned()
                } else {
                    parent.to_owned()
                };
            }
            let exists = Path::new(&folder).ancestors().any(|above| {
                root().join(above).join(word).exists() || root().join(above).join(format!("{word}.rs")).exists()
            });
            if !exists {
                violations.insert((word.to_owned(), "does not exist".to_owned()));
            }
        }
    }
    assert_none("ARCHITECTURE.md names existing files", &violations);
}

/// Dependency graph: files or folders, each with its dependencies.
type Graph = BTreeMap<String, BTreeSet<String>>;

/// Returns every name that can be reached from itself, with a shortest cycle as text: `a → b → a`.
fn cycles(graph: &Graph) -> BTreeMap<String, String> {
    let name_and_cycle = |name: &String| shortest_cycle(graph, name).map(|cycle| (name.clone(), cycle.join(" → ")));
    graph.keys().filter_map(name_and_cycle).collect()
}

/// Searches breadth-first for a cycle from `start` back to it.
fn shortest_cycle(graph: &Graph, start: &str) -> Option<Vec<String>> {
    let mut reached_from: BTreeMap<&str, &str> = BTreeMap::new();
    let mut queue = VecDeque::from([start]);
    while let Some(current) = queue.pop_front() {
        for next in graph.get(current).into_iter().flatten() {
            if next == start {
                let mut cycle = vec![start.to_owned(), current.to_owned()];
                let mut step = current;
                while step != start {
                    step = reached_from[step];
                    cycle.push(step.to_owned());
                }
                cycle.reverse();
                return Some(cycle);
            }
            if !reached_from.contains_key(next.as_str()) {
                reached_from.insert(next, current);
                queue.push_back(next);
            }
        }
    }
    None
}
