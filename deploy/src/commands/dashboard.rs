//! `reveille dashboard`: a run in the browser, one that goes on or a recording.

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::Context;

use super::inspect::live::Live;
use super::inspect::source::{groups, open};
use crate::cli::DashboardArgs;
use crate::dashboard::feed::Feed;
use crate::dashboard::serve;
use crate::display::note;
use crate::exit::Exit;

/// Serves the page until Ctrl-C.
pub async fn run(args: &DashboardArgs) -> anyhow::Result<ExitCode> {
    match &args.from {
        Some(path) => recorded(path, &args.listen).await?,
        None => live(args).await?,
    }
    Ok(Exit::Done.into())
}

async fn recorded(path: &Path, listen: &str) -> anyhow::Result<()> {
    let named = || path.display().to_string();
    let mut recording = open(path)?;
    let scenario = recording.bundle().load().with_context(named)?;
    let feed = Feed::new(recording.run(), &scenario, groups(&scenario).as_deref(), false);
    let torn = loop {
        match recording.next_frame() {
            Ok(Some(frame)) => feed.take(frame),
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
    };
    feed.end();
    if let Some(error) = torn {
        note!("{}: {error}; what is before is shown", named());
    }
    let dashboard = serve(listen, feed, None).await?;
    note!("the recording is shown at {}; Ctrl-C ends", dashboard.url);
    crate::interrupt::told().await?;
    Ok(())
}

async fn live(args: &DashboardArgs) -> anyhow::Result<()> {
    let mut live = Live::connect(&args.target).await?;
    let scenario = live.bundle().await?.load()?;
    live.greet();
    let feed = Feed::new(&live.run, &scenario, groups(&scenario).as_deref(), true);
    let dashboard = serve(&args.listen, Arc::clone(&feed), Some(live.bus())).await?;
    note!("the run is shown at {}; Ctrl-C ends", dashboard.url);
    let hose = feed.open()?;
    while let Some((frames, _)) = live.next().await {
        for frame in frames {
            hose.take(frame);
        }
    }
    drop(hose);
    if live.has_ended() {
        note!("the run has ended; what was seen of it is shown until Ctrl-C");
        crate::interrupt::told().await?;
    }
    Ok(())
}
