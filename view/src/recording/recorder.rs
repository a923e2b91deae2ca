//! A recording of a run that goes on: written by a thread of its own, which the run waits for when it must.

use std::fs::{File, TryLockError};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use mcap::McapResult;
use reveille_common::message::Frame;

use super::bundle::Bundle;
use super::writer::Writer;
use crate::batches::{Batches, step_back};

/// Frames that may wait to be written.
const QUEUE: usize = 8_192;
/// How long frames may wait for the file while nothing follows them.
const IDLE: Duration = Duration::from_millis(200);

/// A recording that a run is written to.
pub struct Recorder {
    path: PathBuf,
    queue: SyncSender<Item>,
    shared: Arc<Shared>,
    thread: JoinHandle<McapResult<u64>>,
}

/// What goes to the thread.
enum Item {
    Frame(Frame),
    /// The run has ended, with this summary.
    End(Option<String>),
}

/// What the run and the thread both know.
#[derive(Default)]
struct Shared {
    /// Nanoseconds that the run has waited.
    waited: AtomicU64,
    /// Why nothing more can be written.
    failure: OnceLock<String>,
}

/// What was recorded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Recorded {
    /// Messages.
    pub frames: u64,
    /// Bytes of the file.
    pub bytes: u64,
    /// How long the run waited for the file.
    pub waited: Duration,
}

/// Hands frames to a recorder.
#[derive(Clone)]
pub struct Tape {
    queue: SyncSender<Item>,
    shared: Arc<Shared>,
}

/// Whether a recorder is writing the file that was opened as `file`.
pub fn is_growing(file: &File) -> bool {
    let is_locked = matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock));
    // Only asked: the lock is for who writes.
    let _free = file.unlock().is_ok();
    is_locked
}

impl Recorder {
    /// Begins the recording of the run called `run`, of what is in `bundle`, in a new file at `path`.
    ///
    /// # Errors
    /// If there is a file already, or none can be written.
    pub fn start(path: &Path, run: &str, bundle: &Bundle) -> Result<Self, String> {
        let file = File::options().write(true).create_new(true).open(path);
        let file = file.map_err(|error| error.to_string())?;
        // For as long as it is written, so that others see that it is. Some network file systems cannot lock.
        let _locked = file.try_lock().is_ok();
        let writer = Writer::begin(BufWriter::new(file), run, bundle).map_err(|error| error.to_string())?;
        let (queue, items) = sync_channel(QUEUE);
        let shared = Arc::new(Shared::default());
        let own = Arc::clone(&shared);
        let write = move || {
            step_back();
            let written = write(writer, Batches::new(items));
            if let Err(error) = &written {
                // Nobody else sets it.
                let _first = own.failure.set(error.to_string());
            }
            written
        };
        let thread = std::thread::Builder::new().name("recorder".to_owned()).spawn(write);
        Ok(Self {
            path: path.to_owned(),
            queue,
            shared,
            thread: thread.map_err(|error| error.to_string())?,
        })
    }

    /// Where frames are handed in.
    pub fn tape(&self) -> Tape {
        Tape {
            queue: self.queue.clone(),
            shared: Arc::clone(&self.shared),
        }
    }

    /// Ends the recording, with the text of the summary where the run has one.
    ///
    /// # Errors
    /// If it could not be written.
    pub fn finish(self, summary: Option<String>) -> Result<Recorded, String> {
        // If the thread has ended, its error is told below.
        let _gone = self.queue.send(Item::End(summary)).is_err();
        drop(self.queue);
        let written = self
            .thread
            .join()
            .map_err(|_| "the thread that writes it has failed".to_owned())?;
        let frames = written.map_err(|error| error.to_string())?;
        Ok(Recorded {
            frames,
            bytes: std::fs::metadata(&self.path).map_or(0, |file| file.len()),
            waited: Duration::from_nanos(self.shared.waited.load(Ordering::Relaxed)),
        })
    }
}

impl Tape {
    /// Takes in a frame; waits while the queue is full.
    pub fn take(&self, frame: Frame) {
        let item = match self.queue.try_send(Item::Frame(frame)) {
            Ok(()) | Err(TrySendError::Disconnected(_)) => return,
            Err(TrySendError::Full(item)) => item,
        };
        #[expect(clippy::disallowed_methods, reason = "the recorder reports how long the run waited")]
        let started = Instant::now();
        let _gone = self.queue.send(item).is_err();
        let waited = started.elapsed().as_nanos() as u64;
        self.shared.waited.fetch_add(waited, Ordering::Relaxed);
    }

    /// Why nothing more can be written, if it is so.
    pub fn failure(&self) -> Option<&str> {
        self.shared.failure.get().map(String::as_str)
    }

    /// How long the run has waited so far.
    pub fn waited(&self) -> Duration {
        Duration::from_nanos(self.shared.waited.load(Ordering::Relaxed))
    }
}

/// Writes what comes until the end; gives the number of frames. Where no end comes, as the run has failed, the file is
/// closed without a summary.
fn write(mut writer: Writer<BufWriter<File>>, mut items: Batches<Item>) -> McapResult<u64> {
    loop {
        let batch = match items.next(IDLE) {
            Ok(batch) => batch,
            Err(RecvTimeoutError::Timeout) => {
                writer.flush()?;
                continue;
            }
            Err(RecvTimeoutError::Disconnected) => return close(writer, None),
        };
        for item in batch {
            match item {
                Item::Frame(frame) => writer.write(&frame)?,
                Item::End(summary) => return close(writer, summary.as_deref()),
            }
        }
    }
}

fn close(writer: Writer<BufWriter<File>>, summary: Option<&str>) -> McapResult<u64> {
    let frames = writer.count();
    let mut file = writer.finish(summary)?;
    file.flush()?;
    file.get_ref().sync_all()?;
    Ok(frames)
}
