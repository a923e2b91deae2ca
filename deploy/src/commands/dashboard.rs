//! `reveille dashboard`: a live or recorded run in the browser, served by the module `dashboard`. `up --dashboard`
//! serves the same page without this command. Tests wait for the note `dashboard at`, read the address up to the end
//! of its line, and rely on handlers of signals installed before it. Readers copy the line, so nothing may follow the
//! address.

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, bail};
use reveille_bs::scenario::compare_scenarios;
use reveille_common::bus::Role;
use reveille_common::message::Frame;
use reveille_view::compare::{RunComparison, RunSide};

use super::inspect::live::Live;
use super::inspect::source::{device_groups, open_recording};
use crate::cli::DashboardArgs;
use crate::dashboard::feed::{ComparedRun, Feed, FeedOrigin};
use crate::dashboard::serve;
use crate::display::note;
use crate::exit::ExitReason;
use crate::metrics_server::check_can_listen;
use crate::signals::{SignalMode, Signals};

/// Serves the page until Ctrl-C. A recording is read whole before its page is served.
pub(crate) async fn run(args: &DashboardArgs) -> anyhow::Result<ExitCode> {
    check_can_listen("--listen", &args.listen)?;
    match &args.file {
        Some(path) => serve_recording(path, args).await?,
        None => serve_live(args).await?,
    }
    Ok(ExitReason::Done.into())
}

/// Returns a feed with the recording at `path`, up to the first damage, next to the run `compared`. Passes every frame
/// that can be read to `on_frame`.
fn feed_from_recording(
    path: &Path,
    compared: Option<ComparedRun>,
    mut on_frame: impl FnMut(&Frame),
) -> anyhow::Result<Arc<Feed>> {
    let path_text = || path.display().to_string();
    let mut recording = open_recording(path)?;
    let scenario = recording.bundle().load().with_context(path_text)?;
    let feed = Feed::new(
        recording.run(),
        &scenario,
        device_groups(&scenario),
        FeedOrigin::Recording(path),
        compared,
    );
    let mut is_empty = true;
    let read_error = loop {
        match recording.next_frame() {
            Ok(Some(frame)) => {
                is_empty = false;
                on_frame(&frame);
                feed.apply(frame);
            }
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
    };
    if is_empty {
        let cause = read_error.map_or_else(String::new, |error| format!(": it {error}"));
        bail!("{}: the recording holds no messages{cause}", path_text());
    }
    if let Some(error) = read_error {
        let reason = format!("{}: {error}; the messages before this point are shown", path_text());
        note!("{reason}");
        feed.mark_broken(reason);
    }
    feed.end();
    Ok(feed)
}

/// Reads the optional recording at `path` to compare with, and returns it with the text of its scenario file. Its
/// `fields` are empty until [`add_scenario_differences`] fills them.
fn read_compared(path: Option<&Path>) -> anyhow::Result<Option<(ComparedRun, String)>> {
    let Some(path) = path else { return Ok(None) };
    let option = || format!("--compare {}", path.display());
    let scenario_text = open_recording(path).with_context(option)?.bundle().text.clone();
    let mut comparison = RunComparison::default();
    let feed = feed_from_recording(path, None, |frame| comparison.push(RunSide::Other, frame)).with_context(option)?;
    // A recording that was cut short cannot be compared beyond its end.
    if feed.is_whole() {
        comparison.end(RunSide::Other);
    }
    let compared = ComparedRun {
        feed,
        fields: Vec::new(),
        comparison,
    };
    Ok(Some((compared, scenario_text)))
}

/// Adds the fields in which the compared scenario differs from `scenario_text`, the scenario file of the shown run.
fn add_scenario_differences(
    compared: Option<(ComparedRun, String)>,
    scenario_text: &str,
) -> anyhow::Result<Option<ComparedRun>> {
    let Some((compared, compared_scenario_text)) = compared else {
        return Ok(None);
    };
    let fields = compare_scenarios(scenario_text, &compared_scenario_text)
        .context("the scenario of the recording or of --compare")?;
    Ok(Some(ComparedRun { fields, ..compared }))
}

async fn serve_recording(path: &Path, args: &DashboardArgs) -> anyhow::Result<()> {
    let scenario_text = open_recording(path)?.bundle().text.clone();
    let compared = add_scenario_differences(read_compared(args.compare.as_deref())?, &scenario_text)?;
    let feed = feed_from_recording(path, compared, |_| {})?;
    // Installed after the recording is read: until then the default action ends the program.
    let signals = Signals::install(SignalMode::HasNoResults)?;
    let dashboard = serve(&args.listen, feed, None).await?;
    note!("dashboard at {}\npress Ctrl-C to end", dashboard.url);
    signals.wait_for_first().await;
    Ok(())
}

async fn serve_live(args: &DashboardArgs) -> anyhow::Result<()> {
    // Read before connecting: frames that arrive during a long read could be lost.
    let compared = read_compared(args.compare.as_deref())?;
    let mut live = Live::connect(&args.target, &[Role::Operator, Role::Observer]).await?;
    let bundle = live.bundle().await?;
    let scenario = bundle.load()?;
    let compared = add_scenario_differences(compared, &bundle.text)?;
    let catch_up = live.start_catch_up(&bundle).await?;
    live.report_position();
    let feed = Feed::new(
        &live.run_name,
        &scenario,
        device_groups(&scenario),
        FeedOrigin::OtherRun,
        compared,
    );
    let dashboard = serve(&args.listen, Arc::clone(&feed), Some(live.bus())).await?;
    note!("dashboard at {}\npress Ctrl-C to end", dashboard.url);
    let feed_handle = feed.open()?;
    let reachability_feed = Arc::clone(&feed);
    live.wait_for_lost_bs(move |is_reachable| reachability_feed.set_reachable(is_reachable));
    live.follow(catch_up, |frame| feed_handle.send(frame)).await?;
    // The last handle: its drop ends the feed, so that the page shows the end.
    drop(feed_handle);
    let signals = live.signals();
    if live.has_ended() && !signals.has_arrived() {
        let ending = live
            .check_ran_to_end()
            .map_or_else(|error| error.to_string(), |()| "the run has ended".to_owned());
        note!("{ending}; its messages are shown until Ctrl-C");
        signals.wait_for_first().await;
    }
    Ok(())
}
