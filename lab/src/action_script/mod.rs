//! Scripts of timed actions (`--actions FILE`): text, one line for each action or repeated action.
//!
//! ```text
//! 500 fail 7                                  # device 7 fails at the start of TTI 500
//! 500 fail 3,10-14 for 400                    # these devices fail, and are revived 400 TTIs later
//! 900 energy 7 2.5                            # device 7 receives 2.5 units
//! 950 revive all
//! 1000 set events.alpha 0.05
//! from 0 to 6000 every 600 fail 0-49 for 60 at random
//! ```
//! A script becomes the same external inputs in every run of a scenario, in memory and over the bus: random times
//! follow from the seed of the scenario, the line number and the device. A change of the draws or of the order of
//! actions changes the digests of runs with scripts. `docs/actions.md` explains the forms. `deploy/src/cli/run.rs` and
//! `sweep/grid.rs` read scripts; `reveille clock` parses its arguments with the same functions.

use std::path::Path;
use std::str::FromStr;

use reveille_bs::actions::check_change;
use reveille_bs::scenario::Scenario;
use reveille_common::declare::{FileError, Files, describe_read_error};
use reveille_common::digits::count_noun;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, DeviceRange, OperatorAction, Setting};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::units::{Energy, MAX_UNITS, ROUNDING_RULE, is_changed_by_rounding};

use crate::external_inputs;

/// The largest size of a script, bytes. The experiments of sweeps contain their scripts, so their limit is larger
/// (`MAX_EXPERIMENT_BYTES` in `sweep/folder.rs`).
const MAX_SCRIPT_BYTES: u64 = 4 << 20;
/// The largest number of actions of a script.
const MAX_ACTIONS: usize = 10_000_000;
/// The largest product of actions and devices for which revivals are checked.
const MAX_REVIVAL_CHECKS: usize = 100_000_000;

/// The forms of a line, for errors.
const FORMS: &str = "use `TTI ACTION` or `from TTI [to TTI] every TTIS ACTION [at random]`, where ACTION is `fail \
    DEVICES [for TTIS]`, `revive DEVICES`, `energy DEVICES UNITS` or `set FIELD VALUE`";

/// An error in a script.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum ScriptError {
    /// A line is not an action of the run.
    #[error("line {line}: {cause}")]
    Line {
        /// The line number, from 1.
        line: usize,
        /// The cause and the fix.
        cause: String,
    },
    /// The text starts like an input log, and its actions cannot be used.
    #[error("{0}")]
    Log(String),
}

/// Returns the text of the script at `path`.
///
/// # Errors
/// If it cannot be read or is not text; describes the cause and the fix, without the path.
pub fn read(path: &Path, files: &dyn Files) -> Result<String, String> {
    let bytes = files.read(path, MAX_SCRIPT_BYTES).map_err(|error| match error {
        FileError::Io(error) => {
            let hint = "name a script of timed actions, with lines such as `500 fail 7` (see docs/actions.md)";
            describe_read_error(&error, hint)
        }
        FileError::TooLong { .. } => format!("{error}; repeat actions with `from TTI every TTIS ACTION`"),
        FileError::Folder | FileError::Special => error.to_string(),
    })?;
    String::from_utf8(bytes)
        .map_err(|_| "not a text file; name a script of timed actions (see docs/actions.md)".to_owned())
}

/// Parses a script for a run of `scenario`, or the input log of any run, which is a script of its actions. Returns the
/// actions in the order of TTIs; actions of one TTI are in the order of lines.
///
/// # Errors
/// If a line has none of the forms, or names an impossible action. Whether it does must not depend on the seed: sweeps
/// check a script with the first seed only.
pub fn parse(text: &str, scenario: &Scenario) -> Result<Vec<OperatorAction>, ScriptError> {
    let mut actions = Vec::new();
    // No line of a script starts with a brace, and every line of an input log does.
    if text.starts_with('{') {
        actions =
            external_inputs::parse_actions(text, scenario).map_err(|error| ScriptError::Log(error.to_string()))?;
        actions.sort_by_key(|action| action.tti);
        return Ok(actions);
    }
    for (line, line_text) in (1..).zip(text.lines()) {
        let words: Vec<&str> = line_text
            .split('#')
            .next()
            .unwrap_or_default()
            .split_whitespace()
            .collect();
        if words.is_empty() {
            continue;
        }
        let result = parse_line(&words).and_then(|parsed| parsed.add_to(&mut actions, line as u64, scenario));
        result.map_err(|cause| ScriptError::Line { line, cause })?;
    }
    // Stable, so that a revival precedes the next failure in the same TTI.
    actions.sort_by_key(|action| action.tti);
    Ok(actions)
}

/// Returns a warning, a sentence without its stop, if `actions` are in the warm-up of `scenario`, which no metric
/// counts.
pub fn warm_up_warning(actions: &[OperatorAction], scenario: &Scenario) -> Option<String> {
    let warm_up_end = scenario.warm_up_end();
    let early = || actions.iter().map(|action| action.tti).filter(|tti| *tti < warm_up_end);
    let (first, last) = (early().min()?, early().max()?);
    let ttis = if first == last {
        format!("TTI {first}")
    } else {
        format!("TTIs {first} to {last}")
    };
    // Rounded down, so that the count starts at the first action or a little earlier.
    let warm_up = (first.0 as f64 / scenario.run.ttis as f64 * 1e4).floor() / 1e4;
    Some(format!(
        "{} of {} actions ({ttis}) are in the warm-up, which no metric counts; use TTIs from {warm_up_end} on, or \
         --set warm_up={warm_up} to count from the first action",
        early().count(),
        actions.len()
    ))
}

/// Returns warnings about actions that are in the warm-up or have no effect, sentences without their stops.
pub fn warnings(actions: &[OperatorAction], scenario: &Scenario) -> Vec<String> {
    let revival = useless_revival_warning(actions, scenario.run.devices as usize);
    warm_up_warning(actions, scenario).into_iter().chain(revival).collect()
}

/// Returns a warning if a revival comes while none of its devices is failed, such as before their failure.
fn useless_revival_warning(actions: &[OperatorAction], device_count: usize) -> Option<String> {
    // Long scripts of large runs are not checked, since each action can concern all devices.
    if actions.len().saturating_mul(device_count) > MAX_REVIVAL_CHECKS {
        return None;
    }
    let mut is_failed = vec![false; device_count];
    let mut useless_ttis = actions.iter().filter_map(|action| {
        let range = action.change.with_all_resolved(device_count as u32).devices()?;
        let devices = is_failed
            .iter_mut()
            .skip(range.first.0 as usize)
            .take(range.count as usize);
        match action.change {
            Change::Fail(_) => devices.for_each(|is_failed| *is_failed = true),
            Change::Revive(_) => {
                let failed_count: usize = devices.map(|is_failed| usize::from(std::mem::take(is_failed))).sum();
                return (failed_count == 0).then_some(action.tti);
            }
            Change::AddEnergy(..) | Change::Set(..) => {}
        }
        None
    });
    let first = useless_ttis.next()?;
    let count = 1 + useless_ttis.count();
    Some(format!(
        "{} without effect, the first in TTI {first}: none of the devices is failed then; a failure must come before \
         its revival",
        count_noun(count, "revival")
    ))
}

/// The times of a line, in TTIs.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Times {
    Once(u64),
    /// Once in each period of `every` TTIs from `from` on, before `to` or the end of the run; at the start of the
    /// period or at a random time in it.
    Repeated {
        from: u64,
        to: Option<u64>,
        every: u64,
        at_random: bool,
    },
}

/// A line of a script.
#[derive(Clone, Debug, PartialEq)]
struct ScriptLine {
    times: Times,
    changes: Vec<Change>,
    /// The duration of a failure, TTIs; `None` for other actions and for failures without an end.
    duration: Option<u64>,
}

/// Parses a list of devices and ranges, such as `3,7,10-14`, or `all`.
///
/// # Errors
/// If the text is no such list.
pub fn parse_devices(text: &str) -> Result<Vec<DeviceRange>, String> {
    if text == "all" {
        return Ok(vec![DeviceRange::ALL]);
    }
    let ends = |item: &str| -> Option<(u32, u32)> {
        let (first, last) = item.split_once('-').unwrap_or((item, item));
        Some((first.trim().parse().ok()?, last.trim().parse().ok()?))
    };
    let range = |item| {
        // A range of `u32::MAX` devices from 0 on would mean all devices.
        let ends = ends(item).filter(|ends| !matches!(ends, (0, last) if *last >= u32::MAX - 1));
        let ends =
            ends.ok_or_else(|| format!("`{text}` must be `all`, or devices and ranges of devices such as 3,7,10-14"));
        let (first, last) = ends?;
        let distance = last.checked_sub(first);
        let distance =
            distance.ok_or_else(|| format!("`{first}-{last}`: {first} is larger than {last}; use {last}-{first}"))?;
        Ok(DeviceRange {
            first: DeviceId(first),
            count: distance + 1,
        })
    };
    text.split(',').map(range).collect()
}

/// Parses an amount of energy, units.
///
/// # Errors
/// If the text is not an amount that a battery can receive, or rounding to micro-units changes it by more than 1 %.
pub fn parse_energy(text: &str) -> Result<Energy, String> {
    let units = text.parse().ok().filter(|units| *units > 0.0);
    let energy = units.and_then(|units| Energy::from_units(units).map(|energy| (units, energy)));
    if let Some((units, energy)) = energy
        && is_changed_by_rounding(units, energy.units())
    {
        return Err(format!(
            "`{text}` would become {}, since {ROUNDING_RULE}",
            energy.units()
        ));
    }
    energy
        .map(|(_, energy)| energy)
        .ok_or_else(|| format!("`{text}` must be an energy above 0, at most {MAX_UNITS} units"))
}

/// Parses the field of a setting that can change during a run.
///
/// # Errors
/// If there is no such setting.
pub fn parse_setting(text: &str) -> Result<Setting, String> {
    let fields = Setting::ALL.map(Setting::field).join(" or ");
    Setting::from_field(text).ok_or_else(|| format!("`{text}` cannot change during a run; use {fields}"))
}

/// Parses a number. The error has the text: the word must be `requirement`.
fn parse_number<T: FromStr>(word: &str, requirement: &str) -> Result<T, String> {
    word.parse().map_err(|_| format!("`{word}` must be {requirement}"))
}

fn parse_line(words: &[&str]) -> Result<ScriptLine, String> {
    let parse_ttis = |word: &str| parse_number::<u64>(word, "a whole number of TTIs, such as 600");
    let (times, action) = match words {
        ["from", from, "to", to, "every", every, action @ ..] => (
            repeated(parse_ttis(from)?, Some(parse_ttis(to)?), parse_ttis(every)?),
            action,
        ),
        ["from", from, "every", every, action @ ..] => (repeated(parse_ttis(from)?, None, parse_ttis(every)?), action),
        ["from", ..] => return Err(format!("incomplete repetition; {FORMS}")),
        [tti, action @ ..] => (
            Times::Once(parse_number(tti, "the TTI of the action, or `from`")?),
            action,
        ),
        [] => return Err(FORMS.to_owned()),
    };
    let (times, action) = match (times, action) {
        (Times::Repeated { from, to, every, .. }, [action @ .., "at", "random"]) => {
            let at_random = true;
            (
                Times::Repeated {
                    from,
                    to,
                    every,
                    at_random,
                },
                action,
            )
        }
        (Times::Once(_), [.., "at", "random"]) => {
            return Err("`at random` needs a repetition; start the line with `from TTI every TTIS`".to_owned());
        }
        (times, action) => (times, action),
    };
    let changes_of = |devices: &str, change: fn(DeviceRange) -> Change| -> Result<Vec<Change>, String> {
        Ok(parse_devices(devices)?.into_iter().map(change).collect())
    };
    let (changes, duration) = match action {
        ["fail", devices] => (changes_of(devices, Change::Fail)?, None),
        ["fail", devices, "for", ttis] => (changes_of(devices, Change::Fail)?, Some(parse_ttis(ttis)?)),
        ["revive", devices] => (changes_of(devices, Change::Revive)?, None),
        ["energy", devices, units] => {
            let energy = parse_energy(units)?;
            let ranges = parse_devices(devices)?.into_iter();
            (ranges.map(|range| Change::AddEnergy(range, energy)).collect(), None)
        }
        ["set", field, value] => (
            vec![Change::Set(parse_setting(field)?, parse_number(value, "a number")?)],
            None,
        ),
        [] => return Err(format!("the action is missing; {FORMS}")),
        _ => return Err(format!("`{}` is not an action; {FORMS}", action.join(" "))),
    };
    Ok(ScriptLine {
        times,
        changes,
        duration,
    })
}

const fn repeated(from: u64, to: Option<u64>, every: u64) -> Times {
    Times::Repeated {
        from,
        to,
        every,
        at_random: false,
    }
}

impl ScriptLine {
    /// Appends the actions of line number `line` in a run of `scenario`. Checks the line first.
    fn add_to(mut self, actions: &mut Vec<OperatorAction>, line: u64, scenario: &Scenario) -> Result<(), String> {
        let ttis = scenario.run.ttis;
        for change in &mut self.changes {
            *change = change.with_all_resolved(scenario.run.devices);
            check_change(change, scenario)?;
        }
        if self.duration == Some(0) {
            return Err("a failure lasts at least 1 TTI; use `for` with a larger number".to_owned());
        }
        match self.times {
            Times::Once(tti) if tti >= ttis => Err(format!("TTI {tti} is not in the run; use TTIs before {ttis}")),
            Times::Once(tti) => {
                let changes = self.changes.iter();
                changes
                    .into_iter()
                    .try_for_each(|change| self.add_change(actions, tti, *change, ttis))
            }
            Times::Repeated {
                from,
                to,
                every,
                at_random,
            } => {
                if from >= ttis {
                    return Err(format!("TTI {from} is not in the run; use TTIs before {ttis}"));
                }
                if to.is_some_and(|to| to <= from) {
                    return Err("`to` must be after `from`".to_owned());
                }
                let duration = self.duration.unwrap_or(1);
                if every == 0 {
                    return Err("`every` must be at least 1 TTI".to_owned());
                }
                if every < duration || (self.duration.is_some() && every == duration) {
                    return Err(format!(
                        "`every` {every} must be longer than the failure; use a larger number"
                    ));
                }
                let until = to.unwrap_or(ttis).min(ttis);
                if at_random {
                    // A failure ends within its period.
                    let max_delay = every - duration;
                    return self.add_at_random(actions, (from, until, max_delay), every, line, scenario);
                }
                let mut starts = (from..until).step_by(usize::try_from(every).unwrap_or(usize::MAX));
                starts.try_for_each(|tti| {
                    let mut changes = self.changes.iter();
                    changes.try_for_each(|change| self.add_change(actions, tti, *change, ttis))
                })
            }
        }
    }

    /// Appends the actions at random times: one for each device and period of `every` TTIs, at most `max_delay` TTIs
    /// after the start of the period. Times from `until` on are left out.
    fn add_at_random(
        &self,
        actions: &mut Vec<OperatorAction>,
        (from, until, max_delay): (u64, u64, u64),
        every: u64,
        line: u64,
        scenario: &Scenario,
    ) -> Result<(), String> {
        for change in &self.changes {
            let Some(range) = change.devices() else {
                return Err("a setting has no devices, whose times could differ; leave out `at random`".to_owned());
            };
            for device in range.devices() {
                let single_device = DeviceRange {
                    first: device,
                    count: 1,
                };
                let change = change.with_devices(single_device);
                let stream_id = line << 32 | u64::from(device.0);
                let mut stream = Stream::new(scenario.run.seed, Purpose::Actions, stream_id);
                for start in (from..until).step_by(usize::try_from(every).unwrap_or(usize::MAX)) {
                    let tti = start.saturating_add(stream.below(max_delay + 1));
                    if tti < until {
                        self.add_change(actions, tti, change, scenario.run.ttis)?;
                    }
                }
            }
        }
        Ok(())
    }

    /// Appends `change` in TTI `tti`, and the revival after a failure with a duration, unless the run of `ttis` TTIs
    /// ends before it.
    fn add_change(&self, actions: &mut Vec<OperatorAction>, tti: u64, change: Change, ttis: u64) -> Result<(), String> {
        if actions.len() >= MAX_ACTIONS {
            return Err(format!(
                "the script has more than {MAX_ACTIONS} actions; use longer periods or fewer devices"
            ));
        }
        actions.push(OperatorAction { tti: Tti(tti), change });
        if let (Some(duration), Change::Fail(range)) = (self.duration, change)
            && let revival = tti.saturating_add(duration)
            && revival < ttis
        {
            actions.push(OperatorAction {
                tti: Tti(revival),
                change: Change::Revive(range),
            });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
