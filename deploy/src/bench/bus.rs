//! `reveille bench bus`: TTIs per second over the bus, against bare barriers with messages of the same size.
//! `docs/benchmarks.md` quotes the table.

use std::process::ExitCode;

use reveille_common::codec;
use reveille_common::ids::{HostId, Tti};
use reveille_common::message::{ClockMessage, GrantMessage, HostAnswer, UnableDetectors};
use serde_json::Value;

use super::bare::{self, QuietTtiSizes};
use crate::child_process::run_for_summary;
use crate::cli::BusBenchArgs;
use crate::display;
use crate::runtime::median;

/// Devices of the measured runs, unless there are more processes.
const DEFAULT_DEVICES: u32 = 50;

/// One repetition of one row. Rates are TTIs, or rounds of a bare barrier, per second.
struct BusSample {
    /// A bare barrier over zenoh.
    bare_rate: f64,
    /// A barrier over unix sockets.
    unix_rate: f64,
    /// The emulator without lookahead.
    stepped_rate: f64,
    /// The emulator without lookahead, with untuned device processes.
    untuned_rate: f64,
    /// The emulator with lookahead.
    lookahead_rate: f64,
    /// Seconds of the run without lookahead before its first TTI: preparation and joins.
    ready_s: f64,
    /// Mean memory of its device processes: resident set size, and proportional set size.
    rss_mb: f64,
    pss_mb: f64,
}

/// Runs the benchmark, one row for each number of processes.
pub(super) fn run(args: &BusBenchArgs) -> anyhow::Result<ExitCode> {
    let (sizes, seconds) = (quiet_tti_sizes(), args.time.as_secs_f64());
    display::print_stdout(&format!(
        "preset paper, knn; a grant of {} B, an answer of {} B; medians of {} repetitions of {} s\n",
        sizes.grant, sizes.answer, args.repeat, seconds
    ))?;
    display::print_stdout(
        "TTIs (rounds) per second; `ratio`: emulator without lookahead / bare zenoh barrier; `tuning`: emulator \
         without lookahead / the same with untuned device processes\n",
    )?;
    display::print_stdout(&format!(
        "{:>9} {:>8} {:>11} {:>11} {:>6} {:>11} {:>11} {:>6} {:>11} {:>8} {:>8} {:>8} {:>8}\n",
        "processes",
        "devices",
        "unix",
        "bare zenoh",
        "ratio",
        "emulator",
        "untuned",
        "tuning",
        "lookahead",
        "speed-up",
        "ready s",
        "RSS MB",
        "PSS MB"
    ))?;
    for &processes in &args.processes {
        // `up` refuses more processes than devices.
        let devices = DEFAULT_DEVICES.max(processes);
        let samples = (0..args.repeat)
            .map(|_| measure(processes, devices, sizes, seconds))
            .collect::<Result<Vec<_>, _>>()?;
        let median_of = |value: fn(&BusSample) -> f64| median(samples.iter().map(value).collect());
        display::print_stdout(&format!(
            "{processes:>9} {devices:>8} {:>11.0} {:>11.0} {:>6.2} {:>11.0} {:>11.0} {:>6.2} {:>11.0} {:>8.2} \
             {:>8.2} {:>8.1} {:>8.1}\n",
            median_of(|s| s.unix_rate),
            median_of(|s| s.bare_rate),
            median_of(|s| s.stepped_rate / s.bare_rate),
            median_of(|s| s.stepped_rate),
            median_of(|s| s.untuned_rate),
            median_of(|s| s.stepped_rate / s.untuned_rate),
            median_of(|s| s.lookahead_rate),
            median_of(|s| s.lookahead_rate / s.stepped_rate),
            median_of(|s| s.ready_s),
            median_of(|s| s.rss_mb),
            median_of(|s| s.pss_mb),
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Returns the sizes of the grant and of an answer in a quiet TTI.
fn quiet_tti_sizes() -> QuietTtiSizes {
    // A TTI in the middle of a run: the encoding of small numbers is shorter.
    let tti = Tti(5_000);
    let grant = ClockMessage::Grant(GrantMessage {
        first: tti,
        last: tti,
        stimulus: None,
        stimulus_last: Tti::ZERO,
        wants_totals: false,
        wants_views: false,
        plan_from: Tti::ZERO,
        plan_count: 1,
        change_count: 0,
    });
    let answer = HostAnswer::GrantDone {
        host: HostId(0),
        tti,
        reports: 0,
        failures: Vec::new(),
        unable: UnableDetectors::default(),
        totals: None,
        views: None,
    };
    QuietTtiSizes {
        grant: codec::encode(&grant).len(),
        answer: codec::encode(&answer).len(),
    }
}

fn measure(processes: u32, devices: u32, sizes: QuietTtiSizes, seconds: f64) -> anyhow::Result<BusSample> {
    let bare_rate = bare::zenoh(processes, sizes, seconds)?;
    // The emulator reaches most of the bare rate, so the run takes about `seconds`.
    let ttis = ((bare_rate * seconds * 0.8) as u64).clamp(500, 1_000_000);
    let run_emulator = |ttis: u64, extra: &[&str]| {
        let numbers = [devices.to_string(), ttis.to_string(), processes.to_string()];
        let [devices, ttis, processes] = &numbers;
        // Without --scenario and --policy: the heading of the table names their defaults.
        let common = ["up", "--devices", devices, "--ttis", ttis, "--processes", processes];
        run_for_summary(&[&common, extra].concat())
    };
    let stepped = run_emulator(ttis, &["--no-lookahead"])?;
    let untuned = run_emulator(ttis, &["--no-lookahead", "--untuned"])?;
    let unix_rate = bare::unix(processes, sizes, seconds.min(1.0))?;
    // With lookahead the emulator is several times as fast; a longer run keeps the measured time similar.
    let lookahead = run_emulator(ttis * 3, &[])?;
    let timing = |run: &Value, field: &str| run["timing"][field].as_f64().unwrap_or(f64::NAN);
    Ok(BusSample {
        bare_rate,
        unix_rate,
        stepped_rate: timing(&stepped, "ttis_per_s"),
        untuned_rate: timing(&untuned, "ttis_per_s"),
        lookahead_rate: timing(&lookahead, "ttis_per_s"),
        ready_s: timing(&stepped, "ready_s"),
        rss_mb: timing(&stepped, "host_rss_mb"),
        pss_mb: timing(&stepped, "host_pss_mb"),
    })
}
