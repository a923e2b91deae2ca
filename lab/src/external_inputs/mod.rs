//! The external inputs of a run as text, the input log (a replay log): a line that names the run, then one line for
//! each input. Inputs of a kind are in order of arrival. `deploy/src/input_log.rs` writes and reads the file.
//!
//! External inputs are removals of devices, whose process was lost under `--on-loss continue`, decisions of a policy
//! process, and actions of operators. They and the scenario determine the run: replays and resumed runs read them from
//! `inputs.log`. A change of the lines needs a new `VERSION`; `docs/external-policies.md` shows some. Logs of version
//! 1, which has only removals, and of version 2, which has no actions, must still be read. A resumed run appends its
//! actions to such a log.

#[cfg(test)]
mod tests;

use reveille_bs::actions::check_change;
use reveille_bs::policy::external::{Decision, PlanDecision, RecordedDecision};
use reveille_bs::scenario::Scenario;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, DeviceRange, DeviceRemoval, OperatorAction, Setting};
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::units::Energy;
use serde::{Deserialize, Serialize};

/// The version in the first line of a new log.
const VERSION: u32 = 3;

/// A reason why a text is not an input log of a scenario.
#[derive(Debug, thiserror::Error)]
pub enum InputLogError {
    /// A line is malformed.
    #[error("line {line}, column {column}: invalid input log entry: {cause}; use the inputs.log of a run folder")]
    Line {
        /// The line number, from 1.
        line: usize,
        /// The column of the error, from 1.
        column: usize,
        /// The cause.
        cause: String,
    },
    /// The log has another format version.
    #[error("was written by another version of reveille; use that version")]
    Version,
    /// The log belongs to another run.
    #[error("belongs to a run of another scenario or seed; use `--scenario scenario.toml` from its run folder")]
    Scenario,
    /// The log does not begin with the line that names its run.
    #[error("line {0}: the line that names the run must come first")]
    MissingFirstLine(usize),
    /// A second line names a run.
    #[error("line {0}: a second line names the run; use the unedited inputs.log of a run folder")]
    SecondFirstLine(usize),
    /// A log of version 1 holds a decision.
    #[error("line {0}: a log of version 1 holds no decisions; use the unedited inputs.log of a run folder")]
    DecisionInVersion1(usize),
    /// An action is impossible in this run.
    #[error("line {line}: {cause}")]
    Action {
        /// The line number, from 1.
        line: usize,
        /// The cause and the fix.
        cause: String,
    },
    /// A removal is impossible in this run.
    #[error("line {0}: this run cannot have removed these devices at this point")]
    Removal(usize),
    /// A decision is impossible in this run.
    #[error("line {0}: this run cannot have had this decision at this point")]
    Decision(usize),
}

/// An external input.
#[derive(Clone, Debug, PartialEq)]
pub enum ExternalInput {
    /// A removal of devices.
    Removal(DeviceRemoval),
    /// A decision of a policy process.
    Decision(RecordedDecision),
    /// An action of an operator.
    Action(OperatorAction),
}

/// All external inputs of a run, each kind in order of arrival.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ExternalInputs {
    /// The removals.
    pub removals: Vec<DeviceRemoval>,
    /// The decisions.
    pub decisions: Vec<RecordedDecision>,
    /// The actions, which need not be in the order of their TTIs.
    pub actions: Vec<OperatorAction>,
}

impl ExternalInputs {
    /// Creates inputs with removals only.
    pub fn from_removals(removals: &[DeviceRemoval]) -> Self {
        Self {
            removals: removals.to_vec(),
            ..Self::default()
        }
    }

    /// Creates inputs with actions only.
    pub fn from_actions(actions: &[OperatorAction]) -> Self {
        Self {
            actions: actions.to_vec(),
            ..Self::default()
        }
    }

    /// Appends an input to its kind.
    pub fn add(&mut self, input: ExternalInput) {
        match input {
            ExternalInput::Removal(removal) => self.removals.push(removal),
            ExternalInput::Decision(decision) => self.decisions.push(decision),
            ExternalInput::Action(action) => self.actions.push(action),
        }
    }

    /// Returns the removals and decisions of the TTIs before `k`, and all actions, which do not depend on the run: a
    /// run resumed at `k` must still make them.
    #[must_use]
    pub fn before(&self, k: Tti) -> Self {
        let (removals, decisions) = (self.removals.iter(), self.decisions.iter());
        Self {
            removals: removals.copied().filter(|removal| removal.tti < k).collect(),
            decisions: decisions.filter(|decision| decision.tti < k).cloned().collect(),
            actions: self.actions.clone(),
        }
    }

    /// Returns the inputs without the first ones of each kind, as many as `known_counts`, which an earlier call of
    /// [`Self::counts`] returned.
    ///
    /// # Panics
    /// If there are fewer.
    #[must_use]
    pub fn after(&self, known_counts: [usize; 3]) -> Self {
        Self {
            removals: self.removals[known_counts[0]..].to_vec(),
            decisions: self.decisions[known_counts[1]..].to_vec(),
            actions: self.actions[known_counts[2]..].to_vec(),
        }
    }

    /// The numbers of removals, decisions and actions, in the order that [`Self::after`] expects.
    pub const fn counts(&self) -> [usize; 3] {
        [self.removals.len(), self.decisions.len(), self.actions.len()]
    }

    /// Iterates over all inputs: removals, decisions, actions. The kinds are not merged by TTI.
    pub fn iter(&self) -> impl Iterator<Item = ExternalInput> {
        let removals = self.removals.iter().copied().map(ExternalInput::Removal);
        let decisions = self.decisions.iter().cloned().map(ExternalInput::Decision);
        removals
            .chain(decisions)
            .chain(self.actions.iter().copied().map(ExternalInput::Action))
    }
}

/// A line of the log. The names here, in snake case, are the keys of its JSON; a removal has the field names of
/// [`DeviceRemoval`].
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum InputLogLine {
    /// The first line, which names the run.
    Inputs { version: u32, scenario_hash: String },
    /// A removal of devices; logs name it an outage.
    #[serde(rename = "outage")]
    Removal(DeviceRemoval),
    /// The devices that sense from TTI `tti` on; the next plan is due in TTI `next`.
    Sense { tti: u64, devices: Vec<u32>, next: u64 },
    /// A plan of duty cycles: `t_on`, `t_drx` and offset of each device.
    Cycles {
        tti: u64,
        devices: Vec<[u32; 3]>,
        next: u64,
    },
    /// The devices to wake in TTI `tti`, in this order.
    Wake { tti: u64, devices: Vec<u32> },
    /// `count` devices from `first` on fail at the start of TTI `tti`.
    Fail { tti: u64, first: u32, count: u32 },
    /// `count` devices from `first` on are revived.
    Revive { tti: u64, first: u32, count: u32 },
    /// Each of `count` devices from `first` on receives `micro` micro-units of energy.
    Energy {
        tti: u64,
        first: u32,
        count: u32,
        micro: u64,
    },
    /// The scenario field `field` is set to `value`.
    Set { tti: u64, field: String, value: f64 },
}

impl InputLogLine {
    fn to_text(&self) -> String {
        serde_json::to_string(self).expect("an entry is JSON") + "\n"
    }
}

impl From<&RecordedDecision> for InputLogLine {
    fn from(
        RecordedDecision {
            tti: Tti(tti),
            decision,
        }: &RecordedDecision,
    ) -> Self {
        let tti = *tti;
        match decision {
            Decision::Wake(devices) => Self::Wake {
                tti,
                devices: devices.iter().map(|device| device.0).collect(),
            },
            Decision::Plan(PlanDecision { plan, next }) => match plan {
                Plan::Bits { bits } => Self::Sense {
                    tti,
                    devices: Plan::sensing_devices(bits).map(|device| device.0).collect(),
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

impl From<&OperatorAction> for InputLogLine {
    fn from(OperatorAction { tti: Tti(tti), change }: &OperatorAction) -> Self {
        let tti = *tti;
        match *change {
            Change::Fail(DeviceRange { first, count }) => Self::Fail {
                tti,
                first: first.0,
                count,
            },
            Change::Revive(DeviceRange { first, count }) => Self::Revive {
                tti,
                first: first.0,
                count,
            },
            Change::AddEnergy(DeviceRange { first, count }, energy) => Self::Energy {
                tti,
                first: first.0,
                count,
                micro: energy.micro(),
            },
            Change::Set(setting, value) => Self::Set {
                tti,
                field: setting.field().to_owned(),
                value,
            },
        }
    }
}

/// Returns the first line of the log of a run of `scenario`, with its line feed.
pub fn first_line(scenario: &Scenario) -> String {
    first_line_of(VERSION, scenario)
}

fn first_line_of(version: u32, scenario: &Scenario) -> String {
    let first = InputLogLine::Inputs {
        version,
        scenario_hash: scenario.hash_hex(),
    };
    first.to_text()
}

/// Returns the line of an input, with its line feed.
pub fn input_line(input: &ExternalInput) -> String {
    match input {
        ExternalInput::Removal(removal) => InputLogLine::Removal(*removal).to_text(),
        ExternalInput::Decision(decision) => InputLogLine::from(decision).to_text(),
        ExternalInput::Action(action) => InputLogLine::from(action).to_text(),
    }
}

/// Returns the complete lines of a log. After a kill the last line may be incomplete; the run does not depend on it.
pub fn complete_lines(text: &str) -> &str {
    &text[..text.rfind('\n').map_or(0, |last| last + 1)]
}

/// Parses the complete lines of a log of a run of `scenario`.
///
/// A kill can leave an incomplete last line, which is ignored. Without a complete line, the text must be the start of a
/// first line.
///
/// # Errors
/// If the text is not an input log, belongs to another scenario, or contains an impossible input.
pub fn parse(text: &str, scenario: &Scenario) -> Result<ExternalInputs, InputLogError> {
    let mut parser = InputLogParser::default();
    let read_bytes = parser.read(text, scenario)?;
    let incomplete_line = &text[read_bytes..];
    let is_start_of_first_line =
        (1..=VERSION).any(|version| first_line_of(version, scenario).starts_with(incomplete_line));
    if read_bytes == 0 && !is_start_of_first_line {
        parser.line_count = 1;
        parser.parse_line(incomplete_line, scenario)?;
    }
    Ok(parser.inputs)
}

/// Whether an input log, of any scenario, holds decisions of a policy process.
pub fn holds_decisions(text: &str) -> bool {
    complete_lines(text).lines().any(|line| {
        matches!(
            serde_json::from_str(line),
            Ok(InputLogLine::Sense { .. } | InputLogLine::Cycles { .. } | InputLogLine::Wake { .. })
        )
    })
}

/// Parses only the actions in the complete lines of a log, for a run of `scenario`, which may differ from the logged
/// run. Removals and decisions belong to the logged run and are left out.
///
/// # Errors
/// If the text is not an input log, or an action is impossible in a run of `scenario`.
pub fn parse_actions(text: &str, scenario: &Scenario) -> Result<Vec<OperatorAction>, InputLogError> {
    let mut parser = InputLogParser {
        reads_only_actions: true,
        ..InputLogParser::default()
    };
    parser.read(text, scenario)?;
    Ok(parser.inputs.actions)
}

/// An incremental parser, for example for the log of a run in progress. After an error it must not be used further.
#[derive(Clone, Debug, Default)]
pub struct InputLogParser {
    inputs: ExternalInputs,
    /// The number of lines read.
    line_count: usize,
    /// The version in the first line, once that line is read.
    version: Option<u32>,
    /// Whether the log may belong to another scenario; all inputs except actions are then left out.
    reads_only_actions: bool,
}

impl InputLogParser {
    /// The inputs so far.
    pub const fn inputs(&self) -> &ExternalInputs {
        &self.inputs
    }

    /// Parses the complete lines at the start of `text`, which continues the previous call's text. Returns their length
    /// in bytes. All parts must come from a run of the same `scenario`.
    ///
    /// # Errors
    /// See [`parse`].
    pub fn read(&mut self, text: &str, scenario: &Scenario) -> Result<usize, InputLogError> {
        let text = complete_lines(text);
        for line in text.lines() {
            self.line_count += 1;
            self.parse_line(line, scenario)?;
        }
        Ok(text.len())
    }

    fn parse_line(&mut self, text: &str, scenario: &Scenario) -> Result<(), InputLogError> {
        let Self {
            inputs,
            line_count: line_number,
            version: log_version,
            reads_only_actions,
        } = self;
        let parsed_line = serde_json::from_str(text).map_err(|error| line_error(*line_number, &error))?;
        let decision = match parsed_line {
            InputLogLine::Inputs { .. } if log_version.is_some() => {
                return Err(InputLogError::SecondFirstLine(*line_number));
            }
            InputLogLine::Inputs { version, .. } if !(1..=VERSION).contains(&version) => {
                return Err(InputLogError::Version);
            }
            InputLogLine::Inputs { scenario_hash, .. }
                if !*reads_only_actions && scenario_hash != scenario.hash_hex() =>
            {
                return Err(InputLogError::Scenario);
            }
            InputLogLine::Inputs { version, .. } => {
                *log_version = Some(version);
                return Ok(());
            }
            // Everything below is checked against the scenario, which only the first line guarantees.
            _ if log_version.is_none() => return Err(InputLogError::MissingFirstLine(*line_number)),
            InputLogLine::Removal(_)
            | InputLogLine::Sense { .. }
            | InputLogLine::Cycles { .. }
            | InputLogLine::Wake { .. }
                if *reads_only_actions =>
            {
                return Ok(());
            }
            InputLogLine::Removal(removal) => {
                if !is_possible_removal(&removal, &inputs.removals, scenario) {
                    return Err(InputLogError::Removal(*line_number));
                }
                inputs.removals.push(removal);
                return Ok(());
            }
            InputLogLine::Sense { .. } | InputLogLine::Cycles { .. } | InputLogLine::Wake { .. }
                if *log_version == Some(1) =>
            {
                return Err(InputLogError::DecisionInVersion1(*line_number));
            }
            InputLogLine::Fail { tti, first, count } => {
                return self.add_action(tti, Change::Fail(device_range(first, count)), scenario);
            }
            InputLogLine::Revive { tti, first, count } => {
                return self.add_action(tti, Change::Revive(device_range(first, count)), scenario);
            }
            InputLogLine::Energy {
                tti,
                first,
                count,
                micro,
            } => {
                let energy = Energy::from_micro(micro);
                return self.add_action(tti, Change::AddEnergy(device_range(first, count), energy), scenario);
            }
            InputLogLine::Set { tti, field, value } => {
                let cause =
                    || format!("{field} cannot change during a run; use the unedited inputs.log of a run folder");
                let line = self.line_count;
                let setting = Setting::from_field(&field);
                let setting = setting.ok_or_else(|| InputLogError::Action { line, cause: cause() })?;
                return self.add_action(tti, Change::Set(setting, value), scenario);
            }
            InputLogLine::Sense { tti, devices, next } => existing_devices(&devices, scenario).map(|devices| {
                let plan = Plan::from_devices(scenario.run.devices as usize, &devices);
                (tti, Decision::Plan(PlanDecision { plan, next: Tti(next) }))
            }),
            InputLogLine::Cycles { tti, devices, next } => valid_cycles(&devices, scenario).map(|cycles| {
                let plan = Plan::Periodic(cycles);
                (tti, Decision::Plan(PlanDecision { plan, next: Tti(next) }))
            }),
            InputLogLine::Wake { tti, devices } => {
                existing_devices(&devices, scenario).map(|devices| (tti, Decision::Wake(devices)))
            }
        };
        let decision = decision.map(|(tti, decision)| RecordedDecision {
            tti: Tti(tti),
            decision,
        });
        let decision = decision.filter(|decision| is_possible_decision(decision, inputs.decisions.last(), scenario));
        inputs
            .decisions
            .push(decision.ok_or(InputLogError::Decision(*line_number))?);
        Ok(())
    }

    fn add_action(&mut self, tti: u64, change: Change, scenario: &Scenario) -> Result<(), InputLogError> {
        let line = self.line_count;
        let checked = check_change(&change, scenario).and_then(|()| {
            let is_in_run = tti < scenario.run.ttis;
            let cause = || format!("TTI {tti} is not in the run; use TTIs before {}", scenario.run.ttis);
            is_in_run.then_some(()).ok_or_else(cause)
        });
        checked.map_err(|cause| InputLogError::Action { line, cause })?;
        self.inputs.actions.push(OperatorAction { tti: Tti(tti), change });
        Ok(())
    }
}

const fn device_range(first: u32, count: u32) -> DeviceRange {
    DeviceRange {
        first: DeviceId(first),
        count,
    }
}

/// Returns the error of line number `line`. The JSON parser sees one line at a time, so its own line number is dropped.
fn line_error(line: usize, error: &serde_json::Error) -> InputLogError {
    let (column, text) = (error.column(), error.to_string());
    let position = format!(" at line {} column {column}", error.line());
    let cause = text.strip_suffix(&position).unwrap_or(&text).to_owned();
    // serde_json gives column 0 for an error before the first character.
    let column = column.max(1);
    InputLogError::Line { line, column, cause }
}

fn existing_devices(devices: &[u32], scenario: &Scenario) -> Option<Vec<DeviceId>> {
    let all_exist = devices.iter().all(|device| *device < scenario.run.devices);
    all_exist.then(|| devices.iter().copied().map(DeviceId).collect())
}

/// Returns the cycles that these triples of `t_on`, `t_drx` and offset describe, if there is a valid one for each
/// device.
fn valid_cycles(triples: &[[u32; 3]], scenario: &Scenario) -> Option<Vec<DutyCycle>> {
    let cycles = triples
        .iter()
        .map(|&[t_on, t_drx, offset]| DutyCycle { t_on, t_drx, offset });
    // A cycle with t_DRX = 0 from a damaged log would cause a division by zero in the plan.
    let cycles: Vec<DutyCycle> = cycles.filter(|cycle| cycle.is_valid()).collect();
    (cycles.len() == triples.len() && triples.len() == scenario.run.devices as usize).then_some(cycles)
}

fn is_possible_removal(removal: &DeviceRemoval, earlier: &[DeviceRemoval], scenario: &Scenario) -> bool {
    let point_in_run = |removal: &DeviceRemoval| (removal.tti, removal.wake_ups);
    let is_in_order = earlier
        .last()
        .is_none_or(|last| point_in_run(last) <= point_in_run(removal));
    let is_disjoint = |other: &DeviceRemoval| other.last() < removal.first || removal.last() < other.first;
    // A valid removal names devices of the run, so its range can index them. A device is removed once, so ranges are
    // disjoint.
    let is_in_run = removal.is_valid(scenario.run.devices) && removal.tti.0 < scenario.run.ttis;
    is_in_run && is_in_order && earlier.iter().all(is_disjoint)
}

/// Returns whether `decision` is possible after `previous`. A run starts with a plan, and a TTI has at most one.
fn is_possible_decision(decision: &RecordedDecision, previous: Option<&RecordedDecision>, scenario: &Scenario) -> bool {
    let Some(previous) = previous else {
        return decision.tti == Tti::ZERO && matches!(decision.decision, Decision::Plan(_));
    };
    let is_later = match decision.decision {
        Decision::Plan(PlanDecision { next, .. }) => decision.tti > previous.tti && next > decision.tti,
        Decision::Wake(_) => decision.tti >= previous.tti,
    };
    is_later && decision.tti.0 < scenario.run.ttis
}
