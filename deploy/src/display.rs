//! Output for people: lines of text, log lines and progress bars, written so that log lines and bars do not tear each
//! other. Results go to standard output ([`print_stdout`]), all else to standard error. Tests wait for `TTIs/s` in the
//! bar of a run.

use std::io;
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::Context;
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use reveille_bs::scenario::Scenario;
use reveille_bs::server::RunProgress;
use reveille_common::digits::format_significant;
use reveille_common::units::MICRO_PER_UNIT;

use crate::terminal;

/// Writes `text` to standard output. A closed output is not an error: the reported work is done anyway.
///
/// # Errors
/// If it cannot be written for another reason.
pub(crate) fn print_stdout(text: &str) -> anyhow::Result<()> {
    use std::io::Write;
    let mut stdout = io::stdout().lock();
    // Flushed here: an error at the end of the program would be lost.
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if !terminal::is_closed_output(&error, stdout.as_fd()) => {
            Err(error).context("cannot write to standard output")
        }
        Ok(()) | Err(_) => Ok(()),
    }
}

/// Writes a whole line to standard error with one call, so that readers never see a part of it. A failed write is
/// ignored: the exit code still tells how the command ended. Unlike a log line, it does not suspend progress bars.
macro_rules! note {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let line = format!("{}\n", format_args!($($text)*));
        let _failed = std::io::stderr().write_all(line.as_bytes()).is_err();
    }};
}
pub(crate) use note;

/// Formats a number with its noun: `1 run`, `2 runs`.
pub(crate) fn count_noun(number: usize, noun: &str) -> String {
    let plural = if number == 1 { "" } else { "s" };
    format!("{number} {noun}{plural}")
}

/// All progress bars of the process: log lines are written between them, not over them.
static ALL_BARS: std::sync::LazyLock<MultiProgress> =
    std::sync::LazyLock::new(|| MultiProgress::with_draw_target(terminal::progress_target()));

/// Writes log lines to standard error without tearing a progress bar.
#[derive(Clone, Copy)]
pub(crate) struct LogWriter;

impl io::Write for LogWriter {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        // tracing reports a failed write by `eprintln!`, which panics if standard error is what failed.
        let _failed = ALL_BARS.suspend(|| io::stderr().write_all(line)).is_err();
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

impl<'a> tracing_subscriber::fmt::MakeWriter<'a> for LogWriter {
    type Writer = Self;

    fn make_writer(&'a self) -> Self {
        *self
    }
}

/// Creates a progress bar, unless `hidden` or standard error is not a terminal.
pub(crate) fn new_bar(length: u64, template: &str, hidden: bool) -> ProgressBar {
    let bar = if hidden {
        ProgressBar::hidden()
    } else {
        ALL_BARS.add(ProgressBar::new(length))
    };
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    bar.set_style(style.progress_chars("━╸ "));
    bar
}

/// A progress bar with a thread that updates it; removed when dropped.
pub(crate) struct RunProgressBar {
    bar: ProgressBar,
    done: Arc<std::sync::atomic::AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl RunProgressBar {
    /// Shows `progress` of a run of `scenario`, unless `hidden` or standard error is not a terminal.
    pub(crate) fn start(progress: &Arc<RunProgress>, scenario: &Scenario, hidden: bool) -> Self {
        let template = "{bar:30} TTI {pos}/{len}  {msg}  {eta} left";
        let bar = new_bar(scenario.run.ttis, template, hidden);
        let done = Arc::new(std::sync::atomic::AtomicBool::new(false));
        let (thread_bar, thread_done, progress) = (bar.clone(), Arc::clone(&done), Arc::clone(progress));
        let devices = scenario.run.devices;
        let thread = std::thread::spawn(move || {
            let mut has_started = false;
            while !thread_done.load(Ordering::Relaxed) {
                has_started = update_bar(&thread_bar, &progress, devices, has_started);
                // `drop` unparks the thread, so that the end does not wait for this pause.
                std::thread::park_timeout(Duration::from_millis(100));
            }
        });
        Self {
            bar,
            done,
            thread: Some(thread),
        }
    }
}

impl Drop for RunProgressBar {
    fn drop(&mut self) {
        self.done.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _panicked = thread.join().is_err();
        }
        self.bar.finish_and_clear();
    }
}

/// Shows the progress. Returns whether the first TTI has passed; `had_started` is the result of the last call.
fn update_bar(bar: &ProgressBar, progress: &RunProgress, devices: u32, had_started: bool) -> bool {
    let load = |value: &std::sync::atomic::AtomicU64| value.load(Ordering::Relaxed);
    let tti = load(&progress.next_tti);
    let paused = progress.is_paused.load(Ordering::Relaxed);
    if tti == 0 && paused {
        bar.set_message("paused before TTI 0; resume with `reveille clock resume`");
        return false;
    }
    if tti == 0 {
        bar.set_message(format!(
            "joining: {} of {devices} devices",
            load(&progress.joined_devices)
        ));
        return false;
    }
    // The time before the first TTI would lower the rate.
    if !had_started {
        bar.reset_elapsed();
        bar.reset_eta();
    }
    let (events, missed) = (load(&progress.events), load(&progress.misdetected));
    let share = if events == 0 {
        0.0
    } else {
        100.0 * missed as f64 / events as f64
    };
    let battery = load(&progress.mean_battery_micro) as f64 / MICRO_PER_UNIT as f64;
    // Before the first window ends there is no mean. A mean of 0 (all batteries empty) shows the same.
    let battery = if battery > 0.0 {
        format_significant(battery, 3)
    } else {
        "–".to_owned()
    };
    bar.set_position(tti);
    let state = if paused {
        "paused".to_owned()
    } else {
        format!("running at {:.0} TTIs/s", bar.per_sec())
    };
    bar.set_message(format!(
        "{state}  events {events}  missed {share:.1} %  battery {battery}"
    ));
    true
}
