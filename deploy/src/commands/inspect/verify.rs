//! `reveille inspect verify`: what a recording says that its run came to, from its messages alone.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::process::ExitCode;

use anyhow::{Context, bail};
use reveille_common::ids::Tti;
use reveille_common::score::Final;
use reveille_common::totals::Totals;
use reveille_view::replay::Replay;
use serde::Deserialize;

use super::source::open;
use crate::cli::VerifyArgs;
use crate::display::{count, out};
use crate::exit::Exit;

/// Goes through a recording.
pub fn run(args: &VerifyArgs) -> anyhow::Result<ExitCode> {
    let named = || args.file.display().to_string();
    let mut recording = open(&args.file)?;
    let summary = recording.summary().map(str::to_owned);
    let scenario = recording.bundle().load().with_context(named)?;
    let mut replay = Replay::new(&scenario);
    let mut frames = 0;
    let torn = loop {
        match recording.next_frame() {
            Ok(Some(frame)) => {
                let is_from_the_start = frames > 0 || frame.tti == Tti::ZERO;
                anyhow::ensure!(
                    is_from_the_start,
                    "{}: begins in TTI {}: what a run came to follows from all of its messages alone",
                    named(),
                    frame.tti
                );
                replay.take(&frame).with_context(named)?;
                frames += 1;
            }
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
    };
    let ttis = replay.ttis();
    let own = replay.finish();
    let said = format!(
        "{}: {}, TTIs 0 to {}, fit together",
        named(),
        count(frames, "message"),
        ttis.saturating_sub(1)
    );
    if let Some(error) = torn {
        out(&format!("{said}\n"))?;
        bail!("{}: {error}; there is no summary to compare with", named());
    }
    let Some(summary) = summary else {
        out(&format!("{said}\ndigest of these TTIs {}\n", own.digest))?;
        let why = if ttis < scenario.ttis {
            format!("the run was cut short, before TTI {}", scenario.ttis)
        } else {
            "it was recorded by another program than the run's, or its end was damaged".to_owned()
        };
        bail!("{}: there is no summary to compare with: {why}", named());
    };
    let summary: Told = serde_json::from_str(&summary).with_context(named)?;
    let metrics = compare(&own, ttis, &summary).with_context(named)?;
    out(&format!(
        "{said}\ndigest {}, as in the summary\n{metrics} metrics and all totals, as in the summary\n",
        own.digest
    ))?;
    Ok(Exit::Done.into())
}

/// What a summary says that follows from messages.
#[derive(Deserialize)]
struct Told {
    digest: String,
    ttis_done: u64,
    metrics: BTreeMap<String, Option<f64>>,
    totals: Totals,
}

/// Holds what the messages come to against the summary. Gives the number of metrics.
fn compare(own: &Final, ttis: u64, told: &Told) -> anyhow::Result<usize> {
    fn same<T: PartialEq + Debug>(what: &str, own: &T, told: &T) -> anyhow::Result<()> {
        anyhow::ensure!(
            own == told,
            "{what} is {own:?} by the messages, and {told:?} in the summary"
        );
        Ok(())
    }
    same("ttis_done", &ttis, &told.ttis_done)?;
    let rows = own.metrics.rows();
    for (name, value, _) in &rows {
        let value = Some(*value).filter(|value| !value.is_nan());
        same(name, &value, &told.metrics.get(*name).copied().flatten())?;
    }
    same("totals", &own.totals, &told.totals)?;
    same("digest", &own.digest.to_string(), &told.digest)?;
    Ok(rows.len())
}
