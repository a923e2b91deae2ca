//! The scenario files, copied to the run folder: the folder can be moved, and the run repeated without the originals. A
//! recording holds the same copies ([`ScenarioFiles::bundle`]). The copied `scenario.toml` names them by [`FOLDER`].

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use anyhow::Context;
use reveille_bs::scenario::{Scenario, load};
use reveille_view::recording::ScenarioBundle;

/// The subfolder of the copies in a run folder. Existing run folders and recordings name it, and `docs/results.md`.
pub(crate) const FOLDER: &str = "scenario-files";

/// In-memory copies of the scenario files: writing the run folder may overwrite an original.
pub(crate) struct ScenarioFiles(Vec<ScenarioFile>);

struct ScenarioFile {
    /// The path of the original, as the scenario resolves it.
    path: PathBuf,
    /// The file name of the copy, unique among the copies.
    copy_name: String,
    bytes: Vec<u8>,
}

impl ScenarioFiles {
    /// Reads the files of `scenario`.
    ///
    /// # Errors
    /// If a file cannot be read any more.
    pub(crate) fn read(scenario: &Scenario) -> anyhow::Result<Self> {
        let mut files: Vec<ScenarioFile> = Vec::new();
        for path in scenario.files() {
            let bytes = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
            let is_taken = |name: &str| files.iter().any(|file| file.copy_name == name);
            // The copies of files from several folders share one folder, so their names must differ.
            let copy_name = free_name(&path, is_taken);
            files.push(ScenarioFile { path, copy_name, bytes });
        }
        Ok(Self(files))
    }

    /// Writes the copies to the run folder `folder`.
    ///
    /// # Errors
    /// If they cannot be written.
    pub(crate) fn write(&self, folder: &Path) -> io::Result<()> {
        if self.0.is_empty() {
            return Ok(());
        }
        let folder = folder.join(FOLDER);
        fs::create_dir_all(&folder)?;
        self.0
            .iter()
            .try_for_each(|file| fs::write(folder.join(&file.copy_name), &file.bytes))
    }

    /// Checks that `scenario.toml` of the run folder, at `path`, reads as `scenario` with the copied files. Call it
    /// after both are written.
    ///
    /// # Errors
    /// If a scenario file changed after it was read.
    pub(crate) fn check(&self, path: &Path, scenario: &Scenario) -> anyhow::Result<()> {
        if self.0.is_empty() {
            return Ok(());
        }
        let copy = load(&path.to_string_lossy(), &[])?.scenario;
        let names: Vec<String> = self.0.iter().map(|file| file.path.display().to_string()).collect();
        anyhow::ensure!(
            copy.hash_hex() == scenario.hash_hex(),
            "a scenario file was changed while it was read ({}); start the run again",
            names.join(", ")
        );
        Ok(())
    }

    /// Bundles `scenario` with its files.
    pub(crate) fn bundle(&self, scenario: &Scenario) -> ScenarioBundle {
        let file = |file: &ScenarioFile| (format!("{FOLDER}/{}", file.copy_name), file.bytes.clone());
        ScenarioBundle {
            text: self.to_toml(scenario),
            referenced_files: self.0.iter().map(file).collect(),
        }
    }

    /// Formats `scenario` as `scenario.toml` of the run folder, which refers to the copied files, not to the originals.
    pub(crate) fn to_toml(&self, scenario: &Scenario) -> String {
        scenario.to_toml_with_files(|path| {
            let copy = self.0.iter().find(|file| file.path == path);
            copy.map(|file| format!("{FOLDER}/{}", file.copy_name))
        })
    }
}

/// Removes the copies of an earlier run from `folder`.
///
/// # Errors
/// If they cannot be removed.
pub(crate) fn remove(folder: &Path) -> io::Result<()> {
    match fs::remove_dir_all(folder.join(FOLDER)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        Ok(()) | Err(_) => Ok(()),
    }
}

/// The file name of `path`, numbered if the name is taken.
fn free_name(path: &Path, is_taken: impl Fn(&str) -> bool) -> String {
    let text = |part: Option<&std::ffi::OsStr>| part.unwrap_or_default().to_string_lossy().into_owned();
    let (stem, extension) = (text(path.file_stem()), text(path.extension()));
    let extension = if extension.is_empty() {
        extension
    } else {
        format!(".{extension}")
    };
    let mut name = format!("{stem}{extension}");
    let mut number = 2;
    while is_taken(&name) {
        name = format!("{stem}-{number}{extension}");
        number += 1;
    }
    name
}
