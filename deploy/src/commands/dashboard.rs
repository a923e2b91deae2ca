//! `reveille dashboard`: a run in the browser, one that goes on or a recording.

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::Context;
use reveille_common::message::Frame;
use reveille_view::compare::{Comparison, Side, fields};

use super::inspect::live::Live;
use super::inspect::source::{groups, open};
use crate::cli::DashboardArgs;
use crate::dashboard::feed::{Beside, Feed};
use crate::dashboard::serve;
use crate::display::note;
use crate::exit::Exit;
use crate::web::can_listen;

/// Serves the page until Ctrl-C.
pub async fn run(args: &DashboardArgs) -> anyhow::Result<ExitCode> {
    can_listen("--listen", &args.listen)?;
    match &args.from {
        Some(path) => recorded(path, args).await?,
        None => live(args).await?,
    }
    Ok(Exit::Done.into())
}

/// The recording at `path`, all of it, where `see` sees every frame.
fn read(path: &Path, beside: Option<Beside>, mut see: impl FnMut(&Frame)) -> anyhow::Result<Arc<Feed>> {
    let named = || path.display().to_string();
    let mut recording = open(path)?;
    let scenario = recording.bundle().load().with_context(named)?;
    let feed = Feed::new(recording.run(), &scenario, groups(&scenario), false, beside);
    let torn = loop {
        match recording.next_frame() {
            Ok(Some(frame)) => {
                see(&frame);
                feed.take(frame);
            }
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
    };
    if let Some(error) = torn {
        let why = format!("{}: {error}; what is before is shown", named());
        note!("{why}");
        feed.tear(why);
    }
    feed.end();
    Ok(feed)
}

/// The recording at `path`, if a run is to be compared with one, and its scenario file.
fn beside(path: Option<&Path>) -> anyhow::Result<Option<(Beside, String)>> {
    let Some(path) = path else { return Ok(None) };
    let named = || format!("--compare {}", path.display());
    let scenario = open(path).with_context(named)?.bundle().scenario.clone();
    let mut comparison = Comparison::default();
    let feed = read(path, None, |frame| comparison.take(Side::Other, frame)).with_context(named)?;
    if feed.is_whole() {
        comparison.end(Side::Other);
    }
    let beside = Beside {
        feed,
        fields: Vec::new(),
        comparison,
    };
    Ok(Some((beside, scenario)))
}

/// The recording beside a run with the scenario file `scenario`.
fn matched(other: Option<(Beside, String)>, scenario: &str) -> anyhow::Result<Option<Beside>> {
    let Some((beside, other)) = other else { return Ok(None) };
    let fields = fields(scenario, &other).context("the scenario of a recording")?;
    Ok(Some(Beside { fields, ..beside }))
}

async fn recorded(path: &Path, args: &DashboardArgs) -> anyhow::Result<()> {
    let scenario = open(path)?.bundle().scenario.clone();
    let other = matched(beside(args.compare.as_deref())?, &scenario)?;
    let feed = read(path, other, |_| {})?;
    let listen = &args.listen;
    let dashboard = serve(listen, feed, None).await?;
    note!("the recording is shown at {}; Ctrl-C ends", dashboard.url);
    crate::interrupt::told().await?;
    Ok(())
}

async fn live(args: &DashboardArgs) -> anyhow::Result<()> {
    // Before the run is listened to, of which nothing is to be missed meanwhile.
    let other = beside(args.compare.as_deref())?;
    let mut live = Live::connect(&args.target).await?;
    let bundle = live.bundle().await?;
    let (scenario, other) = (bundle.load()?, matched(other, &bundle.scenario)?);
    let past = live.past(&bundle).await?;
    live.greet();
    let feed = Feed::new(&live.run, &scenario, groups(&scenario), true, other);
    let dashboard = serve(&args.listen, Arc::clone(&feed), Some(live.bus())).await?;
    note!("the run is shown at {}; Ctrl-C ends", dashboard.url);
    let hose = feed.open()?;
    live.follow(past, |frame| hose.take(frame)).await?;
    drop(hose);
    if live.has_ended() && !live.is_interrupted {
        let how = live
            .check_whole()
            .map_or_else(|why| why.to_string(), |()| "the run has ended".to_owned());
        note!("{how}; what was seen of it is shown until Ctrl-C");
        crate::interrupt::told().await?;
    }
    Ok(())
}
