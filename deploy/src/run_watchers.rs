//! The watchers of a run within its process: its recording (`--record`) and its metrics (`--metrics`). `run`, `up` and
//! `bs` start them before the first TTI and pass them every frame. They never change the run's results, but a recording
//! that fails ends the run early ([`RunWatchers::recording_failure_check`]).

use std::sync::Arc;

use anyhow::bail;
use reveille_bs::scenario::Scenario;
use reveille_common::bus::FrameSink;
use reveille_view::metrics::{MetricsObserver, ProcessStats, PrometheusMetrics};
use reveille_view::recording::RecorderHandle;

use crate::cli::{DriveArgs, OutputArgs};
use crate::metrics_server::{self, MetricsServer};
use crate::paths::check_output_path;
use crate::recording::{RunRecording, is_growing};
use crate::run_folder::is_run_file;

/// The watchers that the command line requests.
pub(crate) struct RunWatchers {
    recording: RunRecording,
    /// The handle of `recording`, if there is a recording.
    recorder: Option<RecorderHandle>,
    metrics: Option<Arc<PrometheusMetrics>>,
    metrics_server: Option<MetricsServer>,
}

/// Checks, before a run folder exists, that the watchers requested by `args` can be started.
///
/// # Errors
/// If the recording exists and must not be replaced, has the name of a file of the run, its folder is missing, or
/// the metrics address is not available.
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
        // The run creates its folder before the recording.
        let is_in_run_folder = args.out.is_some() && path.parent() == args.out.as_deref();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if is_in_run_folder && is_run_file(&name) {
            bail!(
                "--record {}: the run folder has its own {name}; choose another name",
                path.display()
            );
        }
        if !is_in_run_folder || path.is_dir() {
            check_output_path(path, "the recording")?;
        }
    }
    if let Some(address) = &args.metrics {
        metrics_server::check_can_listen("--metrics", address)?;
    }
    Ok(())
}

/// Checks, before a run folder exists, that the recording, the metrics and the dashboard of the run can be started.
///
/// # Errors
/// If one of them cannot.
pub(crate) fn check_observers(output: &OutputArgs, drive: &DriveArgs) -> anyhow::Result<()> {
    check(output)?;
    match &drive.dashboard {
        Some(address) => metrics_server::check_can_listen("--dashboard", address),
        None => Ok(()),
    }
}

impl RunWatchers {
    /// Starts the watchers of the run called `run`, of `scenario`. `process_stats` returns the statistics of its
    /// processes, except the recorder's. Call it within a runtime.
    ///
    /// # Errors
    /// If the recording cannot be written, or the metrics address is not available.
    pub(crate) async fn start(
        args: &OutputArgs,
        run: &str,
        scenario: &Scenario,
        process_stats: impl Fn() -> ProcessStats + Send + Sync + 'static,
    ) -> anyhow::Result<Self> {
        let recording = RunRecording::start(args, run, scenario)?;
        let recorder = recording.handle();
        let (metrics, metrics_server) = match &args.metrics {
            Some(address) => {
                let metrics = PrometheusMetrics::new(run, scenario);
                let metrics_recorder = recorder.clone();
                let process_stats = move || ProcessStats {
                    recorder_waited_s: metrics_recorder
                        .as_ref()
                        .map_or(0.0, |recorder| recorder.waited().as_secs_f64()),
                    ..process_stats()
                };
                let server = metrics_server::serve(address, Arc::clone(&metrics), Arc::new(process_stats)).await?;
                (Some(metrics), Some(server))
            }
            None => (None, None),
        };
        Ok(Self {
            recording,
            recorder,
            metrics,
            metrics_server,
        })
    }

    /// The sink for every frame, if a watcher needs one.
    pub(crate) fn sink(&self) -> Option<Box<FrameSink>> {
        let (recorder, metrics) = (self.recorder.clone(), self.metrics.clone());
        (recorder.is_some() || metrics.is_some()).then(|| -> Box<FrameSink> {
            Box::new(move |frame| {
                // Counted first, since the recorder can wait for the disk.
                if let Some(metrics) = &metrics {
                    metrics.count_frame(frame);
                }
                if let Some(recorder) = &recorder {
                    recorder.push(frame.clone());
                }
            })
        })
    }

    /// The observer for metrics that frames do not contain, if metrics are served. The run must notify it.
    pub(crate) fn metrics_observer(&self) -> Option<MetricsObserver> {
        self.metrics.clone().map(MetricsObserver)
    }

    /// Returns a function that returns whether the recording has failed. At the end of a window, `run` and `bs` end the
    /// run if it has.
    pub(crate) fn recording_failure_check(&self) -> impl Fn() -> bool + use<> {
        let recorder = self.recorder.clone();
        move || recorder.as_ref().is_some_and(|recorder| recorder.failure().is_some())
    }

    /// Ends the watchers. Closes the recording with the JSON text of the summary if the run has one.
    ///
    /// # Errors
    /// If the recording could not be written.
    pub(crate) async fn finish(self, summary: Option<String>) -> anyhow::Result<()> {
        if let Some(server) = self.metrics_server {
            server.shut_down().await;
        }
        self.recording.finish(summary)
    }
}
