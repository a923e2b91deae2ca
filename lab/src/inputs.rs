//! What a run depends on beside scenario and seed, as text: a line for each such input, in the order in which they
//! came.
//!
//! These are outages, of devices whose process was lost under `--on-loss continue`, and decisions from outside.

use reveille_bs::policy::external::{Answer, Answered, Decision};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Outage;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::scenario::Scenario;
use serde::{Deserialize, Serialize};

/// The form of the text.
const VERSION: u32 = 2;

/// Why a text is no log of inputs.
#[derive(Debug, thiserror::Error)]
pub enum InputsError {
    /// A line has another form.
    #[error("line {line} is none of a log of inputs, at column {column}: {what}")]
    Line {
        /// Its number, from 1.
        line: usize,
        /// Where it is wrong, from 1.
        column: usize,
        /// What is wrong with it.
        what: String,
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
    /// There can have been no such decision.
    #[error("line {0} is a decision that nobody can have made then")]
    Decision(usize),
}

/// An input.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Input {
    /// Devices went.
    Outage(Outage),
    /// Somebody outside decided.
    Decision(Answered),
}

/// All inputs of a run, each kind in the order in which they came.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Inputs {
    /// Outages.
    pub outages: Vec<Outage>,
    /// Decisions.
    pub decisions: Vec<Answered>,
}

impl Inputs {
    /// Outages alone.
    pub fn of_outages(outages: &[Outage]) -> Self {
        Self {
            outages: outages.to_vec(),
            decisions: Vec::new(),
        }
    }

    /// One more, the last of its kind.
    pub fn add(&mut self, input: Input) {
        match input {
            Input::Outage(outage) => self.outages.push(outage),
            Input::Decision(decision) => self.decisions.push(decision),
        }
    }

    /// Those that came before TTI `k`.
    #[must_use]
    pub fn before(&self, k: Tti) -> Self {
        let (outages, decisions) = (self.outages.iter(), self.decisions.iter());
        Self {
            outages: outages.copied().filter(|outage| outage.tti < k).collect(),
            decisions: decisions.filter(|decision| decision.tti < k).cloned().collect(),
        }
    }

    /// Each of them.
    pub fn iter(&self) -> impl Iterator<Item = Input> {
        let outages = self.outages.iter().copied().map(Input::Outage);
        outages.chain(self.decisions.iter().cloned().map(Input::Decision))
    }
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
    /// Who senses from TTI `tti` on; what is asked next for a plan is TTI `next`.
    Sense {
        tti: u64,
        devices: Vec<u32>,
        next: u64,
    },
    /// The same, as `t_on`, `t_drx` and offset of each device.
    Cycles {
        tti: u64,
        devices: Vec<[u32; 3]>,
        next: u64,
    },
    /// Who is woken in TTI `tti`, in this order.
    Wake {
        tti: u64,
        devices: Vec<u32>,
    },
}

impl Entry {
    fn line(&self) -> String {
        serde_json::to_string(self).expect("an entry is JSON") + "\n"
    }
}

impl From<&Answered> for Entry {
    fn from(Answered { tti: Tti(tti), answer }: &Answered) -> Self {
        let tti = *tti;
        match answer {
            Answer::Wake(devices) => Self::Wake {
                tti,
                devices: devices.iter().map(|device| device.0).collect(),
            },
            Answer::Plan(Decision { plan, next }) => match plan {
                Plan::Bits { bits } => Self::Sense {
                    tti,
                    devices: Plan::chosen(bits).map(|device| device.0).collect(),
                    next: next.0,
                },
                Plan::Periodic(cycles) => Self::Cycles {
                    tti,
                    devices: cycles.iter().map(|c| [c.t_on, c.t_drx, c.offset]).collect(),
                    next: next.0,
                },
            },
        }
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

/// The line of an input.
pub fn line(input: &Input) -> String {
    match input {
        Input::Outage(outage) => Entry::Outage(*outage).line(),
        Input::Decision(decision) => Entry::from(decision).line(),
    }
}

/// The whole lines of a log. The last one of a run that was killed may not be whole; nothing depends on that.
pub fn whole(text: &str) -> &str {
    &text[..text.rfind('\n').map_or(0, |last| last + 1)]
}

/// The inputs in the whole lines of a log of a run of `scenario`.
///
/// # Errors
/// It is no log, that of a run of another scenario, or says what cannot have come.
pub fn parse(text: &str, scenario: &Scenario) -> Result<Inputs, InputsError> {
    let mut parser = Parser::default();
    parser.read(text, scenario)?;
    Ok(parser.inputs)
}

/// Reads a log that comes part by part, as that of a run that goes on does.
#[derive(Clone, Debug, Default)]
pub struct Parser {
    inputs: Inputs,
    /// Lines that were read.
    lines: usize,
    has_begun: bool,
}

impl Parser {
    /// The inputs so far.
    pub const fn inputs(&self) -> &Inputs {
        &self.inputs
    }

    /// Takes in the whole lines at the beginning of `text`, which follows the last one that was taken in, and gives
    /// their length in bytes. All parts are of a run of the same `scenario`.
    ///
    /// # Errors
    /// As of [`parse`].
    pub fn read(&mut self, text: &str, scenario: &Scenario) -> Result<usize, InputsError> {
        let text = whole(text);
        for line in text.lines() {
            self.lines += 1;
            self.take(line, scenario)?;
        }
        Ok(text.len())
    }

    fn take(&mut self, text: &str, scenario: &Scenario) -> Result<(), InputsError> {
        let Self {
            inputs,
            lines: line,
            has_begun,
        } = self;
        let entry = serde_json::from_str(text).map_err(|error| bad_line(*line, &error))?;
        let decision = match entry {
            Entry::Inputs { version, .. } if !(1..=VERSION).contains(&version) => return Err(InputsError::Version),
            Entry::Inputs { scenario_hash, .. } if scenario_hash != scenario.hash_hex() => {
                return Err(InputsError::Scenario);
            }
            Entry::Inputs { .. } => {
                *has_begun = true;
                return Ok(());
            }
            _ if !*has_begun => return Err(InputsError::Headless(*line)),
            Entry::Outage(outage) => {
                if !may_come(&outage, &inputs.outages, scenario) {
                    return Err(InputsError::Outage(*line));
                }
                inputs.outages.push(outage);
                return Ok(());
            }
            Entry::Sense { tti, devices, next } => chosen(&devices, scenario).map(|devices| {
                let plan = Plan::from_chosen(scenario.devices as usize, &devices);
                (tti, Answer::Plan(Decision { plan, next: Tti(next) }))
            }),
            Entry::Cycles { tti, devices, next } => cycles(&devices, scenario).map(|cycles| {
                let plan = Plan::Periodic(cycles);
                (tti, Answer::Plan(Decision { plan, next: Tti(next) }))
            }),
            Entry::Wake { tti, devices } => chosen(&devices, scenario).map(|devices| (tti, Answer::Wake(devices))),
        };
        let decision = decision.map(|(tti, answer)| Answered { tti: Tti(tti), answer });
        let decision = decision.filter(|decision| may_be_made(decision, inputs.decisions.last(), scenario));
        inputs.decisions.push(decision.ok_or(InputsError::Decision(*line))?);
        Ok(())
    }
}

/// What is wrong in the line with this number. An error of JSON counts the lines of what it was given, which is one.
fn bad_line(line: usize, error: &serde_json::Error) -> InputsError {
    let (column, what) = (error.column(), error.to_string());
    let place = format!(" at line {} column {column}", error.line());
    let what = what.strip_suffix(&place).unwrap_or(&what).to_owned();
    let column = column.max(1);
    InputsError::Line { line, column, what }
}

/// These devices, if all are there.
fn chosen(devices: &[u32], scenario: &Scenario) -> Option<Vec<DeviceId>> {
    let is_there = devices.iter().all(|device| *device < scenario.devices);
    is_there.then(|| devices.iter().copied().map(DeviceId).collect())
}

/// These cycles, if there is one for each device.
fn cycles(devices: &[[u32; 3]], scenario: &Scenario) -> Option<Vec<DutyCycle>> {
    let cycles = devices
        .iter()
        .map(|&[t_on, t_drx, offset]| DutyCycle { t_on, t_drx, offset });
    let cycles: Vec<DutyCycle> = cycles.filter(|cycle| cycle.is_valid()).collect();
    (cycles.len() == devices.len() && devices.len() == scenario.devices as usize).then_some(cycles)
}

/// Whether `outage` may come after those `before`.
fn may_come(outage: &Outage, before: &[Outage], scenario: &Scenario) -> bool {
    let order = |outage: &Outage| (outage.tti, outage.wake_ups);
    let is_next = before.last().is_none_or(|last| order(last) <= order(outage));
    let is_apart = |other: &Outage| other.last() < outage.first || outage.last() < other.first;
    outage.is_sound(scenario.devices) && outage.tti.0 < scenario.ttis && is_next && before.iter().all(is_apart)
}

/// Whether `decision` may be made after the one `before`: a run begins with a plan, and there is one in a TTI.
fn may_be_made(decision: &Answered, before: Option<&Answered>, scenario: &Scenario) -> bool {
    let Some(before) = before else {
        return decision.tti == Tti::ZERO && matches!(decision.answer, Answer::Plan(_));
    };
    let is_later = match decision.answer {
        Answer::Plan(Decision { next, .. }) => decision.tti > before.tti && next > decision.tti,
        Answer::Wake(_) => decision.tti >= before.tti,
    };
    is_later && decision.tti.0 < scenario.ttis
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

    /// What is read of a log of these inputs, whose last line is torn.
    fn written_and_read(inputs: &[Input]) -> Result<Inputs, InputsError> {
        let scenario = load("quick", &[]).expect("a preset");
        let lines: String = inputs.iter().map(line).collect();
        parse(&format!("{}{lines}{{\"outage\":", first_line(&scenario)), &scenario)
    }

    fn plan(tti: u64, plan: Plan, next: u64) -> Answered {
        let next = Tti(next);
        let answer = Answer::Plan(Decision { plan, next });
        Answered { tti: Tti(tti), answer }
    }

    fn wake(tti: u64, devices: &[u32]) -> Answered {
        let answer = Answer::Wake(devices.iter().copied().map(DeviceId).collect());
        Answered { tti: Tti(tti), answer }
    }

    /// A plan of the right size, in which device `j` senses.
    fn bits(j: u32) -> Plan {
        let devices = load("quick", &[]).expect("a preset").devices;
        Plan::from_chosen(devices as usize, &[DeviceId(j)])
    }

    #[test]
    fn a_log_is_read_up_to_its_last_whole_line() {
        let devices = load("quick", &[]).expect("a preset").devices as usize;
        let inputs = Inputs {
            outages: vec![outage(3, 2, 5), outage(0, 3, 5), outage(9, 1, 80)],
            decisions: vec![
                plan(0, bits(3), 1),
                wake(0, &[7, 2]),
                wake(0, &[]),
                plan(1, Plan::Periodic(vec![DutyCycle::SENSING; devices]), u64::MAX),
                wake(60, &[1]),
            ],
        };
        let all: Vec<Input> = inputs.iter().collect();
        assert_eq!(written_and_read(&all).expect("a log"), inputs);
        let scenario = load("quick", &[]).expect("a preset");
        let text = first_line(&scenario) + &all.iter().map(line).collect::<String>();
        for length in [1, 7, 60, 4000] {
            let (mut parser, mut read, mut end) = (Parser::default(), 0, 0);
            while read < text.len() {
                end = text.len().min(end + length);
                read += parser.read(&text[read..end], &scenario).expect("a log");
            }
            assert_eq!(parser.inputs(), &inputs, "{length} bytes at a time");
        }
        assert_eq!(written_and_read(&[]).expect("a log"), Inputs::default());
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
            let outages: Vec<Input> = outages.into_iter().map(Input::Outage).collect();
            let refused = written_and_read(&outages).expect_err("impossible");
            assert!(matches!(refused, InputsError::Outage(_)), "{refused}");
        }
        let first = || plan(0, bits(3), 1);
        let impossible = [
            vec![plan(1, bits(3), 2)],
            vec![wake(0, &[1])],
            vec![first(), plan(0, bits(3), 1)],
            vec![first(), plan(1, bits(3), 1)],
            vec![first(), wake(1, &[1]), plan(1, bits(3), 2)],
            vec![first(), wake(0, &[u32::MAX])],
            vec![first(), plan(1, Plan::Periodic(vec![DutyCycle::SENSING]), 2)],
            vec![first(), plan(u64::MAX, bits(3), 2)],
        ];
        for decisions in impossible {
            let decisions: Vec<Input> = decisions.into_iter().map(Input::Decision).collect();
            let refused = written_and_read(&decisions).expect_err("impossible");
            assert!(matches!(refused, InputsError::Decision(_)), "{refused}");
        }
        let scenario = load("quick", &[]).expect("a preset");
        let of = |text: &str| parse(text, &scenario).expect_err("no log of this run");
        assert_eq!(
            of("{\"wake\":{\"tti\":true}}\n").to_string(),
            "line 1 is none of a log of inputs, at column 19: invalid type: boolean `true`, expected u64"
        );
        assert!(matches!(
            of(&line(&Input::Outage(outage(0, 1, 1)))),
            InputsError::Headless(1)
        ));
        let other = |version| format!("{{\"inputs\":{{\"version\":{version},\"scenario_hash\":\"00\"}}}}\n");
        assert!(matches!(of(&other(VERSION)), InputsError::Scenario));
        assert!(matches!(of(&other(VERSION + 1)), InputsError::Version));
    }
}
