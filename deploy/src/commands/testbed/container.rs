//! A container of a testbed, with its state for users and the actions that this state allows.

use std::path::Path;

use anyhow::{bail, ensure};

use super::faults::Fault;
use crate::cli::FaultKind;
use crate::display::shell_word;

/// Exit codes without a failure of the program: success, and the signals of faults and of compose.
const NO_FAILURES: [u8; 4] = [0, 130, 137, 143];

/// The phase of a container, the first word or words of its status.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// Its process runs.
    Running,
    /// Its process is frozen.
    Paused,
    /// The engine starts it again after its process has ended.
    Restarting,
    /// Its process has ended, and the engine does not start it again.
    Exited,
    /// It has not been started, or is being removed.
    Other,
}

/// A container of a project.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Container {
    pub id: String,
    pub service: String,
    /// Its state and for how long, such as `Up 5 seconds (healthy)`.
    pub status: String,
    /// Whether it is on a network.
    pub is_connected: bool,
}

impl Container {
    /// Its phase. No other code reads the words of a status.
    pub(super) fn phase(&self) -> Phase {
        match self.status.split(' ').next() {
            Some("Up") if self.status.contains("(Paused)") => Phase::Paused,
            Some("Up") => Phase::Running,
            Some("Restarting") => Phase::Restarting,
            Some("Exited") => Phase::Exited,
            _ => Phase::Other,
        }
    }

    /// Whether it has a process, frozen or not.
    pub(super) fn is_up(&self) -> bool {
        matches!(self.phase(), Phase::Running | Phase::Paused)
    }

    /// Whether its process has ended without an error, and the engine does not start it again.
    pub(super) fn is_complete(&self) -> bool {
        self.phase() == Phase::Exited && self.exit_code() == Some(0)
    }

    /// The exit code of its last process, if that failed other than by a fault or compose.
    pub(super) fn failure(&self) -> Option<u8> {
        self.exit_code().filter(|code| !NO_FAILURES.contains(code))
    }

    /// Whether its process failed, or does not answer the check of its health.
    pub(super) fn has_failed(&self) -> bool {
        self.failure().is_some() || self.status.contains("(unhealthy)")
    }

    /// Its state, for users.
    pub(super) fn state(&self) -> String {
        let cut_off = self.is_up() && !self.is_connected;
        format!("{}{}", self.status, if cut_off { ", disconnected" } else { "" })
    }

    /// Checks that it can be disturbed.
    pub(super) fn check_runs(&self, fault: &Fault) -> anyhow::Result<()> {
        let Self { service, status, .. } = self;
        ensure!(
            self.is_up(),
            "{fault}: {service} does not run ({status}); only running containers can be disturbed"
        );
        let needs_processes = matches!(fault.kind, FaultKind::Kill | FaultKind::Pause | FaultKind::Stop);
        ensure!(
            !needs_processes || self.phase() != Phase::Paused,
            "{fault}: {service} is paused; end that with `restore` first"
        );
        Ok(())
    }

    /// Checks that the base station in it can answer commands. `folder` is the folder of the testbed.
    ///
    /// # Errors
    /// If it does not run; the error has the command to use instead.
    pub(super) fn check_answers(&self, folder: &Path) -> anyhow::Result<()> {
        let (Self { service, status, .. }, folder) = (self, shell_word(folder));
        if self.phase() == Phase::Paused {
            bail!(
                "{service}: the container is paused; end that with `reveille testbed fault {folder} restore {service}`"
            );
        }
        ensure!(
            !self.is_complete(),
            "{service}: the run is over; `reveille testbed results {folder}` copies its results"
        );
        ensure!(
            self.phase() != Phase::Restarting,
            "{service}: the engine is starting the container again ({status}); repeat the command, or read \
             `reveille testbed logs {folder} {service}`"
        );
        ensure!(
            self.is_up(),
            "{service}: the container does not run ({status}); start it with `reveille testbed up {folder}`"
        );
        Ok(())
    }

    /// The exit code of its last process; `None` while one runs.
    pub(super) fn exit_code(&self) -> Option<u8> {
        let (_, rest) = self.status.split_once(" (")?;
        let (code, _) = rest.split_once(')')?;
        matches!(self.phase(), Phase::Exited | Phase::Restarting).then(|| code.parse().ok())?
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::testbed::placement::BS_SERVICE;

    #[test]
    fn a_base_station_that_cannot_answer_is_reported_with_the_fix() {
        for (status, error) in [
            ("Up 5 seconds (healthy)", ""),
            (
                "Up 2 minutes (Paused)",
                "bs: the container is paused; end that with `reveille testbed fault my restore bs`",
            ),
            (
                "Exited (0) 3 seconds ago",
                "bs: the run is over; `reveille testbed results my` copies its results",
            ),
            (
                "Exited (130) 2 hours ago",
                "bs: the container does not run (Exited (130) 2 hours ago); start it with `reveille testbed \
                 up my`",
            ),
            (
                "Created",
                "bs: the container does not run (Created); start it with `reveille testbed up my`",
            ),
            (
                "Restarting (0) 2 seconds ago",
                "bs: the engine is starting the container again (Restarting (0) 2 seconds ago); repeat the command, or \
                 read `reveille testbed logs my bs`",
            ),
            (
                "Restarting (1) 2 seconds ago",
                "bs: the engine is starting the container again (Restarting (1) 2 seconds ago); repeat the command, or \
                 read `reveille testbed logs my bs`",
            ),
        ] {
            let answer = container(status).check_answers(Path::new("my"));
            assert_eq!(answer.err().map(|error| error.to_string()).unwrap_or_default(), error);
        }
    }

    #[test]
    fn a_status_has_the_phase_and_the_exit_code_of_an_ended_process() {
        for (status, phase, exit_code) in [
            ("Up 5 seconds (healthy)", Phase::Running, None),
            ("Up 2 minutes (Paused)", Phase::Paused, None),
            ("Exited (0) 3 seconds ago", Phase::Exited, Some(0)),
            ("Restarting (0) 3 seconds ago", Phase::Restarting, Some(0)),
            ("Restarting (137) Less than a second ago", Phase::Restarting, Some(137)),
            ("Created", Phase::Other, None),
            ("", Phase::Other, None),
        ] {
            let container = container(status);
            assert_eq!(
                (container.phase(), container.exit_code()),
                (phase, exit_code),
                "{status}"
            );
            assert_eq!(container.is_complete(), status.starts_with("Exited (0)"), "{status}");
            assert!(!container.has_failed(), "{status}");
        }
        for status in [
            "Exited (1) 3 seconds ago",
            "Restarting (2) 3 seconds ago",
            "Up 9 minutes (unhealthy)",
        ] {
            assert!(container(status).has_failed(), "{status}");
        }
    }

    /// Returns the container of a base station with this status.
    fn container(status: &str) -> Container {
        Container {
            id: String::new(),
            service: BS_SERVICE.to_owned(),
            status: status.to_owned(),
            is_connected: true,
        }
    }
}
