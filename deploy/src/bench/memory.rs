//! `reveille bench memory`: TTIs per second of runs in memory on one core, by policy and number of devices.
//! `deploy/bench/instructions.sh` counts on [`REPETITIONS`] runs per measurement; `docs/benchmarks.md` quotes the
//! table.

use std::process::ExitCode;

use reveille_bs::scenario::{Override, Scenario, load};
use reveille_lab::preparation::RunPreparer;
use reveille_lab::run::{Run, RunOptions};

use crate::cli::MemoryBenchArgs;
use crate::display;
use crate::runtime::{median, now};

/// Repetitions of each measurement.
const REPETITIONS: usize = 3;
/// Device count at which `--keep-density` keeps the preset's area, as its help states, and its side in metres
/// (the defaults of `area.width` and `area.height`).
const REFERENCE_DEVICES: f64 = 250.0;
const PRESET_SIDE_M: f64 = 20.0;

/// Runs the benchmark, one row for each policy and number of devices.
pub(super) fn run(args: &MemoryBenchArgs) -> anyhow::Result<ExitCode> {
    let area = if args.keep_density { ", density kept" } else { "" };
    display::print_stdout(&format!(
        "preset paper{area}, {} TTIs, one core; medians of {REPETITIONS} runs\n",
        args.ttis
    ))?;
    display::print_stdout(&format!(
        "{:>10} {:>8} {:>12} {:>22}\n",
        "policy", "devices", "TTIs/s", "M device-TTIs/s"
    ))?;
    // Caches searches: of three repetitions only the first one contains the search, so the median excludes it.
    let preparer = RunPreparer::default();
    for policy in &args.measured.policies {
        for devices in &args.devices {
            let scenario = load_scenario(args, policy, *devices)?;
            let rates = (0..REPETITIONS)
                .map(|_| {
                    let started = now();
                    // The time includes the preparation of the run, which matters if the run is short.
                    std::hint::black_box(Run::new(&preparer.prepare(&scenario), RunOptions::default()).finish(&mut ()));
                    args.ttis as f64 / started.elapsed().as_secs_f64()
                })
                .collect();
            let rate = median(rates);
            display::print_stdout(&format!(
                "{policy:>10} {devices:>8} {rate:>12.0} {:>22.1}\n",
                rate * f64::from(*devices) / 1e6
            ))?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Loads the preset `paper` with the options of the benchmark.
fn load_scenario(args: &MemoryBenchArgs, policy: &str, devices: u32) -> anyhow::Result<Scenario> {
    let mut overrides = vec![
        Override::from_flag("a policy of --policies", "policy.name", policy)?,
        Override::from_flag("--devices", "devices", &devices.to_string())?,
        Override::from_flag("--ttis", "ttis", &args.ttis.to_string())?,
    ];
    if args.keep_density {
        let side = (f64::from(devices) / REFERENCE_DEVICES).sqrt() * PRESET_SIDE_M;
        for field in ["area.width", "area.height"] {
            overrides.push(Override::from_flag("--keep-density", field, &format!("{side:?}"))?);
        }
    }
    Ok(load("paper", &overrides)?.scenario)
}
