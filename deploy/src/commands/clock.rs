//! `reveille clock`: pause, step and resume a run, and act on it. The printed status is the text of `ClockStatus`
//! (`common/src/message/control.rs`), which `tests/src/process.rs` and `tests/chaos/bus_runs.py` parse.

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::message::{ActRequest, ClockCommand, ClockStatus};
use tokio::sync::Notify;

use crate::cli::ClockArgs;
use crate::display::{self, note};
use crate::exit::ExitReason;
use crate::run_registry;

/// Longest wait for the connection and for each reply.
const QUERY_TIMEOUT: Duration = Duration::from_secs(5);
/// Time between two queries while waiting for the clock.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Time that `clock pause` waits for the open TTI to close before it reports that it is still open, as its help states.
const PAUSE_TIMEOUT: Duration = Duration::from_secs(2);

/// Sends a command to a run's clock and prints its position.
pub(crate) async fn run(args: &ClockArgs) -> anyhow::Result<ExitCode> {
    let address = run_registry::find(&args.target)?;
    let bus = Bus::connect(&address.endpoint, address.run, QUERY_TIMEOUT)
        .await?
        .with_key(address.key);
    let command = match args.command.clock_command() {
        Ok(command) => command,
        // Not a failure: `clock act` has an action instead of a command.
        Err(action_args) => return act_on_run(bus, &ActRequest::from(action_args)).await,
    };
    let ended = Arc::new(Notify::new());
    let end_notifier = Arc::clone(&ended);
    let _watch = bus.watch_alive(bus.key_exprs().bs_liveliness(), move |_, alive| {
        if !alive {
            // `notify_one` keeps a permit: the liveliness token can disappear before anything waits for it.
            end_notifier.notify_one();
        }
    })?;
    let Some(status) = bus.query(&command, QUERY_TIMEOUT).await? else {
        return Err(bus.no_run_error().await.into());
    };
    // The clock ignores a TTI that is past or after the end; its status alone does not show that.
    if let ClockCommand::RunTo(k) = command
        && !(status.tti.0..=status.ttis).contains(&k.0)
    {
        let ClockStatus { tti, ttis, .. } = status;
        anyhow::bail!("run-to {k}: must be from {tti}, the next TTI, to {ttis}, the end of the run");
    }
    let wait_timeout = if args.command.waits() {
        Some(Duration::MAX)
    } else {
        (command == ClockCommand::Pause).then_some(PAUSE_TIMEOUT)
    };
    let status_text = match wait_timeout {
        Some(timeout) => wait_for_target(&bus, &ended, status, timeout).await?,
        None => status.to_string(),
    };
    display::print_stdout(&format!("{status_text}\n"))?;
    bus.close().await;
    Ok(ExitReason::Done.into())
}

/// Sends an action and prints the TTI in which it takes effect.
async fn act_on_run(bus: Bus, request: &ActRequest) -> anyhow::Result<ExitCode> {
    let Some(tti) = bus.query(request, QUERY_TIMEOUT).await? else {
        return Err(bus.no_run_error().await.into());
    };
    // Without `at`, its text names only the changes.
    let changes = ActRequest {
        at: None,
        ..request.clone()
    };
    display::print_stdout(&format!("TTI {tti}: {changes}\n"))?;
    bus.close().await;
    Ok(ExitReason::Done.into())
}

/// Waits until the clock reaches the target, the TTI `until` in `reply`, the answer to the command. Returns the status
/// to print, at the latest after polls for `timeout`; the time of the queries does not count.
///
/// # Errors
/// If the clock stops or the run ends before the target, or the base station does not answer.
async fn wait_for_target(bus: &Bus, ended: &Notify, reply: ClockStatus, timeout: Duration) -> anyhow::Result<String> {
    let (target, ttis) = (reply.stop_before, reply.ttis);
    let mut status = reply;
    let (mut polled_time, mut has_noted_loss) = (Duration::ZERO, false);
    loop {
        if status.paused && status.tti < target {
            anyhow::bail!("{status}: another command paused the clock before TTI {target}");
        }
        // Another command can have sent the clock beyond the target.
        if status.paused || status.tti > target || polled_time >= timeout {
            return Ok(status.to_string());
        }
        if !status.lost.is_empty() && !has_noted_loss {
            note!("{status}");
            has_noted_loss = true;
        }
        let next_reply = tokio::select! {
            () = ended.notified() => None,
            next_reply = async {
                tokio::time::sleep(POLL_INTERVAL).await;
                bus.query(&ClockCommand::Status, QUERY_TIMEOUT).await
            } => next_reply?,
        };
        polled_time += POLL_INTERVAL;
        let Some(next_status) = next_reply else {
            let last_tti = status.tti;
            if last_tti.0 >= ttis {
                return Ok(format!("finished: all {ttis} TTIs are done"));
            }
            // A target at the end of the run is reached by a run that has ended, even if no status showed it.
            anyhow::ensure!(
                target.0 >= ttis,
                "the run was interrupted or failed before TTI {target}; last seen at TTI {last_tti} of {ttis}"
            );
            return Ok(format!("the run has ended; last seen at TTI {last_tti} of {ttis}"));
        };
        status = next_status;
    }
}
