//! Sources of frames for `tail` and `stats`: a live run or a recording. Both keep the order of frames. Every command
//! that reads a recording uses [`open_recording`]; the dashboard also shows [`device_groups`].

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail};
use reveille_bs::cycle::PreparedRun;
use reveille_bs::policy::outside;
use reveille_bs::scenario::Scenario;
use reveille_common::declare::describe_read_error;
use reveille_common::ids::Tti;
use reveille_common::message::Frame;
use reveille_view::recording::{RecordingReader, ScenarioBundle, is_growing};

use super::live::{Live, OBSERVERS};
use crate::cli::TargetArgs;
use crate::display::{count_noun, note};
use crate::exit::InvalidUsage;
use crate::folder_lock::{FolderStatus, status};
use crate::input_log::INPUT_LOG_FILE;
use crate::recording::RECORDING_EXTENSION;
use crate::run_folder::SCENARIO_FILE;
use crate::run_reader::RunReader;

/// A recording file.
pub(crate) type RecordingFile = RecordingReader<BufReader<File>>;

/// Opens the recording at `path`, or the only recording in the run folder `path`.
///
/// # Errors
/// If the file is not a recording or has another version, or the folder does not hold exactly one recording.
pub(crate) fn open_recording(path: &Path) -> anyhow::Result<RecordingFile> {
    let path = find_recording(path)?;
    let path_text = || path.display().to_string();
    let file = File::open(&path).map_err(|error| {
        let hint = "name a recording, such as run.mcap, or the run folder that holds one";
        anyhow!("{}: {}", path_text(), describe_read_error(&error, hint))
    })?;
    if is_growing(&file) {
        note!("{}: still being written; reading the messages so far", path_text());
    }
    RecordingReader::open(BufReader::new(file)).with_context(path_text)
}

/// Returns the options of `reveille run` that repeat the run in `folder`, with its external inputs.
fn repeating_options(folder: &Path) -> String {
    let run = RunReader::open(folder);
    let is_external = run.is_ok_and(|run| outside::is_external(&run.scenario.policy));
    let has_log = folder.join(INPUT_LOG_FILE).exists();
    let folder = folder.display();
    if is_external {
        format!("--policy replay={folder}")
    } else if has_log {
        format!("--scenario {folder}/{SCENARIO_FILE} --input-log {folder}/{INPUT_LOG_FILE}")
    } else {
        format!("--scenario {folder}/{SCENARIO_FILE}")
    }
}

/// Returns `path`, or for a folder the only recording in it.
///
/// # Errors
/// If the folder does not hold exactly one recording.
pub(super) fn find_recording(path: &Path) -> anyhow::Result<PathBuf> {
    if !path.is_dir() {
        return Ok(path.to_owned());
    }
    let folder = path.display();
    let file_paths = path
        .read_dir()
        .with_context(|| folder.to_string())?
        .flatten()
        .map(|entry| entry.path());
    let mut recordings: Vec<PathBuf> = file_paths
        .filter(|file| {
            file.extension()
                .is_some_and(|extension| extension == RECORDING_EXTENSION)
        })
        .collect();
    recordings.sort_unstable();
    match (&recordings[..], path.join(SCENARIO_FILE).is_file()) {
        ([only], _) => Ok(only.clone()),
        ([], false) => bail!("{folder}: the folder holds no recording; name a recording, such as run.mcap"),
        ([], true) if matches!(status(path), FolderStatus::Running(_)) => {
            bail!("{folder}: the folder holds no recording; leave it out to observe the active run")
        }
        ([], true) => bail!(
            "{folder}: the folder holds no recording; create one with `reveille run {} --record \
             {folder}/run.{RECORDING_EXTENSION}`",
            repeating_options(path)
        ),
        ([first, ..], _) => bail!(
            "{folder}: the folder holds {} recordings; name one of them, such as {}",
            recordings.len(),
            first.display()
        ),
    }
}

/// Checks that `since` and `until`, the values of --since and --until, leave a TTI between them.
pub(super) fn check_tti_range(since: Option<u64>, until: Option<u64>) -> Result<(), InvalidUsage> {
    match (since, until) {
        (Some(since), Some(until)) if since > until => Err(InvalidUsage(format!(
            "--since {since} is larger than --until {until}; give --since at most the value of --until"
        ))),
        _ => Ok(()),
    }
}

/// A source of frames.
pub(crate) enum FrameSource {
    /// A live run.
    Live(Box<Live>),
    /// A recording, with its path as given, for errors.
    Recorded(Box<RecordingFile>, String),
}

impl FrameSource {
    /// Opens the recording `file`, or else the run that `target` selects.
    ///
    /// # Errors
    /// If there is no such run, the bus fails, or the file is not a recording.
    pub(crate) async fn open(file: Option<&Path>, target: &TargetArgs) -> anyhow::Result<Self> {
        if let Some(path) = file {
            return Ok(Self::Recorded(
                Box::new(open_recording(path)?),
                path.display().to_string(),
            ));
        }
        let mut live = Live::connect(target, &OBSERVERS).await?;
        live.force_exit_after_signal()?;
        Ok(Self::Live(Box::new(live)))
    }

    /// The scenario with its files.
    ///
    /// # Errors
    /// If the run has ended, or a signal comes.
    pub(crate) async fn bundle(&self) -> anyhow::Result<ScenarioBundle> {
        match self {
            Self::Live(live) => live.bundle().await,
            Self::Recorded(recording, _) => Ok(recording.bundle().clone()),
        }
    }

    /// Moves a recording to the first frame of TTI `tti` or later. A live run is not moved: callers filter its frames.
    ///
    /// # Errors
    /// If it cannot be read.
    pub(crate) fn seek(&mut self, tti: Tti) -> anyhow::Result<()> {
        match self {
            Self::Live(_) => Ok(()),
            Self::Recorded(recording, name) => recording.seek(tti).with_context(|| name.clone()),
        }
    }

    /// Prints the position of a live run.
    pub(crate) fn report_position(&self) {
        if let Self::Live(live) = self {
            live.report_position();
        }
    }

    /// Returns the next frames and the number of frames dropped before them; `None` after the last, or after a signal
    /// that ends the observation of a live run.
    ///
    /// # Errors
    /// If the recording is torn or damaged here.
    pub(crate) async fn next(&mut self) -> anyhow::Result<Option<(Vec<Frame>, u64)>> {
        match self {
            Self::Live(live) => Ok(live.next().await),
            Self::Recorded(recording, name) => {
                let frame = recording.next_frame().with_context(|| name.clone())?;
                Ok(frame.map(|frame| (vec![frame], 0)))
            }
        }
    }

    /// The closing line after `shown` messages.
    pub(crate) fn closing_line(&self, shown: u64) -> String {
        let shown_messages = count_noun(shown, "message");
        match self {
            Self::Live(live) => {
                let reason = if live.dropped_frames() > 0 {
                    " (reader too slow)"
                } else {
                    ""
                };
                format!("{shown_messages} shown, {} dropped{reason}", live.dropped_frames())
            }
            Self::Recorded(..) => format!("{shown_messages} shown"),
        }
    }

    /// Closes the source.
    pub(crate) async fn close(self) {
        if let Self::Live(live) = self {
            live.close().await;
        }
    }
}

/// The group of each device, the cluster of `--cluster`; `None` if the policy has no groups by position or needs pilot
/// runs to form them.
pub(crate) fn device_groups(scenario: &Scenario) -> Option<Vec<u32>> {
    let prepared = PreparedRun::without_pilots(scenario);
    if scenario.policy.settings().pilot_search().is_some() {
        return None;
    }
    let known = prepared.knowledge();
    prepared.policy(&known).device_groups().map(<[u32]>::to_vec)
}
