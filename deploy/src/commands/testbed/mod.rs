//! `reveille testbed`: a testbed of containers for a scenario. `config` is the file that users edit, `model` the
//! testbed with its containers, `compose` their file. `docker` drives the engine, and `up` runs a testbed to its end.
//! The other commands are here. A testbed's run has the digest of `reveille run` with the same scenario, whatever its
//! faults.

mod compose;
mod config;
mod container;
mod docker;
mod faults;
mod model;
mod placement;
mod program;
mod results;
#[cfg(test)]
mod tests;
mod up;

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context, ensure};

use self::compose::write_compose;
use self::config::{CONFIG_FILE, TestbedConfig};
use self::container::{Container, Phase};
use self::docker::{Docker, POLL_INTERVAL, Project, clock_in_foreground, shorten_clock};
use self::faults::Fault;
use self::model::{Testbed, devices_by_class};
use self::placement::{BS_SERVICE, DASHBOARD_SERVICE};
use self::results::{copy_results, is_complete};
use self::up::lock_folder;
use super::resolve_scenario::resolve_with_builtin_policy;
use crate::cli::{TestbedArgs, TestbedCommand, TestbedInitArgs};
use crate::display::{count_noun, note, print_stdout, shell_word};
use crate::exit::ExitReason;
use crate::run_folder::SCENARIO_FILE;
use crate::scenario_files::ScenarioFiles;
use crate::signals::{SignalMode, Signals};
use crate::terminal::shows_colours;

/// Executes a subcommand.
pub(crate) fn run(args: &TestbedArgs) -> anyhow::Result<ExitCode> {
    match &args.command {
        TestbedCommand::Init(args) => init(args)?,
        TestbedCommand::Up(args) => return up::run(args),
        TestbedCommand::Down(folder) => remove(&folder.path)?,
        TestbedCommand::Status(folder) => print_status(&Testbed::load(&folder.path)?)?,
        TestbedCommand::Logs {
            folder,
            container,
            follow,
        } => {
            let (docker, project) = find_project(folder)?;
            if let Some(service) = container {
                docker.container(&project, service)?;
            }
            let colours = (!shows_colours()).then_some("--no-color");
            let options = colours.into_iter().chain(follow.then_some("--follow"));
            let words = ["logs"].into_iter().chain(options).chain(container.as_deref());
            return docker.compose_in_foreground(&project, &words.collect::<Vec<_>>());
        }
        TestbedCommand::Clock { folder, args } => {
            let (docker, project) = find_project(folder)?;
            let bs = docker.container(&project, BS_SERVICE)?;
            bs.check_answers(folder)?;
            return clock_in_foreground(&bs, args);
        }
        TestbedCommand::Results(folder) => {
            let testbed = Testbed::load(&folder.path)?;
            let results = copy_results(&find_project(&testbed.folder)?.0, &testbed)?;
            print_stdout(&format!("results in {}\n", results.display()))?;
            if !is_complete(&results) {
                note!(
                    "the run is not complete, so the copy holds a part of it; repeat `reveille testbed results {}` \
                     after its end",
                    shell_word(&folder.path)
                );
            }
        }
        TestbedCommand::Fault {
            folder,
            kind,
            container,
            duration,
        } => {
            let testbed = Testbed::load(folder)?;
            let fault = Fault::new(*kind, container, *duration, &testbed.services()).map_err(anyhow::Error::msg)?;
            return disturb(&testbed, &fault);
        }
    }
    Ok(ExitReason::Done.into())
}

/// Writes a new testbed.
fn init(args: &TestbedInitArgs) -> anyhow::Result<()> {
    let scenario = resolve_with_builtin_policy(&args.scenario)?;
    let schedule_path = args.faults.as_deref().unwrap_or(Path::new(""));
    let schedule = match &args.faults {
        Some(path) => fs::read_to_string(path).with_context(|| format!("--faults {}", path.display()))?,
        None => String::new(),
    };
    let sizes: Vec<usize> = devices_by_class(&scenario).iter().map(Vec::len).collect();
    let config = TestbedConfig::new(args, &scenario, &sizes, &schedule)?;
    // Checked before anything is written.
    let testbed = Testbed::new(&args.out, config, scenario)?.with_schedule(schedule_path)?;
    let config_path = args.out.join(CONFIG_FILE);
    ensure!(
        !config_path.exists(),
        "{}: file exists; edit it, or choose another folder with --out",
        config_path.display()
    );
    let files = ScenarioFiles::read(&testbed.scenario)?;
    let write_all = || {
        fs::create_dir_all(&args.out)?;
        files.write(&args.out)?;
        fs::write(args.out.join(SCENARIO_FILE), files.to_toml(&testbed.scenario))?;
        write_compose(&testbed)?;
        fs::write(&config_path, testbed.config.to_toml())
    };
    write_all().with_context(|| format!("cannot write {}", args.out.display()))?;
    files.check(&args.out.join(SCENARIO_FILE), &testbed.scenario)?;
    let folder_name = args.out.file_name().unwrap_or_default().to_string_lossy();
    if testbed.config.name != folder_name {
        note!(
            "the name of the testbed is {}, since {folder_name:?} cannot name a compose project",
            testbed.config.name
        );
    }
    note!(
        "wrote {}: {} in {}; run it with `reveille testbed up {}`",
        config_path.display(),
        count_noun(testbed.scenario.run.devices, "device"),
        count_noun(testbed.containers.len(), "container"),
        shell_word(&args.out)
    );
    Ok(())
}

/// Returns the engine and the project of the testbed in `folder`, also if its scenario is invalid.
///
/// # Errors
/// If there is no engine, or the containers of this name belong to a testbed in another folder.
fn find_project(folder: &Path) -> anyhow::Result<(Docker, Project)> {
    let project = Project {
        folder: folder.to_owned(),
        name: TestbedConfig::read(folder)?.name,
    };
    let docker = Docker::find()?;
    docker.check_owner(&project)?;
    Ok((docker, project))
}

/// Removes the containers, the network and the volumes of the testbed in `folder`.
///
/// # Errors
/// If there is no engine, `folder` is not a testbed, or `testbed up` runs.
fn remove(folder: &Path) -> anyhow::Result<()> {
    let (docker, project) = match TestbedConfig::read(folder) {
        Ok(_) => find_project(folder)?,
        Err(error) => find_started(folder, error)?,
    };
    let again = shell_word(folder);
    let fix = format!("end it with Ctrl-C, then repeat `reveille testbed down {again}`");
    let _lock = lock_folder(folder, &fix)?;
    if !docker.is_there(&project)? {
        note!("{}: nothing to remove: the testbed has no containers", project.name);
        return Ok(());
    }
    docker.compose(&project, &["down", "--volumes", "--remove-orphans", "--timeout", "30"])?;
    note!(
        "removed the containers, the network and the volumes of {}",
        project.name
    );
    Ok(())
}

/// Returns the engine and the project whose containers were started from the testbed in `folder`, whose description
/// cannot be read because of `error`.
///
/// # Errors
/// `error`, if `folder` has no description or has started no containers.
fn find_started(folder: &Path, error: anyhow::Error) -> anyhow::Result<(Docker, Project)> {
    // The containers of other compose projects must not be removed.
    if !folder.join(CONFIG_FILE).exists() {
        return Err(error);
    }
    let docker = Docker::find()?;
    let Some(name) = docker.project_started_from(folder)? else {
        return Err(error);
    };
    note!("{error:#}; removing the containers that were started from this folder");
    let project = Project {
        folder: folder.to_owned(),
        name,
    };
    Ok((docker, project))
}

/// Prints the clock and all containers.
fn print_status(testbed: &Testbed) -> anyhow::Result<()> {
    let (docker, project) = find_project(&testbed.folder)?;
    let containers = docker.containers(&project)?;
    let bs = containers.iter().find(|container| container.service == BS_SERVICE);
    let clock = match bs {
        None => "not started".to_owned(),
        Some(bs) if bs.is_complete() => "the run is over".to_owned(),
        Some(bs) if bs.phase() == Phase::Exited => {
            let folder = shell_word(&testbed.folder);
            format!("stopped; continue with `reveille testbed up {folder}`")
        }
        Some(bs) => {
            let clock = docker.clock(bs, &["status"]);
            clock.unwrap_or_else(|_| "the base station does not answer".to_owned())
        }
    };
    let (memory, slow) = (
        docker.memory(&containers)?,
        docker.slow_containers(testbed, &containers)?,
    );
    let services = testbed.services();
    let mut text = format!("{}: {}\n", testbed.config.name, shorten_clock(&clock, &services));
    let width = services.iter().map(String::len).max().unwrap_or_default();
    for service in services {
        let container = containers.iter().find(|container| container.service == service);
        let mut state = container.map_or_else(|| "not created".to_owned(), Container::state);
        if container.is_some_and(|container| slow.contains(&container.id)) {
            state.push_str(", slow");
        }
        let memory = container.and_then(|container| memory.get(&container.id));
        let own = testbed.containers.iter().find(|other| other.service == service);
        let devices = own.map_or_else(String::new, |own| {
            let devices: u32 = own.ranges.iter().map(|range| range.count).sum();
            format!(
                "{}, {}",
                count_noun(devices, "device"),
                count_noun(own.ranges.len(), "host")
            )
        });
        let memory = memory.map_or("", String::as_str);
        text += format!("  {service:<width$}  {state:<24}  {devices:<21}  {memory}").trim_end();
        text.push('\n');
    }
    let dashboard = containers
        .iter()
        .find(|container| container.service == DASHBOARD_SERVICE);
    if let Some(url) = dashboard.and_then(|dashboard| docker.dashboard_url(dashboard)) {
        let _infallible = writeln!(text, "dashboard at {url}");
    } else if testbed.config.tls && !testbed.config.dashboard && bs.is_some_and(Container::is_up) {
        let _infallible = writeln!(
            text,
            "to watch: set `dashboard = true` in {CONFIG_FILE}, and repeat `testbed up`"
        );
    } else if !testbed.config.tls
        && let Some(port) = bs.and_then(|bs| docker.published_port(bs, "7447"))
    {
        let run = &testbed.config.name;
        let _infallible = writeln!(text, "to watch: reveille dashboard --connect tcp/{port} --run {run}");
    }
    print_stdout(&text)
}

/// Applies a fault, and ends it after its duration.
fn disturb(testbed: &Testbed, fault: &Fault) -> anyhow::Result<ExitCode> {
    let (docker, project) = find_project(&testbed.folder)?;
    let signals = Signals::install(SignalMode::HasNoResults)?;
    docker.apply(testbed, &project, fault)?;
    note!("{fault}");
    let Some(duration) = fault.duration else {
        if fault.halts_run() {
            let (folder, container) = (shell_word(&testbed.folder), &fault.container);
            note!("the run waits for {container} until `reveille testbed fault {folder} restore {container}`");
        }
        return Ok(ExitReason::Done.into());
    };
    let started = crate::runtime::now();
    while started.elapsed() < duration && !signals.has_arrived() {
        std::thread::sleep(POLL_INTERVAL.min(duration.saturating_sub(started.elapsed())));
    }
    let restore = fault.restoration();
    docker.end_fault(testbed, &project, &restore)?;
    note!("{restore}");
    Ok(ExitReason::Done.into())
}
