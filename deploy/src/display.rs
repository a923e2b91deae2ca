//! Output for people: lines of text, log lines and progress bars, written so that log lines and bars do not tear each
//! other. Results go to standard output ([`print_stdout`]), all else to standard error.
//! `tests/program/closed_terminal.rs` waits for `TTIs/s` in the bar of a run.

use std::collections::VecDeque;
use std::ffi::OsStr;
use std::io;
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::Context;
use indicatif::{HumanDuration, MultiProgress, ProgressBar, ProgressStyle};
use reveille_bs::scenario::Scenario;
use reveille_bs::server::RunProgress;
pub(crate) use reveille_common::digits::count_noun;
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

/// Writes a whole line to standard error with one call, so that readers never see a part of it, and without tearing a
/// progress bar. A failed write is ignored: the exit code still tells how the command ended.
macro_rules! note {
    ($($text:tt)*) => {
        $crate::display::write_stderr(format!("{}\n", format_args!($($text)*)).as_bytes())
    };
}
pub(crate) use note;

/// Writes `line` to standard error while all progress bars are suspended. A failed write is ignored.
pub(crate) fn write_stderr(line: &[u8]) {
    let _failed = ALL_BARS
        .suspend(|| io::Write::write_all(&mut io::stderr(), line))
        .is_err();
}

/// Breaks `text`, one line, at spaces into lines of at most `width` characters. A longer word keeps its own line.
pub(crate) fn wrap_text(text: &str, width: usize) -> String {
    let (mut lines, mut length) = (String::new(), 0);
    for word in text.split(' ') {
        let word_length = word.chars().count();
        if length > 0 && length + 1 + word_length > width {
            lines.push('\n');
            length = 0;
        } else if length > 0 {
            lines.push(' ');
            length += 1;
        }
        lines.push_str(word);
        length += word_length;
    }
    lines
}

/// Breaks `text` into lines of at most `width` characters, each after this many `spaces` (fewer than `width`).
pub(crate) fn wrap_indented(text: &str, width: usize, spaces: usize) -> String {
    let lines = wrap_text(text, width - spaces);
    let lines: Vec<String> = lines.lines().map(|line| format!("{:spaces$}{line}", "")).collect();
    lines.join("\n")
}

/// Columns of a line of text for people; results, `compare` and the lists of `--help` keep to it.
pub(crate) const WIDTH: usize = 80;

/// Returns `text` as a word of a shell command: in quotes if it has characters that a shell reads differently.
pub(crate) fn shell_word(text: impl AsRef<OsStr>) -> String {
    let text = text.as_ref().to_string_lossy();
    let is_plain = |c: char| c.is_alphanumeric() || "/._-=:,+@%".contains(c);
    if !text.is_empty() && text.chars().all(is_plain) {
        return text.into_owned();
    }
    format!("'{}'", text.replace('\'', r"'\''"))
}

/// Formats a speed in device-TTIs per second, with at most three significant digits.
pub(crate) fn format_speed(device_ttis_per_s: f64) -> String {
    let (value, scale) = if device_ttis_per_s >= 1e6 {
        (device_ttis_per_s / 1e6, " million")
    } else {
        (device_ttis_per_s, "")
    };
    // The integer part would keep all of its digits.
    let rounded = format!("{value:.2e}").parse().unwrap_or(value);
    format!("{}{scale} device-TTIs/s", format_significant(rounded, 3))
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
        write_stderr(line);
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

/// Creates a progress bar; it draws nothing if `hidden` or if standard error is not a terminal.
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

/// The template of a bar with a message.
pub(crate) const RUN_BAR: &str = "{bar:12} {wide_msg}";
/// Columns before the message of a [`RUN_BAR`].
pub(crate) const BAR_COLUMNS: usize = 13;

/// A progress bar with a thread that updates it; removed when dropped.
pub(crate) struct RunProgressBar {
    bar: ProgressBar,
    done: Arc<std::sync::atomic::AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl RunProgressBar {
    /// Shows `progress` of a run of `scenario`, unless `hidden` or standard error is not a terminal.
    pub(crate) fn start(progress: &Arc<RunProgress>, scenario: &Scenario, hidden: bool) -> Self {
        let bar = new_bar(scenario.run.ttis, RUN_BAR, hidden);
        let done = Arc::new(std::sync::atomic::AtomicBool::new(false));
        let (thread_bar, thread_done, progress) = (bar.clone(), Arc::clone(&done), Arc::clone(progress));
        let (devices, ttis, warm_up_end) = (scenario.run.devices, scenario.run.ttis, scenario.warm_up_end().0);
        let thread = std::thread::spawn(move || {
            let mut speed = SpeedMeter::default();
            while !thread_done.load(Ordering::Relaxed) {
                let tti = progress.next_tti.load(Ordering::Relaxed);
                let ttis_per_s = speed.measure(crate::runtime::now(), tti);
                thread_bar.set_position(tti);
                let parts = run_message(&progress, (devices, ttis, warm_up_end), ttis_per_s);
                thread_bar.set_message(join_fitting(&parts, BAR_COLUMNS));
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

/// Measures the speed of a run over its last seconds.
#[derive(Debug, Default)]
struct SpeedMeter {
    /// The next TTI of the run at several times, oldest first.
    samples: VecDeque<(Instant, u64)>,
    /// Whether the run has advanced since the first sample; before, no speed is measured.
    has_advanced: bool,
}

impl SpeedMeter {
    /// Time over which the speed is measured.
    const SPAN: Duration = Duration::from_secs(3);
    /// Shortest time for a first value.
    const MIN_SPAN: Duration = Duration::from_millis(500);

    /// Adds the next TTI of the run at `now`. Returns the TTIs per second; `None` until half a second with a finished
    /// TTI is measured.
    fn measure(&mut self, now: Instant, tti: u64) -> Option<f64> {
        // The time before the first TTI would lower the speed.
        if tti == 0 {
            *self = Self::default();
            return None;
        }
        self.samples.push_back((now, tti));
        while self
            .samples
            .get(1)
            .is_some_and(|(time, _)| now.duration_since(*time) >= Self::SPAN)
        {
            self.samples.pop_front();
        }
        let (first, first_tti) = *self.samples.front()?;
        self.has_advanced |= tti > first_tti;
        let elapsed = now.duration_since(first);
        (self.has_advanced && elapsed >= Self::MIN_SPAN)
            .then(|| tti.saturating_sub(first_tti) as f64 / elapsed.as_secs_f64())
    }
}

/// Joins the `parts` that fit next to a bar in the terminal, of which `used` columns are taken. Parts are left out
/// whole, since a cut number is a wrong one; the first part always stays.
pub(crate) fn join_fitting(parts: &[String], used: usize) -> String {
    join_within(parts, terminal::columns().saturating_sub(used))
}

/// Joins the `parts` that fit within `width` columns, as [`join_fitting`] describes.
fn join_within(parts: &[String], width: usize) -> String {
    const GAP: &str = "  ";
    let (first, others) = parts
        .split_first()
        .map_or((String::new(), parts), |(first, others)| (first.clone(), others));
    others.iter().fold(first, |line, part| {
        let has_room = line.chars().count() + GAP.len() + part.chars().count() <= width;
        if has_room { line + GAP + part } else { line }
    })
}

/// Describes the progress of a run of this many devices and TTIs, whose warm-up ends before the last number: parts
/// by importance. A value is left out until it is measured.
fn run_message(
    progress: &RunProgress,
    (devices, ttis, warm_up_end): (u32, u64, u64),
    ttis_per_s: Option<f64>,
) -> Vec<String> {
    let load = |value: &std::sync::atomic::AtomicU64| value.load(Ordering::Relaxed);
    let (tti, joined) = (load(&progress.next_tti), load(&progress.joined_devices));
    let is_paused = progress.is_paused.load(Ordering::Relaxed);
    match (tti, is_paused, joined) {
        (0, true, _) => {
            return ["paused before TTI 0", "resume with `reveille clock resume`"]
                .map(str::to_owned)
                .to_vec();
        }
        (0, false, 0) => return vec!["starting".to_owned()],
        (0, false, _) => return vec![format!("joining: {joined} of {}", count_noun(devices, "device"))],
        _ => {}
    }
    let mut parts = vec![format!("TTI {tti}/{ttis}")];
    if is_paused {
        parts.push("paused".to_owned());
    } else if let Some(ttis_per_s) = ttis_per_s {
        parts.push(format!("{} TTIs/s", format_rate(ttis_per_s)));
    }
    if tti < warm_up_end {
        parts.push(format!("warm-up until TTI {warm_up_end}"));
    }
    if let Some(ttis_per_s) = ttis_per_s.filter(|rate| !is_paused && *rate > 0.0) {
        let remaining = ttis.saturating_sub(tti) as f64 / ttis_per_s;
        let remaining = Duration::try_from_secs_f64(remaining).unwrap_or(Duration::MAX);
        parts.push(format!("{:#} left", HumanDuration(remaining)));
    }
    if tti < warm_up_end {
        return parts;
    }
    let (events, missed) = (load(&progress.events), load(&progress.misdetected));
    if events > 0 {
        parts.push(format!("missed {:.1} %", 100.0 * missed as f64 / events as f64));
    }
    let battery = load(&progress.mean_battery_micro) as f64 / MICRO_PER_UNIT as f64;
    // Before the first window ends there is no mean. A mean of 0 (all batteries empty) shows the same.
    if battery > 0.0 {
        parts.push(format!("battery {}", format_significant(battery, 3)));
    }
    parts
}

/// Formats TTIs per second: whole numbers, or two significant digits of a slow run.
fn format_rate(ttis_per_s: f64) -> String {
    if ttis_per_s < 10.0 {
        format_significant(ttis_per_s, 2)
    } else {
        format!("{ttis_per_s:.0}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_is_quoted_only_if_a_shell_would_split_or_expand_it() {
        for (text, word) in [
            ("runs/demo-1.2", "runs/demo-1.2"),
            ("harvest.lambda=0.1", "harvest.lambda=0.1"),
            ("policy.random.t_drx=[1,2]", "'policy.random.t_drx=[1,2]'"),
            ("my demo", "'my demo'"),
            ("Jo's $x", r"'Jo'\''s $x'"),
            ("", "''"),
        ] {
            assert_eq!(shell_word(text), word);
        }
    }

    #[test]
    fn a_speed_needs_half_a_second_and_covers_three() {
        let start = crate::runtime::now();
        let mut speed = SpeedMeter::default();
        let mut measure = |millis, tti| speed.measure(start + Duration::from_millis(millis), tti);
        assert_eq!(
            (measure(0, 0), measure(100, 5000), measure(400, 5600)),
            (None, None, None)
        );
        assert_eq!(measure(1100, 7000), Some(2000.0));
        // Two thousand TTIs per second for a second, then none.
        assert_eq!(measure(4100, 7000), Some(0.0));
        // A first TTI that takes long has no speed yet.
        let mut slow = SpeedMeter::default();
        let mut measure = |millis, tti| slow.measure(start + Duration::from_millis(millis), tti);
        assert_eq!(
            (measure(0, 1), measure(900, 1), measure(2000, 2)),
            (None, None, Some(0.5))
        );
    }

    #[test]
    fn a_message_has_measured_values_only() {
        let progress = RunProgress::default();
        let run = (50, 10_000, 1000);
        assert_eq!(run_message(&progress, run, None), ["starting"]);
        progress.joined_devices.store(12, Ordering::Relaxed);
        assert_eq!(run_message(&progress, run, None), ["joining: 12 of 50 devices"]);
        progress.next_tti.store(500, Ordering::Relaxed);
        assert_eq!(
            run_message(&progress, run, Some(450.0)),
            ["TTI 500/10000", "450 TTIs/s", "warm-up until TTI 1000", "21s left"]
        );
        progress.next_tti.store(5500, Ordering::Relaxed);
        assert_eq!(run_message(&progress, run, None), ["TTI 5500/10000"]);
        progress.events.store(200, Ordering::Relaxed);
        progress.misdetected.store(3, Ordering::Relaxed);
        progress.mean_battery_micro.store(77_100_000, Ordering::Relaxed);
        assert_eq!(
            run_message(&progress, run, Some(0.5)),
            [
                "TTI 5500/10000",
                "0.5 TTIs/s",
                "3h left",
                "missed 1.5 %",
                "battery 77.1"
            ]
        );
        progress.is_paused.store(true, Ordering::Relaxed);
        assert_eq!(
            run_message(&progress, run, Some(450.0)),
            ["TTI 5500/10000", "paused", "missed 1.5 %", "battery 77.1"]
        );
    }

    #[test]
    fn parts_of_a_line_are_left_out_whole() {
        let parts = ["TTI 9/10", "warm-up until TTI 1000", "10s left"].map(str::to_owned);
        for (width, line) in [
            (42, "TTI 9/10  warm-up until TTI 1000  10s left"),
            (41, "TTI 9/10  warm-up until TTI 1000"),
            (31, "TTI 9/10  10s left"),
            (5, "TTI 9/10"),
        ] {
            assert_eq!(join_within(&parts, width), line, "{width} columns");
        }
        assert_eq!(join_within(&[], 80), "");
    }

    #[test]
    fn a_speed_has_three_significant_digits() {
        for (speed, expected) in [
            (0.0, "0"),
            (7.25, "7.25"),
            (450_321.0, "450000"),
            (1_000_000.0, "1 million"),
            (3_141_592.0, "3.14 million"),
            (68_912_345.0, "68.9 million"),
            (1.2345e9, "1230 million"),
        ] {
            assert_eq!(format_speed(speed), format!("{expected} device-TTIs/s"));
        }
    }

    #[test]
    fn text_is_wrapped_at_spaces() {
        assert_eq!(wrap_text("one two three", 7), "one two\nthree");
        assert_eq!(wrap_text("µµµ µµµ", 7), "µµµ µµµ");
        assert_eq!(wrap_text("incomprehensible a", 4), "incomprehensible\na");
    }
}
