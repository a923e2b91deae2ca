//! Recorder of a running run. A separate thread writes the file; the run waits only when its queue is full. A write
//! error does not end the run: the thread stops, and [`RecorderHandle::failure`] returns the error. The file is locked
//! while it grows, which [`is_growing`] tests. `deploy/src/recording.rs` starts the recorder of a run.

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

use super::bundle::ScenarioBundle;
use super::writer::RecordingWriter;
use crate::batch_receiver::{BatchReceiver, lower_priority};

/// Capacity of the queue, frames: enough for [`BatchReceiver`].
const QUEUE_FRAMES: usize = 8_192;
/// Longest time that frames stay unwritten while no others follow.
const MAX_UNWRITTEN_TIME: Duration = Duration::from_millis(200);

/// Recorder of one run.
pub struct Recorder {
    path: PathBuf,
    queue: SyncSender<RecorderItem>,
    shared: Arc<RecorderState>,
    thread: JoinHandle<McapResult<u64>>,
}

/// Item in the queue to the thread.
enum RecorderItem {
    Frame(Frame),
    /// End of the run, with its summary.
    End(Option<String>),
}

/// State shared by the run and the thread.
#[derive(Default)]
struct RecorderState {
    /// Total time that the run has waited, nanoseconds.
    waited_nanos: AtomicU64,
    /// The error that stopped writing.
    failure: OnceLock<String>,
}

/// Statistics of a finished recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecordingStats {
    /// Number of messages.
    pub frames: u64,
    /// Size of the file, bytes.
    pub bytes: u64,
    /// Total time that the run was blocked by the file.
    pub waited: Duration,
}

/// Handle that passes frames to a recorder.
#[derive(Clone)]
pub struct RecorderHandle {
    queue: SyncSender<RecorderItem>,
    shared: Arc<RecorderState>,
}

/// Whether a recorder is still writing `file`; always false where the file system lacks locks. Releases any lock that
/// `file` itself holds.
pub fn is_growing(file: &File) -> bool {
    let is_locked = matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock));
    // Released immediately: this was a test, and the lock belongs to the writer.
    let _unlocked = file.unlock().is_ok();
    is_locked
}

impl Recorder {
    /// Starts recording the run called `run`, with the files of `bundle`, in a new file at `path`.
    ///
    /// # Errors
    /// If the file exists or cannot be written.
    pub fn start(path: &Path, run: &str, bundle: &ScenarioBundle) -> Result<Self, String> {
        let file = File::options().write(true).create_new(true).open(path);
        let file = file.map_err(|error| error.to_string())?;
        // Locked during writing, so that readers can tell. A failure is ignored, as some network file systems lack
        // locks.
        let _locked = file.try_lock().is_ok();
        let writer = RecordingWriter::begin(BufWriter::new(file), run, bundle).map_err(|error| error.to_string())?;
        let (queue, items) = sync_channel(QUEUE_FRAMES);
        let shared = Arc::new(RecorderState::default());
        let thread_state = Arc::clone(&shared);
        let run_thread = move || {
            lower_priority();
            let written = write_items(writer, BatchReceiver::new(items));
            if let Err(error) = &written {
                // Only this thread sets it, so the first value is the only one.
                let _first = thread_state.failure.set(error.to_string());
            }
            written
        };
        let thread = std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(run_thread);
        Ok(Self {
            path: path.to_owned(),
            queue,
            shared,
            thread: thread.map_err(|error| error.to_string())?,
        })
    }

    /// Returns a handle for adding frames.
    pub fn handle(&self) -> RecorderHandle {
        RecorderHandle {
            queue: self.queue.clone(),
            shared: Arc::clone(&self.shared),
        }
    }

    /// Completes the recording, with the text of the summary if the run has one. Frames that handles add later are
    /// lost.
    ///
    /// # Errors
    /// If the recording could not be written.
    pub fn finish(self, summary: Option<String>) -> Result<RecordingStats, String> {
        // If the thread has ended, `join` returns its error below.
        let _gone = self.queue.send(RecorderItem::End(summary)).is_err();
        // Handles may still hold senders, so the `End` item ends the thread, not a closed queue.
        drop(self.queue);
        let written = self
            .thread
            .join()
            .map_err(|_| "the thread that writes it has failed".to_owned())?;
        let frames = written.map_err(|error| error.to_string())?;
        Ok(RecordingStats {
            frames,
            bytes: std::fs::metadata(&self.path).map_or(0, |file| file.len()),
            waited: Duration::from_nanos(self.shared.waited_nanos.load(Ordering::Relaxed)),
        })
    }
}

impl RecorderHandle {
    /// Adds a frame; waits while the queue is full. After a write error the frame is dropped.
    pub fn push(&self, frame: Frame) {
        let item = match self.queue.try_send(RecorderItem::Frame(frame)) {
            // If writing has failed, `failure` returns the error.
            Ok(()) | Err(TrySendError::Disconnected(_)) => return,
            Err(TrySendError::Full(item)) => item,
        };
        #[expect(clippy::disallowed_methods, reason = "the recorder reports how long the run waited")]
        let started = Instant::now();
        let _gone = self.queue.send(item).is_err();
        let waited_nanos = started.elapsed().as_nanos() as u64;
        self.shared.waited_nanos.fetch_add(waited_nanos, Ordering::Relaxed);
    }

    /// The error that stopped writing, if any.
    pub fn failure(&self) -> Option<&str> {
        self.shared.failure.get().map(String::as_str)
    }

    /// Total time that the run has waited so far.
    pub fn waited(&self) -> Duration {
        Duration::from_nanos(self.shared.waited_nanos.load(Ordering::Relaxed))
    }
}

/// Writes all items up to `End` and returns the number of frames. If the run fails and sends no `End`, the file is
/// closed without a summary.
fn write_items(
    mut writer: RecordingWriter<BufWriter<File>>,
    mut items: BatchReceiver<RecorderItem>,
) -> McapResult<u64> {
    loop {
        let batch = match items.next_batch(MAX_UNWRITTEN_TIME) {
            Ok(batch) => batch,
            Err(RecvTimeoutError::Timeout) => {
                writer.flush()?;
                continue;
            }
            Err(RecvTimeoutError::Disconnected) => return close_recording(writer, None),
        };
        for item in batch {
            match item {
                RecorderItem::Frame(frame) => writer.write(&frame)?,
                RecorderItem::End(summary) => return close_recording(writer, summary.as_deref()),
            }
        }
    }
}

fn close_recording(writer: RecordingWriter<BufWriter<File>>, summary: Option<&str>) -> McapResult<u64> {
    let frames = writer.frame_count();
    let mut file = writer.finish(summary)?;
    file.flush()?;
    // A recording reported as complete must survive a power failure.
    file.get_ref().sync_all()?;
    Ok(frames)
}
