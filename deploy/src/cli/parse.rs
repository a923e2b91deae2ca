//! How values on the command line are read.

use std::time::Duration;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use reveille_bs::policy::registry;
use reveille_common::message::{MessageKind, Pace};
use reveille_view::filter::Named;

/// Help for an option that names a policy.
pub(super) fn one_policy() -> String {
    let each = registry::POLICIES.iter().map(|policy| policy.name());
    format!("Policy: {}.", each.collect::<Vec<_>>().join(", "))
}

/// Help for an option that names one of a run, which somebody outside may decide for.
pub(super) fn one_policy_or_outside() -> String {
    format!(
        "{} Of a run it can also be external: another program decides, over the bus; and replay=FILE: what one has \
         decided before, as the inputs.log of its run has it.",
        one_policy()
    )
}

/// Help for an option that names several.
pub(super) fn several_policies() -> String {
    let each = registry::POLICIES.iter().map(|policy| policy.name());
    format!(
        "Policies, separated by commas: {} [default: the scenario's].",
        each.collect::<Vec<_>>().join(", ")
    )
}

pub(super) fn parse_sizes(text: &str) -> Result<(usize, usize), String> {
    let pair = text
        .split_once(',')
        .and_then(|(tick, answer)| Some((tick.parse().ok()?, answer.parse().ok()?)));
    pair.ok_or_else(|| "must be TICK,ANSWER".to_owned())
}

/// Reads the name of a kind of message; `--help` lists those that are declared.
pub(super) fn kind_parser() -> impl TypedValueParser<Value = MessageKind> {
    let value = |kind: &MessageKind| {
        let help = format!("{}: {}", kind.direction(), kind.about());
        PossibleValue::new(kind.name()).help(help)
    };
    PossibleValuesParser::new(MessageKind::ALL.iter().map(value)).try_map(|name| {
        let kind = MessageKind::ALL.iter().copied().find(|kind| kind.name() == name);
        kind.ok_or("no kind of message")
    })
}

/// Reads the name of a state.
pub(super) fn state_parser() -> impl TypedValueParser<Value = Named> {
    PossibleValuesParser::new(Named::ALL.map(|(name, _)| name)).try_map(|name| {
        let named = Named::ALL.into_iter().find(|(known, _)| *known == name);
        named.map(|(_, state)| state).ok_or("no state")
    })
}

pub(super) fn parse_whole(text: &str) -> Result<u64, String> {
    text.parse()
        .map_err(|_| format!("must be a whole number from 0 to {}", i64::MAX))
}

/// Reads a number of things of which there is one at least.
pub(super) fn parse_count(text: &str) -> Result<usize, String> {
    let count = text.parse().ok().filter(|count| *count > 0);
    count.ok_or_else(|| "must be a whole number from 1".to_owned())
}

/// Reads a field with its value.
pub(super) fn parse_field(text: &str) -> Result<(String, String), String> {
    let pair = text.split_once('=').filter(|(field, _)| !field.is_empty());
    let pair = pair.map(|(field, value)| (field.trim().to_owned(), value.trim().to_owned()));
    pair.ok_or_else(|| "must be FIELD=VALUE, such as devices=50".to_owned())
}

pub(super) fn parse_device(text: &str) -> Result<u32, String> {
    let number = text.trim().parse();
    number.map_err(|_| "must be the number of a device, a whole number from 0, such as 3".to_owned())
}

pub(super) fn parse_pace(text: &str) -> Result<Pace, String> {
    if text == "max" {
        return Ok(Pace::Max);
    }
    parse_duration(text)
        .map(|duration| Pace::RealTime(duration.as_micros() as u64))
        .map_err(|e| format!("must be `max` or {e}"))
}

pub(super) fn parse_duration(text: &str) -> Result<Duration, String> {
    let units = [("us", 1e-6), ("ms", 1e-3), ("s", 1.0), ("min", 60.0)];
    let number = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = units
        .iter()
        .find(|(name, _)| *name == &text[number.len()..])
        .map(|(_, seconds)| seconds);
    match (number.parse::<f64>(), unit) {
        (Ok(n), Some(seconds)) if n > 0.0 && n * seconds <= 1e6 => Ok(Duration::from_secs_f64(n * seconds)),
        _ => Err("a time above 0 such as 500us, 10ms, 2s or 1min".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_are_read() {
        assert_eq!(parse_duration("10ms"), Ok(Duration::from_millis(10)));
        assert_eq!(parse_duration("1.5s"), Ok(Duration::from_millis(1500)));
        for bad in ["", "10", "ms", "-1s", "0s", "nans", "1h", "1e99s"] {
            assert!(parse_duration(bad).is_err(), "{bad}");
        }
    }
}
