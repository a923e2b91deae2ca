//! Device processes as children of this process. No child outlives it, even if it is killed: the arguments of a child
//! name this process as its parent ([`exit_with_parent`]). `supervisor` starts and replaces the processes of `up`;
//! benchmarks use [`Children`] and [`run_for_summary`].
//!
//! [`DeviceProcesses::commands`] writes the options that `cli::run::DeviceArgs` parses. Tests find device processes by
//! the first argument `device` and the argument `--run=NAME` (`tests/src/process.rs`).

use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::Context;
use reveille_common::secret::Secret;
use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, waitid};
use serde_json::Value;

use crate::key;

/// The variable that sets zenoh's threads. It takes effect only before the first session of a process opens.
/// `docs/command-line.md` lets users set it.
const ZENOH_THREADS_VARIABLE: &str = "ZENOH_RUNTIME";
/// One thread for all of zenoh, so that a grant is answered without a handover between threads. Only for processes that
/// run devices and never block that thread on its own work.
const ONE_ZENOH_THREAD: &str =
    "(rx:(handover:app),acc:(handover:app),tx:(handover:app),net:(handover:app),app:(worker_threads:1))";

/// zenoh's threads in a process, unless the environment sets them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ZenohThreads {
    /// One thread for everything.
    One,
    /// zenoh's default threads.
    Default,
}

/// Time for a few child processes to leave on their own.
pub(crate) const EXIT_TIMEOUT: Duration = Duration::from_secs(5);

/// Child processes of this program without supervision; killed when dropped.
pub(crate) struct Children {
    running: Vec<Child>,
}

impl Children {
    /// Starts a process of this program for each list of arguments.
    ///
    /// # Errors
    /// If a process cannot be started.
    pub(crate) fn spawn(arguments: impl Iterator<Item = Vec<String>>) -> anyhow::Result<Self> {
        let mut children = Self { running: Vec::new() };
        for (number, arguments) in arguments.enumerate() {
            // If one fails, the drop of `children` ends those before it.
            let child =
                spawn(&arguments, None, ZenohThreads::One).with_context(|| format!("cannot start process {number}"))?;
            children.running.push(child);
        }
        Ok(children)
    }

    /// Waits for all children to leave. After [`EXIT_TIMEOUT`] the drop of `self` kills the others.
    pub(crate) fn wait(mut self) {
        let started = crate::runtime::now();
        while started.elapsed() < EXIT_TIMEOUT {
            self.running
                .retain_mut(|child| !matches!(child.try_wait(), Ok(Some(_))));
            if self.running.is_empty() {
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        tracing::warn!(
            processes = self.running.len(),
            "child processes did not exit in time and were killed"
        );
    }
}

impl Drop for Children {
    fn drop(&mut self) {
        for child in &mut self.running {
            // An error means that the child has already ended.
            let _already_ended = child.kill().is_err();
            let _already_reaped = child.wait().is_err();
        }
    }
}

/// The device processes of a run.
pub(crate) struct DeviceProcesses<'a> {
    /// Total number of devices.
    pub devices: u32,
    /// Number of processes.
    pub processes: u32,
    /// Endpoint of the base station.
    pub endpoint: &'a str,
    /// The name of the run.
    pub run: &'a str,
    /// Options for logging, from `Cli::log_options`.
    pub log: &'a [String],
    /// Whether the processes run without tuning.
    pub is_untuned: bool,
}

impl DeviceProcesses<'_> {
    /// Returns the arguments of each process.
    pub(crate) fn commands(&self) -> Vec<Vec<String>> {
        // In one argument, so that no name is taken for an option.
        let run = format!("--run={}", self.run);
        let (parent, host_count) = (std::process::id().to_string(), self.processes.to_string());
        let command = |count: u32| {
            let count = count.to_string();
            let device_args = ["device", "--connect", self.endpoint, &run, "--count", &count];
            let lifetime_args = ["--parent", &parent, "--host-count", &host_count];
            let untuned = self.is_untuned.then_some("--untuned");
            let options = device_args.into_iter().chain(lifetime_args).chain(untuned);
            options.map(str::to_owned).chain(self.log.iter().cloned()).collect()
        };
        split_devices(self.devices, self.processes).map(command).collect()
    }
}

/// Starts a process of this program and passes it the run's key, if any.
///
/// Call it from a thread that lives as long as the run. The kernel ends a child tied to its parent when the thread that
/// started it ends.
///
/// # Errors
/// If it cannot be started.
pub(crate) fn spawn(arguments: &[String], run_key: Option<Secret>, threads: ZenohThreads) -> anyhow::Result<Child> {
    let program = std::env::current_exe().context("cannot find the path of the reveille program")?;
    let mut command = Command::new(program);
    if threads == ZenohThreads::One && !has_thread_setting() {
        command.env(ZENOH_THREADS_VARIABLE, ONE_ZENOH_THREAD);
    }
    if let Some(run_key) = run_key {
        command.env(key::KEY_VARIABLE, run_key.to_string());
    }
    Ok(command
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        // In another process group Ctrl-C reaches the parent alone, which then ends its children.
        .process_group(0)
        .spawn()?)
}

/// Restarts this process with one zenoh thread, unless the environment sets zenoh's threads. Returns if no restart is
/// needed or the restart fails. Call it before any runtime or session: it replaces the process.
pub(crate) fn restart_with_one_zenoh_thread() {
    if !has_thread_setting() {
        let error = replace_process();
        tracing::debug!(%error, "cannot restart with one zenoh thread; zenoh uses its default number");
    }
}

/// Restarts this process with one zenoh thread unless it has one already, because TLS needs one
/// (`common/src/bus/tls.rs`). Call it before any session: it replaces the process.
///
/// # Errors
/// If the restart fails.
pub(crate) fn ensure_one_zenoh_thread() -> anyhow::Result<()> {
    if std::env::var_os(ZENOH_THREADS_VARIABLE).is_some_and(|set| set == ONE_ZENOH_THREAD) {
        return Ok(());
    }
    Err(replace_process()).with_context(|| {
        format!(
            "TLS needs one zenoh thread, and this process cannot restart; set {ZENOH_THREADS_VARIABLE} to \
             {ONE_ZENOH_THREAD:?}"
        )
    })
}

/// Replaces this process by one with the same arguments and one zenoh thread; returns the error if that fails. zenoh
/// takes the number from the environment only, and changing the environment of a running process needs unsafe code.
fn replace_process() -> std::io::Error {
    // Replaced here, so that the restarted process does not repeat the warnings.
    let (arguments, _) = crate::cli::former::replace_former_names(std::env::args_os());
    let mut arguments = arguments.into_iter();
    let name = arguments.next();
    let program = match std::env::current_exe() {
        Ok(program) => program,
        Err(error) => return error,
    };
    let mut command = Command::new(&program);
    command.arg0(name.unwrap_or_else(|| program.into_os_string()));
    command
        .args(arguments)
        .env(ZENOH_THREADS_VARIABLE, ONE_ZENOH_THREAD)
        .exec()
}

/// Whether the environment sets zenoh's threads. zenoh cannot read an empty setting.
fn has_thread_setting() -> bool {
    std::env::var_os(ZENOH_THREADS_VARIABLE).is_some_and(|set| !set.is_empty())
}

/// The number of devices of each of `processes` processes: as even as possible, never 0.
fn split_devices(devices: u32, processes: u32) -> impl Iterator<Item = u32> {
    // No process without a device, and no division by zero.
    let processes = processes.clamp(1, devices.max(1));
    (0..processes).map(move |i| devices / processes + u32::from(i < devices % processes))
}

/// Whether a child of this process may have ended without its status being read: one system call for all children.
pub(crate) fn has_exited_child() -> bool {
    // `NOWAIT` only looks: the status stays for the child's own `try_wait`.
    let options = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
    !matches!(waitid(WaitId::All, options), Ok(None))
}

/// Ties this process to the one that started it: when the `parent` ends for any reason, this process gets `signal`.
///
/// # Errors
/// If the parent has ended already, or the kernel refuses.
pub(crate) fn exit_with_parent(parent: i32, signal: Signal) -> anyhow::Result<()> {
    rustix::process::set_parent_process_death_signal(Some(signal)).context("cannot tie this process to its parent")?;
    // Compared after the request: the kernel sends nothing for a parent that ended before it.
    let is_parent_alive = rustix::process::getppid().map(Pid::as_raw_pid) == Some(parent);
    anyhow::ensure!(is_parent_alive, "the parent process has ended");
    Ok(())
}

/// Ends this process in order when the given `parent` ends; does nothing without one.
///
/// # Errors
/// See [`exit_with_parent`].
pub(crate) fn exit_with_optional_parent(parent: Option<i32>) -> anyhow::Result<()> {
    parent.map_or(Ok(()), |parent| exit_with_parent(parent, Signal::TERM))
}

/// Runs `reveille ARGUMENTS`, a `run` or an `up`, and returns the summary of that run. One call at a time: its folder
/// has the number of this process in its name.
///
/// # Errors
/// If the run fails; the error contains its standard error.
pub(crate) fn run_for_summary(arguments: &[&str]) -> anyhow::Result<Value> {
    let folder = std::env::temp_dir().join(format!("reveille-bench-{}", std::process::id()));
    // A killed benchmark leaves its folder, and this process may have the same id.
    let _absent = std::fs::remove_dir_all(&folder).is_err();
    // `--parent` ends the run if a signal ends the benchmark.
    let mut command = Command::new(std::env::current_exe()?);
    command
        .args(arguments)
        .args([
            "--parent",
            &std::process::id().to_string(),
            "--json",
            "--quiet",
            "--out",
        ])
        .arg(&folder)
        .stdin(Stdio::null());
    let output = command.output().context("cannot start reveille")?;
    anyhow::ensure!(
        output.status.success(),
        "reveille {}: {}",
        arguments.join(" "),
        String::from_utf8_lossy(&output.stderr)
    );
    // The next run uses the same folder, and `--out` refuses one that already holds a run.
    std::fs::remove_dir_all(&folder)?;
    Ok(serde_json::from_slice(&output.stdout)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_are_split_evenly_and_completely() {
        let shares = |devices, processes| split_devices(devices, processes).collect::<Vec<_>>();
        assert_eq!(shares(50, 4), [13, 13, 12, 12]);
        assert_eq!(shares(3, 8), [1, 1, 1]);
        assert_eq!(shares(7, 1), [7]);
    }
}
