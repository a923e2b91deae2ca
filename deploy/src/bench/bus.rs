//! `reveille bench bus`.

use std::process::{Command, ExitCode, Stdio};

use anyhow::Context;
use reveille_common::codec;
use reveille_common::ids::{HostId, Tti};
use reveille_common::message::{Answer, Clock, Tick};
use serde_json::Value;

use super::bare::{self, Sizes};
use crate::cli::BusBenchArgs;
use crate::display;
use crate::wall::median;

/// Devices of the measured runs, where there are not more processes than that.
const DEVICES: u32 = 50;

/// One repetition of one row.
struct Sample {
    bare: f64,
    unix: f64,
    stepped: f64,
    lookahead: f64,
    ready_s: f64,
    rss_mb: f64,
    pss_mb: f64,
}

/// Measures, one row for each number of processes.
pub fn run(args: &BusBenchArgs) -> anyhow::Result<ExitCode> {
    let (sizes, seconds) = (sizes(), args.time.as_secs_f64());
    display::out(&format!(
        "preset paper, knn; a tick of {} B, an answer of {} B; medians of {} repetitions of {} s\n",
        sizes.tick, sizes.answer, args.repeat, seconds
    ))?;
    display::out("TTIs (rounds) per second; `ratio` is emulator without lookahead / bare zenoh barrier\n")?;
    display::out(&format!(
        "{:>9} {:>8} {:>11} {:>11} {:>6} {:>11} {:>11} {:>8} {:>8} {:>8} {:>8}\n",
        "processes",
        "devices",
        "unix",
        "bare zenoh",
        "ratio",
        "emulator",
        "lookahead",
        "speed-up",
        "ready s",
        "RSS MB",
        "PSS MB"
    ))?;
    for &processes in &args.processes {
        let devices = DEVICES.max(processes);
        let samples = (0..args.repeat)
            .map(|_| sample(processes, devices, sizes, seconds))
            .collect::<Result<Vec<_>, _>>()?;
        let of = |value: fn(&Sample) -> f64| median(samples.iter().map(value).collect());
        display::out(&format!(
            "{processes:>9} {devices:>8} {:>11.0} {:>11.0} {:>6.2} {:>11.0} {:>11.0} {:>8.2} {:>8.2} {:>8.1} {:>8.1}\n",
            of(|s| s.unix),
            of(|s| s.bare),
            of(|s| s.stepped / s.bare),
            of(|s| s.stepped),
            of(|s| s.lookahead),
            of(|s| s.lookahead / s.stepped),
            of(|s| s.ready_s),
            of(|s| s.rss_mb),
            of(|s| s.pss_mb),
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// The sizes of the messages that a quiet TTI sends.
fn sizes() -> Sizes {
    let tti = Tti(5_000);
    let tick = Clock::Grant(Tick {
        first: tti,
        last: tti,
        stimulus: None,
        account: false,
        views: false,
        plan: Tti::ZERO,
        plans: 1,
    });
    let answer = Answer::Done {
        host: HostId(0),
        tti,
        reports: 0,
        failures: Vec::new(),
        totals: None,
        views: None,
    };
    Sizes {
        tick: codec::encode(&tick).len(),
        answer: codec::encode(&answer).len(),
    }
}

fn sample(processes: u32, devices: u32, sizes: Sizes, seconds: f64) -> anyhow::Result<Sample> {
    let bare = bare::zenoh(processes, sizes, seconds)?;
    let ttis = ((bare * seconds * 0.8) as u64).clamp(500, 1_000_000);
    let stepped = emulate(processes, devices, ttis, false)?;
    let unix = bare::unix(processes, sizes, seconds.min(1.0))?;
    let lookahead = emulate(processes, devices, ttis * 3, true)?;
    let timing = |run: &Value, field: &str| run["timing"][field].as_f64().unwrap_or(f64::NAN);
    Ok(Sample {
        bare,
        unix,
        stepped: timing(&stepped, "ttis_per_s"),
        lookahead: timing(&lookahead, "ttis_per_s"),
        ready_s: timing(&stepped, "ready_s"),
        rss_mb: timing(&stepped, "host_rss_mb"),
        pss_mb: timing(&stepped, "host_pss_mb"),
    })
}

/// One run of `reveille up` in a process of its own; its summary.
fn emulate(processes: u32, devices: u32, ttis: u64, lookahead: bool) -> anyhow::Result<Value> {
    let folder = std::env::temp_dir().join(format!("reveille-bench-{}", std::process::id()));
    let numbers = [devices.to_string(), ttis.to_string(), processes.to_string()];
    let mut command = Command::new(std::env::current_exe()?);
    command
        .args([
            "up",
            "--json",
            "--quiet",
            "--devices",
            &numbers[0],
            "--ttis",
            &numbers[1],
            "--processes",
            &numbers[2],
        ])
        .args((!lookahead).then_some("--no-lookahead"))
        .arg("--out")
        .arg(&folder)
        .stdin(Stdio::null());
    let output = command.output().context("cannot start reveille up")?;
    anyhow::ensure!(
        output.status.success(),
        "reveille up: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    std::fs::remove_dir_all(&folder)?;
    Ok(serde_json::from_slice(&output.stdout)?)
}
