//! `reveille`: the command line of the emulator.

mod bench;
mod cli;
mod commands;
mod display;
mod interrupt;
mod launch;
mod local;
mod results;

use std::process::ExitCode;

use clap::Parser;
use reveille_bs::actor::BsError;

use cli::{Cli, Command};

/// The exit code of a run that Ctrl-C cut short, as shells have it.
const INTERRUPTED: u8 = 130;
/// The exit code for what this build cannot do, as for a command line that is wrong.
#[cfg(not(feature = "tune"))]
const NOT_BUILT: u8 = 2;

fn main() -> ExitCode {
    let cli = Cli::parse();
    reveille_common::logging::init(cli.verbose, cli.log_format.into(), display::LogWriter);
    match run(cli) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("reveille: {error:#}");
            let by_bs = error.downcast_ref::<BsError>().is_some_and(BsError::is_interruption);
            let in_memory = error.is::<commands::run::Interrupted>()
                || error.is::<commands::sweep::Interrupted>()
                || error.is::<commands::train::Interrupted>();
            if by_bs || in_memory {
                ExitCode::from(INTERRUPTED)
            } else {
                ExitCode::FAILURE
            }
        }
    }
}

fn run(cli: Cli) -> anyhow::Result<ExitCode> {
    let log = cli.log_options();
    match cli.command {
        Command::Scenario(command) => commands::scenario::run(&command),
        Command::Run(args) => commands::run::run(&args),
        Command::Sweep(args) => commands::sweep::run(&args),
        Command::Train(command) => commands::train::run(&command),
        Command::Tune(args) => tune(&args),
        Command::Merge(args) => commands::merge::run(&args),
        Command::Up(args) => runtime(2)?.block_on(commands::up::run(&args, &log)),
        Command::Bs(args) => runtime(2)?.block_on(commands::bs::run(&args)),
        Command::Device(args) => runtime(1)?.block_on(commands::device::run(&args)),
        Command::Inspect(command) => runtime(1)?.block_on(commands::inspect::run(&command)),
        Command::Clock(args) => runtime(1)?.block_on(commands::clock::run(&args)),
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
    eprintln!("reveille: this build has no optimiser; build one with `cargo run --release --features tune -- tune …`");
    Ok(ExitCode::from(NOT_BUILT))
}

#[expect(clippy::disallowed_methods, reason = "the command line reports how long things took")]
fn now() -> std::time::Instant {
    std::time::Instant::now()
}

/// zenoh needs a multi-thread runtime, even with one worker.
fn runtime(workers: usize) -> std::io::Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(workers)
        .enable_all()
        .build()
}
