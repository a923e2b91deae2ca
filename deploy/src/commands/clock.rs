//! `reveille clock`: pause, step and resume a run, and act on it. The printed status is the text of `ClockStatus`
//! (`common/src/message/control.rs`), which `tests/src/process.rs` and `tests/chaos/bus_runs.py` parse.

use std::collections::BTreeSet;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use reveille_common::bus::{Bus, Role};
use reveille_common::ids::Tti;
use reveille_common::message::{
    ActRequest, ClockCommand, ClockStatus, DescribeRequest, InputLogPart, InputLogRequest, OperatorAction,
};
use reveille_lab::external_inputs;
use reveille_view::recording::ScenarioBundle;
use tokio::sync::Notify;

use crate::action_text::describe_change;
use crate::cli::{ActArgs, ClockArgs};
use crate::display::{self, count_noun, note};
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
    let bus = address
        .connect(&[Role::Operator, Role::Observer], QUERY_TIMEOUT)
        .await?;
    let command = match args.command.clock_command() {
        Ok(command) => command,
        // Not a failure: `clock act` has an action instead of a command.
        Err(action_args) => return act_on_run(bus, action_args).await,
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
        None => status_text(&status, args.command.lists_hosts()),
    };
    display::print_stdout(&format!("{status_text}\n"))?;
    bus.close().await;
    Ok(ExitReason::Done.into())
}

/// Formats `status`, with a line for each host if `lists_hosts`.
fn status_text(status: &ClockStatus, lists_hosts: bool) -> String {
    let listed = status.hosts.iter().filter(|_| lists_hosts);
    let lines = listed.map(|host| format!("\n  {host}{}", if host.is_lost { " (lost)" } else { "" }));
    status.to_string() + &lines.collect::<String>()
}

/// Sends an action, and the one that ends it if it has a duration, and prints the TTIs in which they take effect.
async fn act_on_run(bus: Bus, args: &ActArgs) -> anyhow::Result<ExitCode> {
    let tti = send_action(&bus, &ActRequest::from(args)).await?;
    if let Some(revival) = args.revival(tti) {
        send_action(&bus, &revival).await?;
    }
    bus.close().await;
    Ok(ExitReason::Done.into())
}

/// Sends an action, prints the TTI in which it takes effect, and returns it.
async fn send_action(bus: &Bus, request: &ActRequest) -> anyhow::Result<Tti> {
    // Without the earlier actions, the answer does not tell on which devices the action has no effect.
    let (earlier_actions, device_count) = read_actions(bus).await.unwrap_or_default();
    let Some(tti) = bus.query(request, QUERY_TIMEOUT).await? else {
        return Err(bus.no_run_error().await.into());
    };
    let mut failed = BTreeSet::new();
    for action in earlier_actions.iter().filter(|action| action.tti <= tti) {
        describe_change(&action.change, device_count, &mut failed);
    }
    let changes = request.changes.iter();
    let changes: Vec<String> = changes
        .map(|change| describe_change(change, device_count, &mut failed))
        .collect();
    display::print_stdout(&format!("TTI {tti}: {}\n", changes.join(", ")))?;
    Ok(tti)
}

/// Reads the actions in the input log of the run, in the order in which they take effect, and its number of devices.
async fn read_actions(bus: &Bus) -> anyhow::Result<(Vec<OperatorAction>, u32)> {
    let description = bus.query(&DescribeRequest, QUERY_TIMEOUT).await?;
    let scenario = ScenarioBundle::from(description.context("the run has ended")?).load()?;
    let mut log = Vec::new();
    loop {
        let from = log.len() as u64;
        let part = bus.query(&InputLogRequest { from }, QUERY_TIMEOUT).await?;
        let bytes = part.context("the run has ended")?.bytes;
        log.extend_from_slice(&bytes);
        // A part shorter than the limit ends the log.
        if (bytes.len() as u64) < InputLogPart::MAX_BYTES {
            break;
        }
    }
    let mut actions = Vec::new();
    if !log.is_empty() {
        actions = external_inputs::parse_actions(&String::from_utf8_lossy(&log), &scenario)?;
    }
    actions.sort_by_key(|action| action.tti);
    Ok((actions, scenario.run.devices))
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
        if status.lost_hosts().next().is_some() && !has_noted_loss {
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
                return Ok(format!("finished after {}", count_noun(ttis, "TTI")));
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
