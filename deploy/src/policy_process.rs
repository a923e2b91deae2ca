//! The policy process that a run starts by `--policy-command`, and that ends with it, however that is.
//!
//! ```text
//!   base station ──starts──► guard ──starts──► /bin/sh -c COMMAND ──► …
//!                SIGTERM            SIGTERM, then SIGKILL
//!                ───────►           ──────────────────────► the group of all of them
//! ```
//! The kernel sends the guard the same signal when the base station is gone without a word, as by `kill -9`.

use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::{Child, Command, ExitCode, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, ensure};
use reveille_bs::host::Progress;
use reveille_common::bus::Bus;
use reveille_common::secret::Secret;
use rustix::io::Errno;
use rustix::process::{
    Pid, Signal, WaitOptions, getpgrp, getpid, kill_current_process_group, kill_process, kill_process_group,
    set_child_subreaper, wait,
};
use tokio::signal::unix::{SignalKind, signal};

use crate::exit::Exit;
use crate::interrupt::Signals;
use crate::wall::now;
use crate::{key, launch};

/// The variable that says where the base station listens.
const CONNECT: &str = "REVEILLE_CONNECT";
/// The variable that names the run.
const RUN: &str = "REVEILLE_RUN";
/// The subcommand of a guard.
const GUARD: &str = "policy-process";
/// What an exit code is above where a signal has ended a process.
const SIGNALLED: i32 = 128;
/// Time between two looks at a process.
const LOOK: Duration = Duration::from_millis(20);
/// How long a policy process may take to end: when it hears that the run is over, and when it is told to.
const LEAVE: Duration = Duration::from_secs(2);

/// A policy process, looked after until this is dropped.
pub struct PolicyProcess {
    /// The run is over.
    is_over: Arc<AtomicBool>,
    /// It is to be ended.
    is_left: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl PolicyProcess {
    /// Starts `command` by the shell, to decide for the run on `bus` that has this `key`. If it ends before the run,
    /// `progress` is told that the run must end, and why. To be called by a thread that lasts as long as the run.
    ///
    /// # Errors
    /// It cannot be started.
    pub fn start(command: &str, bus: &Bus, key: Option<Secret>, progress: &Arc<Progress>) -> anyhow::Result<Self> {
        let program = std::env::current_exe().context("cannot find the reveille program itself")?;
        let mut guard = Command::new(program);
        guard
            .args([GUARD, "--parent", &std::process::id().to_string(), "--", command])
            .env(CONNECT, bus.endpoint())
            .env(RUN, bus.keys().run().to_string())
            .stdin(Stdio::null())
            // Its results are on the standard output of the run, and nobody else's.
            .stdout(std::io::stderr())
            // A key that ends the run ends the process in its turn.
            .process_group(0);
        if let Some(key) = key {
            guard.env(key::VARIABLE, key.to_string());
        }
        let guard = guard.spawn().context("cannot start a process for --policy-command")?;
        let is_over = Arc::new(AtomicBool::new(false));
        let is_left = Arc::new(AtomicBool::new(false));
        let charge = Charge {
            guard,
            command: command.to_owned(),
            is_over: Arc::clone(&is_over),
            is_left: Arc::clone(&is_left),
        };
        let progress = Arc::clone(progress);
        let thread = std::thread::Builder::new()
            .name("policy".to_owned())
            .spawn(move || charge.look_after(&progress))?;
        Ok(Self {
            is_over,
            is_left,
            thread: Some(thread),
        })
    }

    /// The run is over: it may end, and is ended when this is dropped.
    #[must_use]
    pub fn dismissed(self) -> Self {
        self.is_over.store(true, Ordering::Relaxed);
        self
    }
}

impl Drop for PolicyProcess {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.is_left.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _panicked = thread.join().is_err();
        }
    }
}

/// A policy process as its base station sees it.
struct Charge {
    guard: Child,
    command: String,
    is_over: Arc<AtomicBool>,
    is_left: Arc<AtomicBool>,
}

impl Charge {
    fn look_after(mut self, progress: &Progress) {
        self.watch(progress);
        // What the command has started and left behind, and a guard that hangs.
        let _gone = kill_process_group(Pid::from_child(&self.guard), Signal::KILL).is_err();
        let _reaped = self.guard.wait().is_err();
    }

    /// Until it has ended, or has been told to and does not.
    fn watch(&mut self, progress: &Progress) {
        while !self.is_left.load(Ordering::Relaxed) {
            if let Ok(Some(status)) = self.guard.try_wait() {
                if !self.is_over.load(Ordering::Relaxed) {
                    let why = format!("the policy process `{}` ended with {}", self.command, ending(status));
                    // The first cause is the one that counts.
                    let _told_before = progress.cause.set(why).is_err();
                    progress.stop.store(true, Ordering::Relaxed);
                }
                return;
            }
            std::thread::sleep(LOOK);
        }
        if !self.has_ended_within(LEAVE) {
            let _gone = kill_process(Pid::from_child(&self.guard), Signal::TERM).is_err();
            self.has_ended_within(2 * LEAVE);
        }
    }

    fn has_ended_within(&mut self, patience: Duration) -> bool {
        let begun = now();
        while begun.elapsed() < patience {
            if !matches!(self.guard.try_wait(), Ok(None)) {
                return true;
            }
            std::thread::sleep(LOOK);
        }
        false
    }
}

/// The guard of `command`: starts it by the shell, in the group of this process, and ends as it does; ends it when it
/// is told to, and with the process `parent`, which has started this one. The exit code is that of the command.
///
/// # Errors
/// The command cannot be started, this process does not lead a group, or cannot be tied to its parent.
pub async fn guard(command: &str, parent: i32) -> anyhow::Result<ExitCode> {
    ensure!(
        getpgrp() == getpid(),
        "this is for `reveille up` and `reveille bs` to start"
    );
    launch::die_with(parent, Signal::TERM)?;
    // Those whose parent has ended come to this process, so that it knows when all have.
    set_child_subreaper(Some(getpid()))?;
    let mut signals = Signals::install()?;
    let mut ended = signal(SignalKind::child())?;
    let mut shell = Command::new("/bin/sh")
        .args(["-c", command])
        .spawn()
        .context("cannot start a shell for --policy-command")?;
    loop {
        if let Some(status) = shell.try_wait()? {
            return Ok(code(status));
        }
        tokio::select! {
            _ = ended.recv() => {}
            () = signals.any() => break,
        }
    }
    kill_current_process_group(Signal::TERM)?;
    let begun = now();
    while begun.elapsed() < LEAVE {
        match wait(WaitOptions::NOHANG) {
            Err(Errno::CHILD) => return Ok(Exit::Interrupted.into()),
            Ok(None) | Err(_) => tokio::time::sleep(LOOK).await,
            Ok(Some(_)) => {}
        }
    }
    // Whatever is left, and this process.
    kill_current_process_group(Signal::KILL)?;
    Ok(Exit::Interrupted.into())
}

/// 128 and the number of the signal, as shells have it, where that has ended a process.
fn code(status: ExitStatus) -> ExitCode {
    let signal = || SIGNALLED + status.signal().unwrap_or_default();
    u8::try_from(status.code().unwrap_or_else(signal))
        .unwrap_or(u8::MAX)
        .into()
}

/// How a process has ended, by its exit code.
fn ending(status: ExitStatus) -> String {
    match status.code() {
        Some(code) if code > SIGNALLED => format!("{status}, by signal {}", code - SIGNALLED),
        _ => status.to_string(),
    }
}
