//! `reveille testbed up`: starts the containers, applies the schedule of faults, waits for the end and copies the
//! results. The clock pauses before the TTI of each fault, so that a fault takes effect there at any speed; pauses do
//! not change the digest. After an interruption, the same command resumes the run.

use std::collections::{BTreeSet, VecDeque};
use std::fs::{File, TryLockError};
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use indicatif::ProgressBar;

use super::compose::{RESULTS_FOLDER, write_compose};
use super::container::Container;
use super::docker::{Docker, LOG_LINES, POLL_INTERVAL, Project, shorten_clock};
use super::faults::{Fault, ScheduledFault};
use super::model::Testbed;
use super::placement::{BS_SERVICE, DASHBOARD_SERVICE};
use super::results::{check_digest, copy_results};
use crate::cli::TestbedUpArgs;
use crate::display::{RUN_BAR, count_noun, new_bar, note, print_stdout, shell_word};
use crate::exit::{ExitReason, Interrupted};
use crate::signals::{SignalMode, Signals};

/// Longest wait for the address of the dashboard before the devices start.
const DASHBOARD_PATIENCE: Duration = Duration::from_secs(20);

/// Runs a testbed.
pub(super) fn run(args: &TestbedUpArgs) -> anyhow::Result<ExitCode> {
    let testbed = Testbed::load(&args.testbed.path)?;
    ensure!(
        !args.detach || testbed.faults.is_empty(),
        "--detach: only a running `testbed up` can apply the schedule; leave out --detach, or remove the faults from \
         testbed.toml"
    );
    let status = format!("`reveille testbed status {}` shows it", shell_word(&testbed.folder));
    let _lock = lock_folder(&testbed.folder, &status)?;
    let docker = Docker::find()?;
    let project = Project::of(&testbed);
    docker.check_image(&testbed.config.image)?;
    docker.check_owner(&project)?;
    let signals = Signals::install(SignalMode::StopsContainers)?;
    write_compose(&testbed).context("cannot write the files of the testbed")?;
    docker.end_left_faults(&testbed, &project)?;
    let mut driver = Driver::start(&docker, &testbed, &project, &signals)?;
    let folder = shell_word(&testbed.folder);
    if args.detach && !signals.has_arrived() {
        note!("started; `reveille testbed status {folder}` shows it, `… results {folder}` copies the results");
        return Ok(ExitReason::Done.into());
    }
    let exit_code = driver.drive_to_end();
    let bs = driver.finish();
    let exit_code = exit_code?;
    let services = testbed.services();
    // The dashboard shows a complete run until `down`.
    let is_stopped = |service: &&str| exit_code != Some(0) || *service != DASHBOARD_SERVICE;
    let stopped = services.iter().map(String::as_str).filter(is_stopped);
    docker.compose(&project, &["stop"].into_iter().chain(stopped).collect::<Vec<_>>())?;
    let Some(exit_code) = exit_code else {
        let text =
            format!("interrupted; continue with `reveille testbed up {folder}`, or remove with `… down {folder}`");
        return Err(Interrupted(text.into()).into());
    };
    if exit_code != 0 {
        let log = docker.last_log_lines(&bs, LOG_LINES)?;
        bail!(
            "the base station ended with exit code {exit_code}:\n{log}\n`reveille testbed logs {folder} bs` prints the \
             whole log; `… down` removes the run"
        );
    }
    let results = copy_results(&docker, &testbed)?;
    // The base station names the folder in its container.
    let printed = docker.results_printed_by(&bs)?;
    let inner_folder = format!("{RESULTS_FOLDER}/{}", project.name);
    let in_command = format!("misses {inner_folder}");
    let printed = printed.replace(&in_command, &format!("misses {}", shell_word(&results)));
    print_stdout(&(printed.replace(&inner_folder, &results.display().to_string()) + "\n"))?;
    if args.check {
        check_digest(&testbed, &results)?;
    }
    Ok(ExitReason::Done.into())
}

/// Locks the folder of a testbed until the returned file is closed, also by the death of this process.
///
/// # Errors
/// If another `testbed up` or `testbed down` has locked it. The error ends with `fix`.
pub(super) fn lock_folder(folder: &Path, fix: &str) -> anyhow::Result<File> {
    let file = File::open(folder).with_context(|| folder.display().to_string())?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => bail!(
            "{}: another `reveille testbed up` or `down` has locked this testbed; {fix}",
            folder.display()
        ),
        Err(TryLockError::Error(error)) => Err(error).with_context(|| folder.display().to_string()),
    }
}

/// A testbed that runs.
struct Driver<'a> {
    docker: &'a Docker,
    testbed: &'a Testbed,
    project: &'a Project,
    signals: &'a Signals,
    bar: ProgressBar,
    bs: Container,
    /// The last known start of the base station.
    bs_started_at: String,
    /// The faults to come.
    schedule: VecDeque<&'a ScheduledFault>,
    /// The ends of faults to come, with their times.
    restorations: Vec<(Instant, Fault)>,
    /// Containers whose failure was reported.
    reported: BTreeSet<String>,
    /// The dashboard, until its address is printed.
    starting_dashboard: Option<Container>,
}

impl<'a> Driver<'a> {
    /// Starts the base station, sets the clock to pause at the first fault, and starts the other containers.
    fn start(
        docker: &'a Docker,
        testbed: &'a Testbed,
        project: &'a Project,
        signals: &'a Signals,
    ) -> anyhow::Result<Self> {
        let bar = new_bar(testbed.scenario.run.ttis, RUN_BAR, false);
        bar.set_message("starting the base station");
        docker.start_bs(testbed, project)?;
        let mut driver = Self {
            docker,
            testbed,
            project,
            signals,
            bar,
            bs: docker.container(project, BS_SERVICE)?,
            bs_started_at: String::new(),
            schedule: testbed.faults.iter().collect(),
            restorations: Vec::new(),
            reported: BTreeSet::new(),
            starting_dashboard: None,
        };
        // A complete run only prints its digest again; it needs no devices.
        if driver.wait_for_clock()? {
            // Before the devices, whose run can be over within a second.
            driver.start_dashboard()?;
            driver.wait_for_dashboard();
            driver.bar.set_message(format!(
                "starting {}",
                count_noun(testbed.containers.len(), "container")
            ));
            docker.compose_up(project, &["--remove-orphans"])?;
        }
        Ok(driver)
    }

    /// Starts a new dashboard, if the testbed has one: the certificates of an earlier one are not valid any more.
    fn start_dashboard(&mut self) -> anyhow::Result<()> {
        if !self.testbed.config.dashboard {
            return Ok(());
        }
        let options = ["--no-deps", "--force-recreate", DASHBOARD_SERVICE];
        self.docker.compose_up(self.project, &options)?;
        self.starting_dashboard = Some(self.docker.container(self.project, DASHBOARD_SERVICE)?);
        Ok(())
    }

    /// Waits until the new dashboard serves, but not for ever.
    fn wait_for_dashboard(&mut self) {
        let began = crate::runtime::now();
        while self.starting_dashboard.is_some() && began.elapsed() < DASHBOARD_PATIENCE && !self.signals.has_arrived() {
            self.report_dashboard();
            std::thread::sleep(POLL_INTERVAL);
        }
    }

    /// Prints the address of a new dashboard once it serves.
    fn report_dashboard(&mut self) {
        let url = |dashboard: &mut Container| self.docker.dashboard_url(dashboard);
        if let Some(url) = self.starting_dashboard.as_mut().and_then(url) {
            note!("dashboard at {url}");
            self.starting_dashboard = None;
        }
    }

    /// Waits until the clock of the base station has the first target. Returns false if the run is over, or after a
    /// signal.
    fn wait_for_clock(&mut self) -> anyhow::Result<bool> {
        while !self.signals.has_arrived() {
            let state = self.docker.bs_state(&self.bs)?;
            if state.status == "exited" {
                return Ok(false);
            }
            if let Some((_, tti)) = self.clock_status() {
                self.bs_started_at = state.started_at;
                while let Some(ScheduledFault { tti, fault }) = self.schedule.pop_front_if(|fault| fault.tti < tti) {
                    note!("TTI {tti}: {fault}: skipped, since the run has passed this TTI");
                }
                if self.set_target().is_ok() {
                    return Ok(true);
                }
            }
            std::thread::sleep(POLL_INTERVAL);
        }
        Ok(false)
    }

    /// Lets the clock run to the next fault, or to the end.
    fn set_target(&self) -> anyhow::Result<()> {
        let tti = self.schedule.front().map(|fault| fault.tti.to_string());
        let command = tti.as_deref().map_or(vec!["resume"], |tti| vec!["run-to", tti]);
        self.docker.clock(&self.bs, &command).map(drop)
    }

    /// The clock's status line and TTI; `None` while the base station does not answer.
    fn clock_status(&self) -> Option<(String, u64)> {
        let line = self.docker.clock(&self.bs, &["status"]).ok()?;
        let tti = tti_of_status(&line)?;
        Some((line, tti))
    }

    /// Applies the faults until the base station has ended. Returns its exit code, `None` after a signal.
    fn drive_to_end(&mut self) -> anyhow::Result<Option<u8>> {
        let mut has_target = true;
        let services = self.testbed.services();
        while !self.signals.has_arrived() {
            let state = self.docker.bs_state(&self.bs)?;
            if state.status == "exited" {
                return Ok(Some(state.exit_code));
            }
            if state.started_at != self.bs_started_at {
                // A restarted base station does not know the target of the earlier one.
                self.bs_started_at = state.started_at;
                has_target = false;
            }
            if let Some((line, tti)) = self.clock_status() {
                self.bar.set_position(tti);
                self.bar.set_message(shorten_clock(&line, &services));
                // It can be later than scheduled: after a restart of the base station, or after `clock resume`.
                let is_due =
                    |fault: &ScheduledFault| tti > fault.tti || (tti == fault.tti && line.starts_with("paused"));
                while let Some(scheduled) = self.schedule.pop_front_if(|fault| is_due(fault)) {
                    self.apply(tti, scheduled)?;
                    has_target = false;
                }
                // `clock resume` and other commands of users replace the target.
                let runs_past = |fault: &ScheduledFault| stop_of_status(&line).is_none_or(|stop| stop > fault.tti);
                let next_is_missed = self.schedule.front().is_some_and(|fault| runs_past(fault));
                has_target &= !(line.starts_with("running") && next_is_missed);
            }
            if !has_target {
                // The base station may be about to restart.
                has_target = self.set_target().is_ok();
            }
            self.report_dashboard();
            self.end_due_faults(crate::runtime::now());
            self.report_failures()?;
            std::thread::sleep(POLL_INTERVAL);
        }
        Ok(None)
    }

    /// Reports each container that has failed by itself, such as one with an image of another version.
    fn report_failures(&mut self) -> anyhow::Result<()> {
        for container in self.docker.containers(self.project)? {
            if let Some(code) = container.failure()
                && self.reported.insert(container.service.clone())
            {
                let log = self.docker.last_log_lines(&container, "1")?;
                note!("{} ended with exit code {code}: {log}", container.service);
            }
        }
        Ok(())
    }

    fn apply(&mut self, tti: u64, scheduled: &ScheduledFault) -> anyhow::Result<()> {
        let fault = &scheduled.fault;
        self.docker.apply(self.testbed, self.project, fault)?;
        if tti == scheduled.tti {
            note!("TTI {tti}: {fault}");
        } else {
            note!("TTI {tti}: {fault}, late: scheduled for TTI {}", scheduled.tti);
        }
        if let Some(duration) = fault.duration {
            self.restorations
                .push((crate::runtime::now() + duration, fault.restoration()));
        }
        Ok(())
    }

    /// Ends the faults whose time is over at `now`.
    fn end_due_faults(&mut self, now: Instant) {
        for (_, restoration) in self.restorations.extract_if(.., |(time, _)| *time <= now) {
            match self.docker.end_fault(self.testbed, self.project, &restoration) {
                Ok(()) => note!("{restoration}"),
                Err(error) => tracing::warn!("{error:#}"),
            }
        }
    }

    /// Ends all faults that have an end, since a frozen container cannot be stopped, and removes the progress bar.
    /// Returns the container of the base station.
    fn finish(mut self) -> Container {
        for (time, _) in &mut self.restorations {
            *time = crate::runtime::now();
        }
        self.end_due_faults(crate::runtime::now());
        self.bar.finish_and_clear();
        self.bs
    }
}

/// Returns the TTI in a line of `clock status`, such as `paused before TTI 9 of 60`.
fn tti_of_status(line: &str) -> Option<u64> {
    let (_, rest) = line.split_once("TTI ")?;
    rest.split([' ', ',', ';']).next()?.parse().ok()
}

/// Returns the TTI before which the clock stops, in a line such as `running at TTI 9 of 60, to stop before TTI 12`.
fn stop_of_status(line: &str) -> Option<u64> {
    tti_of_status(line.split_once("to stop before ")?.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_line_has_the_tti() {
        for (line, tti) in [
            ("running at TTI 12 of 400", Some(12)),
            ("paused before TTI 400 of 400", Some(400)),
            (
                "joining before TTI 0 of 400, 20 of 50 devices so far; then paused",
                Some(0),
            ),
            ("no run", None),
        ] {
            assert_eq!(tti_of_status(line), tti, "{line}");
        }
        for (line, stop) in [
            ("running at TTI 12 of 400", None),
            ("running at TTI 12 of 400, to stop before TTI 15", Some(15)),
        ] {
            assert_eq!(stop_of_status(line), stop, "{line}");
        }
    }

    #[test]
    fn only_one_program_runs_a_testbed() {
        let folder = std::env::temp_dir().join(format!("reveille-lock-{}", std::process::id()));
        std::fs::create_dir(&folder).expect("writable");
        let lock = lock_folder(&folder, "").expect("free");
        let refusal = lock_folder(&folder, "end it").expect_err("locked").to_string();
        let expected = "another `reveille testbed up` or `down` has locked this testbed; end it";
        assert!(refusal.ends_with(expected), "{refusal}");
        drop(lock);
        lock_folder(&folder, "").expect("free again");
        std::fs::remove_dir(&folder).expect("ours");
    }
}
