//! Device processes as children of this one. None outlives it, however it ends.

use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::Context;
use reveille_common::secret::Secret;
use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, waitid};

use crate::key;

/// The variable that says which threads zenoh has. It counts until the first session of a process is opened.
const THREADS: &str = "ZENOH_RUNTIME";
/// One thread for all of zenoh, so that a tick is answered without handing over. Only for processes that carry devices,
/// and do nothing on that thread that waits for it.
const ONE_THREAD: &str =
    "(rx:(handover:app),acc:(handover:app),tx:(handover:app),net:(handover:app),app:(worker_threads:1))";

/// The threads that zenoh is given in a process, where nobody has said which.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Threads {
    /// One, for everything.
    One,
    /// Those that it has by default.
    Default,
}

/// How long child processes may take to leave by themselves, where they are few.
pub const LEAVE: Duration = Duration::from_secs(5);

/// Processes of this program that are not looked after.
pub struct Children {
    running: Vec<Child>,
}

impl Children {
    /// Starts a process of this program for each list of arguments.
    ///
    /// # Errors
    /// If a process cannot be started.
    pub fn spawn(arguments: impl Iterator<Item = Vec<String>>) -> anyhow::Result<Self> {
        let mut children = Self { running: Vec::new() };
        for (number, arguments) in arguments.enumerate() {
            let child =
                spawn(&arguments, None, Threads::One).with_context(|| format!("cannot start process {number}"))?;
            children.running.push(child);
        }
        Ok(children)
    }

    /// Waits for all to leave, and ends those that do not.
    pub fn wait(mut self) {
        let started = crate::wall::now();
        while started.elapsed() < LEAVE {
            self.running
                .retain_mut(|child| !matches!(child.try_wait(), Ok(Some(_))));
            if self.running.is_empty() {
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        tracing::warn!(
            processes = self.running.len(),
            "device processes did not leave by themselves"
        );
    }
}

impl Drop for Children {
    fn drop(&mut self) {
        for child in &mut self.running {
            // Already gone is as good.
            let _gone = child.kill().is_err();
            let _reaped = child.wait().is_err();
        }
    }
}

/// The device processes of a run.
pub struct Fleet<'a> {
    /// Devices that they carry together.
    pub devices: u32,
    /// How many processes there are.
    pub processes: u32,
    /// Where their BS listens.
    pub endpoint: &'a str,
    /// The run.
    pub run: &'a str,
    /// Options for logging.
    pub log: &'a [String],
    /// Whether they are to be as they would be without any tuning.
    pub is_untuned: bool,
}

impl Fleet<'_> {
    /// What each process is told.
    pub fn commands(&self) -> Vec<Vec<String>> {
        // In one argument, so that no name is taken for an option.
        let run = format!("--run={}", self.run);
        let (parent, among) = (std::process::id().to_string(), self.processes.to_string());
        let command = |count: u32| {
            let count = count.to_string();
            let own = ["device", "--connect", self.endpoint, &run, "--count", &count];
            let ties = ["--parent", &parent, "--among", &among];
            let untuned = self.is_untuned.then_some("--untuned");
            let all = own.into_iter().chain(ties).chain(untuned);
            all.map(str::to_owned).chain(self.log.iter().cloned()).collect()
        };
        shares(self.devices, self.processes).map(command).collect()
    }
}

/// Starts a process of this program, and tells it the run's `key`.
///
/// Call it from a thread that lives as long as the run: the kernel ends a child that ends with its parent when the
/// thread that started it ends.
///
/// # Errors
/// If it cannot be started.
pub fn spawn(arguments: &[String], key: Option<Secret>, threads: Threads) -> anyhow::Result<Child> {
    let program = std::env::current_exe().context("cannot find the reveille program itself")?;
    let mut command = Command::new(program);
    if threads == Threads::One && !are_threads_said() {
        command.env(THREADS, ONE_THREAD);
    }
    if let Some(key) = key {
        command.env(key::VARIABLE, key.to_string());
    }
    Ok(command
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        // Ctrl-C in the terminal is for the parent, which tells the children.
        .process_group(0)
        .spawn()?)
}

/// Begins this process anew with one thread for zenoh, unless somebody has said which it is to have. zenoh looks at the
/// environment alone, which a process cannot change for itself. Returns if there is nothing to do, or it is impossible.
pub fn with_one_thread() {
    if are_threads_said() {
        return;
    }
    let mut arguments = std::env::args_os();
    let name = arguments.next();
    let Ok(program) = std::env::current_exe() else { return };
    let mut command = Command::new(&program);
    command.arg0(name.unwrap_or_else(|| program.into_os_string()));
    let error = command.args(arguments).env(THREADS, ONE_THREAD).exec();
    tracing::debug!(%error, "zenoh has the threads that it has by default");
}

/// Whether somebody has said which threads zenoh is to have. It cannot read an empty setting.
fn are_threads_said() -> bool {
    std::env::var_os(THREADS).is_some_and(|set| !set.is_empty())
}

/// How many devices each of `processes` processes carries: as even as possible, never none.
fn shares(devices: u32, processes: u32) -> impl Iterator<Item = u32> {
    let processes = processes.clamp(1, devices.max(1));
    (0..processes).map(move |i| devices / processes + u32::from(i < devices % processes))
}

/// Whether a child of this process may have ended that nobody has looked at: one question for all of them.
pub fn has_one_ended() -> bool {
    let options = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
    !matches!(waitid(WaitId::All, options), Ok(None))
}

/// Ties this process to the one that started it: when the `parent` ends, however that is, this one is sent `signal`.
///
/// # Errors
/// If the parent has ended already, or the kernel refuses.
pub fn die_with(parent: i32, signal: Signal) -> anyhow::Result<()> {
    rustix::process::set_parent_process_death_signal(Some(signal)).context("cannot tie this process to its parent")?;
    let is_ours = rustix::process::getppid().map(Pid::as_raw_pid) == Some(parent);
    anyhow::ensure!(is_ours, "the process that started this one has ended");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_even_and_complete() {
        let all = |devices, processes| shares(devices, processes).collect::<Vec<_>>();
        assert_eq!(all(50, 4), [13, 13, 12, 12]);
        assert_eq!(all(3, 8), [1, 1, 1]);
        assert_eq!(all(7, 1), [7]);
    }
}
