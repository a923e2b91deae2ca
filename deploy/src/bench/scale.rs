//! `reveille bench scale`: the time per device-TTI, over the bus and in memory, against the number of devices.
//! `docs/benchmarks.md` quotes the table.

use std::process::ExitCode;

use serde_json::Value;

use crate::child_process::run_for_summary;
use crate::cli::ScaleBenchArgs;
use crate::display;
use crate::runtime::median;

/// Device count at which `--keep-density` keeps the preset's area, as its help states, and its side in metres
/// (the defaults of `area.width` and `area.height`).
const REFERENCE_DEVICES: f64 = 50.0;
const PRESET_SIDE_M: f64 = 20.0;
const NANOS_PER_SECOND: f64 = 1e9;

/// One repetition of one row: the summaries of the same run in each mode.
struct ScaleSample {
    /// In memory.
    memory: Value,
    /// Over the bus, with lookahead.
    bus: Value,
    /// Over the bus without lookahead.
    stepped: Value,
}

impl ScaleSample {
    fn runs(&self) -> [&Value; 3] {
        [&self.memory, &self.bus, &self.stepped]
    }
}

/// Runs the benchmark, one row for each number of devices.
pub(super) fn run(args: &ScaleBenchArgs) -> anyhow::Result<ExitCode> {
    display::print_stdout(&format!(
        "preset paper{}, {}, {} TTIs, at most {} processes; medians of {}\n\
         TTIs per second, and nanoseconds per device and TTI; `stepped` grants every TTI separately\n",
        if args.keep_density { ", density kept" } else { "" },
        args.policy,
        args.ttis,
        args.processes,
        display::count_noun(args.repeat as usize, "repetition"),
    ))?;
    display::print_stdout(&format!(
        "{:>8} {:>9} {:>8} {:>10} {:>9} {:>10} {:>9} {:>10} {:>9}  digest\n",
        "devices", "processes", "ready s", "memory", "ns", "bus", "ns", "stepped", "ns"
    ))?;
    for &devices in &args.devices {
        let processes = args.processes.min(devices);
        let samples = (0..args.repeat)
            .map(|_| measure(args, devices, processes))
            .collect::<Result<Vec<_>, _>>()?;
        let digest = &samples[0].memory["digest"];
        let is_same = samples
            .iter()
            .flat_map(ScaleSample::runs)
            .all(|run| run["digest"] == *digest);
        // Rows with different digests would compare different runs.
        anyhow::ensure!(is_same, "the runs with {devices} devices have different digests");
        let median_of = |value: fn(&ScaleSample) -> f64| median(samples.iter().map(value).collect());
        let rates = [
            median_of(|s| ttis_per_s(&s.memory)),
            median_of(|s| ttis_per_s(&s.bus)),
            median_of(|s| ttis_per_s(&s.stepped)),
        ];
        let ready = median_of(|s| timing(&s.stepped, "ready_s"));
        display::print_stdout(&format!("{devices:>8} {processes:>9} {ready:>8.2}"))?;
        for rate in rates {
            let nanos = NANOS_PER_SECOND / (rate * f64::from(devices));
            display::print_stdout(&format!(" {rate:>10.0} {nanos:>9.1}"))?;
        }
        display::print_stdout(&format!("  {}\n", digest.as_str().unwrap_or_default()))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn measure(args: &ScaleBenchArgs, devices: u32, processes: u32) -> anyhow::Result<ScaleSample> {
    let numbers = [devices.to_string(), args.ttis.to_string(), processes.to_string()];
    let [count, ttis, processes] = &numbers;
    let mut common = vec!["--policy", &args.policy, "--devices", count, "--ttis", ttis];
    let side = (f64::from(devices) / REFERENCE_DEVICES).sqrt() * PRESET_SIDE_M;
    let sides = ["width", "height"].map(|dimension| format!("area.{dimension}={side:?}"));
    if args.keep_density {
        common.extend(sides.iter().flat_map(|side| ["--set", side]));
    }
    let up = ["up", "--processes", processes];
    Ok(ScaleSample {
        memory: run_for_summary(&[&["run"], &*common].concat())?,
        bus: run_for_summary(&[&up, &*common].concat())?,
        stepped: run_for_summary(&[&up, &*common, &["--no-lookahead"]].concat())?,
    })
}

fn ttis_per_s(run: &Value) -> f64 {
    timing(run, "ttis_per_s")
}

/// Returns a field of `timing` in the summary of `run`; NaN if it is absent.
fn timing(run: &Value, field: &str) -> f64 {
    run["timing"][field].as_f64().unwrap_or(f64::NAN)
}
