//! The recording of a run that this process makes.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use reveille_common::scenario::Scenario;
use reveille_view::recording::{self, Bundle, Recorder, Tape};

use crate::cli::OutputArgs;
use crate::display::note;
use crate::inputs::Inputs;

/// A recording, where one was asked for.
pub struct Recording {
    recorder: Option<(Recorder, PathBuf)>,
    quiet: bool,
}

impl Recording {
    /// Begins what `args` ask for, of the run called `run`.
    ///
    /// # Errors
    /// If the file is there already, or cannot be written.
    pub fn start(args: &OutputArgs, run: &str, scenario: &Scenario) -> anyhow::Result<Self> {
        let recorder = match &args.record {
            Some(path) => {
                if args.force && path.is_file() {
                    fs::remove_file(path).with_context(|| format!("--record: cannot replace {}", path.display()))?;
                }
                let bundle = bundle(scenario)?;
                let recorder = Recorder::start(path, run, &bundle);
                let recorder = recorder.map_err(|why| anyhow!("--record {}: {why}", path.display()))?;
                Some((recorder, path.clone()))
            }
            None => None,
        };
        Ok(Self {
            recorder,
            quiet: args.quiet,
        })
    }

    /// Where frames are handed in, if they are recorded.
    pub fn tape(&self) -> Option<Tape> {
        self.recorder.as_ref().map(|(recorder, _)| recorder.tape())
    }

    /// Ends the recording, with the text of the summary where the run has one.
    ///
    /// # Errors
    /// If it could not be written.
    pub fn finish(self, summary: Option<String>) -> anyhow::Result<()> {
        let Some((recorder, path)) = self.recorder else {
            return Ok(());
        };
        let recorded = recorder
            .finish(summary)
            .map_err(|why| anyhow!("--record {}: {why}", path.display()))?;
        if !self.quiet {
            note!(
                "recorded {} messages in {}, {:.1} MB; the run waited {:.2} s for it",
                recorded.frames,
                path.display(),
                recorded.bytes as f64 / 1e6,
                recorded.waited.as_secs_f64()
            );
        }
        Ok(())
    }
}

/// Whether somebody is writing the recording at `path`.
pub fn is_growing(path: &Path) -> bool {
    File::open(path).is_ok_and(|file| recording::is_growing(&file))
}

/// `scenario` with the files that it names.
///
/// # Errors
/// One cannot be read any more.
pub fn bundle(scenario: &Scenario) -> anyhow::Result<Bundle> {
    Ok(Inputs::read(scenario)?.bundle(scenario))
}
