//! The files that a scenario names, kept in the run folder: the folder can be moved, and the run repeated, when they
//! are gone from where they were.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use anyhow::Context;
use reveille_bs::scenario::load;
use reveille_common::scenario::Scenario;
use reveille_view::recording::Bundle;

/// The folder of the copies within a run folder.
pub const FOLDER: &str = "inputs";

/// Copies of the files that a scenario names, in memory: what they are written over may be one of them.
pub struct Inputs(Vec<Input>);

struct Input {
    path: PathBuf,
    /// The name of the copy.
    name: String,
    bytes: Vec<u8>,
}

impl Inputs {
    /// The files of `scenario`.
    ///
    /// # Errors
    /// One cannot be read any more.
    pub fn read(scenario: &Scenario) -> anyhow::Result<Self> {
        let mut inputs: Vec<Input> = Vec::new();
        for path in scenario.files() {
            let bytes = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
            let is_taken = |name: &str| inputs.iter().any(|input| input.name == name);
            let name = free_name(&path, is_taken);
            inputs.push(Input { path, name, bytes });
        }
        Ok(Self(inputs))
    }

    /// Writes the copies into the run folder `folder`.
    ///
    /// # Errors
    /// They cannot be written.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        if self.0.is_empty() {
            return Ok(());
        }
        let folder = folder.join(FOLDER);
        fs::create_dir_all(&folder)?;
        self.0
            .iter()
            .try_for_each(|input| fs::write(folder.join(&input.name), &input.bytes))
    }

    /// Checks that the scenario file at `path`, which names the copies, means `scenario`.
    ///
    /// # Errors
    /// It does not: a file was changed after it had been read.
    pub fn check(&self, path: &Path, scenario: &Scenario) -> anyhow::Result<()> {
        if self.0.is_empty() {
            return Ok(());
        }
        let copy = load(&path.to_string_lossy(), &[])?;
        let names: Vec<String> = self.0.iter().map(|input| input.path.display().to_string()).collect();
        anyhow::ensure!(
            copy.hash_hex() == scenario.hash_hex(),
            "a file of the scenario was changed while it was read; start the run again ({})",
            names.join(", ")
        );
        Ok(())
    }

    /// `scenario` with its files, as one thing.
    pub fn bundle(&self, scenario: &Scenario) -> Bundle {
        let file = |input: &Input| (format!("{FOLDER}/{}", input.name), input.bytes.clone());
        Bundle {
            scenario: self.to_toml(scenario),
            files: self.0.iter().map(file).collect(),
        }
    }

    /// `scenario` as the run folder's scenario file, which names the copies.
    pub fn to_toml(&self, scenario: &Scenario) -> String {
        scenario.to_toml_with(|path| {
            let copy = self.0.iter().find(|input| input.path == path);
            copy.map(|input| format!("{FOLDER}/{}", input.name))
        })
    }
}

/// Takes the copies of an earlier run out of `folder`.
///
/// # Errors
/// They cannot be removed.
pub fn remove(folder: &Path) -> io::Result<()> {
    match fs::remove_dir_all(folder.join(FOLDER)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        Ok(()) | Err(_) => Ok(()),
    }
}

/// The last part of `path`, numbered if another file has that name.
fn free_name(path: &Path, is_taken: impl Fn(&str) -> bool) -> String {
    let text = |part: Option<&std::ffi::OsStr>| part.unwrap_or_default().to_string_lossy().into_owned();
    let (stem, ending) = (text(path.file_stem()), text(path.extension()));
    let ending = if ending.is_empty() {
        ending
    } else {
        format!(".{ending}")
    };
    let mut name = format!("{stem}{ending}");
    let mut number = 2;
    while is_taken(&name) {
        name = format!("{stem}-{number}{ending}");
        number += 1;
    }
    name
}
