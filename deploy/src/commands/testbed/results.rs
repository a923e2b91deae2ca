//! The results of a testbed: copied from the container of the base station, and compared with a run in memory.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use reveille_lab::preparation;
use reveille_lab::run::RunOptions;

use super::compose::RESULTS_FOLDER;
use super::docker::{Docker, Project};
use super::model::Testbed;
use super::placement::BS_SERVICE;
use crate::display::note;
use crate::input_log;
use crate::run_folder::SCENARIO_FILE;
use crate::run_reader::RunReader;

/// Copies the run folder out of the container of the base station to `results` in the testbed's folder. If that name
/// holds a run of another scenario, the copy gets the next free number: `results-2`.
///
/// # Errors
/// If there is no such container or no run folder in it.
pub(super) fn copy_results(docker: &Docker, testbed: &Testbed) -> anyhow::Result<PathBuf> {
    let project = Project::of(testbed);
    let bs = docker.container(&project, BS_SERVICE)?;
    let new = testbed.folder.join(".results-new");
    if new.exists() {
        fs::remove_dir_all(&new).with_context(|| format!("cannot remove {}", new.display()))?;
    }
    let source = format!("{}:{}/{}", bs.id, RESULTS_FOLDER, project.name);
    docker.run(&["cp", &source, &new.to_string_lossy()])?;
    let scenario = |folder: &Path| fs::read(folder.join(SCENARIO_FILE)).ok();
    let own_scenario = scenario(&new);
    let candidates = (1..).map(|number| match number {
        1 => testbed.folder.join("results"),
        _ => testbed.folder.join(format!("results-{number}")),
    });
    let is_free = |folder: &PathBuf| !folder.exists() || own_scenario.is_some() && scenario(folder) == own_scenario;
    let target = candidates
        .into_iter()
        .find(is_free)
        .context("no free name for the results")?;
    if target.exists() {
        fs::remove_dir_all(&target).with_context(|| format!("cannot replace {}", target.display()))?;
    }
    fs::rename(&new, &target).with_context(|| format!("cannot write {}", target.display()))?;
    Ok(target)
}

/// Whether the run in the folder `results` is complete.
pub(super) fn is_complete(results: &Path) -> bool {
    let reader = RunReader::open(results).ok();
    let summary = reader.and_then(|reader| reader.summary);
    summary.is_some_and(|summary| summary["status"] == "complete")
}

/// Repeats the run in memory and compares the digests.
///
/// # Errors
/// If they differ.
pub(super) fn check_digest(testbed: &Testbed, results: &Path) -> anyhow::Result<()> {
    let reader = RunReader::open(results)?;
    let copied = reader
        .summary
        .as_ref()
        .and_then(|summary| summary["digest"].as_str())
        .unwrap_or_default();
    let mut repeated = preparation::start(&testbed.scenario, RunOptions::default());
    repeated.schedule_inputs(&input_log::read_folder(results, &testbed.scenario)?);
    let digest = repeated.finish(&mut ()).digest.to_string();
    ensure!(
        copied == digest,
        "--check: the testbed has the digest {copied}, a run in memory {digest}; please report this"
    );
    note!("the digest equals the digest of the same run in memory");
    Ok(())
}
