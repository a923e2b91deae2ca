//! `reveille bench memory`.

use std::process::ExitCode;

use reveille_common::scenario::{Override, load};
use reveille_lab::run;

use super::median;
use crate::cli::MemoryBenchArgs;
use crate::display;
use crate::now;

/// Repetitions of each measurement.
const REPEAT: usize = 3;

/// Measures, one row for each policy and number of devices.
pub fn run(args: &MemoryBenchArgs) -> anyhow::Result<ExitCode> {
    display::out(&format!(
        "preset paper, {} TTIs, one core; medians of {REPEAT} runs\n",
        args.ttis
    ))?;
    display::out(&format!(
        "{:>10} {:>8} {:>12} {:>22}\n",
        "policy", "devices", "TTIs/s", "M device-TTIs/s"
    ))?;
    for policy in &args.policies {
        for devices in &args.devices {
            let overrides = [
                Override::flag("a policy of --policies", "policy.name", policy)?,
                Override::flag("--devices", "devices", &devices.to_string())?,
                Override::flag("--ttis", "ttis", &args.ttis.to_string())?,
            ];
            let scenario = load("paper", &overrides)?;
            let rates = (0..REPEAT)
                .map(|_| {
                    let started = now();
                    std::hint::black_box(run::run(&scenario));
                    args.ttis as f64 / started.elapsed().as_secs_f64()
                })
                .collect();
            let rate = median(rates);
            display::out(&format!(
                "{policy:>10} {devices:>8} {rate:>12.0} {:>22.1}\n",
                rate * f64::from(*devices) / 1e6
            ))?;
        }
    }
    Ok(ExitCode::SUCCESS)
}
