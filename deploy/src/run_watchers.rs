//! The watchers of a run within its process: its recording and its metrics.

use std::sync::Arc;

use anyhow::bail;
use reveille_bs::scenario::Scenario;
use reveille_common::bus::FrameSink;
use reveille_view::metrics::{MetricsObserver, ProcessStats, PrometheusMetrics};
use reveille_view::recording::RecorderHandle;

use crate::cli::OutputArgs;
use crate::metrics_server;
use crate::paths::check_place;
use crate::recording::{RunRecording, is_growing};

/// The watchers that the command line requests.
pub(crate) struct RunWatchers {
    recording: RunRecording,
    recorder: Option<RecorderHandle>,
    metrics: Option<Arc<PrometheusMetrics>>,
}

/// Checks, before a run folder exists, that the watchers requested by `args` can be started.
///
/// # Errors
/// If the recording exists already, its folder is missing, or the metrics address is not available.
pub(crate) fn check(args: &OutputArgs) -> anyhow::Result<()> {
    if let Some(path) = &args.record {
        let may_replace = args.force && path.is_file();
        if path.exists() && !may_replace {
            bail!(
                "--record {}: file exists; choose another name, or move the file away",
                path.display()
            );
        }
        if may_replace && is_growing(path) {
            bail!(
                "--record {}: a run is recording to this file; choose another name, or wait until the run has finished \
                 (--force never replaces a growing recording)",
                path.display()
            );
        }
        check_place(path, "the recording")?;
    }
    if let Some(address) = &args.metrics {
        metrics_server::can_listen("--metrics", address)?;
    }
    Ok(())
}

impl RunWatchers {
    /// Starts the watchers of the run called `run`, of `scenario`. `process` returns the statistics of its processes.
    /// Call it within a runtime.
    ///
    /// # Errors
    /// If the recording cannot be written, or the metrics address is not available.
    pub(crate) async fn start(
        args: &OutputArgs,
        run: &str,
        scenario: &Scenario,
        process: impl Fn() -> ProcessStats + Send + Sync + 'static,
    ) -> anyhow::Result<Self> {
        let recording = RunRecording::start(args, run, scenario)?;
        let tape = recording.recorder();
        let metrics = match &args.metrics {
            Some(address) => {
                let metrics = PrometheusMetrics::new(run, scenario);
                let own = tape.clone();
                let process = move || ProcessStats {
                    recorder_waited_s: own.as_ref().map_or(0.0, |tape| tape.waited().as_secs_f64()),
                    ..process()
                };
                metrics_server::serve(address, Arc::clone(&metrics), Arc::new(process)).await?;
                Some(metrics)
            }
            None => None,
        };
        Ok(Self {
            recording,
            recorder: tape,
            metrics,
        })
    }

    /// The sink for every frame, if a watcher needs one.
    pub(crate) fn sink(&self) -> Option<Box<FrameSink>> {
        let (tape, metrics) = (self.recorder.clone(), self.metrics.clone());
        (tape.is_some() || metrics.is_some()).then(|| -> Box<FrameSink> {
            Box::new(move |frame| {
                // Counted first, since the tape can wait for the disk.
                if let Some(metrics) = &metrics {
                    metrics.count(frame);
                }
                if let Some(tape) = &tape {
                    tape.take(frame.clone());
                }
            })
        })
    }

    /// The observer for metrics that frames do not contain.
    pub(crate) fn metrics_observer(&self) -> Option<MetricsObserver> {
        self.metrics.clone().map(MetricsObserver)
    }

    /// Returns a check whether the recording has failed.
    pub(crate) fn is_broken(&self) -> impl Fn() -> bool + use<> {
        let tape = self.recorder.clone();
        move || tape.as_ref().is_some_and(|tape| tape.failure().is_some())
    }

    /// Closes the recording, with the text of the summary if the run has one.
    ///
    /// # Errors
    /// If the recording could not be written.
    pub(crate) fn finish(self, summary: Option<String>) -> anyhow::Result<()> {
        self.recording.finish(summary)
    }
}
