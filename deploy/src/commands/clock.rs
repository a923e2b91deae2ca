//! `reveille clock`: pause, step and resume a run.

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::message::{ClockCommand, ClockStatus};
use tokio::sync::Notify;

use crate::cli::ClockArgs;
use crate::display::{self, note};
use crate::exit::Exit;
use crate::local;

const PATIENCE: Duration = Duration::from_secs(5);
/// Time between two looks at a clock that is waited for.
const LOOK: Duration = Duration::from_millis(20);
/// How long `clock pause` waits for the TTI in work to be closed, before it says that it is not.
const CLOSING: Duration = Duration::from_secs(2);

/// Sends one command to a run's clock and prints where it is.
pub async fn run(args: &ClockArgs) -> anyhow::Result<ExitCode> {
    let found = local::find(&args.target)?;
    let bus = Bus::connect(&found.endpoint, found.run, PATIENCE)
        .await?
        .with_key(found.key);
    let ended = Arc::new(Notify::new());
    let bell = Arc::clone(&ended);
    let _watch = bus.watch_alive(bus.keys().bs_alive(), move |_, alive| {
        if !alive {
            bell.notify_one();
        }
    })?;
    let command = ClockCommand::from(args.command);
    let Some(status) = bus.ask(&command, PATIENCE).await? else {
        return Err(bus.no_run().await.into());
    };
    if let ClockCommand::RunTo(k) = command
        && !(status.tti.0..=status.ttis).contains(&k.0)
    {
        let ClockStatus { tti, ttis, .. } = status;
        anyhow::bail!("TTI {k} cannot be run to: the next is TTI {tti}, and the run ends before TTI {ttis}");
    }
    let wait = if args.command.waits() {
        Some(Duration::MAX)
    } else {
        (command == ClockCommand::Pause).then_some(CLOSING)
    };
    let said = match wait {
        Some(patience) => reach(&bus, &ended, status, patience).await?,
        None => status.to_string(),
    };
    display::out(&format!("{said}\n"))?;
    bus.close().await;
    Ok(Exit::Done.into())
}

/// Waits until the clock stands where `first`, the answer to the command, says that it will stop. Gives what there is
/// to say then, or after `patience`.
///
/// # Errors
/// If it stops before that, or the run ends before that.
async fn reach(bus: &Bus, ended: &Notify, first: ClockStatus, patience: Duration) -> anyhow::Result<String> {
    let (target, ttis) = (first.until, first.ttis);
    let mut status = first;
    let (mut waited, mut is_told) = (Duration::ZERO, false);
    loop {
        if status.paused && status.tti < target {
            anyhow::bail!("{status}, short of TTI {target}: another command has stopped the clock");
        }
        if status.paused || status.tti > target || waited >= patience {
            return Ok(status.to_string());
        }
        if !status.lost.is_empty() && !is_told {
            note!("{status}");
            is_told = true;
        }
        let reply = tokio::select! {
            () = ended.notified() => None,
            reply = async {
                tokio::time::sleep(LOOK).await;
                bus.ask(&ClockCommand::Status, PATIENCE).await
            } => reply?,
        };
        waited += LOOK;
        let Some(now) = reply else {
            let seen = status.tti;
            if seen.0 >= ttis {
                return Ok(format!("the run has ended: all {ttis} TTIs are done"));
            }
            anyhow::ensure!(
                target.0 >= ttis,
                "the run ended before TTI {target}: it was interrupted or has failed; last seen at TTI {seen} of {ttis}"
            );
            return Ok(format!("the run has ended; last seen at TTI {seen} of {ttis}"));
        };
        status = now;
    }
}
