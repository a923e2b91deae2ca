//! `reveille clock`: pause, step and resume a run.

use std::process::ExitCode;
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::keys::Kind;
use reveille_common::message::{ClockCommand, ClockStatus};

use crate::cli::ClockArgs;
use crate::{display, local};

const PATIENCE: Duration = Duration::from_secs(5);

/// Sends one command to a run's clock and prints where it is.
pub async fn run(args: &ClockArgs) -> anyhow::Result<ExitCode> {
    let (endpoint, run) = local::find(&args.target)?;
    let bus = Bus::connect(&endpoint, run, PATIENCE).await?;
    let command = ClockCommand::from(args.command);
    let status: Option<ClockStatus> = bus.ask(bus.keys().of(Kind::Control), &command, PATIENCE).await?;
    let Some(status) = status else {
        return Err(bus.no_run().await.into());
    };
    let ClockStatus {
        tti,
        ttis,
        paused,
        until,
        begun,
    } = status;
    if let ClockCommand::RunTo(k) = command
        && !(tti.0..=ttis).contains(&k.0)
    {
        anyhow::bail!("TTI {k} cannot be run to: the next is TTI {tti}, and the run ends before TTI {ttis}");
    }
    match (paused, until.0 < ttis) {
        (_, _) if !begun && paused => display::out(&format!(
            "before TTI 0 of {ttis}, waiting for devices to join; then paused\n"
        ))?,
        (_, _) if !begun => display::out(&format!("before TTI 0 of {ttis}, waiting for devices to join\n"))?,
        (true, _) => display::out(&format!("paused before TTI {tti} of {ttis}\n"))?,
        (false, true) => display::out(&format!("running at TTI {tti} of {ttis}, to stop before TTI {until}\n"))?,
        (false, false) => display::out(&format!("running at TTI {tti} of {ttis}\n"))?,
    }
    bus.close().await;
    Ok(ExitCode::SUCCESS)
}
