//! Ctrl-C, SIGTERM and a closed terminal: the first signal requests a clean end, the second ends the process
//! immediately.
//!
//! A command installs its handlers once, before it prints anything or creates a folder, and keeps them to its end.
//! Before that, the kernel ends it at a signal. A separate thread receives every signal, so that neither a later wait
//! nor a busy runtime misses one. Every command whose work takes long uses [`Signals`]; its exit code is in `exit`.
//! `docs/command-line.md` lists the effects by command.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;
use std::{fs, io, thread};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator;
use tokio::sync::watch;

use crate::display::note;
use crate::exit::ExitReason;

/// Time between two checks for a signal by a thread that waits for something else.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Time from a signal to the end enforced by [`Signals::force_exit_after_signal`].
const GRACE: Duration = Duration::from_secs(1);

/// The reaction of a process to signals. Every process also records the first one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SignalMode {
    /// A process with results to keep: announces its end at the first signal. The second ends it immediately.
    SavesResults,
    /// A process without results to keep. The second signal ends it immediately.
    HasNoResults,
    /// A process that stops its containers: announces that at the first signal. The second ends it immediately.
    StopsContainers,
    /// A process that ends its process group, itself included, with the same signals: further ones change nothing.
    EndsGroup,
}

/// The signals that end a command. Once installed, none of them ends the process by default.
#[derive(Clone, Debug)]
pub(crate) struct Signals {
    has_arrived: watch::Receiver<bool>,
    /// Whether the results are saved, so that a signal loses none.
    is_saved: Arc<AtomicBool>,
}

impl Signals {
    /// Installs the handlers for the life of the process. Call it once: a second call would react to each signal twice.
    ///
    /// # Errors
    /// If the handlers cannot be installed, or their thread cannot be started.
    pub(crate) fn install(mode: SignalMode) -> io::Result<Self> {
        // `nohup` asks to outlive the terminal.
        let hang_up_signal = (!is_under_nohup()).then_some(SIGHUP);
        // Not tokio's streams: their handlers are installed before the stream exists, and a signal in between is lost
        // if a runtime already runs.
        let mut signals = iterator::Signals::new([SIGINT, SIGTERM].into_iter().chain(hang_up_signal))?;
        let (sender, has_arrived) = watch::channel(false);
        let is_saved = Arc::new(AtomicBool::new(false));
        let saved = Arc::clone(&is_saved);
        thread::Builder::new().name("signals".to_owned()).spawn(move || {
            for signal in signals.forever() {
                // `send_replace` returns the old value, so exactly one signal is the first.
                let is_first = !sender.send_replace(true);
                react(mode, signal, is_first, saved.load(Ordering::Relaxed));
            }
        })?;
        Ok(Self { has_arrived, is_saved })
    }

    /// Notes that the results are saved: the next signal needs no announcement.
    pub(crate) fn note_saved(&self) {
        self.is_saved.store(true, Ordering::Relaxed);
    }

    /// Whether a signal has arrived.
    pub(crate) fn has_arrived(&self) -> bool {
        *self.has_arrived.borrow()
    }

    /// Waits for the first signal, which may have arrived already.
    pub(crate) async fn wait_for_first(&self) {
        // The thread lasts as long as the process.
        let _lasts = self
            .has_arrived
            .clone()
            .wait_for(|has_arrived| *has_arrived)
            .await
            .is_ok();
    }

    /// Returns the result of `work`, or `None` if a signal arrives first.
    pub(crate) async fn unless_interrupted<T>(&self, work: impl Future<Output = T>) -> Option<T> {
        tokio::select! {
            done = work => Some(done),
            () = self.wait_for_first() => None,
        }
    }

    /// Ends the program with `exit_message` if it lasts for [`GRACE`] after a signal, unless the returned value is
    /// dropped by then: for a command whose work does not check for signals.
    ///
    /// # Errors
    /// If the thread cannot be started.
    pub(crate) fn force_exit_after_signal(
        &self,
        exit_message: impl FnOnce() -> String + Send + 'static,
    ) -> io::Result<ForcedExit> {
        let signals = self.clone();
        let (keep_alive, drop_receiver) = channel();
        thread::Builder::new().name("insistence".to_owned()).spawn(move || {
            // Nothing is ever sent: the channel closes when the `ForcedExit` is dropped.
            let is_dropped_within =
                |timeout| drop_receiver.recv_timeout(timeout) == Err(RecvTimeoutError::Disconnected);
            while !signals.has_arrived() {
                if is_dropped_within(POLL_INTERVAL) {
                    return;
                }
            }
            if !is_dropped_within(GRACE) {
                note!("reveille: {}", exit_message());
                ExitReason::Interrupted.exit_now();
            }
        })?;
        Ok(ForcedExit(keep_alive))
    }
}

/// Ends the program soon after a signal, until this is dropped.
pub(crate) struct ForcedExit(#[expect(dead_code, reason = "it is dropped, and nothing else")] Sender<()>);

/// Runs `work`, the preparation of a run, on another thread, and blocks. Returns its result, or `None` if `should_stop`
/// is true first; the thread then ends with the process.
///
/// # Errors
/// If the thread cannot be started, or panics.
pub(crate) fn run_on_thread<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
    should_stop: impl Fn() -> bool,
) -> anyhow::Result<Option<T>> {
    let (sender, receiver) = channel();
    thread::Builder::new().spawn(move || {
        // The caller may have given up and need no result.
        let _given_up = sender.send(work()).is_err();
    })?;
    loop {
        match receiver.recv_timeout(POLL_INTERVAL) {
            Ok(done) => return Ok(Some(done)),
            Err(RecvTimeoutError::Timeout) if should_stop() => return Ok(None),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => anyhow::bail!("the preparation of the run has failed"),
        }
    }
}

/// Reacts to a signal, in addition to its record in [`Signals`].
fn react(mode: SignalMode, signal: i32, is_first: bool, is_saved: bool) {
    // A terminal that closes sends SIGHUP more than once: from the kernel, and from its shell.
    let is_repeated = !is_first && signal != SIGHUP;
    match mode {
        SignalMode::SavesResults if is_first && is_saved => {}
        SignalMode::SavesResults if is_first => {
            tracing::warn!("interrupted; saving the results so far (a second signal ends the program without saving)");
        }
        SignalMode::StopsContainers if is_first => {
            note!("interrupted; stopping the containers (a second signal ends the program immediately)");
        }
        SignalMode::StopsContainers if is_repeated => {
            note!("ended; containers may still run: see `reveille testbed status`");
            ExitReason::Interrupted.exit_now()
        }
        SignalMode::SavesResults | SignalMode::HasNoResults if is_repeated => ExitReason::Interrupted.exit_now(),
        SignalMode::SavesResults | SignalMode::HasNoResults | SignalMode::StopsContainers | SignalMode::EndsGroup => {}
    }
}

/// Whether this process was started to ignore the closing of its terminal.
fn is_under_nohup() -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored_text = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let ignored_mask = ignored_text.and_then(|text| u64::from_str_radix(text.trim(), 16).ok());
    // Signal n is bit n - 1.
    ignored_mask.is_some_and(|mask| mask >> (SIGHUP - 1) & 1 == 1)
}
