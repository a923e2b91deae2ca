//! The run folder.
//!
//! | file | what |
//! |---|---|
//! | `scenario.toml` | the resolved scenario |
//! | `inputs/` | copies of the files that it names: layout, traces, learned tables |
//! | `events.csv` | a row per event |
//! | `windows.csv` | a row per window of TTIs |
//! | `learned.json` | the tables of a policy that has learned in the run |
//! | `summary.json` | metrics, digest, timing, versions |
//! | `RUNNING` | there while the run goes; left behind, the run was killed |
//! | `FAILED` | why a run ended without a summary |

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use reveille_bs::observe::{Happening, Observer};
use reveille_bs::outcome::Outcome;
use reveille_common::scenario::Scenario;
use reveille_common::score::Digest;
use reveille_common::score::Metrics;
use reveille_common::score::{EventRecord, WindowRecord};
use reveille_common::totals::{PICO_PER_INFORMATION, Totals};
use reveille_lab::io::replace;
use reveille_lab::training::learned_in;
use serde::Serialize;

use crate::cli::OutputArgs;
use crate::inputs::{self, Inputs};

const RUNNING: &str = "RUNNING";
const FAILED: &str = "FAILED";
const SCENARIO: &str = "scenario.toml";
const SUMMARY: &str = "summary.json";
const LEARNED: &str = "learned.json";
/// What a run that was killed while it wrote may have left.
const PARTS: [&str; 3] = ["scenario.toml.part", "summary.json.part", "learned.json.part"];

/// Metrics of all devices that `windows.csv` has for each window.
const WINDOW_METRICS: [&str; 5] = [
    "mean_battery",
    "low_energy_pct",
    "energy_per_device_tti",
    "harvested_per_device_tti",
    "overflow_per_device_tti",
];

/// The form of `summary.json`; raised when a field changes its meaning.
const SUMMARY_VERSION: u32 = 1;

/// `summary.json`.
#[derive(Debug, Serialize)]
pub struct Summary<'a> {
    /// The run's fingerprint.
    pub digest: Digest,
    /// Whether the run was `complete` or `interrupted`.
    pub status: &'static str,
    /// The policy's name.
    pub policy: &'static str,
    /// Number of devices N.
    pub n: u32,
    /// Length of the run K in TTIs.
    pub ttis: u64,
    /// TTIs that were run.
    pub ttis_done: u64,
    /// The seed.
    pub seed: u64,
    /// The preset that the scenario starts from.
    pub preset: &'a str,
    /// What the policy found out about the deployment, such as the number of clusters.
    pub policy_facts: BTreeMap<&'static str, f64>,
    /// SHA-256 of the resolved scenario.
    pub scenario_hash: String,
    /// The metrics; those per event are null where no event was counted.
    pub metrics: Metrics,
    /// The exact totals behind them; energies in micro-units.
    pub totals: Totals,
    /// How long things took; the only part that differs between two runs of a scenario.
    pub timing: Timing,
    /// Versions of what wrote this.
    pub versions: Versions,
}

/// How long things took.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Timing {
    /// Seconds until all devices had joined.
    pub ready_s: f64,
    /// Seconds from the first TTI to the last ledger.
    pub run_s: f64,
    /// TTIs per second over that time.
    pub ttis_per_s: f64,
    /// Processes that carried devices (1 where the base station's own did), or 0 for a run in memory.
    pub hosts: usize,
    /// Barriers over all hosts; fewer than TTIs where lookahead joined them.
    pub grants: u64,
    /// TTIs that began late under a real-time pace.
    pub late_ttis: u64,
    /// The largest delay, milliseconds.
    pub max_late_ms: f64,
    /// Payloads on the bus that were no messages and were dropped.
    pub malformed: u64,
    /// Messages on the bus that nobody waited for, or that could not be true, and were dropped.
    pub strays: u64,
    /// Mean resident memory of a device process in MB, 0 where there is none.
    pub host_rss_mb: f64,
    /// Mean proportional memory of a device process in MB (shared pages split), 0 where there is none.
    pub host_pss_mb: f64,
}

/// What made the summary, and in which forms.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Versions {
    /// The version of Reveille.
    pub reveille: &'static str,
    /// The version of the form of messages.
    pub wire: u8,
    /// The version of the form of this file.
    pub summary: u32,
}

impl<'a> Summary<'a> {
    /// The summary of a run of `scenario`.
    pub fn new(scenario: &'a Scenario, outcome: &Outcome, timing: Timing) -> Self {
        Self {
            digest: outcome.digest,
            status: if outcome.complete { "complete" } else { "interrupted" },
            policy: scenario.policy.name(),
            n: scenario.devices,
            ttis: scenario.ttis,
            ttis_done: outcome.ttis_done,
            seed: scenario.seed,
            preset: &scenario.preset,
            policy_facts: outcome.facts.iter().copied().collect(),
            scenario_hash: scenario.hash_hex(),
            metrics: outcome.metrics,
            totals: outcome.totals,
            timing,
            versions: Versions {
                reveille: env!("CARGO_PKG_VERSION"),
                wire: reveille_common::codec::WIRE_VERSION,
                summary: SUMMARY_VERSION,
            },
        }
    }

    /// The summary as JSON text.
    ///
    /// # Errors
    /// Never in practice.
    pub fn to_json(&self) -> anyhow::Result<String> {
        Ok(serde_json::to_string_pretty(self)? + "\n")
    }
}

/// A run folder that is being filled.
pub struct RunFolder {
    path: PathBuf,
    events: csv::Writer<BufWriter<File>>,
    windows: csv::Writer<BufWriter<File>>,
    devices: u32,
    alpha: f64,
    error: Option<csv::Error>,
    is_closed: bool,
}

impl RunFolder {
    /// Makes the folder that `args` names, or the next free one under `runs/`, and marks it as running.
    ///
    /// # Errors
    /// If the folder holds something already, or cannot be written.
    pub fn create(args: &OutputArgs, scenario: &Scenario) -> anyhow::Result<Self> {
        // Before a folder is emptied that may hold them.
        let inputs = Inputs::read(scenario)?;
        let path = match &args.out {
            Some(path) => {
                clear(path, args.force)?;
                path.clone()
            }
            None => free_name(scenario)?,
        };
        let cannot = || format!("cannot write in the run folder {}", path.display());
        fs::create_dir_all(&path).with_context(cannot)?;
        fs::write(path.join(RUNNING), format!("pid {}\n", std::process::id())).with_context(cannot)?;
        inputs.write(&path).with_context(cannot)?;
        replace(&path.join(SCENARIO), inputs.to_toml(scenario).as_bytes()).with_context(cannot)?;
        let open =
            |name: &str| File::create(path.join(name)).map(|file| csv::Writer::from_writer(BufWriter::new(file)));
        let mut folder = Self {
            events: open("events.csv").with_context(cannot)?,
            windows: open("windows.csv").with_context(cannot)?,
            devices: scenario.devices,
            alpha: scenario.events.alpha,
            error: None,
            is_closed: false,
            path,
        };
        folder.headers()?;
        Ok(folder)
    }

    /// The path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The last part of its path, as a name for the run.
    pub fn name(&self) -> String {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let fits = |c: char| {
            if c.is_ascii_alphanumeric() || c == '-' || c == '_' {
                c
            } else {
                '-'
            }
        };
        let name: String = name.chars().map(fits).skip_while(|&c| c == '-').take(64).collect();
        if name.is_empty() { "run".to_owned() } else { name }
    }

    /// Writes the summary and takes the running mark away.
    ///
    /// # Errors
    /// If something cannot be written.
    pub fn finish(mut self, summary: &Summary<'_>) -> anyhow::Result<()> {
        let cannot = || format!("cannot write in the run folder {}", self.path.display());
        if let Some(error) = self.error.take() {
            return Err(error).with_context(cannot);
        }
        self.events.flush().with_context(cannot)?;
        self.windows.flush().with_context(cannot)?;
        replace(&self.path.join(SUMMARY), summary.to_json()?.as_bytes()).with_context(cannot)?;
        fs::remove_file(self.path.join(RUNNING)).with_context(cannot)?;
        self.is_closed = true;
        Ok(())
    }

    /// Keeps what the policy has learned in the run, if it learns.
    pub fn keep_learned(&self, scenario: &Scenario, outcome: &Outcome) -> anyhow::Result<()> {
        let Some(learned) = learned_in(scenario, outcome) else {
            return Ok(());
        };
        replace(&self.path.join(LEARNED), learned.to_json().as_bytes())
            .with_context(|| format!("cannot write in the run folder {}", self.path.display()))
    }

    /// Marks the run as failed.
    pub fn fail(mut self, why: &anyhow::Error) {
        self.mark(&format!("{why:#}\n"));
    }

    fn mark(&mut self, why: &str) {
        // The run has failed already; what cannot be written about it is not worth another error.
        let _ = self.events.flush();
        let _ = self.windows.flush();
        // Written in place: on a full disk an empty mark is better than none.
        let _ = fs::write(self.path.join(FAILED), why);
        let _ = fs::remove_file(self.path.join(RUNNING));
        self.is_closed = true;
    }

    fn headers(&mut self) -> anyhow::Result<()> {
        self.events.write_record([
            "event",
            "start_tti",
            "last_tti",
            "x_m",
            "y_m",
            "counted",
            "reports",
            "wake_ups",
            "information",
            "wrong_activations",
            "wasted_units",
        ])?;
        let sums = ["events", "misdetected", "information", "wake_ups", "wrong_activations"];
        let columns = ["first_tti", "end_tti"].into_iter().chain(WINDOW_METRICS).chain(sums);
        self.windows.write_record(columns)?;
        Ok(())
    }

    fn write_event(&mut self, event: &EventRecord) -> Result<(), csv::Error> {
        let tally = event.tally;
        self.events.write_record([
            event.event.0.to_string(),
            event.start.to_string(),
            event.last.to_string(),
            event.epicentre.x.to_string(),
            event.epicentre.y.to_string(),
            u8::from(event.counted).to_string(),
            tally.reports.to_string(),
            tally.wake_ups.to_string(),
            (tally.information_pico as f64 / PICO_PER_INFORMATION).to_string(),
            tally.wrong_activations.to_string(),
            tally.wasted.units().to_string(),
        ])
    }

    fn write_window(&mut self, window: &WindowRecord) -> Result<(), csv::Error> {
        let totals = window.events;
        let metrics = Metrics::of(
            self.alpha,
            &Totals {
                devices: u64::from(self.devices),
                ttis: window.end - window.first,
                events: totals,
                energy: window.energy,
                ..Totals::default()
            },
        );
        let times = [window.first, window.end].map(|tti| tti.to_string());
        let means = WINDOW_METRICS.map(|name| metrics.value(name).unwrap_or(f64::NAN).to_string());
        let sums = [
            totals.events.to_string(),
            totals.misdetected.to_string(),
            (totals.information_pico as f64 / PICO_PER_INFORMATION).to_string(),
            totals.wake_ups.to_string(),
            totals.wrong_activations.to_string(),
        ];
        self.windows.write_record(times.into_iter().chain(means).chain(sums))
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        if !self.is_closed {
            self.mark("the run ended without its summary; its error is on the standard error of the command\n");
        }
    }
}

impl Observer for RunFolder {
    fn see(&mut self, happening: &Happening<'_>) {
        if let (Happening::EventEnded(event), None) = (happening, &self.error) {
            self.error = self.write_event(event).err();
        }
    }

    fn window(&mut self, window: &WindowRecord) -> bool {
        if window.end > window.first && self.error.is_none() {
            self.error = self.write_window(window).err();
        }
        self.error.is_none()
    }
}

/// Empties a folder that held a run, if that is wanted.
fn clear(path: &Path, force: bool) -> anyhow::Result<()> {
    let Ok(mut files) = fs::read_dir(path) else {
        return Ok(());
    };
    if files.next().is_none() {
        return Ok(());
    }
    let is_run = path.join(SCENARIO).exists();
    if !force || !is_run {
        let hint = if is_run {
            "choose another, or add --force to replace it"
        } else {
            "and it is not a run: choose another"
        };
        bail!("--out {}: the folder is not empty; {hint}", path.display());
    }
    let files = [SUMMARY, LEARNED, RUNNING, FAILED, SCENARIO, "events.csv", "windows.csv"];
    for name in files.into_iter().chain(PARTS) {
        let file = path.join(name);
        if file.exists() {
            fs::remove_file(&file).with_context(|| format!("cannot replace {}", file.display()))?;
        }
    }
    inputs::remove(path).with_context(|| format!("cannot replace {}", path.join(inputs::FOLDER).display()))
}

/// A folder under `runs/` that does not exist yet. It is made here, so that two runs never share one.
fn free_name(scenario: &Scenario) -> anyhow::Result<PathBuf> {
    fs::create_dir_all("runs").context("cannot create the folder runs here; name another with --out")?;
    let stem = format!("{}-n{}-s{}", scenario.policy.name(), scenario.devices, scenario.seed);
    for number in 1.. {
        let name = if number == 1 {
            stem.clone()
        } else {
            format!("{stem}-{number}")
        };
        let path = Path::new("runs").join(name);
        match fs::create_dir(&path) {
            Ok(()) => return Ok(path),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error).with_context(|| format!("cannot create {}", path.display())),
        }
    }
    bail!("no free name under runs/")
}
