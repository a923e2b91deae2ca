//! `reveille clock`: pause, step and resume a run.

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::message::{ClockCommand, ClockStatus};
use tokio::sync::Notify;

use crate::cli::ClockArgs;
use crate::display::{self, note};
use crate::exit::ExitReason;
use crate::run_registry;

const PATIENCE: Duration = Duration::from_secs(5);
/// Time between two queries while waiting for the clock.
const LOOK: Duration = Duration::from_millis(20);
/// Time that `clock pause` waits for the open TTI to close before it reports that it is still open.
const CLOSING: Duration = Duration::from_secs(2);

/// Sends a command to a run's clock and prints its position.
pub(crate) async fn run(args: &ClockArgs) -> anyhow::Result<ExitCode> {
    let found = run_registry::find(&args.target)?;
    let bus = Bus::connect(&found.endpoint, found.run, PATIENCE)
        .await?
        .with_key(found.key);
    let ended = Arc::new(Notify::new());
    let bell = Arc::clone(&ended);
    let _watch = bus.watch_alive(bus.keys().bs_alive(), move |_, alive| {
        if !alive {
            // `notify_one` keeps a permit: the token can disappear before anything waits for the bell.
            bell.notify_one();
        }
    })?;
    let command = ClockCommand::from(args.command);
    let Some(status) = bus.query(&command, PATIENCE).await? else {
        return Err(bus.no_run_error().await.into());
    };
    // The clock ignores a TTI that is past or after the end; its status alone does not show that.
    if let ClockCommand::RunTo(k) = command
        && !(status.tti.0..=status.ttis).contains(&k.0)
    {
        let ClockStatus { tti, ttis, .. } = status;
        anyhow::bail!("run-to {k}: must be from {tti}, the next TTI, to {ttis}, the end of the run");
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
    display::print(&format!("{said}\n"))?;
    bus.close().await;
    Ok(ExitReason::Done.into())
}

/// Waits until the clock reaches the target in `first`, the answer to the command. Returns the status to print, at the
/// latest after `patience`.
///
/// # Errors
/// If the clock stops or the run ends before the target.
async fn reach(bus: &Bus, ended: &Notify, first: ClockStatus, patience: Duration) -> anyhow::Result<String> {
    let (target, ttis) = (first.until, first.ttis);
    let mut status = first;
    let (mut waited, mut is_told) = (Duration::ZERO, false);
    loop {
        if status.paused && status.tti < target {
            anyhow::bail!("{status}: another command paused the clock before TTI {target}");
        }
        // Another command can have sent the clock beyond the target.
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
                bus.query(&ClockCommand::Status, PATIENCE).await
            } => reply?,
        };
        waited += LOOK;
        let Some(now) = reply else {
            let seen = status.tti;
            if seen.0 >= ttis {
                return Ok(format!("finished: all {ttis} TTIs are done"));
            }
            // A target at the end of the run is reached by a run that has ended, even if no status showed it.
            anyhow::ensure!(
                target.0 >= ttis,
                "the run was interrupted or failed before TTI {target}; last seen at TTI {seen} of {ttis}"
            );
            return Ok(format!("the run has ended; last seen at TTI {seen} of {ttis}"));
        };
        status = now;
    }
}
