//! The policy process that a run starts for `--policy-command`, and that ends with the run in every case.
//! `policy_source` starts it; `main` runs [`guard`] in a separate process.
//!
//! ```text
//!   base station ──starts──► guard ──starts──► /bin/sh -c COMMAND ──► …
//!                SIGTERM            SIGTERM, then SIGKILL
//!                ───────►           ──────────────────────► the group of all of them
//! ```
//! The kernel sends the guard the same signal if the base station ends without a signal to it, as by `kill -9`.
//!
//! The environment variables are a public interface: `docs/policy-port.md` and the help of `--policy-command` list
//! them, and `python/reveille/policy_client.py` reads them.

use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::{Child, Command, ExitCode, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, ensure};
use reveille_bs::server::RunProgress;
use reveille_common::bus::Bus;
use reveille_common::secret::Secret;
use rustix::io::Errno;
use rustix::process::{
    Pid, Signal, WaitOptions, getpgrp, getpid, kill_current_process_group, kill_process, kill_process_group,
    set_child_subreaper, wait,
};
use tokio::signal::unix::{SignalKind, signal};

use crate::exit::ExitReason;
use crate::runtime::now;
use crate::signals::{SignalMode, Signals};
use crate::{child_process, key, run_registry};

/// The variable with the base station's endpoint.
const CONNECT_VARIABLE: &str = "REVEILLE_CONNECT";
/// The variable with the folder of certificates, if the bus is encrypted.
const TLS_VARIABLE: &str = "REVEILLE_TLS";
/// The variable with the run's name.
const RUN_VARIABLE: &str = "REVEILLE_RUN";
/// The subcommand that runs the guard: clap's name of `Command::PolicyProcess`.
const GUARD: &str = "policy-process";
/// Base of the exit codes of processes ended by a signal.
const SIGNAL_EXIT_BASE: i32 = 128;
/// Time between two checks of a process.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Time for a policy process to end: once after the end of the run, as `docs/external-policies.md` states, and once
/// after SIGTERM.
const EXIT_TIMEOUT: Duration = Duration::from_secs(2);

/// A policy process, supervised until this is dropped.
pub(crate) struct PolicyProcess {
    /// The run is over.
    is_over: Arc<AtomicBool>,
    /// The policy process must end.
    must_end: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl PolicyProcess {
    /// Starts `command` with the shell, to decide for the run on `bus` that has this `key`, with the folder `tls` of
    /// certificates if the bus is encrypted. If it ends before the run, the cause is set in `progress` and the run
    /// stops. Call it from a thread that lives as long as the run.
    ///
    /// # Errors
    /// If it cannot be started.
    pub(crate) fn start(
        command: &str,
        (bus, tls): (&Bus, Option<&Path>),
        key: Option<Secret>,
        progress: &Arc<RunProgress>,
    ) -> anyhow::Result<Self> {
        let program = std::env::current_exe().context("cannot find the path of the reveille program")?;
        let mut guard = Command::new(program);
        guard
            .args([GUARD, "--parent", &std::process::id().to_string(), "--", command])
            .env(CONNECT_VARIABLE, run_registry::local_endpoint(bus.endpoint()))
            .env(RUN_VARIABLE, bus.key_exprs().run().to_string())
            .stdin(Stdio::null())
            // The run's standard output is for its results only.
            .stdout(std::io::stderr())
            // In another process group Ctrl-C reaches the run alone, which ends the policy process later.
            .process_group(0);
        if let Some(key) = key {
            guard.env(key::KEY_VARIABLE, key.to_string());
        }
        if let Some(folder) = tls {
            guard.env(TLS_VARIABLE, std::path::absolute(folder)?);
        }
        let guard = guard.spawn().context("cannot start a process for --policy-command")?;
        let is_over = Arc::new(AtomicBool::new(false));
        let must_end = Arc::new(AtomicBool::new(false));
        let guarded = GuardedProcess {
            guard,
            command: command.to_owned(),
            is_over: Arc::clone(&is_over),
            must_end: Arc::clone(&must_end),
        };
        let progress = Arc::clone(progress);
        let thread = std::thread::Builder::new()
            .name("policy".to_owned())
            .spawn(move || guarded.supervise(&progress))?;
        Ok(Self {
            is_over,
            must_end,
            thread: Some(thread),
        })
    }

    /// Notes that the run is over: the process may end now, and is ended when this is dropped. Call it before the
    /// farewell to the policy process, or its end stops the run.
    #[must_use]
    pub(crate) fn allow_end(self) -> Self {
        self.is_over.store(true, Ordering::Relaxed);
        self
    }
}

impl Drop for PolicyProcess {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.must_end.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _panicked = thread.join().is_err();
        }
    }
}

/// A policy process as seen by the thread that supervises it.
struct GuardedProcess {
    guard: Child,
    command: String,
    is_over: Arc<AtomicBool>,
    must_end: Arc<AtomicBool>,
}

impl GuardedProcess {
    fn supervise(mut self, progress: &RunProgress) {
        self.watch_guard(progress);
        // Ends processes that the command left behind, and a guard that hangs.
        let _gone = kill_process_group(Pid::from_child(&self.guard), Signal::KILL).is_err();
        let _reaped = self.guard.wait().is_err();
    }

    /// Watches the guard until it ends. After `must_end` it gets [`EXIT_TIMEOUT`], then SIGTERM; returns even if it
    /// does not react.
    fn watch_guard(&mut self, progress: &RunProgress) {
        while !self.must_end.load(Ordering::Relaxed) {
            if let Ok(Some(status)) = self.guard.try_wait() {
                if !self.is_over.load(Ordering::Relaxed) {
                    let why = format!(
                        "the policy process `{}` ended with {}",
                        self.command,
                        describe_status(status)
                    );
                    progress.request_stop_because(why);
                }
                return;
            }
            std::thread::sleep(POLL_INTERVAL);
        }
        if !self.wait_for_guard(EXIT_TIMEOUT) {
            let _gone = kill_process(Pid::from_child(&self.guard), Signal::TERM).is_err();
            // The guard itself waits up to EXIT_TIMEOUT before it kills its group.
            self.wait_for_guard(2 * EXIT_TIMEOUT);
        }
    }

    /// Waits up to `timeout` for the guard to end. Returns whether it has ended.
    fn wait_for_guard(&mut self, timeout: Duration) -> bool {
        let started = now();
        while started.elapsed() < timeout {
            if !matches!(self.guard.try_wait(), Ok(None)) {
                return true;
            }
            std::thread::sleep(POLL_INTERVAL);
        }
        false
    }
}

/// Runs the guard of `command`: starts it with the shell, in this process's group, and returns its exit code. Ends the
/// group at a signal or when the process `parent`, which started this one, ends.
///
/// # Errors
/// If the command cannot be started, this process does not lead a group, or it cannot be tied to its parent.
pub(crate) async fn guard(command: &str, parent: i32) -> anyhow::Result<ExitCode> {
    // The guard kills its own group, which must not be the group of a user's shell.
    ensure!(
        getpgrp() == getpid(),
        "this internal command must be started by `reveille up` or `reveille bs`"
    );
    child_process::exit_with_parent(parent, Signal::TERM)?;
    // Orphans become children of this process, so that it notices when all have ended.
    set_child_subreaper(Some(getpid()))?;
    // Both are installed before the shell starts, or its end could be missed.
    let signals = Signals::install(SignalMode::EndsGroup)?;
    let mut child_signals = signal(SignalKind::child())?;
    let mut shell = Command::new("/bin/sh")
        .args(["-c", command])
        .spawn()
        .context("cannot start a shell for --policy-command")?;
    loop {
        // SIGCHLD also comes for orphans; only the end of the shell counts.
        if let Some(status) = shell.try_wait()? {
            return Ok(exit_code(status));
        }
        tokio::select! {
            _ = child_signals.recv() => {}
            () = signals.wait_for_first() => break,
        }
    }
    // This process receives the signal too, and ignores it (`SignalMode::EndsGroup`).
    kill_current_process_group(Signal::TERM)?;
    let signalled = now();
    while signalled.elapsed() < EXIT_TIMEOUT {
        match wait(WaitOptions::NOHANG) {
            Err(Errno::CHILD) => return Ok(ExitReason::Interrupted.into()),
            Ok(None) | Err(_) => tokio::time::sleep(POLL_INTERVAL).await,
            Ok(Some(_)) => {}
        }
    }
    // Ends what is left, and this process with it.
    kill_current_process_group(Signal::KILL)?;
    Ok(ExitReason::Interrupted.into())
}

/// The exit code of a process; 128 plus the signal number, as in shells, if a signal ended it.
fn exit_code(status: ExitStatus) -> ExitCode {
    let signal = || SIGNAL_EXIT_BASE + status.signal().unwrap_or_default();
    u8::try_from(status.code().unwrap_or_else(signal))
        .unwrap_or(u8::MAX)
        .into()
}

/// Describes how a process ended, by its exit code.
fn describe_status(status: ExitStatus) -> String {
    match status.code() {
        Some(exit_code) if exit_code > SIGNAL_EXIT_BASE => {
            format!("{status}, by signal {}", exit_code - SIGNAL_EXIT_BASE)
        }
        _ => status.to_string(),
    }
}
