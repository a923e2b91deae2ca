//! `reveille inspect verify`: recomputes the results of a recorded run from its messages alone, with
//! `view/src/reconstruction.rs`, and compares them with the summary in the recording. [`ExpectedResults`] has field
//! names of `summary.json` (`summary`). `docs/watching.md` shows the text.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::process::ExitCode;

use anyhow::{Context, bail};
use reveille_common::ids::Tti;
use reveille_common::score::FinalScore;
use reveille_common::totals::Totals;
use reveille_view::reconstruction::Reconstruction;
use serde::Deserialize;

use super::source::open_recording;
use crate::cli::VerifyArgs;
use crate::display::{count_noun, print_stdout};
use crate::exit::ExitReason;

/// Verifies a recording.
pub(super) fn run(args: &VerifyArgs) -> anyhow::Result<ExitCode> {
    let path_text = || args.file.display().to_string();
    let mut recording = open_recording(&args.file)?;
    let summary = recording.summary().map(str::to_owned);
    let scenario = recording.bundle().load().with_context(path_text)?;
    let mut reconstruction = Reconstruction::new(&scenario);
    let mut frame_count = 0;
    let torn = loop {
        match recording.next_frame() {
            Ok(Some(frame)) => {
                let is_from_the_start = frame_count > 0 || frame.tti == Tti::ZERO;
                anyhow::ensure!(
                    is_from_the_start,
                    "{}: starts at TTI {}, but results can be verified only from TTI 0; use a recording of the whole \
                     run",
                    path_text(),
                    frame.tti
                );
                reconstruction.apply(&frame).with_context(path_text)?;
                frame_count += 1;
            }
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
    };
    let ttis_done = reconstruction.ttis_applied();
    let recomputed = reconstruction.finish();
    let consistency = match ttis_done.checked_sub(1) {
        None => format!("{}: no TTI in {}", path_text(), count_noun(frame_count, "message")),
        Some(last) => format!(
            "{}: {}, TTIs 0 to {last}, are consistent",
            path_text(),
            count_noun(frame_count, "message")
        ),
    };
    if let Some(error) = torn {
        if ttis_done > 0 {
            print_stdout(&format!("{consistency} up to the cut\n"))?;
        }
        bail!("{}: {error}; the recording has no summary to compare with", path_text());
    }
    let Some(summary) = summary else {
        print_stdout(&format!("{consistency}\ndigest of these TTIs {}\n", recomputed.digest))?;
        let cause = if ttis_done < scenario.run.ttis {
            format!("the run was interrupted before TTI {}", scenario.run.ttis)
        } else {
            "it was recorded by `inspect record`, or its end is damaged".to_owned()
        };
        bail!("{}: the recording has no summary to compare with: {cause}", path_text());
    };
    let summary: ExpectedResults = serde_json::from_str(&summary).with_context(path_text)?;
    compare_with_summary(&recomputed, ttis_done, &summary).with_context(path_text)?;
    print_stdout(&format!(
        "{consistency}\ndigest {}, as in the summary\nall metrics and totals, as in the summary\n",
        recomputed.digest
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

/// Compares the results from the messages of the first `ttis_done` TTIs with the summary.
///
/// # Errors
/// If a result differs; the message names the first one.
fn compare_with_summary(recomputed: &FinalScore, ttis_done: u64, expected: &ExpectedResults) -> anyhow::Result<()> {
    fn check_equal<T: PartialEq + Debug>(name: &str, recomputed: &T, expected: &T) -> anyhow::Result<()> {
        anyhow::ensure!(
            recomputed == expected,
            "{name} is {recomputed:?} according to the messages, but {expected:?} in the summary"
        );
        Ok(())
    }
    check_equal("ttis_done", &ttis_done, &expected.ttis_done)?;
    for (name, value, _) in recomputed.metrics.rows() {
        // JSON has no NaN: the summary holds null instead.
        let value = Some(value).filter(|value| !value.is_nan());
        check_equal(name, &value, &expected.metrics.get(name).copied().flatten())?;
    }
    check_equal("totals", &recomputed.totals, &expected.totals)?;
    // The digest comes last: the comparisons before it name the difference.
    check_equal("digest", &recomputed.digest.to_string(), &expected.digest)
}
