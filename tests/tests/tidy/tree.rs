//! The Rust sources of the workspace, and the paths that each module names, for the rules in `mod.rs`.
//!
//! Paths are resolved by name, without types: [`Crate::uses`] misses uses through methods, fields and generated code.
//! Unit tests (`#[cfg(test)]`) are left out.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use proc_macro2::{TokenStream, TokenTree};
use syn::punctuated::Punctuated;
use syn::visit::{self, Visit};

/// The crates, each after all crates that it may use. A new crate also needs a line in `MAY_USE`.
pub(super) const CRATES: [&str; 9] = [
    "common", "device", "bs", "lab", "study", "view", "deploy", "tests", "python",
];

/// Source file with its text.
pub(super) struct SourceFile {
    /// Path from the root of the workspace, such as `common/src/plan.rs`.
    pub name: String,
    /// Contents of the file.
    pub text: String,
}

impl SourceFile {
    /// Whether the file contains only tests.
    pub(super) fn is_test(&self) -> bool {
        is_test(&self.name)
    }

    /// Returns the lines of code, without comments and without the unit tests, which must be called `tests` and come
    /// last. Empty lines count.
    pub(super) fn code(&self) -> Vec<&str> {
        let text = self.text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
        text.lines()
            .filter(|line| !line.trim_start().starts_with("//"))
            .collect()
    }
}

/// Whether the file `name` contains only tests, by the place and the name of the file.
fn is_test(name: &str) -> bool {
    name.ends_with("tests.rs") || name.contains("/tests/") || name.contains("/program/")
}

/// Returns the root of the workspace.
pub(super) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Returns all Rust files of the tree, ordered by name, including files outside the workspace.
pub(super) fn sources() -> Vec<SourceFile> {
    let mut sources = Vec::new();
    for folder in ["docs", "tests/fuzz/fuzz_targets"] {
        let count_before = sources.len();
        collect(&root().join(folder), folder, &mut sources);
        assert!(sources.len() > count_before, "{folder} has no source file");
    }
    for member in CRATES {
        for folder in ["src", "tests", "program"] {
            collect(
                &root().join(member).join(folder),
                &format!("{member}/{folder}"),
                &mut sources,
            );
        }
    }
    sources.sort_by(|a, b| a.name.cmp(&b.name));
    assert!(sources.len() > 100, "only {} source files were found", sources.len());
    sources
}

/// Adds the Rust files in and below `folder`, whose path from the root of the workspace is `name`.
fn collect(folder: &Path, name: &str, sources: &mut Vec<SourceFile>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries {
        let path = entry.expect("an entry").path();
        let name = format!("{name}/{}", path.file_name().expect("a name").to_string_lossy());
        if path.is_dir() {
            collect(&path, &name, sources);
        } else if path.extension().is_some_and(|e| e == "rs") {
            let text = fs::read_to_string(&path).expect("UTF-8");
            sources.push(SourceFile { name, text });
        }
    }
}

/// Path that code names, such as `crate::plan::DutyCycle`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Mention {
    /// Words of the path.
    pub words: Vec<String>,
    /// Syntactic role of the path.
    role: MentionRole,
}

/// Syntactic role of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum MentionRole {
    /// In an expression, a type or a pattern.
    Code,
    /// In a `use`.
    Import,
    /// In a `pub use`, which re-exports it.
    ReExport,
}

/// Module of a file, or inline module in braces. Tests are left out.
#[derive(Default)]
pub(super) struct Module {
    /// File that contains the module.
    pub file: String,
    /// Direct child modules.
    children: BTreeSet<String>,
    /// Names that the module itself declares.
    items: BTreeSet<String>,
    /// Declared macros, which `#[macro_export]` puts at the root of the crate.
    macros: BTreeSet<String>,
    /// Imported names with their paths.
    imports: BTreeMap<String, Vec<String>>,
    /// Modules of glob imports.
    globs: Vec<Vec<String>>,
    /// Every path named in the module.
    pub mentions: BTreeSet<Mention>,
    /// Methods called without an argument.
    pub calls: BTreeSet<String>,
    /// Types of `static` items, as written; `thread_local` for that macro.
    pub statics: Vec<String>,
}

/// Crate of the workspace. A `path` that its functions receive must be a module of the crate.
pub(super) struct Crate {
    /// Folder of the crate.
    pub member: String,
    /// Modules by path; `[]` is the root.
    pub modules: BTreeMap<Vec<String>, Module>,
}

/// Maximum number of imports that are followed to the target of a path.
const MAX_IMPORT_DEPTH: u32 = 16;

/// Target of a path.
enum Target {
    /// Path of a module.
    Module(Vec<String>),
    /// File that declares an item.
    Item(String),
}

impl Crate {
    /// Reads the modules of `member`.
    pub(super) fn read(member: &str, sources: &[SourceFile]) -> Self {
        let (mut modules, mut test_modules) = (BTreeMap::new(), Vec::new());
        let prefix = format!("{member}/src/");
        for source in sources.iter().filter(|source| !source.is_test()) {
            let Some(inner) = source.name.strip_prefix(&prefix) else {
                continue;
            };
            let mut path: Vec<String> = inner.trim_end_matches(".rs").split('/').map(str::to_owned).collect();
            if matches!(path.last().map(String::as_str), Some("mod" | "lib" | "main")) {
                path.pop();
            }
            let file = syn::parse_file(&source.text).unwrap_or_else(|error| panic!("{}: {error}", source.name));
            let mut reader = SourceReader {
                file: &source.name,
                path,
                modules: &mut modules,
                test_modules: &mut test_modules,
            };
            reader.current_module();
            reader.visit_file(&file);
        }
        assert!(modules.contains_key(&Vec::new()), "{member} has a root");
        let is_in_test_module = |path: &Vec<String>| test_modules.iter().any(|module| path.starts_with(module));
        modules.retain(|path, _| !is_in_test_module(path));
        let member = member.to_owned();
        let mut read_crate = Self { member, modules };
        read_crate.add_children();
        read_crate
    }

    /// Records the child modules of each module. Only modules of non-test files count.
    fn add_children(&mut self) {
        let paths: Vec<Vec<String>> = self.modules.keys().cloned().collect();
        for path in paths {
            if let Some((name, above)) = path.split_last()
                && let Some(parent) = self.modules.get_mut(above)
            {
                parent.children.insert(name.clone());
            }
        }
    }

    /// Returns the files of the crate that each file uses, each with a path that shows the use.
    ///
    /// A `mod` item does not count as a use, nor does a `pub use` of a module below. A folder's `mod.rs` may re-export
    /// items of its files; a use through such a re-export counts for the declaring file.
    pub(super) fn uses(&self) -> BTreeMap<String, BTreeMap<String, String>> {
        let mut uses: BTreeMap<String, BTreeMap<String, String>> = BTreeMap::new();
        for (path, module) in &self.modules {
            let used_files = uses.entry(module.file.clone()).or_default();
            for mention in &module.mentions {
                if self.is_re_export(path, mention) {
                    continue;
                }
                if let Some(file) = self.file_from_module(path, &mention.words)
                    && file != module.file
                {
                    used_files.entry(file).or_insert_with(|| mention.words.join("::"));
                }
            }
        }
        uses
    }

    /// Whether `mention` in the module at `path` is a `pub use` of something below it.
    pub(super) fn is_re_export(&self, path: &[String], mention: &Mention) -> bool {
        let first = mention.words.iter().find(|&word| word != "self");
        let is_below = first.is_some_and(|first| self.modules[path].children.contains(first));
        mention.role == MentionRole::ReExport && is_below
    }

    /// Returns `words` in the module at `path` with imports expanded: `std::path::absolute` for `path::absolute`.
    pub(super) fn expand_imports(&self, path: &[String], words: &[String]) -> Vec<String> {
        match self.modules[path].imports.get(&words[0]) {
            Some(import) => import.iter().chain(&words[1..]).cloned().collect(),
            None => words.to_vec(),
        }
    }

    /// Returns the file that declares the target of `words` at the root of the crate.
    pub(super) fn file_from_root(&self, words: &[String]) -> Option<String> {
        match self.walk(Vec::new(), words, 0)? {
            Target::Module(path) => Some(self.modules[&path].file.clone()),
            Target::Item(file) => Some(file),
        }
    }

    /// Returns the file that declares the target of `words` in the module at `path`; `None` for names outside this
    /// crate.
    pub(super) fn file_from_module(&self, path: &[String], words: &[String]) -> Option<String> {
        if words.len() == 1 && !self.modules[path].imports.contains_key(&words[0]) {
            return None; // A variable, or an item of the module itself.
        }
        match self.resolve(path, words, 0)? {
            Target::Module(path) => Some(self.modules[&path].file.clone()),
            Target::Item(file) => Some(file),
        }
    }

    /// Finds the target of `words` in the module at `path`. `depth` counts the imports followed so far.
    fn resolve(&self, path: &[String], words: &[String], depth: u32) -> Option<Target> {
        let (first, rest) = words.split_first()?;
        match first.as_str() {
            "crate" => self.walk(Vec::new(), rest, depth),
            name if name.strip_prefix("reveille_") == Some(&self.member) => self.walk(Vec::new(), rest, depth),
            "self" => self.walk(path.to_vec(), rest, depth),
            "super" => {
                let above = &path[..path.len().checked_sub(1)?];
                if rest.first().is_some_and(|word| word == "super") {
                    self.resolve(above, rest, depth)
                } else {
                    self.walk(above.to_vec(), rest, depth)
                }
            }
            name => {
                let module = &self.modules[path];
                let is_known = module.children.contains(name) || module.imports.contains_key(name);
                is_known.then(|| self.walk(path.to_vec(), words, depth))?
            }
        }
    }

    /// Finds the target of `words`, which start in the namespace of the module at `module_path`.
    fn walk(&self, module_path: Vec<String>, words: &[String], depth: u32) -> Option<Target> {
        let module = self.modules.get(&module_path)?;
        let Some((first, rest)) = words.split_first() else {
            return Some(Target::Module(module_path));
        };
        if module.children.contains(first) {
            let mut below = module_path;
            below.push(first.clone());
            return self.walk(below, rest, depth);
        }
        // Imports can refer to each other without end.
        if module.items.contains(first) || depth > MAX_IMPORT_DEPTH {
            return Some(Target::Item(module.file.clone()));
        }
        if let Some(import) = module.imports.get(first) {
            return match self.resolve(&module_path, import, depth + 1)? {
                Target::Module(path) => self.walk(path, rest, depth + 1),
                item @ Target::Item(_) => Some(item),
            };
        }
        for glob in &module.globs {
            if let Some(Target::Module(path)) = self.resolve(&module_path, glob, depth + 1)
                && self.modules[&path].items.contains(first)
            {
                return Some(Target::Item(self.modules[&path].file.clone()));
            }
        }
        let is_macro = |other: &&Module| module_path.is_empty() && other.macros.contains(first);
        let declares = self.modules.values().find(is_macro).unwrap_or(module);
        Some(Target::Item(declares.file.clone()))
    }
}

/// Visitor that records the contents of one file in its modules.
struct SourceReader<'a> {
    /// Name of the file.
    file: &'a str,
    /// Path of the current module: of the file, or of an inline module in it.
    path: Vec<String>,
    /// All modules of the crate so far.
    modules: &'a mut BTreeMap<Vec<String>, Module>,
    /// Modules in separate files that are only for tests.
    test_modules: &'a mut Vec<Vec<String>>,
}

impl SourceReader<'_> {
    /// Returns the current module, which the first call for a path creates.
    fn current_module(&mut self) -> &mut Module {
        let module = self.modules.entry(self.path.clone()).or_default();
        if module.file.is_empty() {
            self.file.clone_into(&mut module.file);
        }
        module
    }

    fn add_mention(&mut self, words: Vec<String>, role: MentionRole) {
        self.current_module().mentions.insert(Mention { words, role });
    }

    /// Records the imports of a `use`. `words` is the path up to `use_tree`.
    fn add_imports(&mut self, use_tree: &syn::UseTree, mut words: Vec<String>, role: MentionRole) {
        let (word, name) = match use_tree {
            syn::UseTree::Path(path) => {
                words.push(path.ident.to_string());
                return self.add_imports(&path.tree, words, role);
            }
            syn::UseTree::Group(group) => {
                for item in &group.items {
                    self.add_imports(item, words.clone(), role);
                }
                return;
            }
            syn::UseTree::Glob(_) => {
                self.current_module().globs.push(words.clone());
                return self.add_mention(words, role);
            }
            syn::UseTree::Name(name) => (name.ident.to_string(), name.ident.to_string()),
            syn::UseTree::Rename(rename) => (rename.ident.to_string(), rename.rename.to_string()),
        };
        let name = if word == "self" {
            words.last().cloned().unwrap_or_default()
        } else {
            words.push(word);
            name
        };
        self.current_module().imports.insert(name, words.clone());
        self.add_mention(words, role);
    }

    /// Collects paths in the arguments of a macro, which syn does not parse.
    fn read_tokens(&mut self, tokens: TokenStream) {
        let mut words: Vec<String> = Vec::new();
        let mut colons = 0;
        for token in tokens {
            match token {
                TokenTree::Ident(word) => {
                    // Only `::` joins two words.
                    if colons != 2 {
                        self.finish_path(&mut words);
                    }
                    words.push(word.to_string());
                    colons = 0;
                }
                TokenTree::Punct(mark) if mark.as_char() == ':' => colons += 1,
                TokenTree::Group(group) => {
                    self.finish_path(&mut words);
                    self.read_tokens(group.stream());
                }
                TokenTree::Punct(_) | TokenTree::Literal(_) => self.finish_path(&mut words),
            }
        }
        self.finish_path(&mut words);
    }

    /// Records the words of a path and empties `words`. A single word is no path.
    fn finish_path(&mut self, words: &mut Vec<String>) {
        let words = std::mem::take(words);
        if words.len() > 1 {
            self.add_mention(words, MentionRole::Code);
        }
    }
}

/// Whether `attributes` contain `#[cfg(test)]`.
fn has_cfg_test(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        let list = attribute.meta.require_list();
        attribute.path().is_ident("cfg") && list.is_ok_and(|list| list.tokens.to_string() == "test")
    })
}

/// Returns the attributes of an item. `#[cfg(test)]` on a kind of item that is not listed has no effect.
#[expect(clippy::wildcard_enum_match_arm, reason = "an enum of syn, which may grow")]
fn attributes(item: &syn::Item) -> &[syn::Attribute] {
    match item {
        syn::Item::Const(item) => &item.attrs,
        syn::Item::Enum(item) => &item.attrs,
        syn::Item::Fn(item) => &item.attrs,
        syn::Item::Impl(item) => &item.attrs,
        syn::Item::Macro(item) => &item.attrs,
        syn::Item::Mod(item) => &item.attrs,
        syn::Item::Static(item) => &item.attrs,
        syn::Item::Struct(item) => &item.attrs,
        syn::Item::Trait(item) => &item.attrs,
        syn::Item::Type(item) => &item.attrs,
        syn::Item::Use(item) => &item.attrs,
        _ => &[],
    }
}

/// Returns the name that an item declares; `None` for modules, macros and items without a name.
#[expect(clippy::wildcard_enum_match_arm, reason = "an enum of syn, which may grow")]
fn declared_name(item: &syn::Item) -> Option<String> {
    match item {
        syn::Item::Const(item) => Some(item.ident.to_string()),
        syn::Item::Enum(item) => Some(item.ident.to_string()),
        syn::Item::Fn(item) => Some(item.sig.ident.to_string()),
        syn::Item::Static(item) => Some(item.ident.to_string()),
        syn::Item::Struct(item) => Some(item.ident.to_string()),
        syn::Item::Trait(item) => Some(item.ident.to_string()),
        syn::Item::Type(item) => Some(item.ident.to_string()),
        _ => None,
    }
}

impl<'ast> Visit<'ast> for SourceReader<'_> {
    fn visit_item(&mut self, item: &'ast syn::Item) {
        if has_cfg_test(attributes(item)) {
            if let syn::Item::Mod(module) = item {
                let mut path = self.path.clone();
                path.push(module.ident.to_string());
                self.test_modules.push(path);
            }
            return;
        }
        if let syn::Item::Macro(syn::ItemMacro { ident: Some(name), .. }) = item {
            self.current_module().macros.insert(name.to_string());
        }
        if let Some(name) = declared_name(item) {
            self.current_module().items.insert(name);
        }
        visit::visit_item(self, item);
    }

    fn visit_item_mod(&mut self, item: &'ast syn::ItemMod) {
        if let Some((_, items)) = &item.content {
            self.path.push(item.ident.to_string());
            self.current_module();
            for item in items {
                self.visit_item(item);
            }
            self.path.pop();
        }
    }

    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        let role = if matches!(item.vis, syn::Visibility::Inherited) {
            MentionRole::Import
        } else {
            MentionRole::ReExport
        };
        self.add_imports(&item.tree, Vec::new(), role);
    }

    fn visit_item_static(&mut self, item: &'ast syn::ItemStatic) {
        let mut written = TypeNames::default();
        written.visit_type(&item.ty);
        if matches!(item.mutability, syn::StaticMutability::Mut(_)) {
            written.0.push("mut".to_owned());
        }
        self.current_module().statics.push(written.0.join(" "));
        visit::visit_item_static(self, item);
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let words = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
        self.add_mention(words, MentionRole::Code);
        visit::visit_path(self, path);
    }

    fn visit_expr_method_call(&mut self, call: &'ast syn::ExprMethodCall) {
        if call.args.is_empty() {
            self.current_module().calls.insert(call.method.to_string());
        }
        visit::visit_expr_method_call(self, call);
    }

    fn visit_macro(&mut self, call: &'ast syn::Macro) {
        if call
            .path
            .segments
            .last()
            .is_some_and(|segment| segment.ident == "thread_local")
        {
            self.current_module().statics.push("thread_local".to_owned());
        }
        self.read_tokens(call.tokens.clone());
        if let Ok(arguments) = call.parse_body_with(Punctuated::<syn::Expr, syn::Token![,]>::parse_terminated) {
            for argument in &arguments {
                MacroCalls(self.current_module()).visit_expr(argument);
            }
        }
        visit::visit_macro(self, call);
    }

    // `pub(crate)` and attributes do not refer to code.
    fn visit_visibility(&mut self, _: &'ast syn::Visibility) {}
    fn visit_attribute(&mut self, _: &'ast syn::Attribute) {}
}

/// Collects method calls in the arguments of a macro.
struct MacroCalls<'a>(&'a mut Module);

impl<'ast> Visit<'ast> for MacroCalls<'_> {
    fn visit_expr_method_call(&mut self, call: &'ast syn::ExprMethodCall) {
        if call.args.is_empty() {
            self.0.calls.insert(call.method.to_string());
        }
        visit::visit_expr_method_call(self, call);
    }
}

/// Collects all names in a type.
#[derive(Default)]
struct TypeNames(Vec<String>);

impl<'ast> Visit<'ast> for TypeNames {
    fn visit_ident(&mut self, ident: &'ast proc_macro2::Ident) {
        self.0.push(ident.to_string());
    }
}
