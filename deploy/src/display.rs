//! Output for people: lines of text and progress bars.

use std::io;
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::Context;
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use reveille_bs::scenario::Scenario;
use reveille_bs::server::RunProgress;
use reveille_common::units::MICRO_PER_UNIT;

use crate::terminal;

/// Writes `text` to standard output. A closed output is not an error: the reported work is done anyway.
///
/// # Errors
/// If it cannot be written for another reason.
pub(crate) fn print(text: &str) -> anyhow::Result<()> {
    use std::io::Write;
    let mut stdout = io::stdout().lock();
    // Flushed here: an error at the end of the program would be lost.
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if !terminal::is_gone(&error, stdout.as_fd()) => {
            Err(error).context("cannot write to standard output")
        }
        Ok(()) | Err(_) => Ok(()),
    }
}

/// Writes a whole line to standard error with one call, so that readers never see a part of it. A failed write is
/// ignored: the exit code still tells how the command ended.
macro_rules! note {
    ($($said:tt)*) => {{
        use std::io::Write as _;
        let line = format!("{}\n", format_args!($($said)*));
        let _unread = std::io::stderr().write_all(line.as_bytes()).is_err();
    }};
}
pub(crate) use note;

/// Formats a number with its noun: `1 run`, `2 runs`.
pub(crate) fn count(number: usize, noun: &str) -> String {
    let plural = if number == 1 { "" } else { "s" };
    format!("{number} {noun}{plural}")
}

/// All progress bars of the process: log lines are written between them, not over them.
static BARS: std::sync::LazyLock<MultiProgress> =
    std::sync::LazyLock::new(|| MultiProgress::with_draw_target(terminal::target()));

/// Writes log lines to standard error without tearing a progress bar.
#[derive(Clone, Copy)]
pub(crate) struct LogWriter;

impl io::Write for LogWriter {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        // tracing reports a failed write by `eprintln!`, which panics if standard error is what failed.
        let _unread = BARS.suspend(|| io::stderr().write_all(line)).is_err();
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
pub(crate) fn bar(length: u64, template: &str, hidden: bool) -> ProgressBar {
    let bar = if hidden {
        ProgressBar::hidden()
    } else {
        BARS.add(ProgressBar::new(length))
    };
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    bar.set_style(style.progress_chars("━╸ "));
    bar
}

/// A progress bar with a thread that updates it; removed when dropped.
pub(crate) struct Bar {
    line: ProgressBar,
    done: Arc<std::sync::atomic::AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Bar {
    /// Shows `progress` of a run of `scenario`, unless `hidden` or standard error is not a terminal.
    pub(crate) fn start(progress: &Arc<RunProgress>, scenario: &Scenario, hidden: bool) -> Self {
        let template = "{bar:30} TTI {pos}/{len}  {msg}  {eta} left";
        let bar = bar(scenario.run.ttis, template, hidden);
        let done = Arc::new(std::sync::atomic::AtomicBool::new(false));
        let (thread_bar, thread_done, progress) = (bar.clone(), Arc::clone(&done), Arc::clone(progress));
        let devices = scenario.run.devices;
        let thread = std::thread::spawn(move || {
            let mut is_running = false;
            while !thread_done.load(Ordering::Relaxed) {
                is_running = update(&thread_bar, &progress, devices, is_running);
                // `drop` unparks the thread, so that the end does not wait for this pause.
                std::thread::park_timeout(Duration::from_millis(100));
            }
        });
        Self {
            line: bar,
            done,
            thread: Some(thread),
        }
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.done.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _panicked = thread.join().is_err();
        }
        self.line.finish_and_clear();
    }
}

fn update(bar: &ProgressBar, progress: &RunProgress, devices: u32, was_running: bool) -> bool {
    let get = |value: &std::sync::atomic::AtomicU64| value.load(Ordering::Relaxed);
    let tti = get(&progress.tti);
    let paused = progress.paused.load(Ordering::Relaxed);
    if tti == 0 && paused {
        bar.set_message("paused before TTI 0; resume with `reveille clock resume`");
        return false;
    }
    if tti == 0 {
        bar.set_message(format!("joining: {} of {devices} devices", get(&progress.joined)));
        return false;
    }
    // The time before the first TTI would lower the rate.
    if !was_running {
        bar.reset_elapsed();
        bar.reset_eta();
    }
    let (events, missed) = (get(&progress.events), get(&progress.misdetected));
    let share = if events == 0 {
        0.0
    } else {
        100.0 * missed as f64 / events as f64
    };
    let battery = get(&progress.mean_battery) as f64 / MICRO_PER_UNIT as f64;
    // Before the first window ends there is no mean.
    let battery = if battery > 0.0 {
        format!("{battery:.1}")
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
