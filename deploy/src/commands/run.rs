//! `reveille run`: a run in memory.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use reveille_bs::actor::Progress;
use reveille_bs::outcome::{EventRecord, Watcher, WindowRecord};
use reveille_lab::run::{Options, Run};

use super::{conclude, resolve, window};
use crate::cli::RunArgs;
use crate::display::Bar;
use crate::results::{RunFolder, Summary, Timing};

/// Runs a scenario in memory.
pub fn run(args: &RunArgs) -> anyhow::Result<ExitCode> {
    let scenario = resolve(&args.scenario)?;
    let folder = RunFolder::create(&args.output, &scenario)?;
    let options = Options {
        lookahead: !args.no_lookahead,
        window: window(&args.output, &scenario),
        keep_records: true,
    };
    let progress = Arc::new(Progress::default());
    let runtime = crate::runtime(1)?;
    let stop = runtime.block_on(async { crate::interrupt::watch() })?;
    let bar = Bar::start(&progress, &scenario, args.output.quiet);
    let mut watcher = Shown {
        folder,
        progress: &progress,
        stop: &stop,
        devices: u64::from(scenario.devices),
    };
    let started = crate::now();
    let outcome = Run::new(&scenario, options).finish(&mut watcher);
    let run_s = started.elapsed().as_secs_f64();
    drop(bar);
    let timing = Timing {
        run_s,
        ttis_per_s: outcome.ttis_done as f64 / run_s,
        ..Timing::default()
    };
    let summary = Summary::new(&scenario, &outcome, timing);
    let path = watcher.folder.path().to_owned();
    watcher.folder.finish(&summary)?;
    conclude(&args.output, &summary, &path)
}

/// Writes the series and shows the progress.
struct Shown<'a> {
    folder: RunFolder,
    progress: &'a Progress,
    stop: &'a std::sync::atomic::AtomicBool,
    devices: u64,
}

impl Watcher for Shown<'_> {
    fn window(&mut self, window: &WindowRecord, events: &[EventRecord]) -> bool {
        let device_ttis = u128::from((window.end - window.first) * self.devices).max(1);
        self.progress.tti.store(window.end.0, Ordering::Relaxed);
        self.progress.events.fetch_add(window.events.events, Ordering::Relaxed);
        self.progress
            .misdetected
            .fetch_add(window.events.misdetected, Ordering::Relaxed);
        self.progress
            .mean_battery
            .store((window.energy.battery_sum / device_ttis) as u64, Ordering::Relaxed);
        self.folder.window(window, events) && !self.stop.load(Ordering::Relaxed)
    }
}
