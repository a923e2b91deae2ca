//! `reveille inspect verify`: recomputes the results of a recorded run from its messages alone.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::process::ExitCode;

use anyhow::{Context, bail};
use reveille_common::ids::Tti;
use reveille_common::score::FinalScore;
use reveille_common::totals::Totals;
use reveille_view::reconstruction::Reconstruction;
use serde::Deserialize;

use super::source::open;
use crate::cli::VerifyArgs;
use crate::display::{count, print};
use crate::exit::ExitReason;

/// Verifies a recording.
pub(super) fn run(args: &VerifyArgs) -> anyhow::Result<ExitCode> {
    let named = || args.file.display().to_string();
    let mut recording = open(&args.file)?;
    let summary = recording.summary().map(str::to_owned);
    let scenario = recording.bundle().load().with_context(named)?;
    let mut replay = Reconstruction::new(&scenario);
    let mut frames = 0;
    let torn = loop {
        match recording.next_frame() {
            Ok(Some(frame)) => {
                let is_from_the_start = frames > 0 || frame.tti == Tti::ZERO;
                anyhow::ensure!(
                    is_from_the_start,
                    "{}: starts at TTI {}, but results can be verified only from TTI 0; use a recording of the whole \
                     run",
                    named(),
                    frame.tti
                );
                replay.apply(&frame).with_context(named)?;
                frames += 1;
            }
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
    };
    let ttis = replay.ttis();
    let own = replay.finish();
    let said = format!(
        "{}: {}, TTIs 0 to {}, are consistent",
        named(),
        count(frames, "message"),
        ttis.saturating_sub(1)
    );
    if let Some(error) = torn {
        print(&format!("{said}\n"))?;
        bail!("{}: {error}; the recording has no summary to compare with", named());
    }
    let Some(summary) = summary else {
        print(&format!("{said}\ndigest of these TTIs {}\n", own.digest))?;
        let why = if ttis < scenario.run.ttis {
            format!("the run was interrupted before TTI {}", scenario.run.ttis)
        } else {
            "it was recorded by `inspect record`, or its end is damaged".to_owned()
        };
        bail!("{}: the recording has no summary to compare with: {why}", named());
    };
    let summary: ExpectedResults = serde_json::from_str(&summary).with_context(named)?;
    let metrics = compare(&own, ttis, &summary).with_context(named)?;
    print(&format!(
        "{said}\ndigest {}, as in the summary\n{metrics} metrics and all totals, as in the summary\n",
        own.digest
    ))?;
    Ok(ExitReason::Done.into())
}

/// The results in a summary that follow from the messages.
#[derive(Deserialize)]
struct ExpectedResults {
    digest: String,
    ttis_done: u64,
    metrics: BTreeMap<String, Option<f64>>,
    totals: Totals,
}

/// Compares the results from the messages with the summary. Returns the number of metrics.
fn compare(own: &FinalScore, ttis: u64, told: &ExpectedResults) -> anyhow::Result<usize> {
    fn same<T: PartialEq + Debug>(what: &str, own: &T, told: &T) -> anyhow::Result<()> {
        anyhow::ensure!(
            own == told,
            "{what} is {own:?} according to the messages, but {told:?} in the summary"
        );
        Ok(())
    }
    same("ttis_done", &ttis, &told.ttis_done)?;
    let rows = own.metrics.rows();
    for (name, value, _) in &rows {
        // JSON has no NaN: the summary holds null instead.
        let value = Some(*value).filter(|value| !value.is_nan());
        same(name, &value, &told.metrics.get(*name).copied().flatten())?;
    }
    same("totals", &own.totals, &told.totals)?;
    // The digest comes last: the comparisons before it name the difference.
    same("digest", &own.digest.to_string(), &told.digest)?;
    Ok(rows.len())
}
