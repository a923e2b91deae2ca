//! The recording of a run to the file of `--record`, made by the process of the run. `run_watchers` starts and closes
//! it; `view/src/recording/` defines the format. [`bundle_scenario`] also describes a run to observers on the bus.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use reveille_bs::scenario::Scenario;
use reveille_view::recording::{self, Recorder, RecorderHandle, ScenarioBundle};

use crate::cli::OutputArgs;
use crate::display::{count_noun, note};
use crate::scenario_files::ScenarioFiles;

/// Extension of recordings. Only searches in folders need it; texts and pages repeat it in examples.
pub(crate) const RECORDING_EXTENSION: &str = "mcap";

/// The recording that `--record` requests, or none.
pub(crate) struct RunRecording {
    /// The recorder and the path of its file.
    recorder: Option<(Recorder, PathBuf)>,
    is_quiet: bool,
}

impl RunRecording {
    /// Starts the recording that `args` request, of the run called `run`.
    ///
    /// # Errors
    /// If the file exists without `--force`, or cannot be written. `run_watchers::check` has refused a growing one.
    pub(crate) fn start(args: &OutputArgs, run: &str, scenario: &Scenario) -> anyhow::Result<Self> {
        let recorder = match &args.record {
            Some(path) => {
                // The recorder creates a new file and refuses an existing one.
                if args.force && path.is_file() {
                    fs::remove_file(path).with_context(|| {
                        format!(
                            "--record {}: cannot replace this \
                        file",
                            path.display()
                        )
                    })?;
                }
                let bundle = bundle_scenario(scenario)?;
                let recorder = Recorder::start(path, run, &bundle);
                let recorder = recorder.map_err(|why| anyhow!("--record {}: {why}", path.display()))?;
                Some((recorder, path.clone()))
            }
            None => None,
        };
        Ok(Self {
            recorder,
            is_quiet: args.quiet,
        })
    }

    /// The handle that takes frames, if they are recorded.
    pub(crate) fn handle(&self) -> Option<RecorderHandle> {
        self.recorder.as_ref().map(|(recorder, _)| recorder.handle())
    }

    /// Closes the recording, with the JSON text of the summary if the run has one. Call it after the last frame.
    ///
    /// # Errors
    /// If the recording could not be written.
    pub(crate) fn finish(self, summary: Option<String>) -> anyhow::Result<()> {
        let Some((recorder, path)) = self.recorder else {
            return Ok(());
        };
        let recorded = recorder
            .finish(summary)
            .map_err(|why| anyhow!("--record {}: {why}", path.display()))?;
        if !self.is_quiet {
            note!(
                "recorded {} in {}, {:.1} MB; the run waited {:.2} s for it",
                count_noun(recorded.frames, "message"),
                path.display(),
                recorded.bytes as f64 / 1e6,
                recorded.waited.as_secs_f64()
            );
        }
        Ok(())
    }
}

/// Whether a process is writing the recording at `path`.
pub(crate) fn is_growing(path: &Path) -> bool {
    File::open(path).is_ok_and(|file| recording::is_growing(&file))
}

/// Bundles `scenario` with its scenario files.
///
/// # Errors
/// If a file cannot be read any more.
pub(crate) fn bundle_scenario(scenario: &Scenario) -> anyhow::Result<ScenarioBundle> {
    Ok(ScenarioFiles::read(scenario)?.bundle(scenario))
}
