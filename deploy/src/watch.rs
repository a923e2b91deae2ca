//! What watches a run from within its process: its recording and its metrics.

use std::sync::Arc;

use anyhow::bail;
use reveille_common::message::Frame;
use reveille_common::scenario::Scenario;
use reveille_view::metrics::{Gauged, Metrics, Process};
use reveille_view::recording::Tape;

use crate::cli::OutputArgs;
use crate::paths::check_place;
use crate::recording::{Recording, is_growing};
use crate::web;

/// Takes in every frame of the run.
pub type Sink = Box<dyn Fn(&Frame) + Send + Sync>;

/// The watchers that the command line asks for.
pub struct Watch {
    recording: Recording,
    tape: Option<Tape>,
    metrics: Option<Arc<Metrics>>,
}

/// Looks whether the watchers that `args` ask for can be had, before there is a run folder.
///
/// # Errors
/// The recording is there already, its folder is not, or nothing can listen at the address for metrics.
pub fn check(args: &OutputArgs) -> anyhow::Result<()> {
    if let Some(path) = &args.record {
        let may_replace = args.force && path.is_file();
        if path.exists() && !may_replace {
            bail!(
                "--record {}: is there already; choose another, or move it away",
                path.display()
            );
        }
        if may_replace && is_growing(path) {
            bail!(
                "--record {}: a run is recording in this file; choose another, or wait until it has ended: --force \
                 never replaces what is being written",
                path.display()
            );
        }
        check_place(path, "the recording")?;
    }
    if let Some(address) = &args.metrics {
        web::can_listen("--metrics", address)?;
    }
    Ok(())
}

impl Watch {
    /// Begins to watch the run called `run`, of `scenario`, where `process` tells how its processes are. To be called
    /// within a runtime.
    ///
    /// # Errors
    /// If the recording cannot be written, or nothing can listen at the address for metrics.
    pub async fn start(
        args: &OutputArgs,
        run: &str,
        scenario: &Scenario,
        process: impl Fn() -> Process + Send + Sync + 'static,
    ) -> anyhow::Result<Self> {
        let recording = Recording::start(args, run, scenario)?;
        let tape = recording.tape();
        let metrics = match &args.metrics {
            Some(address) => {
                let metrics = Metrics::new(run, scenario);
                let own = tape.clone();
                let process = move || Process {
                    recorder_waited_s: own.as_ref().map_or(0.0, |tape| tape.waited().as_secs_f64()),
                    ..process()
                };
                web::serve(address, Arc::clone(&metrics), Arc::new(process)).await?;
                Some(metrics)
            }
            None => None,
        };
        Ok(Self {
            recording,
            tape,
            metrics,
        })
    }

    /// Where every frame is to go, if anywhere.
    pub fn sink(&self) -> Option<Sink> {
        let (tape, metrics) = (self.tape.clone(), self.metrics.clone());
        (tape.is_some() || metrics.is_some()).then(|| -> Sink {
            Box::new(move |frame| {
                if let Some(metrics) = &metrics {
                    metrics.count(frame);
                }
                if let Some(tape) = &tape {
                    tape.take(frame.clone());
                }
            })
        })
    }

    /// The observer that looks at what frames do not hold.
    pub fn gauged(&self) -> Option<Gauged> {
        self.metrics.clone().map(Gauged)
    }

    /// Tells whether nothing more can be recorded.
    pub fn is_broken(&self) -> impl Fn() -> bool + use<> {
        let tape = self.tape.clone();
        move || tape.as_ref().is_some_and(|tape| tape.failure().is_some())
    }

    /// Ends the recording, with the text of the summary where the run has one.
    ///
    /// # Errors
    /// If it could not be written.
    pub fn finish(self, summary: Option<String>) -> anyhow::Result<()> {
        self.recording.finish(summary)
    }
}
