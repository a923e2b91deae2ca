//! `reveille`: the command line of the emulator. `cli` declares the commands and their options, `commands` executes
//! them, `bench` measures, `dashboard` serves the page. The other modules are services for them: `run_folder` for the
//! files of a run, `audit` for its replay, `display` for output, `signals` for a clean end. Start with `commands::run`
//! (in memory) and `commands::bs` (over the bus).

#![deny(
    clippy::print_stderr,
    reason = "`eprintln!` panics when standard error is closed; `note!` does not"
)]

mod action_text;
mod audit;
mod bench;
#[cfg(feature = "tls")]
mod certificate;
mod child_process;
mod cli;
mod commands;
mod dashboard;
mod display;
mod exit;
mod file_limits;
mod folder_lock;
mod input_log;
mod key;
mod metrics_server;
mod paths;
mod policy_process;
mod policy_source;
mod recording;
mod results_table;
mod resume_mark;
mod run_folder;
mod run_reader;
mod run_registry;
mod run_tables;
mod run_watchers;
mod runtime;
mod saved_address;
mod scenario_files;
mod signals;
mod start_limiter;
mod summary;
mod supervisor;
mod table_writer;
mod terminal;
mod tls;

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

use cli::misplaced::explain_misplaced;
use cli::{Cli, Command};
use display::note;
use reveille_common::bus::RefusalLog;
use runtime::{CLIENT_WORKERS, SERVER_WORKERS, drive};

fn main() -> ExitCode {
    exit::keep_panic_messages();
    let (args, rename_warnings) = cli::former::replace_former_names(std::env::args_os());
    let cli = Cli::try_parse_from(&args).unwrap_or_else(|error| explain_misplaced(error, Cli::command(), &args).exit());
    // Only a base station or router with certificates refuses peers in a way that it can name.
    let has_certificates = matches!(&cli.command, Command::Bs(args) if args.tls.is_some())
        || matches!(&cli.command, Command::Router(args) if args.tls.is_some());
    let refusals = has_certificates.then(RefusalLog::start).and_then(Result::ok);
    reveille_common::logging::init(cli.verbose, cli.log_format.into(), display::LogWriter, refusals);
    for warning in rename_warnings {
        tracing::warn!("{warning}");
    }
    match run(cli) {
        Ok(code) => code,
        Err(error) => {
            note!("reveille: {error:#}");
            exit::ExitReason::from_error(&error).into()
        }
    }
}

fn run(cli: Cli) -> anyhow::Result<ExitCode> {
    let log_options = cli.log_options();
    match cli.command {
        Command::Scenario(command) => commands::scenario::run(&command),
        Command::Run(mut args) => {
            let inputs = &mut [&mut args.actions.actions, &mut args.input_log];
            let done = commands::continued_run::resolve(&mut args.scenario, &mut args.output, inputs)?;
            done.map_or_else(|| commands::run::run(&args), Ok)
        }
        Command::Sweep(args) => commands::sweep::run(&args),
        Command::Train(command) => commands::train::run(&command),
        Command::Tune(args) => tune(&args),
        Command::Merge(args) => commands::merge::run(&args),
        Command::Up(mut args) => {
            let inputs = &mut [&mut args.actions.actions];
            let done = commands::continued_run::resolve(&mut args.scenario, &mut args.output, inputs)?;
            done.map_or_else(|| drive(SERVER_WORKERS, commands::up::run(&args, &log_options)), Ok)
        }
        Command::Bs(mut args) => {
            let inputs = &mut [&mut args.actions.actions];
            let done = commands::continued_run::resolve(&mut args.scenario, &mut args.output, inputs)?;
            done.map_or_else(|| drive(SERVER_WORKERS, commands::bs::run(&args)), Ok)
        }
        Command::Device(args) => {
            // Before any runtime or session: it replaces this process by one with another environment.
            if !args.untuned {
                child_process::restart_with_one_zenoh_thread();
            }
            drive(CLIENT_WORKERS, commands::device::run(&args))
        }
        Command::Router(args) => drive(CLIENT_WORKERS, commands::router::run(&args)),
        Command::Link(args) => drive(CLIENT_WORKERS, commands::link::run(&args)),
        Command::Testbed(args) => commands::testbed::run(&args),
        Command::PolicyProcess(args) => drive(CLIENT_WORKERS, policy_process::guard(&args.command, args.parent)),
        #[cfg(feature = "tls")]
        Command::Tls(command) => commands::tls::run(&command),
        #[cfg(not(feature = "tls"))]
        Command::Tls(_) => Err(tls::missing_feature().into()),
        Command::Inspect(command) => drive(CLIENT_WORKERS, commands::inspect::run(&command)),
        Command::Compare(args) => commands::compare::run(&args),
        Command::Dashboard(args) => drive(SERVER_WORKERS, commands::dashboard::run(&args)),
        Command::Clock(args) => drive(CLIENT_WORKERS, commands::clock::run(&args)),
        Command::Figures(args) => commands::figures::run(&args),
        Command::Report(args) => commands::report::run(&args),
        Command::Analyse(command) => commands::analyse::run(&command),
        Command::Bench(command) => bench::run(&command),
    }
}

#[cfg(feature = "tune")]
fn tune(args: &cli::TuneArgs) -> anyhow::Result<ExitCode> {
    commands::tune::run(args)
}

#[cfg(not(feature = "tune"))]
#[expect(clippy::unnecessary_wraps, reason = "as with the feature")]
fn tune(_: &cli::TuneArgs) -> anyhow::Result<ExitCode> {
    note!(
        "reveille: this build cannot tune, which needs the cargo feature tune; use `cargo run --release --features \
        tune -- tune …`"
    );
    Ok(exit::ExitReason::Usage.into())
}
