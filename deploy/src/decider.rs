//! Who decides for a run from outside, as the command line says; a policy process that it starts by `--policy-command`,
//! and ends with itself.

use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, ensure};
use reveille_bs::host::{Decisions, Progress};
use reveille_bs::policy::outside;
use reveille_common::bus::Bus;
use reveille_common::scenario::Scenario;
use reveille_common::secret::Secret;
use reveille_lab::inputs::Inputs;
use rustix::process::{Pid, Signal, kill_process_group};

use crate::cli::{DriveArgs, OnUndecidedArg, OutsideArgs};
use crate::display::note;
use crate::wall::now;
use crate::{key, local};

/// The variable that says where the base station listens.
const CONNECT: &str = "REVEILLE_CONNECT";
/// The variable that names the run.
const RUN: &str = "REVEILLE_RUN";
/// Time between two looks at the process.
const LOOK: Duration = Duration::from_millis(20);
/// How long it may take to end when it is told to.
const LEAVE: Duration = Duration::from_secs(2);

/// Who decides for a run from outside.
pub struct Deciding<'a> {
    /// What was decided, and how somebody is asked.
    pub decisions: Decisions,
    /// What is started to decide.
    command: Option<&'a str>,
}

/// Who decides in a run of `scenario`: nobody outside, what was `given` of an earlier run, or who answers at the policy
/// port.
///
/// # Errors
/// The options mean nothing here, or what was given cannot be gone through on the bus.
pub fn deciding<'a>(scenario: &Scenario, given: Option<Inputs>, drive: &'a DriveArgs) -> anyhow::Result<Deciding<'a>> {
    let OutsideArgs {
        policy_command,
        decision_timeout,
        on_undecided,
    } = &drive.outside;
    let is_asked = outside::is_external(&scenario.policy) && given.is_none();
    let is_tuned = decision_timeout.is_some() || *on_undecided != OnUndecidedArg::End;
    ensure!(
        is_asked || (policy_command.is_none() && !is_tuned),
        "--policy-command, --decision-timeout and --on-undecided are for a run whose policy asks another program: add \
         --policy external"
    );
    let Inputs { outages, decisions } = given.unwrap_or_default();
    ensure!(
        outages.is_empty(),
        "the log names devices that were lost, which does not happen again on the bus; replay it with `reveille run`"
    );
    Ok(Deciding {
        decisions: Decisions {
            kept: decisions,
            before: 0,
            port: is_asked.then(|| (&drive.outside).into()),
        },
        command: policy_command.as_deref(),
    })
}

impl Deciding<'_> {
    /// Starts the command that decides for the run on `bus` that has this `key`, if there is one; else says where it is
    /// to be decided, if it is and the run `is_quiet` not.
    ///
    /// # Errors
    /// It cannot be started.
    pub fn start(
        &self,
        bus: &Bus,
        key: Option<Secret>,
        progress: &Arc<Progress>,
        is_quiet: bool,
    ) -> anyhow::Result<Option<PolicyProcess>> {
        if let Some(command) = self.command {
            return PolicyProcess::start(command, bus, key, progress).map(Some);
        }
        if self.decisions.port.is_some() && !is_quiet {
            let (port, endpoint) = (bus.keys().policy(), local::reachable(bus.endpoint()));
            note!("asking for decisions at {port} of {endpoint}");
        }
        Ok(None)
    }
}

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
    /// `progress` is told that the run must end, and why.
    ///
    /// # Errors
    /// It cannot be started.
    fn start(command: &str, bus: &Bus, key: Option<Secret>, progress: &Arc<Progress>) -> anyhow::Result<Self> {
        let mut shell = Command::new("/bin/sh");
        shell
            .args(["-c", command])
            .env(CONNECT, bus.endpoint())
            .env(RUN, bus.keys().run().to_string())
            .stdin(Stdio::null())
            // Its results are on the standard output of the run, and nobody else's.
            .stdout(std::io::stderr())
            // A key that ends the run ends the process in its turn.
            .process_group(0);
        if let Some(key) = key {
            shell.env(key::VARIABLE, key.to_string());
        }
        let child = shell.spawn().context("cannot start a shell for --policy-command")?;
        let is_over = Arc::new(AtomicBool::new(false));
        let is_left = Arc::new(AtomicBool::new(false));
        let charge = Charge {
            child,
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
}

impl PolicyProcess {
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

/// A policy process, and those that it has started.
struct Charge {
    child: Child,
    command: String,
    is_over: Arc<AtomicBool>,
    is_left: Arc<AtomicBool>,
}

impl Charge {
    fn look_after(mut self, progress: &Progress) {
        self.watch(progress);
        // What it has started and left behind.
        let _gone = kill_process_group(Pid::from_child(&self.child), Signal::KILL).is_err();
        let _reaped = self.child.wait().is_err();
    }

    /// Until it has ended, or has been told to and does not.
    fn watch(&mut self, progress: &Progress) {
        while !self.is_left.load(Ordering::Relaxed) {
            if let Ok(Some(status)) = self.child.try_wait() {
                if !self.is_over.load(Ordering::Relaxed) {
                    let why = format!("the policy process `{}` ended with {status}", self.command);
                    // The first cause is the one that counts.
                    let _told_before = progress.cause.set(why).is_err();
                    progress.stop.store(true, Ordering::Relaxed);
                }
                return;
            }
            std::thread::sleep(LOOK);
        }
        if !self.has_ended_within(LEAVE) {
            let _gone = kill_process_group(Pid::from_child(&self.child), Signal::TERM).is_err();
            self.has_ended_within(LEAVE);
        }
    }

    fn has_ended_within(&mut self, patience: Duration) -> bool {
        let begun = now();
        while begun.elapsed() < patience {
            if !matches!(self.child.try_wait(), Ok(None)) {
                return true;
            }
            std::thread::sleep(LOOK);
        }
        false
    }
}
