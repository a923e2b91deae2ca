//! The container engine, through the command lines of Docker and of compose: v2 (`docker compose`), or 1.29
//! (`docker-compose`). Containers are found by the labels that both set. Errors tell how to repair the installation.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Output};
use std::time::Duration;

use anyhow::{Context, anyhow, bail, ensure};

use super::compose::{COMPOSE_FILE, NETWORK};
use super::container::{Container, Phase};
use super::faults::Fault;
use super::model::Testbed;
use super::placement::{BS_SERVICE, CERTIFICATES_SERVICE};
use super::program::{execute, execute_in_background, exit_code_in_foreground, explain_failure, text_of};
use crate::cli::FaultKind;
use crate::display::shell_word;

/// Time between two looks at the containers.
pub(super) const POLL_INTERVAL: Duration = Duration::from_millis(200);
/// Lines of a failed container's log that errors show.
pub(super) const LOG_LINES: &str = "5";
/// Longest wait until the engine has started a container again before a fault.
const RESTART_PATIENCE: Duration = Duration::from_secs(10);
/// Processor cores of a slow container.
const SLOW_CPUS: f64 = 0.05;

/// A compose project.
pub(super) struct Project {
    /// The folder with its `compose.yml`.
    pub folder: PathBuf,
    pub name: String,
}

impl Project {
    /// The project of `testbed`.
    pub(super) fn of(testbed: &Testbed) -> Self {
        Self {
            folder: testbed.folder.clone(),
            name: testbed.config.name.clone(),
        }
    }
}

/// The container of the base station at one moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct BsState {
    /// `running`, `restarting`, `exited` and so on.
    pub status: String,
    pub exit_code: u8,
    /// The time of its last start, which changes with each start.
    pub started_at: String,
}

/// The engine, which answers, and its compose command.
pub(super) struct Docker {
    compose: Vec<&'static str>,
}

impl Docker {
    /// Finds the engine and compose.
    ///
    /// # Errors
    /// If one is missing, or the engine does not answer.
    pub(super) fn find() -> anyhow::Result<Self> {
        let has = |command: &[&str]| execute(command).is_ok_and(|output| output.status.success());
        let docker = Self {
            compose: if has(&["docker", "compose", "version"]) {
                vec!["docker", "compose"]
            } else {
                vec!["docker-compose"]
            },
        };
        docker.run(&["version", "--format", "{{.Server.Version}}"])?;
        ensure!(
            docker.compose.len() > 1 || has(&["docker-compose", "version"]),
            "docker: neither `docker compose` nor docker-compose is installed; install the package \
             docker-compose-plugin or docker-compose"
        );
        Ok(docker)
    }

    /// Runs `docker ARGS`, and returns its output even if it fails.
    #[expect(clippy::unused_self, reason = "a `Docker` proves that the engine answers")]
    fn output(&self, args: &[&str]) -> anyhow::Result<Output> {
        execute(&[&["docker"], args].concat())
    }

    /// Runs `docker ARGS` and returns its standard output without the last line break.
    ///
    /// # Errors
    /// If it fails; explains usual causes.
    pub(super) fn run(&self, args: &[&str]) -> anyhow::Result<String> {
        let output = self.output(args)?;
        if output.status.success() {
            return Ok(text_of(&output.stdout));
        }
        Err(explain_failure(args[0], &text_of(&output.stderr)))
    }

    /// Runs a compose command of `project`.
    ///
    /// # Errors
    /// If it fails; holds its output.
    pub(super) fn compose(&self, project: &Project, args: &[&str]) -> anyhow::Result<()> {
        let output = execute_in_background(&mut self.compose_command(project, args))?;
        if output.status.success() {
            return Ok(());
        }
        Err(explain_failure(
            args[0],
            String::from_utf8_lossy(&output.stderr).trim_end(),
        ))
    }

    /// Starts containers of `project`, with these arguments of `compose up`.
    ///
    /// # Errors
    /// If it fails; holds its output and the last log lines of failed containers, since compose does not name causes.
    pub(super) fn compose_up(&self, project: &Project, args: &[&str]) -> anyhow::Result<()> {
        self.compose(project, &[&["up", "--detach"], args].concat())
            .map_err(|error| match self.failure_logs(project) {
                Ok(logs) => anyhow!("{error:#}{logs}"),
                Err(_) => error,
            })
    }

    /// The status and the last log lines of the containers that have failed.
    fn failure_logs(&self, project: &Project) -> anyhow::Result<String> {
        let mut text = String::new();
        for container in self
            .containers(project)?
            .iter()
            .filter(|container| container.has_failed())
        {
            let Container { service, status, .. } = container;
            let log = self.last_log_lines(container, LOG_LINES)?;
            let _infallible = write!(text, "\n{service}: {status}; its last log lines:\n{log}");
        }
        Ok(text)
    }

    /// Runs a compose command of `project` with this program's terminal.
    pub(super) fn compose_in_foreground(&self, project: &Project, args: &[&str]) -> anyhow::Result<ExitCode> {
        exit_code_in_foreground(&mut self.compose_command(project, args))
    }

    fn compose_command(&self, project: &Project, args: &[&str]) -> Command {
        let mut command = Command::new(self.compose[0]);
        command
            .args(&self.compose[1..])
            .args(["--project-name", &project.name, "--project-directory"])
            .arg(&project.folder)
            .arg("--file")
            .arg(project.folder.join(COMPOSE_FILE))
            .args(args);
        command
    }

    /// Starts the base station of `testbed`, after its certificates.
    ///
    /// # Errors
    /// If compose fails, or the image has no TLS.
    pub(super) fn start_bs(&self, testbed: &Testbed, project: &Project) -> anyhow::Result<()> {
        self.compose_up(project, &[BS_SERVICE]).map_err(|error| {
            let certificates = self.container(project, CERTIFICATES_SERVICE);
            if testbed.config.tls && certificates.is_ok_and(|container| container.exit_code() == Some(2)) {
                let image = &testbed.config.image;
                return anyhow!(
                    "image {image}: its Reveille has no TLS; build it with TLS (see deploy/docker/README.md), or set \
                     `tls = false` in testbed.toml"
                );
            }
            error
        })
    }

    /// Checks that the engine has the image, with a Reveille of this version.
    ///
    /// # Errors
    /// If it has not.
    pub(super) fn check_image(&self, image: &str) -> anyhow::Result<()> {
        let found = self.output(&["image", "inspect", image])?.status.success();
        ensure!(
            found,
            "image {image}: not found; build it in a clone of Reveille with `docker compose build bs`, or \
             without a registry with deploy/docker/build-prebuilt.sh (see deploy/docker/README.md), or name another \
             image in testbed.toml"
        );
        let own = format!("reveille {}", env!("CARGO_PKG_VERSION"));
        let version = self.run(&["run", "--rm", "--network=none", image, "--version"]);
        let version = version.map_err(|error| match format!("{error:#}") {
            text if text.contains("executable file not found") => {
                anyhow!("image {image}: it contains no Reveille; build it as deploy/docker/README.md explains")
            }
            text => anyhow!("image {image}: it cannot run `reveille --version`: {text}"),
        })?;
        let first_line = version.lines().next().unwrap_or_default();
        ensure!(
            first_line.starts_with(&own),
            "image {image}: it has {first_line:?}, and this program is {own}; build the image from the same version"
        );
        Ok(())
    }

    /// The containers of `project`, stopped ones too.
    pub(super) fn containers(&self, project: &Project) -> anyhow::Result<Vec<Container>> {
        let filter = format!("label=com.docker.compose.project={}", project.name);
        let form = "{{.ID}}\t{{.Label \"com.docker.compose.service\"}}\t{{.Status}}\t{{.Networks}}";
        let list = self.run(&["ps", "--all", "--filter", &filter, "--format", form])?;
        let parse = |line: &str| {
            let mut cells = line.split('\t').map(str::to_owned);
            Some(Container {
                id: cells.next()?,
                service: cells.next()?,
                status: cells.next()?,
                is_connected: !cells.next()?.is_empty(),
            })
        };
        Ok(list.lines().filter_map(parse).collect())
    }

    /// Checks that no testbed of another folder has the name of `project`.
    ///
    /// # Errors
    /// If one has.
    pub(super) fn check_owner(&self, project: &Project) -> anyhow::Result<()> {
        let filter = format!("label=com.docker.compose.project={}", project.name);
        let form = "{{.Label \"com.docker.compose.project.working_dir\"}}";
        let folders = self.run(&["ps", "--all", "--filter", &filter, "--format", form])?;
        let own = project.folder.canonicalize()?;
        let is_other = |folder: &&str| PathBuf::from(folder).canonicalize().is_ok_and(|folder| folder != own);
        match folders.lines().find(is_other) {
            Some(other) => bail!(
                "{}: containers of this name belong to {other}; change the name in testbed.toml, or remove them with \
                 `reveille testbed down {}`",
                project.name,
                shell_word(other)
            ),
            None => Ok(()),
        }
    }

    /// Whether `project` has containers, networks or volumes.
    pub(super) fn is_there(&self, project: &Project) -> anyhow::Result<bool> {
        let filter = format!("label=com.docker.compose.project={}", project.name);
        for kind in [&["ps", "--all"][..], &["network", "ls"], &["volume", "ls"]] {
            if !self
                .run(&[kind, &["--quiet", "--filter", &filter]].concat())?
                .is_empty()
            {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// The name of the project with a base station whose containers were started from `folder`; `None` without one.
    pub(super) fn project_started_from(&self, folder: &Path) -> anyhow::Result<Option<String>> {
        let Ok(own) = folder.canonicalize() else {
            return Ok(None);
        };
        let form = "{{.Label \"com.docker.compose.project\"}}\t{{.Label \"com.docker.compose.project.working_dir\"}}";
        let filter = format!("label=com.docker.compose.service={BS_SERVICE}");
        let list = self.run(&["ps", "--all", "--filter", &filter, "--format", form])?;
        let mut projects = list.lines().filter_map(|line| line.split_once('\t'));
        let found = projects.find(|(_, folder)| Path::new(folder).canonicalize().is_ok_and(|folder| folder == own));
        Ok(found.map(|(name, _)| name.to_owned()))
    }

    /// The container of a service.
    ///
    /// # Errors
    /// If it does not exist.
    pub(super) fn container(&self, project: &Project, service: &str) -> anyhow::Result<Container> {
        let containers = self.containers(project)?;
        if let Some(found) = containers.iter().find(|container| container.service == service) {
            return Ok(found.clone());
        }
        let mut services: Vec<&str> = containers.iter().map(|container| container.service.as_str()).collect();
        services.sort_unstable();
        if services.is_empty() {
            let folder = shell_word(&project.folder);
            bail!("{service}: no such container; start the testbed with `reveille testbed up {folder}`");
        }
        bail!("{service}: no such container; the testbed has {}", services.join(", "))
    }

    /// The container of a service, once the engine has started it again after a failure.
    ///
    /// # Errors
    /// If it does not exist.
    fn started_container(&self, project: &Project, service: &str) -> anyhow::Result<Container> {
        let began = crate::runtime::now();
        loop {
            let container = self.container(project, service)?;
            if container.phase() != Phase::Restarting || began.elapsed() > RESTART_PATIENCE {
                return Ok(container);
            }
            std::thread::sleep(POLL_INTERVAL);
        }
    }

    /// The state of the base station's container.
    pub(super) fn bs_state(&self, bs: &Container) -> anyhow::Result<BsState> {
        let form = "{{.State.Status}} {{.State.ExitCode}} {{.State.StartedAt}}";
        let text = self.run(&["inspect", "--format", form, &bs.id])?;
        let mut words = text.split(' ');
        let mut next = || words.next().unwrap_or_default().to_owned();
        Ok(BsState {
            status: next(),
            exit_code: next().parse().unwrap_or(1),
            started_at: next(),
        })
    }

    /// The results that the base station printed after its last start.
    pub(super) fn results_printed_by(&self, bs: &Container) -> anyhow::Result<String> {
        let started_at = self.bs_state(bs)?.started_at;
        self.run(&["logs", "--since", &started_at, &bs.id])
    }

    /// The last lines that a container has logged, without repetitions: a container that fails is started again.
    pub(super) fn last_log_lines(&self, container: &Container, count: &str) -> anyhow::Result<String> {
        let output = self.output(&["logs", "--tail", count, &container.id])?;
        let log = text_of(&output.stderr);
        let mut lines: Vec<&str> = log.lines().collect();
        lines.dedup();
        Ok(lines.join("\n"))
    }

    /// Runs `reveille clock ARGS` in the container of the base station, and returns its first line.
    ///
    /// # Errors
    /// If the clock does not answer or refuses.
    pub(super) fn clock(&self, bs: &Container, args: &[&str]) -> anyhow::Result<String> {
        let text = self.run(&[&["exec", &bs.id, "reveille", "clock"], args].concat())?;
        Ok(text.lines().next().unwrap_or_default().to_owned())
    }

    /// The ids of the containers that a fault slows down.
    pub(super) fn slow_containers(&self, testbed: &Testbed, containers: &[Container]) -> anyhow::Result<Vec<String>> {
        if containers.is_empty() {
            return Ok(Vec::new());
        }
        let ids = containers.iter().map(|container| container.id.as_str());
        let command = ["inspect", "--format", "{{.HostConfig.NanoCpus}}"];
        // A line for each container, in the order of the arguments.
        let list = self.run(&command.into_iter().chain(ids).collect::<Vec<_>>())?;
        let limits = containers.iter().zip(list.lines());
        let slow = limits.filter(|(container, limit)| is_slow(limit, testbed.declared_cpus(&container.service)));
        Ok(slow.map(|(container, _)| container.id.clone()).collect())
    }

    /// The address on this machine of a port of a container, while it runs.
    pub(super) fn published_port(&self, container: &Container, port: &str) -> Option<String> {
        let address = self.run(&["port", &container.id, port]).ok()?;
        address.lines().next().map(str::to_owned)
    }

    /// The address of the dashboard in a browser, with its token, once it serves.
    pub(super) fn dashboard_url(&self, dashboard: &Container) -> Option<String> {
        let log = self.last_log_lines(dashboard, "all").ok()?;
        let (_, token) = log
            .lines()
            .rfind(|line| line.starts_with("dashboard at "))?
            .split_once('#')?;
        let address = self.published_port(dashboard, "8464")?;
        Some(format!("http://{address}/#{token}"))
    }

    /// The memory of running containers, by id.
    pub(super) fn memory(&self, containers: &[Container]) -> anyhow::Result<BTreeMap<String, String>> {
        let running = containers.iter().filter(|container| container.is_up());
        let ids: Vec<&str> = running.map(|container| container.id.as_str()).collect();
        if ids.is_empty() {
            return Ok(BTreeMap::new());
        }
        let form = "{{.ID}}\t{{.MemUsage}}";
        let list = self.run(&[&["stats", "--no-stream", "--format", form][..], &ids].concat())?;
        let rows = list.lines().filter_map(|line| line.split_once('\t'));
        Ok(rows.map(|(id, memory)| (id.to_owned(), memory.to_owned())).collect())
    }

    /// Applies a fault now, without its end.
    ///
    /// # Errors
    /// If the container does not exist, or is not in a state for the fault.
    pub(super) fn apply(&self, testbed: &Testbed, project: &Project, fault: &Fault) -> anyhow::Result<()> {
        let container = self.started_container(project, &fault.container)?;
        let id = container.id.as_str();
        let network = format!("{}_{NETWORK}", project.name);
        if fault.kind != FaultKind::Restore {
            container.check_runs(fault)?;
        }
        let result = match fault.kind {
            FaultKind::Kill => return self.kill_processes(&container),
            FaultKind::Pause => self.run(&["pause", id]),
            FaultKind::Disconnect => self.run(&["network", "disconnect", "--force", &network, id]),
            FaultKind::Slow => {
                let cpus = slow_cpus(testbed.declared_cpus(&container.service));
                self.run(&["update", "--cpus", &cpus.to_string(), id])
            }
            FaultKind::Stop => self.run(&["stop", id]),
            FaultKind::Restore => {
                // Only a fault ends a container while the base station runs.
                let is_over = self.container(project, BS_SERVICE)?.phase() == Phase::Exited;
                let Container { service, status, .. } = &container;
                ensure!(
                    !is_over || container.phase() != Phase::Exited,
                    "{fault}: {service} has ended ({status}) like the base station; `reveille testbed up` starts both"
                );
                return self.restore(testbed, &network, &container);
            }
        };
        result.map(drop).with_context(|| fault.to_string())
    }

    /// Ends a fault whose duration is over. A container that ended with the run stays as it is.
    ///
    /// # Errors
    /// If the engine cannot restore the container.
    pub(super) fn end_fault(&self, testbed: &Testbed, project: &Project, restoration: &Fault) -> anyhow::Result<()> {
        let has_ended =
            |service: &str| -> anyhow::Result<bool> { Ok(self.container(project, service)?.phase() == Phase::Exited) };
        if has_ended(BS_SERVICE)? && has_ended(&restoration.container)? {
            return Ok(());
        }
        self.apply(testbed, project, restoration)
    }

    /// Kills all processes in a container except its first one, which ends with them. The engine restarts a container
    /// after that, but not after `docker kill`.
    fn kill_processes(&self, container: &Container) -> anyhow::Result<()> {
        let output = self.output(&["exec", &container.id, "/bin/sh", "-c", "kill -s KILL -- -1"])?;
        // The shell survives its own signal, but can be killed with the container.
        if matches!(output.status.code(), Some(0 | 137)) {
            return Ok(());
        }
        Err(explain_failure("exec", &text_of(&output.stderr)))
    }

    /// Ends the faults that a killed `testbed up` left. Containers that have ended stay as they are.
    ///
    /// # Errors
    /// If the engine fails.
    pub(super) fn end_left_faults(&self, testbed: &Testbed, project: &Project) -> anyhow::Result<()> {
        let network = format!("{}_{NETWORK}", project.name);
        for container in self.containers(project)? {
            if container.is_up() {
                self.restore(testbed, &network, &container)?;
            }
        }
        Ok(())
    }

    /// Ends the effects of faults on a container.
    fn restore(&self, testbed: &Testbed, network: &str, container: &Container) -> anyhow::Result<()> {
        let id = container.id.as_str();
        let form = "{{.State.Status}} {{.HostConfig.NanoCpus}} {{json .NetworkSettings.Networks}}";
        let state = self.run(&["inspect", "--format", form, id])?;
        let (status, rest) = state.split_once(' ').unwrap_or_default();
        let (nano_cpus, networks) = rest.split_once(' ').unwrap_or_default();
        if status == "paused" {
            self.run(&["unpause", id])?;
        }
        if !networks.contains(&format!("\"{network}\"")) {
            // Without the alias the other containers would not find it.
            self.run(&["network", "connect", "--alias", &container.service, network, id])?;
        }
        if status == "exited" {
            self.run(&["start", id])?;
        }
        let cpus = testbed.declared_cpus(&container.service);
        if is_slow(nano_cpus, cpus) {
            // The engine cannot remove a limit; all cores have the same effect.
            let cpus = cpus.map_or_else(
                || self.run(&["info", "--format", "{{.NCPU}}"]),
                |cpus| Ok(cpus.to_string()),
            );
            self.run(&["update", "--cpus", &cpus?, id])?;
        }
        Ok(())
    }
}

/// The smallest limit of processor cores that the engine accepts.
const LEAST_CPUS: f64 = 0.01;

/// The limit of processor cores under the fault `slow`: at most half of the `declared` limit.
fn slow_cpus(declared: Option<f64>) -> f64 {
    declared.map_or(SLOW_CPUS, |cpus| SLOW_CPUS.min(cpus / 2.0).max(LEAST_CPUS))
}

/// Whether a limit of processor cores, in billionths, is the one of the fault `slow`, and not the `declared` limit.
fn is_slow(nano_cpus: &str, declared: Option<f64>) -> bool {
    let is_limit = |cpus: f64| format!("{:.0}", cpus * 1e9) == nano_cpus;
    is_limit(slow_cpus(declared)) && !declared.is_some_and(is_limit)
}

/// Runs `reveille clock ARGS` in the container of the base station, with this program's terminal.
///
/// # Errors
/// If `docker` cannot be started.
pub(super) fn clock_in_foreground(bs: &Container, args: &[String]) -> anyhow::Result<ExitCode> {
    let mut command = Command::new("docker");
    command.args(["exec", &bs.id, "reveille", "clock"]).args(args);
    exit_code_in_foreground(&mut command)
}

/// Shortens a line of `clock status`: names the containers among `services` with lost hosts, not each host.
pub(super) fn shorten_clock(line: &str, services: &[String]) -> String {
    let Some((state, hosts)) = line.split_once(": lost ") else {
        return line.to_owned();
    };
    let is_lost =
        |service: &&String| hosts.contains(&format!(" on {service} (")) || hosts.contains(&format!(" on {service})"));
    let lost: Vec<&str> = services.iter().filter(is_lost).map(String::as_str).collect();
    format!("{state}: lost {}", lost.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_container_at_its_declared_limit_is_not_slow() {
        for (nano_cpus, declared, is_expected) in [
            ("0", None, false),
            ("50000000", None, true),
            ("50000000", Some(0.5), true),
            ("500000000", Some(0.5), false),
            ("50000000", Some(0.05), false),
            ("10000000", Some(0.01), false),
        ] {
            assert_eq!(is_slow(nano_cpus, declared), is_expected, "{nano_cpus} {declared:?}");
        }
        let slow_texts = [None, Some(0.5), Some(0.01)].map(|declared| slow_cpus(declared).to_string());
        assert_eq!(slow_texts, ["0.05", "0.05", "0.01"]);
    }
}
