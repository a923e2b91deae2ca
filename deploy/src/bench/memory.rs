//! `reveille bench memory`.

use std::process::ExitCode;

use reveille_bs::scenario::{Override, Scenario, load};
use reveille_lab::preparation::Workshop;
use reveille_lab::run::{Options, Run};

use crate::cli::MemoryBenchArgs;
use crate::display;
use crate::wall::{median, now};

/// Repetitions of each measurement.
const REPEAT: usize = 3;
/// The devices that `--keep-density` leaves on the preset's area, and its side in metres.
const DENSE: f64 = 250.0;
const SIDE: f64 = 20.0;

/// Measures, one row for each policy and number of devices.
pub fn run(args: &MemoryBenchArgs) -> anyhow::Result<ExitCode> {
    let area = if args.keep_density { ", density kept" } else { "" };
    display::out(&format!(
        "preset paper{area}, {} TTIs, one core; medians of {REPEAT} runs\n",
        args.ttis
    ))?;
    display::out(&format!(
        "{:>10} {:>8} {:>12} {:>22}\n",
        "policy", "devices", "TTIs/s", "M device-TTIs/s"
    ))?;
    let workshop = Workshop::default();
    for policy in &args.policies {
        for devices in &args.devices {
            let scenario = scenario(args, policy, *devices)?;
            let rates = (0..REPEAT)
                .map(|_| {
                    let started = now();
                    std::hint::black_box(Run::new(&workshop.prepare(&scenario), Options::default()).finish(&mut ()));
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

fn scenario(args: &MemoryBenchArgs, policy: &str, devices: u32) -> anyhow::Result<Scenario> {
    let mut overrides = vec![
        Override::flag("a policy of --policies", "policy.name", policy)?,
        Override::flag("--devices", "devices", &devices.to_string())?,
        Override::flag("--ttis", "ttis", &args.ttis.to_string())?,
    ];
    if args.keep_density {
        let side = (f64::from(devices) / DENSE).sqrt() * SIDE;
        for field in ["area.width", "area.height"] {
            overrides.push(Override::flag("--keep-density", field, &format!("{side:?}"))?);
        }
    }
    Ok(load("paper", &overrides)?)
}
