//! File of learned tables, written by `reveille train q-learning`: JSON with a format header and a checksum over its
//! body. Values are rounded on writing and on reading, so that both sides hold the same bits. Raise [`VERSION`] when
//! the fields or the meaning of the buckets ([`super::tables`]) change, and train the shipped tables again
//! (docs/q-learning.md). RELEASING.md lists the version.

use std::fmt::Write as _;
use std::io;
use std::path::Path;

use reveille_common::declare::{FileError, Files, describe_read_error};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::{
    DutyTable, LearnedTables, Lookback, MAX_WINDOW, QTrainingConfig, QWeights, Schedule, TableSet, TrainingSite,
    WakeTable,
};

/// Name of the file format.
pub const FORMAT: &str = "reveille-q-table";
/// Version of the file format that this program reads and writes.
pub const VERSION: u32 = 3;
/// Size of the longest file that is read, bytes.
const MAX_FILE_BYTES: u64 = 64 << 20;

/// Tables that come with the program, learned under the presets `paper` and `paper-literal`, for windows and ages.
const SHIPPED: [(&str, &str); 4] = [
    ("shipped-paper", include_str!("shipped-paper.json")),
    ("shipped-paper-literal", include_str!("shipped-paper-literal.json")),
    ("shipped-paper-ages", include_str!("shipped-paper-ages.json")),
    (
        "shipped-paper-literal-ages",
        include_str!("shipped-paper-literal-ages.json"),
    ),
];
const AGES_SUFFIX: &str = "-ages";

fn parse_shipped(text: &str) -> LearnedTables {
    LearnedTables::parse(text).expect("a test reads the shipped tables")
}

/// Reads the training site from the `text` of a file, without the tables themselves.
fn read_training_site(text: &str) -> TrainingSite {
    #[derive(Deserialize)]
    struct SettingRepr {
        setting: TrainingSite,
    }
    let body = text.split_once(BODY_START).map_or("", |(_, body)| body);
    let front = body.split_once(ENTRIES_START).map_or("", |(front, _)| front);
    let repr: SettingRepr = serde_json::from_str(&format!("{front}}}")).expect("a test reads the shipped tables");
    repr.setting
}

/// Reason why learned tables cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LearnedError {
    /// The file cannot be read.
    #[error("{}", describe_read_error(.0, "name a file that reveille train q-learning wrote, or \"shipped\""))]
    Read(#[from] std::io::Error),
    /// The file does not hold learned tables of Reveille.
    #[error("is not a file of learned tables: {0}; name one that reveille train q-learning wrote")]
    Foreign(String),
    /// The file has another format version.
    #[error(
        "has version {0} of the format of learned tables, and this program reads {VERSION}; train again: \
         reveille train q-learning"
    )]
    Version(u64),
    /// The file was modified or truncated.
    #[error("is damaged: {0}; restore a copy or train again: reveille train q-learning")]
    Damaged(String),
}

impl LearnedError {
    /// Returns the cause, without the advice for a file that the user has named.
    pub fn cause(&self) -> String {
        match self {
            Self::Read(error) => format!("it cannot be read: {error}"),
            Self::Foreign(reason) => format!("it is not a file of learned tables: {reason}"),
            Self::Version(version) => {
                format!("it has version {version} of the format, and this program reads {VERSION}")
            }
            Self::Damaged(reason) => format!("it is damaged: {reason}"),
        }
    }
}

/// Header before the body.
#[derive(Deserialize)]
struct FileHeader {
    format: String,
    version: u64,
    // Optional, so that a file of a later version is refused by its version and not as damaged.
    #[serde(default)]
    sha256: String,
}

const BODY_START: &str = ",\"body\":";
/// Text at which the entries, the last field of the body, begin.
const ENTRIES_START: &str = ",\"entries\":[";

/// The body of a file: [`LearnedTables`], whose site is called `setting` there. `entries` must stay the last field, and
/// `devices` the first of a [`TableSet`]: the text is split there ([`ENTRIES_START`], [`LearnedTables::to_json`]).
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileBody {
    made_by: String,
    scenario: String,
    weights: QWeights,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    begun_from: Option<String>,
    schedule: Schedule,
    training: QTrainingConfig,
    setting: TrainingSite,
    entries: Vec<TableSet>,
}

impl LearnedTables {
    /// Returns the shipped tables that were learned on the site most similar to `site`: those for ages if `for_ages`,
    /// otherwise those for windows.
    pub fn shipped(site: &TrainingSite, for_ages: bool) -> Self {
        let of_kind = SHIPPED
            .into_iter()
            .filter(|(name, _)| name.ends_with(AGES_SUFFIX) == for_ages);
        let differences = |(_, text): &(&str, &str)| read_training_site(text).differences(site).len();
        parse_shipped(of_kind.min_by_key(differences).unwrap_or(SHIPPED[0]).1)
    }

    /// Returns the shipped tables called `name`: `shipped` or `shipped-paper` for the preset `paper`, or
    /// `shipped-paper-literal`. The last two also exist with the suffix `-ages`, for ages.
    pub fn shipped_named(name: &str) -> Option<Self> {
        let name = if name == "shipped" { SHIPPED[0].0 } else { name };
        let (_, text) = SHIPPED.into_iter().find(|(shipped, _)| *shipped == name)?;
        Some(parse_shipped(text))
    }

    /// Reads the file at `path`.
    ///
    /// # Errors
    /// The file cannot be read, has another format or version, or is damaged.
    pub fn read(files: &dyn Files, path: &Path) -> Result<Self, LearnedError> {
        let bytes = files.read(path, MAX_FILE_BYTES).map_err(|error| match error {
            FileError::Io(error) => LearnedError::Read(error),
            FileError::Folder => LearnedError::Read(io::ErrorKind::IsADirectory.into()),
            FileError::Special => LearnedError::Foreign("it is not a regular file".to_owned()),
            FileError::TooLong { length, .. } => LearnedError::Foreign(format!("it is too long, {length} bytes")),
        })?;
        let text = String::from_utf8(bytes).map_err(|error| LearnedError::Foreign(error.to_string()))?;
        Self::parse(&text)
    }

    /// Parses the text of a file.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn parse(text: &str) -> Result<Self, LearnedError> {
        let foreign = || LearnedError::Foreign(format!("it does not begin with {{\"format\":\"{FORMAT}\""));
        let damaged = |error: serde_json::Error| LearnedError::Damaged(error.to_string());
        if !text.starts_with('{') || !text.contains(FORMAT) {
            return Err(foreign());
        }
        let (head_text, body) = text.split_once(BODY_START).unwrap_or((text.trim_end(), ""));
        let head_json = format!("{}}}", head_text.trim_end_matches('}'));
        let header: FileHeader = serde_json::from_str(&head_json).map_err(damaged)?;
        if header.format != FORMAT {
            return Err(foreign());
        }
        if header.version != u64::from(VERSION) {
            return Err(LearnedError::Version(header.version));
        }
        let body = body.trim_end().strip_suffix('}').unwrap_or(body);
        // Checked before parsing, since a damaged body can still be valid JSON.
        if sha256(body) != header.sha256 {
            return Err(LearnedError::Damaged(
                "its checksum does not match its content".to_owned(),
            ));
        }
        let mut body: FileBody = serde_json::from_str(body).map_err(damaged)?;
        // Rounded as in the file, since parsers may differ in the last bit.
        body.entries.iter_mut().for_each(TableSet::round);
        let learned = Self {
            made_by: body.made_by,
            scenario: body.scenario,
            weights: body.weights,
            begun_from: body.begun_from,
            schedule: body.schedule,
            training: body.training,
            site: body.setting,
            entries: body.entries,
        };
        learned.check().map_err(LearnedError::Damaged)?;
        Ok(learned)
    }

    /// Returns the text of the file: one line for each entry, table values rounded to 10⁻⁴.
    ///
    /// # Panics
    /// If a value is not finite or the tables are otherwise invalid.
    pub fn to_json(&self) -> String {
        if let Err(reason) = self.check() {
            panic!("{reason}");
        }
        let mut entries = self.entries.clone();
        entries.iter_mut().for_each(TableSet::round);
        let body = FileBody {
            made_by: self.made_by.clone(),
            scenario: self.scenario.clone(),
            weights: self.weights,
            begun_from: self.begun_from.clone(),
            schedule: self.schedule,
            training: self.training.clone(),
            setting: self.site.clone(),
            entries,
        };
        let body = serde_json::to_string(&body).expect("numbers and words");
        let body = body
            .replace(ENTRIES_START, &format!("{ENTRIES_START}\n"))
            .replace("},{\"devices\"", "},\n{\"devices\"");
        let checksum = sha256(&body);
        format!("{{\"format\":\"{FORMAT}\",\"version\":{VERSION},\"sha256\":\"{checksum}\"{BODY_START}{body}}}\n")
    }

    /// Checks the conditions that a policy relies on.
    fn check(&self) -> Result<(), String> {
        let QWeights { mu1, mu2, zeta } = self.weights;
        if ![mu1, mu2].iter().all(|mu| mu.is_finite() && *mu >= 0.0) || !(0.0..1.0).contains(&zeta) {
            return Err(format!(
                "its weights are out of range: mu1 {mu1}, mu2 {mu2}, zeta {zeta}; mu1 and mu2 must be at least 0, and \
                 zeta at least 0 and below 1"
            ));
        }
        let Schedule {
            rate_decay,
            rate_floor,
            optimism,
        } = self.schedule;
        let is_rate = |rate: f64| rate > 0.0 && rate <= 1.0;
        if !is_rate(rate_decay) || !is_rate(rate_floor) || !optimism.is_finite() || optimism < 0.0 {
            return Err(format!(
                "its schedule is out of range: rate_decay {rate_decay}, rate_floor {rate_floor}, optimism {optimism}; \
                 both rates must be above 0 and at most 1, and optimism at least 0"
            ));
        }
        if self.entries.is_empty() {
            return Err("it has no tables".to_owned());
        }
        for entry in &self.entries {
            let TableSet {
                devices,
                surface,
                lookback,
                duty,
                wake_p42,
                wake_posterior,
                ..
            } = entry;
            if !(1..=MAX_WINDOW).contains(&lookback.window()) {
                return Err(format!(
                    "it has tables for {}; a window must be from 1 to {MAX_WINDOW} TTIs",
                    lookback.describe()
                ));
            }
            if *devices == 0 || !surface.is_finite() || *surface <= 0.0 {
                return Err(format!(
                    "it has tables for {devices} devices on {surface} m²; both numbers must be above 0"
                ));
            }
            if !duty.has_valid_size() || ![wake_p42, wake_posterior].into_iter().all(WakeTable::has_valid_size) {
                return Err(format!("a table for {devices} devices has the wrong size"));
            }
            let mut cells = duty.cells().chain(&wake_p42.q).chain(&wake_posterior.q);
            if cells.any(|cell| !cell.value.is_finite()) {
                return Err(format!(
                    "a table for {devices} devices holds a value that is not a number"
                ));
            }
        }
        // `LearnedTables::lookbacks` and `LearnedTables::served_devices` rely on this order.
        let is_before = |a: &TableSet, b: &TableSet| {
            a.lookback < b.lookback || a.lookback == b.lookback && a.device_density() < b.device_density()
        };
        if !self.entries.is_sorted_by(is_before) {
            return Err("its tables are not in the order of their windows and densities".to_owned());
        }
        Ok(())
    }
}

impl TableSet {
    /// Rounds table values to 10⁻⁴ and the learning curve to 10⁻⁶, the precisions of a file.
    pub fn round(&mut self) {
        self.duty.round();
        self.wake_p42.round();
        self.wake_posterior.round();
        for point in &mut self.curve {
            for value in [&mut point.reward, &mut point.information, &mut point.energy] {
                *value = (*value * 1e6).round() / 1e6;
            }
        }
    }

    /// Returns the SHA-256 of all values that affect decisions, in this order, for the hash of a scenario.
    pub fn fingerprint(&self) -> [u8; 32] {
        let Self {
            devices,
            surface,
            lookback,
            duty: DutyTable { q, outcomes, value },
            wake_p42,
            wake_posterior,
            // The learning curve does not affect decisions.
            curve: _,
        } = self;
        let mut hasher = Sha256::new();
        hasher.update(devices.to_le_bytes());
        hasher.update(surface.to_bits().to_le_bytes());
        let window = match lookback {
            Lookback::Window(window) => *window,
            // No window has length 0.
            Lookback::Ages => 0,
        };
        hasher.update(window.to_le_bytes());
        for cell in q
            .iter()
            .chain(outcomes)
            .chain(value)
            .chain(&wake_p42.q)
            .chain(&wake_posterior.q)
        {
            hasher.update(cell.value.to_bits().to_le_bytes());
            hasher.update(cell.visits.to_le_bytes());
        }
        hasher.finalize().into()
    }
}

fn sha256(text: &str) -> String {
    Sha256::digest(text.as_bytes())
        .iter()
        .fold(String::new(), |mut digits, byte| {
            let _ = write!(digits, "{byte:02x}");
            digits
        })
}

#[cfg(test)]
mod tests {
    use super::super::FIRST_ABLE_BUCKET;
    use super::*;
    use crate::scenario::load;
    use crate::scenario::tests::{load_paper, overrides};

    /// Area of the presets `paper` and `paper-literal`, m².
    const PRESET_SURFACE: f64 = 400.0;

    /// Tables for the windows of 1 and 4 TTIs; one value is learned and has many digits.
    fn sample_tables() -> LearnedTables {
        let weights = QWeights {
            mu1: 14.0,
            mu2: 1.6,
            zeta: 0.95,
        };
        let site = TrainingSite {
            words: vec![("layout.kind".to_owned(), "uniform".to_owned())],
            numbers: vec![("events.alpha".to_owned(), 0.1)],
        };
        let optimistic_tables = |(window, n): (u32, u32)| {
            TableSet::optimistic(
                &load_paper(&[&format!("devices={n}")]).site(),
                &weights,
                Lookback::Window(window),
                1.0,
            )
        };
        let mut entries: Vec<TableSet> = [(1, 10), (1, 50), (4, 20)].map(optimistic_tables).to_vec();
        entries[0]
            .duty
            .at_mut(3, 4, true)
            .learn(1.0 / 3.0, Schedule::default().rates());
        LearnedTables {
            made_by: "reveille 0.1.0".to_owned(),
            scenario: "00".to_owned(),
            weights,
            begun_from: None,
            schedule: Schedule::default(),
            training: QTrainingConfig {
                episodes: 1,
                ttis: 100,
                epsilon: (0.1, 0.03),
                seed: 1,
            },
            site,
            entries,
        }
    }

    fn assert_refused(text: &str, reason: &str) {
        let message = LearnedTables::parse(text).expect_err(reason).to_string();
        assert!(message.contains(reason), "{message}");
    }

    #[test]
    fn a_file_round_trips_with_rounded_values() {
        let text = sample_tables().to_json();
        let read = LearnedTables::parse(&text).expect("a file");
        assert_eq!(read.to_json(), text);
        let [rounded, exact] = [&read, &sample_tables()].map(|tables| tables.entries[0].duty.at(3, 4, true).value);
        assert!(
            (rounded - exact).abs() <= 0.5e-4 && (rounded * 1e4 - (rounded * 1e4).round()).abs() < 1e-6,
            "{rounded} is not {exact} rounded to four digits"
        );
        let mut expected = sample_tables().entries[1].clone();
        expected.round();
        assert_eq!(read.entries[1], expected);
    }

    #[test]
    fn files_with_another_format_version_or_checksum_are_refused() {
        let text = sample_tables().to_json();
        assert_refused("devices = 5", "not a file of learned tables");
        for version in [2, 4] {
            let other_version = text.replace("\"version\":3", &format!("\"version\":{version}"));
            assert_refused(&other_version, &format!("has version {version}"));
        }
        assert_refused(
            "{\"format\":\"reveille-q-table\",\"version\":9,\"made\":1}",
            "has version 9",
        );
        assert_refused(&text[..text.len() / 2], "damaged");
        assert_refused(&text.replacen("20.0", "21.0", 1), "checksum");
        assert_refused("", "not a file of learned tables");
    }

    #[test]
    fn invalid_values_and_sizes_are_refused() {
        // With a valid checksum, so that the content is read.
        let sealed = |body: &str| {
            format!(
                "{{\"format\":\"{FORMAT}\",\"version\":{VERSION},\"sha256\":\"{}\",\"body\":{body}}}",
                sha256(body)
            )
        };
        let text = sample_tables().to_json();
        let (_, body) = text.split_once(BODY_START).expect("a file");
        let body = body.trim_end().strip_suffix('}').expect("a file");
        assert!(LearnedTables::parse(&sealed(body)).is_ok());
        assert_refused(&sealed(&body.replacen("[20.0,0]", "[null,0]", 1)), "damaged");
        assert_refused(&sealed(&body.replacen("[20.0,0]", "[1e999,0]", 1)), "damaged");
        assert_refused(&sealed(&body.replacen("[20.0,0],", "", 1)), "wrong size");
        assert_refused(&sealed(&body.replacen("\"zeta\":0.95", "\"zeta\":1.5", 1)), "zeta 1.5");
        assert_refused(
            &sealed(&body.replacen("\"window\":1", "\"window\":0", 1)),
            "a window of 0 TTIs",
        );
        for (field, value) in [
            ("rate_decay\":0.7", "-7.0"),
            ("rate_floor\":0.002", "0.0"),
            ("optimism\":1.0", "-1.0"),
        ] {
            let (name, _) = field.split_once('"').expect("a name");
            let replacement = format!("{name}\":{value}");
            assert_refused(&sealed(&body.replacen(field, &replacement, 1)), "its schedule is");
        }
        for (original, replacement) in [("devices\":10", "devices\":90"), ("window\":4", "window\":1")] {
            assert_refused(
                &sealed(&body.replacen(original, replacement, 1)),
                "order of their windows and densities",
            );
        }
    }

    #[test]
    fn the_nearest_density_is_used_within_a_factor_of_two() {
        let tables = sample_tables();
        let devices_of_entry = |n: u32, surface: f64| {
            tables
                .closest_entry(Lookback::Window(1), n, surface)
                .map(|entry| entry.devices)
        };
        assert_eq!(
            [
                (5, PRESET_SURFACE),
                (20, PRESET_SURFACE),
                (26, PRESET_SURFACE),
                (100, PRESET_SURFACE)
            ]
            .map(|(n, surface)| devices_of_entry(n, surface)),
            [Some(10), Some(10), Some(50), Some(50)]
        );
        assert_eq!(
            [
                (4, PRESET_SURFACE),
                (101, PRESET_SURFACE),
                (1000, 10.0 * PRESET_SURFACE)
            ]
            .map(|(n, surface)| devices_of_entry(n, surface)),
            [None, None, Some(50)]
        );
        assert_eq!(
            [1, 4].map(|window| tables.served_devices(Lookback::Window(window), PRESET_SURFACE)),
            [(5, 100), (10, 40)]
        );
        let devices_of_window = |window: u32, n: u32| {
            tables
                .closest_entry(Lookback::Window(window), n, PRESET_SURFACE)
                .map(|entry| entry.devices)
        };
        assert_eq!(
            [(4, 40), (4, 41), (2, 20)].map(|(window, n)| devices_of_window(window, n)),
            [Some(20), None, None]
        );
        assert!(tables.closest_entry(Lookback::Ages, 20, PRESET_SURFACE).is_none());
        assert_eq!(tables.lookbacks(), [1, 4].map(Lookback::Window));
        assert_eq!(
            [1, 3, 5].map(|window| tables.nearest_window(window)),
            [1, 4, 4].map(Some)
        );
    }

    #[test]
    fn shipped_tables_for_ages_let_devices_sense_old_places() {
        for (_, text) in SHIPPED.into_iter().filter(|(name, _)| name.ends_with(AGES_SUFFIX)) {
            for entry in parse_shipped(text).entries {
                let advantages = entry.duty.advantages();
                // The least gain at which a device senses, for each battery bucket that pays for a report.
                let able_buckets = advantages.iter().skip(usize::from(FIRST_ABLE_BUCKET));
                let min_gains: Vec<Option<f64>> = able_buckets.map(|row| Lookback::Ages.advantage_start(row)).collect();
                // A device in a corner covers a quarter of a disc, here with places of the largest worth.
                let is_reachable = |min_gain: &&f64| **min_gain < 0.25 * Lookback::Ages.max_gain();
                let reachable_count = min_gains.iter().flatten().filter(is_reachable).count();
                // At least half of the six buckets.
                assert!(reachable_count >= 3, "N = {}: least gains {min_gains:?}", entry.devices);
            }
        }
    }

    #[test]
    fn the_shipped_tables_match_a_training_with_the_current_presets() {
        for (name, text) in SHIPPED {
            let tables = parse_shipped(text);
            assert_eq!(read_training_site(text), tables.site);
            let mut fields = vec![
                "policy.name=q-learning",
                "policy.q-learning.learn=true",
                "policy.q-learning.table=nothing",
            ];
            if name.ends_with(AGES_SUFFIX) {
                assert_eq!(tables.lookbacks(), [Lookback::Ages]);
                fields.push("policy.q-learning.ages=true");
            } else {
                assert_eq!(tables.lookbacks(), [1, 2, 4].map(Lookback::Window));
            }
            for lookback in tables.lookbacks() {
                let (fewest, most) = tables.served_devices(lookback, PRESET_SURFACE);
                assert!(
                    fewest == 5 && most >= 500,
                    "{name}, {lookback}: {fewest} to {most} devices"
                );
            }
            let preset = name.trim_start_matches("shipped-").trim_end_matches(AGES_SUFFIX);
            let mut scenario = load(preset, &overrides(&fields)).expect("a preset").scenario;
            assert!(
                TrainingSite::from_site(&scenario.site())
                    .differences(&tables.site)
                    .is_empty(),
                "{preset}"
            );
            scenario.run.devices = tables.entries[0].devices;
            assert_eq!(
                scenario.hash_hex(),
                tables.scenario,
                "{preset}: train again as in docs/q-learning.md"
            );
        }
    }
}
