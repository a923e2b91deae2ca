//! What a run depends on beside scenario and seed, as text: a line for each such input, in the order in which they
//! came.
//!
//! So far these are outages, of devices whose process was lost under `--on-loss continue`.

use reveille_common::message::Outage;
use reveille_common::scenario::Scenario;
use serde::{Deserialize, Serialize};

/// The form of the text.
const VERSION: u32 = 1;

/// Why a text is no log of inputs.
#[derive(Debug, thiserror::Error)]
pub enum InputsError {
    /// A line has another form.
    #[error("line {line} is none of a log of inputs")]
    Line {
        /// Its number, from 1.
        line: usize,
        /// What is wrong with it.
        source: serde_json::Error,
    },
    /// It has the form of another version.
    #[error("another version of reveille wrote it; use that one")]
    Version,
    /// It is of another run.
    #[error("is of a run of another scenario or seed than this one")]
    Scenario,
    /// It does not begin with the line that names its run.
    #[error("line {0} comes before the line that names the run")]
    Headless(usize),
    /// There can have been no such outage.
    #[error("line {0} is an outage that cannot have come then")]
    Outage(usize),
}

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

impl Entry {
    fn line(&self) -> String {
        serde_json::to_string(self).expect("an entry is JSON") + "\n"
    }
}

/// The first line of the log of a run of `scenario`.
pub fn first_line(scenario: &Scenario) -> String {
    let first = Entry::Inputs {
        version: VERSION,
        scenario_hash: scenario.hash_hex(),
    };
    first.line()
}

/// The line of an outage.
pub fn line(outage: &Outage) -> String {
    Entry::Outage(*outage).line()
}

/// The whole lines of a log. The last one of a run that was killed may not be whole; nothing depends on that.
pub fn whole(text: &str) -> &str {
    &text[..text.rfind('\n').map_or(0, |last| last + 1)]
}

/// The inputs in the whole lines of a log of a run of `scenario`.
///
/// # Errors
/// It is no log, that of a run of another scenario, or says what cannot have come.
pub fn parse(text: &str, scenario: &Scenario) -> Result<Vec<Outage>, InputsError> {
    let mut outages: Vec<Outage> = Vec::new();
    let mut has_begun = false;
    for (number, text) in (1..).zip(whole(text).lines()) {
        let entry = serde_json::from_str(text).map_err(|source| InputsError::Line { line: number, source })?;
        match entry {
            Entry::Inputs { version, .. } if version != VERSION => return Err(InputsError::Version),
            Entry::Inputs { scenario_hash, .. } if scenario_hash != scenario.hash_hex() => {
                return Err(InputsError::Scenario);
            }
            Entry::Inputs { .. } => has_begun = true,
            Entry::Outage(_) if !has_begun => return Err(InputsError::Headless(number)),
            Entry::Outage(outage) => {
                if !may_come(&outage, &outages, scenario) {
                    return Err(InputsError::Outage(number));
                }
                outages.push(outage);
            }
        }
    }
    Ok(outages)
}

/// Whether `outage` may come after those `before`.
fn may_come(outage: &Outage, before: &[Outage], scenario: &Scenario) -> bool {
    let order = |outage: &Outage| (outage.tti, outage.wake_ups);
    let is_next = before.last().is_none_or(|last| order(last) <= order(outage));
    let is_apart = |other: &Outage| other.last() < outage.first || outage.last() < other.first;
    outage.is_sound(scenario.devices) && outage.tti.0 < scenario.ttis && is_next && before.iter().all(is_apart)
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

    /// What is read of a log of these outages, whose last line is torn.
    fn written_and_read(outages: &[Outage]) -> Result<Vec<Outage>, InputsError> {
        let scenario = load("quick", &[]).expect("a preset");
        let lines: String = outages.iter().map(line).collect();
        parse(&format!("{}{lines}{{\"outage\":", first_line(&scenario)), &scenario)
    }

    #[test]
    fn a_log_is_read_up_to_its_last_whole_line() {
        let outages = [outage(3, 2, 5), outage(0, 3, 5), outage(9, 1, 80)];
        assert_eq!(written_and_read(&outages).expect("a log"), outages);
        assert!(written_and_read(&[]).expect("a log").is_empty());
    }

    #[test]
    fn what_cannot_have_come_is_refused() {
        let impossible = [
            vec![outage(0, 0, 5)],
            vec![outage(3, 2, 5), outage(0, 0, 6)],
            vec![outage(u32::MAX, 2, 5)],
            vec![outage(0, 1, u64::MAX)],
            vec![outage(3, 2, 5), outage(4, 1, 9)],
            vec![outage(3, 2, 5), outage(0, 1, 4)],
        ];
        for outages in impossible {
            let refused = written_and_read(&outages).expect_err("impossible");
            assert!(matches!(refused, InputsError::Outage(_)), "{refused}");
        }
        let scenario = load("quick", &[]).expect("a preset");
        let of = |text: &str| parse(text, &scenario).expect_err("no log of this run");
        assert!(matches!(of("{}\n"), InputsError::Line { line: 1, .. }));
        assert!(matches!(of(&line(&outage(0, 1, 1))), InputsError::Headless(1)));
        let other = |version| format!("{{\"inputs\":{{\"version\":{version},\"scenario_hash\":\"00\"}}}}\n");
        assert!(matches!(of(&other(1)), InputsError::Scenario));
        assert!(matches!(of(&other(2)), InputsError::Version));
    }
}
