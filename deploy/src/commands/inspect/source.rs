//! Where frames come from: a run that goes on, or a recording.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::Context;
use reveille_bs::policy::registry;
use reveille_bs::prepared::Prepared;
use reveille_common::ids::Tti;
use reveille_common::message::Frame;
use reveille_common::scenario::Scenario;
use reveille_view::recording::{Bundle, Reader, is_growing};

use super::live::Live;
use crate::cli::TargetArgs;
use crate::display::note;

/// A recording on the disk.
pub type Recording = Reader<BufReader<File>>;

/// Opens the recording at `path`.
///
/// # Errors
/// If it is none, or of another version.
pub fn open(path: &Path) -> anyhow::Result<Recording> {
    let named = || path.display().to_string();
    let file = File::open(path).with_context(named)?;
    anyhow::ensure!(
        file.metadata().is_ok_and(|file| file.is_file()),
        "{}: is not a file",
        named()
    );
    if is_growing(&file) {
        note!("{} is still being written: this is what there is so far", named());
    }
    Reader::open(BufReader::new(file)).with_context(named)
}

/// Where frames come from.
pub enum Source {
    /// A run that goes on.
    Live(Box<Live>),
    /// A recording, with its name.
    Recorded(Box<Recording>, String),
}

impl Source {
    /// The recording at `from`, or else the run that `target` means.
    ///
    /// # Errors
    /// If there is no such run, or it is no recording.
    pub async fn open(from: Option<&Path>, target: &TargetArgs) -> anyhow::Result<Self> {
        match from {
            Some(path) => Ok(Self::Recorded(Box::new(open(path)?), path.display().to_string())),
            None => Ok(Self::Live(Box::new(Live::connect(target).await?))),
        }
    }

    /// The scenario.
    ///
    /// # Errors
    /// If the run is gone.
    pub async fn bundle(&self) -> anyhow::Result<Bundle> {
        match self {
            Self::Live(live) => live.bundle().await,
            Self::Recorded(recording, _) => Ok(recording.bundle().clone()),
        }
    }

    /// The first frames of TTI `tti` or later come next, of a recording.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn seek(&mut self, tti: Tti) -> anyhow::Result<()> {
        match self {
            Self::Live(_) => Ok(()),
            Self::Recorded(recording, name) => recording.seek(tti).with_context(|| name.clone()),
        }
    }

    /// Says where a run that goes on is.
    pub fn greet(&self) {
        if let Self::Live(live) = self {
            live.greet();
        }
    }

    /// The next frames, and how many were left out before them; nothing after the last.
    ///
    /// # Errors
    /// If the recording is torn or damaged here.
    pub async fn next(&mut self) -> anyhow::Result<Option<(Vec<Frame>, u64)>> {
        match self {
            Self::Live(live) => Ok(live.next().await),
            Self::Recorded(recording, name) => {
                let frame = recording.next_frame().with_context(|| name.clone())?;
                Ok(frame.map(|frame| (vec![frame], 0)))
            }
        }
    }

    /// What is to be said at the end of `shown` messages.
    pub fn said(&self, shown: u64) -> String {
        match self {
            Self::Live(live) => {
                let left_out = live.left_out;
                format!("{shown} messages shown, {left_out} left out because this could not keep up")
            }
            Self::Recorded(..) => format!("{shown} messages shown"),
        }
    }

    /// Ends it.
    pub async fn close(self) {
        if let Self::Live(live) = self {
            live.close().await;
        }
    }
}

/// The group of each device, where the policy of `scenario` groups them by place and no pilot runs are needed to know.
pub fn groups(scenario: &Scenario) -> Option<Vec<u32>> {
    let prepared = Prepared::without_pilots(scenario);
    if registry::pilots(prepared.policies, &scenario.policy).is_some() {
        return None;
    }
    let known = prepared.knowledge();
    prepared.mind(&known).groups().map(<[u32]>::to_vec)
}
