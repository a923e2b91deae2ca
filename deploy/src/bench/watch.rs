//! `reveille bench watch`: the cost of observing a run. `docs/benchmarks.md` quotes the table.
//!
//! Compares a run with the same run under observation: recorded, its metrics scraped every second, its dashboard read
//! by browsers. The two runs alternate, so that the load of the machine affects both. The addresses come from the notes
//! of `up` on standard error, which must contain `http://ADDRESS/`.

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

/// Time between two scrapes of the metrics.
const SCRAPE_INTERVAL: Duration = Duration::from_secs(1);
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
        "watched",
        "ratio",
        "recorded MB",
    ))?;
    for lookahead in [true, false] {
        let mut pairs = Vec::new();
        for nth in 0..args.repeat {
            // The load of the machine drifts: the two runs alternate in coming first, so that neither gains from it.
            let mut pair = [
                run_emulator(args, lookahead, nth % 2 == 1)?,
                run_emulator(args, lookahead, nth % 2 == 0)?,
            ];
            if nth % 2 == 1 {
                pair.reverse();
            }
            pairs.push(pair);
        }
        let median_of = |value: fn(&[MeasuredRun; 2]) -> f64| median(pairs.iter().map(value).collect());
        let is_same = pairs.iter().flatten().all(|ran| ran.digest == pairs[0][0].digest);
        anyhow::ensure!(is_same, "the runs with and without observers have different digests");
        display::print_stdout(&format!(
            "{:>9} {:>12.0} {:>12.0} {:>7.3} {:>11.1}  {}\n",
            if lookahead { "on" } else { "off" },
            median_of(|[alone, _]| alone.ttis_per_s),
            median_of(|[_, watched]| watched.ttis_per_s),
            median_of(|[alone, watched]| watched.ttis_per_s / alone.ttis_per_s),
            median_of(|[_, watched]| watched.recorded_mb),
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

fn run_emulator(args: &WatchBenchArgs, lookahead: bool, is_watched: bool) -> anyhow::Result<MeasuredRun> {
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
    if is_watched {
        command
            .args(["--metrics", "127.0.0.1:0", "--dashboard", "127.0.0.1:0", "--record"])
            .arg(&recording);
    }
    let summary = run_watched(&mut command, args.browsers)?;
    let recorded = std::fs::metadata(&recording).map_or(0, |file| file.len());
    std::fs::remove_dir_all(&folder)?;
    Ok(MeasuredRun {
        ttis_per_s: summary["timing"]["ttis_per_s"].as_f64().unwrap_or(f64::NAN),
        digest: summary["digest"].as_str().unwrap_or_default().to_owned(),
        recorded_mb: recorded as f64 / 1e6,
    })
}

/// Runs `command`, reads the addresses that it serves, and returns its summary.
fn run_watched(command: &mut Command, browsers: u32) -> anyhow::Result<Value> {
    let mut run = command.spawn().context("cannot start reveille up")?;
    let (out, err) = (run.stdout.take(), run.stderr.take());
    let is_over = Arc::new(AtomicBool::new(false));
    let summary_text = std::thread::scope(|scope| {
        // A thread reads standard error during the run: it contains the addresses, and a full pipe would block the run.
        let address_reader = scope.spawn(|| read_addresses(scope, err.into_iter().flat_map(lines), browsers, &is_over));
        let mut text = String::new();
        // Read to the end before `wait`: the summary can be longer than a pipe holds.
        let read = out.map_or(Ok(0), |mut out| out.read_to_string(&mut text));
        let ended = run.wait();
        // Set before the join: readers of endless answers stop only at this flag.
        is_over.store(true, Ordering::Relaxed);
        let stderr_text = address_reader.join().unwrap_or_default();
        let status = ended?;
        read?;
        anyhow::ensure!(status.success(), "reveille up: {stderr_text}");
        Ok(text)
    })?;
    Ok(serde_json::from_str(&summary_text)?)
}

fn lines(read: impl Read) -> impl Iterator<Item = String> {
    BufReader::new(read).lines().map_while(Result::ok)
}

/// Reads each address in `lines` until the run is over. Returns all lines.
fn read_addresses<'scope>(
    scope: &'scope Scope<'scope, '_>,
    lines: impl Iterator<Item = String>,
    browsers: u32,
    is_over: &'scope Arc<AtomicBool>,
) -> String {
    let mut stderr_text = String::new();
    let mut readers: Vec<ScopedJoinHandle<'_, ()>> = Vec::new();
    for line in lines {
        let address = line.split("http://").nth(1).and_then(|rest| rest.split('/').next());
        if let Some(address) = address.map(str::to_owned) {
            let (paths, readers_per_path) = if line.contains("/metrics") {
                (&["/metrics"][..], 1)
            } else {
                (&["/api/live", "/api/curves"][..], browsers)
            };
            for _ in 0..readers_per_path {
                for path in paths {
                    let address = address.clone();
                    readers.push(scope.spawn(move || read_until_over(&address, path, is_over)));
                }
            }
        }
        stderr_text = format!("{stderr_text}{line}\n");
    }
    for reader in readers {
        let _ended = reader.join().is_ok();
    }
    stderr_text
}

/// Requests `path` until the run is over: every second if the answer ends, or as one continuous read.
fn read_until_over(address: &str, path: &str, is_over: &AtomicBool) {
    let mut buffer = vec![0; BUFFER_BYTES];
    while !is_over.load(Ordering::Relaxed) {
        let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
        let Ok(mut stream) = TcpStream::connect(address) else {
            return;
        };
        // A live stream can send nothing for long; the timeout lets the loop check `is_over`.
        let _unlimited = stream.set_read_timeout(Some(READ_TIMEOUT)).is_err();
        if stream.write_all(request.as_bytes()).is_err() {
            return;
        }
        loop {
            match stream.read(&mut buffer) {
                Ok(0) => break,
                Err(_) if is_over.load(Ordering::Relaxed) => return,
                Ok(_) | Err(_) => {}
            }
        }
        std::thread::sleep(SCRAPE_INTERVAL);
    }
}
