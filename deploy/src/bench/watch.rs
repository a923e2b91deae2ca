//! `reveille bench watch`: the cost of observing a run. `docs/benchmarks.md` quotes the table.
//!
//! Compares a run alone with the same run under observation: recorded, its metrics scraped every second, its dashboard
//! read by browsers. The runs of a pair take turns in coming first, so that a drift of the machine's load favours
//! neither.
//!
//! It relies on `up`: on standard error, a line with `http://ADDRESS/metrics` names the metrics, and any other line
//! with `http://` the dashboard, of which browsers read [`BROWSER_PATHS`]. Both are on loopback and need no token.
//! `--json` prints `digest` and `timing.ttis_per_s`. An observer that cannot read ends the benchmark with an error.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{Scope, ScopedJoinHandle};
use std::time::Duration;

use anyhow::Context;
use serde_json::Value;

use crate::cli::WatchBenchArgs;
use crate::display;
use crate::runtime::median;

/// The paths of the dashboard that a browser keeps reading.
const BROWSER_PATHS: [&str; 2] = ["/api/live", "/api/curves"];
/// Pause between an answer and the next request.
const REQUEST_PAUSE: Duration = Duration::from_secs(1);
/// Time without data on a connection until the end of the run is checked.
const READ_TIMEOUT: Duration = Duration::from_millis(200);
/// Size of the read buffer in bytes.
const BUFFER_BYTES: usize = 1 << 16;

/// Runs the benchmark: a row with lookahead and one without.
pub(super) fn run(args: &WatchBenchArgs) -> anyhow::Result<ExitCode> {
    display::print_stdout(&format!(
        "preset paper, {}, {} devices in {} processes, {} TTIs; recorded, metrics scraped every second, {} reading the \
         dashboard; medians of {} pairs\n{:>9} {:>12} {:>12} {:>7} {:>11}  digest\n",
        args.policy,
        args.devices,
        args.processes,
        args.ttis,
        display::count_noun(args.browsers as usize, "browser"),
        args.repeat,
        "lookahead",
        "alone TTIs/s",
        "observed",
        "ratio",
        "recorded MB",
    ))?;
    for lookahead in [true, false] {
        let mut pairs = Vec::new();
        for repetition in 0..args.repeat {
            let observed_first = repetition % 2 == 1;
            let mut pair = [
                measure_run(args, lookahead, observed_first)?,
                measure_run(args, lookahead, !observed_first)?,
            ];
            if observed_first {
                pair.reverse();
            }
            pairs.push(pair);
        }
        let median_of = |value: fn(&[MeasuredRun; 2]) -> f64| median(pairs.iter().map(value).collect());
        let is_same = pairs.iter().flatten().all(|run| run.digest == pairs[0][0].digest);
        anyhow::ensure!(is_same, "the runs with and without observers have different digests");
        display::print_stdout(&format!(
            "{:>9} {:>12.0} {:>12.0} {:>7.3} {:>11.1}  {}\n",
            if lookahead { "on" } else { "off" },
            median_of(|[alone, _]| alone.ttis_per_s),
            median_of(|[_, observed]| observed.ttis_per_s),
            median_of(|[alone, observed]| observed.ttis_per_s / alone.ttis_per_s),
            median_of(|[_, observed]| observed.recorded_mb),
            pairs[0][0].digest,
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// The results of one run.
struct MeasuredRun {
    ttis_per_s: f64,
    digest: String,
    recorded_mb: f64,
}

/// Runs `up` once, under observation if `is_observed`.
fn measure_run(args: &WatchBenchArgs, lookahead: bool, is_observed: bool) -> anyhow::Result<MeasuredRun> {
    let folder = std::env::temp_dir().join(format!("reveille-bench-{}", std::process::id()));
    std::fs::create_dir_all(&folder)?;
    let recording = folder.join("run.mcap");
    let mut command = Command::new(std::env::current_exe()?);
    command
        .args(["up", "--parent", &std::process::id().to_string()])
        .args(["--json", "--quiet", "--policy", &args.policy])
        .args(["--devices", &args.devices.to_string(), "--ttis", &args.ttis.to_string()])
        .args(["--processes", &args.processes.to_string()])
        .args((!lookahead).then_some("--no-lookahead"))
        .arg("--out")
        .arg(folder.join("run"))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    if is_observed {
        command
            .args(["--metrics", "127.0.0.1:0", "--dashboard", "127.0.0.1:0", "--record"])
            .arg(&recording);
    }
    let expected_readers = if is_observed {
        // The first one reads the metrics.
        1 + BROWSER_PATHS.len() * args.browsers as usize
    } else {
        0
    };
    let summary = run_and_read(&mut command, args.browsers, expected_readers)?;
    let recorded_bytes = std::fs::metadata(&recording).map_or(0, |file| file.len());
    std::fs::remove_dir_all(&folder)?;
    Ok(MeasuredRun {
        ttis_per_s: summary["timing"]["ttis_per_s"]
            .as_f64()
            .context("the summary has no timing.ttis_per_s")?,
        digest: summary["digest"]
            .as_str()
            .context("the summary has no digest")?
            .to_owned(),
        recorded_mb: recorded_bytes as f64 / 1e6,
    })
}

/// Runs `command`, reads from the addresses that it serves, and returns its summary.
///
/// # Errors
/// If the run fails, or not exactly `expected_readers` readers received a successful answer.
fn run_and_read(command: &mut Command, browsers: u32, expected_readers: usize) -> anyhow::Result<Value> {
    let mut run = command.spawn().context("cannot start reveille up")?;
    let (stdout, stderr) = (run.stdout.take(), run.stderr.take());
    let is_over = Arc::new(AtomicBool::new(false));
    let summary_text = std::thread::scope(|scope| {
        // A thread reads standard error during the run: it contains the addresses, and a full pipe would block the run.
        let stderr_thread =
            scope.spawn(|| follow_stderr(scope, stderr.into_iter().flat_map(read_lines), browsers, &is_over));
        let mut stdout_text = String::new();
        // Read to the end before `wait`: the summary can be longer than a pipe holds.
        let read_result = stdout.map_or(Ok(0), |mut stdout| stdout.read_to_string(&mut stdout_text));
        let wait_result = run.wait();
        // Set before the join: readers of endless answers stop only at this flag.
        is_over.store(true, Ordering::Relaxed);
        let (stderr_text, readers) = stderr_thread.join().unwrap_or_default();
        let status = wait_result?;
        read_result?;
        anyhow::ensure!(status.success(), "`reveille up` failed:\n{}", stderr_text.trim_end());
        anyhow::ensure!(
            readers == expected_readers,
            "{readers} of {expected_readers} observers could read the run; its output was: {stderr_text}"
        );
        Ok(stdout_text)
    })?;
    Ok(serde_json::from_str(&summary_text)?)
}

fn read_lines(read: impl Read) -> impl Iterator<Item = String> {
    BufReader::new(read).lines().map_while(Result::ok)
}

/// Collects standard error, and starts readers of each address in it. Returns the text, and the number of readers that
/// received a successful answer.
fn follow_stderr<'scope>(
    scope: &'scope Scope<'scope, '_>,
    lines: impl Iterator<Item = String>,
    browsers: u32,
    is_over: &'scope Arc<AtomicBool>,
) -> (String, usize) {
    let mut stderr_text = String::new();
    let mut readers: Vec<ScopedJoinHandle<'_, bool>> = Vec::new();
    for line in lines {
        let address = line.split("http://").nth(1).and_then(|rest| rest.split('/').next());
        if let Some(address) = address.map(str::to_owned) {
            let (paths, reader_count) = if line.contains("/metrics") {
                (&["/metrics"][..], 1)
            } else {
                (&BROWSER_PATHS[..], browsers)
            };
            for _ in 0..reader_count {
                for path in paths {
                    let address = address.clone();
                    readers.push(scope.spawn(move || read_until_over(&address, path, is_over)));
                }
            }
        }
        stderr_text = format!("{stderr_text}{line}\n");
    }
    let successful = readers.into_iter().filter_map(|reader| reader.join().ok());
    (stderr_text, successful.filter(|&has_read| has_read).count())
}

/// Requests `path` until the run is over: every second if the answer ends, or as one continuous read. Returns whether
/// an answer had the status 200.
fn read_until_over(address: &str, path: &str, is_over: &AtomicBool) -> bool {
    let mut buffer = vec![0; BUFFER_BYTES];
    let mut has_read = false;
    while !is_over.load(Ordering::Relaxed) {
        let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
        let Ok(mut stream) = TcpStream::connect(address) else {
            return has_read;
        };
        // A live stream can send nothing for long; the timeout lets the loop check `is_over`.
        let _ignored_failure = stream.set_read_timeout(Some(READ_TIMEOUT)).is_err();
        if stream.write_all(request.as_bytes()).is_err() {
            return has_read;
        }
        loop {
            match stream.read(&mut buffer) {
                Ok(0) => break,
                Ok(count) => has_read |= buffer[..count].starts_with(b"HTTP/1.1 200"),
                Err(_) if is_over.load(Ordering::Relaxed) => return has_read,
                Err(_) => {}
            }
        }
        std::thread::sleep(REQUEST_PAUSE);
    }
    has_read
}
