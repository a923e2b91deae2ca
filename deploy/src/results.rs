//! The run folder.
//!
//! | file | what |
//! |---|---|
//! | `scenario.toml` | the resolved scenario |
//! | `inputs/` | copies of the files that it names: layout, traces, learned tables |
//! | `events.csv` | a row per event |
//! | `windows.csv` | a row per window of TTIs |
//! | `devices.csv` | a row per device |
//! | `learned.json` | the tables of a policy that has learned in the run |
//! | `summary.json` | metrics, digest, timing, versions |
//! | `RUNNING` | there while the run goes; left behind, the run was killed |
//! | `FAILED` | why a run ended without a summary |

use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use reveille_bs::observe::{Happening, Observer};
use reveille_bs::outcome::Outcome;
use reveille_common::scenario::Scenario;
use reveille_common::score::WindowRecord;
use reveille_lab::io::replace;
use reveille_lab::training::learned_in;

use crate::cli::OutputArgs;
use crate::inputs::{self, Inputs};
use crate::series;
use crate::summary::Summary;

const RUNNING: &str = "RUNNING";
const FAILED: &str = "FAILED";
/// The resolved scenario.
pub const SCENARIO: &str = "scenario.toml";
/// What the run came to.
pub const SUMMARY: &str = "summary.json";
const LEARNED: &str = "learned.json";
const DEVICES: &str = "devices.csv";
/// What a run that was killed while it wrote may have left.
const PARTS: [&str; 4] = [
    "scenario.toml.part",
    "summary.json.part",
    "learned.json.part",
    "devices.csv.part",
];

/// A run folder that is being filled.
pub struct RunFolder {
    path: PathBuf,
    events: csv::Writer<BufWriter<File>>,
    windows: csv::Writer<BufWriter<File>>,
    devices: u32,
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
            error: None,
            is_closed: false,
            path,
        };
        folder.events.write_record(series::EVENTS)?;
        folder.windows.write_record(series::window_columns())?;
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

    /// Writes the devices and the summary, and takes the running mark away.
    ///
    /// # Errors
    /// If something cannot be written.
    pub fn finish(mut self, scenario: &Scenario, outcome: &Outcome, summary: &Summary<'_>) -> anyhow::Result<()> {
        let cannot = || format!("cannot write in the run folder {}", self.path.display());
        if let Some(error) = self.error.take() {
            return Err(error).with_context(cannot);
        }
        self.events.flush().with_context(cannot)?;
        self.windows.flush().with_context(cannot)?;
        self.write_devices(scenario, outcome).with_context(cannot)?;
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

    fn write_devices(&self, scenario: &Scenario, outcome: &Outcome) -> anyhow::Result<()> {
        let mut rows = csv::Writer::from_writer(Vec::new());
        rows.write_record(series::DEVICES)?;
        for device in &outcome.devices {
            rows.write_record(series::device(scenario, device))?;
        }
        let rows = rows.into_inner().context("a table in memory")?;
        Ok(replace(&self.path.join(DEVICES), &rows)?)
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
            self.error = self.events.write_record(series::event(event)).err();
        }
    }

    fn window(&mut self, window: &WindowRecord) -> bool {
        if window.end > window.first && self.error.is_none() {
            self.error = self.windows.write_record(series::window(self.devices, window)).err();
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
    let files = [
        SUMMARY,
        LEARNED,
        RUNNING,
        FAILED,
        SCENARIO,
        DEVICES,
        "events.csv",
        "windows.csv",
    ];
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
