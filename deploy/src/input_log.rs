//! What a run depends on beside scenario and seed: `inputs.log` in its folder, a line for each such input.
//!
//! So far these are outages, of devices whose process was lost under `--on-loss continue`. A line is on the disk before
//! the run goes on from what it says, so that a replay of the run comes to the same.

use std::fs::{File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use reveille_common::message::Outage;
use reveille_common::scenario::Scenario;
use serde::{Deserialize, Serialize};

/// The file in a run folder.
pub const INPUTS: &str = "inputs.log";
/// What is said of a log of which not all comes to pass.
pub const MISFIT: &str = "inputs.log names an outage that does not come in this run: was it changed?";
/// The form of that file.
const VERSION: u32 = 1;

/// A line.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Entry {
    /// The first: of which run the others are.
    Inputs {
        version: u32,
        scenario_hash: String,
    },
    Outage(Outage),
}

/// The log of a run.
#[derive(Debug)]
pub struct InputLog {
    path: PathBuf,
    scenario_hash: String,
    /// Once there is something in it.
    file: Option<File>,
}

impl InputLog {
    /// The log in a run folder. A file comes about with the first input.
    pub fn new(folder: &Path, scenario: &Scenario) -> Self {
        Self {
            path: folder.join(INPUTS),
            scenario_hash: scenario.hash_hex(),
            file: None,
        }
    }

    /// Adds an outage.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn add(&mut self, outage: &Outage) -> anyhow::Result<()> {
        let written = self.write(outage);
        written.with_context(|| format!("cannot write {}", self.path.display()))
    }

    fn write(&mut self, outage: &Outage) -> io::Result<()> {
        let opened = self.file.take();
        let mut file = opened.map_or_else(|| self.open(), Ok)?;
        writeln!(file, "{}", serde_json::to_string(&Entry::Outage(*outage))?)?;
        file.sync_data()?;
        self.file = Some(file);
        Ok(())
    }

    /// The file behind its last whole line, and with its first.
    fn open(&self) -> io::Result<File> {
        let mut options = OpenOptions::new();
        let mut file = options
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&self.path)?;
        // The last line of a run that was killed may not be whole. Nothing depends on that one.
        let (_, whole) = lines(&io::read_to_string(&file)?);
        file.set_len(whole as u64)?;
        file.seek(SeekFrom::End(0))?;
        if whole == 0 {
            let first = Entry::Inputs {
                version: VERSION,
                scenario_hash: self.scenario_hash.clone(),
            };
            writeln!(file, "{}", serde_json::to_string(&first)?)?;
        }
        Ok(file)
    }
}

/// The whole lines of a log, and how long they are.
fn lines(text: &str) -> (Vec<&str>, usize) {
    let whole = text.rfind('\n').map_or(0, |last| last + 1);
    (text[..whole].lines().collect(), whole)
}

/// The inputs that a run folder holds, in the order in which they came; none if it holds no log.
///
/// # Errors
/// As of [`read`].
pub fn of_folder(folder: &Path, scenario: &Scenario) -> anyhow::Result<Vec<Outage>> {
    let path = folder.join(INPUTS);
    if path.exists() {
        read(&path, scenario)
    } else {
        Ok(Vec::new())
    }
}

/// The inputs in the log at `path`, in the order in which they came.
///
/// # Errors
/// It cannot be read, is no log, or is that of a run of another scenario.
pub fn read(path: &Path, scenario: &Scenario) -> anyhow::Result<Vec<Outage>> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    parse(&text, scenario).with_context(|| path.display().to_string())
}

/// The inputs in the text of a log.
///
/// # Errors
/// It is no log, or that of a run of another scenario.
pub fn parse(text: &str, scenario: &Scenario) -> anyhow::Result<Vec<Outage>> {
    let (lines, _) = lines(text);
    let mut outages: Vec<Outage> = Vec::new();
    let mut has_begun = false;
    for (number, line) in (1..).zip(lines) {
        let entry = serde_json::from_str(line).with_context(|| format!("line {number} is none of an {INPUTS}"))?;
        match entry {
            Entry::Inputs { version, scenario_hash } => {
                ensure!(version == VERSION, "another version of reveille wrote it; use that one");
                ensure!(
                    scenario_hash == scenario.hash_hex(),
                    "is of a run of another scenario or seed than this one"
                );
                has_begun = true;
            }
            Entry::Outage(_) if !has_begun => bail!("line {number} comes before the line that names the run"),
            Entry::Outage(outage) => {
                let order = |outage: &Outage| (outage.tti, outage.wake_ups);
                let is_next = outages.last().is_none_or(|last| order(last) <= order(&outage));
                let is_new = outages
                    .iter()
                    .all(|other| other.last() < outage.first || outage.last() < other.first);
                ensure!(
                    outage.is_sound(scenario.devices) && is_next && is_new && outage.tti.0 < scenario.ttis,
                    "line {number} is an outage that cannot have come then"
                );
                outages.push(outage);
            }
        }
    }
    Ok(outages)
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::load;
    use reveille_common::ids::{DeviceId, Tti};

    use super::*;

    fn outage(first: u32, count: u32, tti: u64) -> Outage {
        Outage {
            first: DeviceId(first),
            count,
            tti: Tti(tti),
            wake_ups: None,
        }
    }

    /// The text of a log of these outages, or why there can be none.
    fn written_and_read(outages: &[Outage]) -> Result<Vec<Outage>, String> {
        let scenario = load("quick", &[]).expect("a preset");
        let first = Entry::Inputs {
            version: VERSION,
            scenario_hash: scenario.hash_hex(),
        };
        let entries = std::iter::once(first).chain(outages.iter().copied().map(Entry::Outage));
        let line = |entry| serde_json::to_string(&entry).expect("an entry") + "\n";
        let text: String = entries.map(line).collect();
        parse(&format!("{text}{{\"outage\":"), &scenario).map_err(|error| format!("{error:#}"))
    }

    #[test]
    fn a_log_is_read_up_to_its_last_whole_line() {
        let outages = [outage(3, 2, 5), outage(0, 3, 5), outage(9, 1, 80)];
        assert_eq!(written_and_read(&outages), Ok(outages.to_vec()));
        assert_eq!(written_and_read(&[]), Ok(Vec::new()));
    }

    #[test]
    fn what_cannot_have_come_is_refused() {
        let impossible = [
            vec![outage(0, 0, 5)],
            vec![outage(u32::MAX, 2, 5)],
            vec![outage(0, 1, u64::MAX)],
            vec![outage(3, 2, 5), outage(4, 1, 9)],
            vec![outage(3, 2, 5), outage(0, 1, 4)],
        ];
        for outages in impossible {
            let refused = written_and_read(&outages).expect_err("impossible");
            assert!(refused.contains("cannot have come then"), "{refused}");
        }
        let scenario = load("quick", &[]).expect("a preset");
        for text in [
            "{}\n",
            "{\"outage\":{\"first\":0,\"count\":1,\"tti\":1,\"wake_ups\":null}}\n",
        ] {
            assert!(parse(text, &scenario).is_err(), "{text}");
        }
        let other = "{\"inputs\":{\"version\":1,\"scenario_hash\":\"00\"}}\n";
        let refused = parse(other, &scenario).expect_err("of another scenario");
        assert!(refused.to_string().contains("another scenario"), "{refused}");
    }
}
