//! `reveille`: the command line of the emulator.

#![deny(
    clippy::print_stderr,
    reason = "`eprintln!` panics where nobody reads standard error any more; `note!` does not"
)]

mod bench;
mod claim;
mod cli;
mod commands;
mod dashboard;
mod decider;
mod display;
mod ending;
mod exit;
mod input_log;
mod inputs;
mod interrupt;
mod key;
mod launch;
mod launcher;
mod limits;
mod local;
mod marks;
mod muster;
mod paths;
mod policy_process;
mod recording;
mod results;
mod rows;
mod series;
mod shadow;
mod summary;
mod terminal;
mod wall;
mod watch;
mod web;

use std::process::ExitCode;

use clap::Parser;

use cli::{Cli, Command};
use display::note;
use wall::runtime;

fn main() -> ExitCode {
    let cli = Cli::parse();
    reveille_common::logging::init(cli.verbose, cli.log_format.into(), display::LogWriter);
    match run(cli) {
        Ok(code) => code,
        Err(error) => {
            note!("reveille: {error:#}");
            ending::of(&error).into()
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
        Command::Device(args) => {
            if !args.untuned {
                launch::with_one_thread();
            }
            runtime(1)?.block_on(commands::device::run(&args))
        }
        Command::PolicyProcess(args) => runtime(1)?.block_on(commands::policy_process::run(&args)),
        Command::Inspect(command) => runtime(1)?.block_on(commands::inspect::run(&command)),
        Command::Dashboard(args) => runtime(2)?.block_on(commands::dashboard::run(&args)),
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
    note!("reveille: this build has no optimiser; build one with `cargo run --release --features tune -- tune …`");
    Ok(exit::Exit::Usage.into())
}
