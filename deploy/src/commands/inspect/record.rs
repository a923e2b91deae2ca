//! `reveille inspect record`: records a live run. The recording holds no summary, so `inspect verify` ends with exit
//! code 1 for it (`docs/watching.md`).

use std::process::ExitCode;

use anyhow::{anyhow, bail};
use reveille_view::recording::Recorder;

use super::live::{Live, OBSERVERS};
use crate::cli::InspectRecordArgs;
use crate::display::{count_noun, note};
use crate::exit::ExitReason;

/// Records until the run ends or a signal arrives.
pub(super) async fn run(args: &InspectRecordArgs) -> anyhow::Result<ExitCode> {
    let path = &args.file;
    if path.exists() {
        bail!(
            "{}: file exists; choose another name, or move the file away",
            path.display()
        );
    }
    let mut live = Live::connect(&args.target, &OBSERVERS).await?;
    let bundle = live.bundle().await?;
    let recording_error = |cause: String| anyhow!("{}: {cause}", path.display());
    let catch_up = live.start_catch_up(&bundle).await?;
    // The file is created last, so that a failed connection leaves none.
    let recorder = Recorder::start(path, &live.run_name, &bundle).map_err(recording_error)?;
    live.report_position();
    let recorder_handle = recorder.handle();
    let started = crate::runtime::now();
    // Returns false, which ends the observation, once the file cannot be written.
    let record_frame = |frame| {
        recorder_handle.push(frame);
        recorder_handle.failure().is_none()
    };
    let follow_result = live.follow(catch_up, record_frame).await;
    drop(recorder_handle);
    let (dropped_frames, end_check) = (live.dropped_frames(), live.check_ran_to_end());
    // Closed before any error is returned, so that the frames so far can be read.
    let file_stats = recorder.finish(None).map_err(recording_error)?;
    follow_result?;
    live.close().await;
    note!(
        "recorded {} in {}, {:.1} MB, in {:.1} s",
        count_noun(file_stats.frames, "message"),
        path.display(),
        file_stats.bytes as f64 / 1e6,
        started.elapsed().as_secs_f64()
    );
    if dropped_frames > 0 {
        bail!(
            "{}: {} dropped (reader too slow); use `up --record`, for which the run waits",
            path.display(),
            count_noun(dropped_frames, "message")
        );
    }
    end_check?;
    Ok(ExitReason::Done.into())
}
