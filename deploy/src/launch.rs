//! Device processes as children of this one. None outlives it, however it ends.

use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::Context;
use reveille_common::secret::Secret;
use rustix::process::{Pid, Signal};

use crate::key;

/// What makes zenoh answer a tick with the fewest hand-overs between threads. Only for processes that carry devices.
const LEAF_RUNTIME: &str =
    "(rx:(handover:app),acc:(handover:app),tx:(handover:app),net:(handover:app),app:(worker_threads:1))";

/// How long child processes may take to leave by themselves.
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
            let child = spawn(&arguments, None).with_context(|| format!("cannot start process {number}"))?;
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

/// What each of `processes` processes is told that together carry `devices` devices of `run` at `endpoint`. `log` are
/// their options for logging.
pub fn device_commands(devices: u32, processes: u32, endpoint: &str, run: &str, log: &[String]) -> Vec<Vec<String>> {
    // In one argument, so that no name is taken for an option.
    let run = format!("--run={run}");
    let parent = std::process::id().to_string();
    let command = |count: u32| {
        let count = count.to_string();
        let own = [
            "device",
            "--connect",
            endpoint,
            &run,
            "--count",
            &count,
            "--parent",
            &parent,
        ];
        own.into_iter().map(str::to_owned).chain(log.iter().cloned()).collect()
    };
    shares(devices, processes).map(command).collect()
}

/// Starts a process of this program, and tells it the run's `key`.
///
/// Call it from a thread that lives as long as the run: the kernel ends a child that ends with its parent when the
/// thread that started it ends.
///
/// # Errors
/// If it cannot be started.
pub fn spawn(arguments: &[String], key: Option<Secret>) -> anyhow::Result<Child> {
    let program = std::env::current_exe().context("cannot find the reveille program itself")?;
    let mut command = Command::new(program);
    if let Some(key) = key {
        command.env(key::VARIABLE, key.to_string());
    }
    Ok(command
        .args(arguments)
        .env("ZENOH_RUNTIME", LEAF_RUNTIME)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        // Ctrl-C in the terminal is for the parent, which tells the children.
        .process_group(0)
        .spawn()?)
}

/// How many devices each of `processes` processes carries: as even as possible, never none.
fn shares(devices: u32, processes: u32) -> impl Iterator<Item = u32> {
    let processes = processes.clamp(1, devices.max(1));
    (0..processes).map(move |i| devices / processes + u32::from(i < devices % processes))
}

/// Ties this process to the one that started it: when the `parent` ends, however that is, this one is killed.
///
/// # Errors
/// If the parent has ended already, or the kernel refuses.
pub fn die_with(parent: i32) -> anyhow::Result<()> {
    rustix::process::set_parent_process_death_signal(Some(Signal::KILL))
        .context("cannot tie this process to its parent")?;
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
