//! Output for people: the progress bar and the closing table.

use std::io;
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::Context;
use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use reveille_bs::scenario::Scenario;
use reveille_bs::server::RunProgress;
use reveille_common::score::{EventActivity, MetricGroup, Metrics};
use reveille_common::units::MICRO_PER_UNIT;

use crate::summary::{ClassSummary, Summary};
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
        bar.set_message("paused; `reveille clock resume` goes on");
        return false;
    }
    if tti == 0 {
        bar.set_message(format!("{}/{devices} devices joined", get(&progress.joined)));
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
    let rate = if paused {
        "paused".to_owned()
    } else {
        format!("{:.0} TTI/s", bar.per_sec())
    };
    bar.set_message(format!(
        "{rate}  events {events}  missed {share:.1} %  battery {battery}"
    ));
    true
}

/// Formats the closing table.
pub(crate) fn table(summary: &Summary<'_>) -> String {
    let mut lines = vec![
        format!(
            "{} · {} devices · {} of {} TTIs · preset {} · seed {}",
            summary.policy, summary.n, summary.ttis_done, summary.ttis, summary.preset, summary.seed
        ),
        metrics(summary),
    ];
    lines.extend(classes(&summary.classes));
    lines.extend(facts(summary));
    lines.extend(missed(summary));
    lines.push(timing(summary));
    if summary.timing.late_ttis > 0 {
        let (late, most) = (summary.timing.late_ttis, summary.timing.max_late_ms);
        lines.push(format!("{late} TTIs began late, by {most:.1} ms at the most"));
    }
    if summary.status != "complete" {
        lines.push(if summary.totals.ttis == 0 {
            "interrupted before the warm-up had ended: there are no figures yet".to_owned()
        } else {
            "interrupted: the figures are those of the TTIs that were run".to_owned()
        });
    }
    lines.push(format!("digest {}\n", summary.digest));
    lines.join("\n")
}

/// Formats the metrics by group.
fn metrics(summary: &Summary<'_>) -> String {
    let mut table = Table::new();
    table
        .load_style(UTF8_FULL_CONDENSED)
        .set_header(["metric", "value", "unit"]);
    let rows = summary.metrics.rows();
    for group in MetricGroup::ALL {
        table.add_row([group.title().to_uppercase(), String::new(), String::new()]);
        for (metric, (name, value, unit)) in Metrics::ALL.iter().zip(rows) {
            if metric.group == group {
                table.add_row([format!("  {name}"), number(value), unit.to_owned()]);
            }
        }
    }
    if let Some(column) = table.column_mut(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table.to_string()
}

/// Formats the device classes in columns, if there are several.
fn classes(classes: &[ClassSummary<'_>]) -> Option<String> {
    if classes.is_empty() {
        return None;
    }
    let mut table = Table::new();
    let names = classes
        .iter()
        .map(|class| format!("{} ({} devices)", class.name, class.n));
    table
        .load_style(UTF8_FULL_CONDENSED)
        .set_header(std::iter::once("by class".to_owned()).chain(names));
    for metric in Metrics::ALL.iter().filter(|metric| metric.group.is_by_device()) {
        let values = classes.iter().map(|class| {
            class
                .metrics
                .get(metric.name)
                .map_or_else(String::new, |value| number(*value))
        });
        table.add_row(std::iter::once(metric.name.to_owned()).chain(values));
    }
    for (at, (name, _)) in EventActivity::default().rows().into_iter().enumerate() {
        let values = classes.iter().map(|class| class.acts.rows()[at].1.to_string());
        table.add_row(std::iter::once(name.to_owned()).chain(values));
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    Some(table.to_string())
}

/// Formats the policy's facts; `None` without facts.
fn facts(summary: &Summary<'_>) -> Option<String> {
    let facts = summary.policy_facts.iter();
    let facts: Vec<String> = facts
        .map(|(name, value)| format!("{name} {}", number(*value)))
        .collect();
    (!facts.is_empty()).then(|| facts.join(" · "))
}

/// Formats the causes of misdetections, each with its share of all events; `None` without misdetections.
fn missed(summary: &Summary<'_>) -> Option<String> {
    let (events, missed) = (summary.totals.events.events, summary.totals.missed);
    let causes = [
        (missed.unseen, "no device within reach sensed them"),
        (missed.lost, "all reports were lost on their way"),
        (missed.unpaid, "no device that detected them could pay for a report"),
        (missed.out_of_reach, "no device stands within d_max"),
    ];
    let told = causes.iter().filter(|(count, _)| *count > 0);
    let told: Vec<String> = told
        // A misdetected event was also counted, so `events` is above 0 here.
        .map(|(count, cause)| format!("{:.2} % {cause}", 100.0 * *count as f64 / events as f64))
        .collect();
    (!told.is_empty()).then(|| format!("events missed, of all: {}", told.join("; ")))
}

/// Formats the speed of the run and its hosts.
fn timing(summary: &Summary<'_>) -> String {
    let timing = &summary.timing;
    let mut parts = vec![format!("{:.0} TTIs/s", timing.ttis_per_s)];
    if timing.hosts > 0 {
        let plural = if timing.hosts == 1 { "" } else { "es" };
        parts.push(format!(
            "{} process{plural} ready in {:.2} s",
            timing.hosts, timing.ready_s
        ));
        parts.push(format!("{} barriers", timing.grants));
    }
    if timing.host_rss_mb > 0.0 {
        let (rss, pss) = (timing.host_rss_mb, timing.host_pss_mb);
        parts.push(format!("{rss:.1} MB ({pss:.1} MB unshared) a process"));
    }
    parts.join(" · ")
}

fn number(value: f64) -> String {
    if value.is_nan() {
        "–".to_owned()
    } else if value.fract() == 0.0 && value.abs() < 1e15 {
        format!("{value:.0}")
    } else {
        format!("{value:.4}")
    }
}
