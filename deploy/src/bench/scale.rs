//! `reveille bench scale`: the time per device-TTI, over the bus and in memory, against the number of devices.

use std::process::ExitCode;

use serde_json::Value;

use crate::child_process::played;
use crate::cli::ScaleBenchArgs;
use crate::display;
use crate::runtime::median;

/// Device count at which `--keep-density` keeps the preset's area, and the area's side in metres.
const DENSE: f64 = 50.0;
const SIDE: f64 = 20.0;
/// Nanoseconds per second.
const NANO: f64 = 1e9;

/// One repetition of one row: the summaries of the same run in each mode.
struct Sample {
    memory: Value,
    bus: Value,
    stepped: Value,
}

impl Sample {
    fn runs(&self) -> [&Value; 3] {
        [&self.memory, &self.bus, &self.stepped]
    }
}

/// Runs the benchmark, one row for each number of devices.
pub(super) fn run(args: &ScaleBenchArgs) -> anyhow::Result<ExitCode> {
    display::print(&format!(
        "preset paper{}, {}, {} TTIs, at most {} processes; medians of {}\n\
         TTIs per second, and nanoseconds per device and TTI; `stepped` grants every TTI separately\n",
        if args.keep_density { ", density kept" } else { "" },
        args.policy,
        args.ttis,
        args.processes,
        display::count(args.repeat as usize, "repetition"),
    ))?;
    display::print(&format!(
        "{:>8} {:>9} {:>8} {:>10} {:>9} {:>10} {:>9} {:>10} {:>9}  digest\n",
        "devices", "processes", "ready s", "memory", "ns", "bus", "ns", "stepped", "ns"
    ))?;
    for &devices in &args.devices {
        let processes = args.processes.min(devices);
        let samples = (0..args.repeat)
            .map(|_| sample(args, devices, processes))
            .collect::<Result<Vec<_>, _>>()?;
        let digest = &samples[0].memory["digest"];
        let is_same = samples
            .iter()
            .flat_map(Sample::runs)
            .all(|run| run["digest"] == *digest);
        // Rows with different digests would compare different runs.
        anyhow::ensure!(is_same, "the runs with {devices} devices have different digests");
        let of = |value: fn(&Sample) -> f64| median(samples.iter().map(value).collect());
        let rates = [of(|s| rate(&s.memory)), of(|s| rate(&s.bus)), of(|s| rate(&s.stepped))];
        let ready = of(|s| timing(&s.stepped, "ready_s"));
        display::print(&format!("{devices:>8} {processes:>9} {ready:>8.2}"))?;
        for rate in rates {
            let cost = NANO / (rate * f64::from(devices));
            display::print(&format!(" {rate:>10.0} {cost:>9.1}"))?;
        }
        display::print(&format!("  {}\n", digest.as_str().unwrap_or_default()))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn sample(args: &ScaleBenchArgs, devices: u32, processes: u32) -> anyhow::Result<Sample> {
    let numbers = [devices.to_string(), args.ttis.to_string(), processes.to_string()];
    let [count, ttis, processes] = &numbers;
    let mut common = vec!["--policy", &args.policy, "--devices", count, "--ttis", ttis];
    let side = (f64::from(devices) / DENSE).sqrt() * SIDE;
    let sides = ["width", "height"].map(|side_of| format!("area.{side_of}={side:?}"));
    if args.keep_density {
        common.extend(sides.iter().flat_map(|side| ["--set", side]));
    }
    let up = ["up", "--processes", processes];
    Ok(Sample {
        memory: played(&[&["run"], &*common].concat())?,
        bus: played(&[&up, &*common].concat())?,
        stepped: played(&[&up, &*common, &["--no-lookahead"]].concat())?,
    })
}

fn rate(run: &Value) -> f64 {
    timing(run, "ttis_per_s")
}

fn timing(run: &Value, field: &str) -> f64 {
    run["timing"][field].as_f64().unwrap_or(f64::NAN)
}
