//! Parsers for values on the command line, and help texts that list registered names. The error of a parser lists the
//! allowed values; `cli/tests/`, `cli/examples.rs` and `tests/program/` compare the wording.

use std::ffi::OsStr;
use std::fmt::Display;
use std::ops::RangeInclusive;
use std::str::FromStr;
use std::time::Duration;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::error::{ContextKind, ContextValue};
use clap::{Arg, Command};
use reveille_bs::policy::registry;
use reveille_common::message::{MessageKind, Pace};
use reveille_common::score::Metrics;
use reveille_view::filter::StateName;

/// The durations that [`parse_duration`] accepts.
const DURATION_HELP: &str = "a time from 1us to 1000000s in us, ms, s, m, h and d, such as 500us, 1.5s, 1m30s or 1h";

/// Help for an option that names a policy.
pub(super) fn policy_help() -> String {
    let names = registry::POLICIES.iter().map(|policy| policy.name);
    format!("Policy: {}.", names.collect::<Vec<_>>().join(", "))
}

/// Help for the policy option of a run, which also accepts a policy process or a replay.
pub(super) fn run_policy_help() -> String {
    format!(
        "{} `up` and `bs` also accept external (a policy process decides over the bus); they and `run` accept \
         replay=FILE (the decisions in the inputs.log of an earlier run).",
        policy_help()
    )
}

/// Help for an option that names several policies.
pub(super) fn policies_help() -> String {
    let names = registry::POLICIES.iter().map(|policy| policy.name);
    format!(
        "Policies, separated by commas: {} [default: the scenario's].",
        names.collect::<Vec<_>>().join(", ")
    )
}

/// Parses the sizes of a grant and of an answer of `bench bare-host`, bytes.
pub(super) fn parse_sizes(text: &str) -> Result<(usize, usize), String> {
    parse_pair(text).ok_or_else(|| "must be GRANT,ANSWER in bytes, such as 40,24".to_owned())
}

/// Parses the ends of a range of numbers.
pub(super) fn parse_range(text: &str) -> Result<(f64, f64), String> {
    match parse_pair(text) {
        Some((from, to)) if from > to => Err(format!("{from} is larger than {to}; give the smaller number first")),
        Some(ends) => Ok(ends),
        None => Err("must be two numbers, the smaller one first, such as 1,5".to_owned()),
    }
}

/// Parses two numbers with a comma between them.
fn parse_pair<T: FromStr>(text: &str) -> Option<(T, T)> {
    let (first, second) = text.split_once(',')?;
    Some((first.trim().parse().ok()?, second.trim().parse().ok()?))
}

/// A parser that ignores white space around the value: the items of `knn, random` have some.
#[derive(Clone, Debug)]
pub(super) struct Trimmed<P>(P);

/// Returns the parser of options that take a list, whose items `parser` parses.
pub(super) const fn trimmed<P: TypedValueParser>(parser: P) -> Trimmed<P> {
    Trimmed(parser)
}

impl<P: TypedValueParser> TypedValueParser for Trimmed<P> {
    type Value = P::Value;

    fn parse_ref(&self, command: &Command, arg: Option<&Arg>, value: &OsStr) -> Result<P::Value, clap::Error> {
        // Text that is not UTF-8 is refused by the parser itself.
        let value = value.to_str().map_or(value, |text| OsStr::new(text.trim()));
        self.0.parse_ref(command, arg, value)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        self.0.possible_values()
    }
}

/// Returns the candidate that is most similar to `word`, if any is similar.
pub(crate) fn most_similar_name(word: &str, candidates: impl Iterator<Item = &'static str>) -> Option<String> {
    let parser = PossibleValuesParser::new(candidates);
    let refusal = parser.parse_ref(&Command::new(""), None, OsStr::new(word)).err()?;
    let Some(ContextValue::String(similar)) = refusal.get(ContextKind::SuggestedValue) else {
        return None;
    };
    Some(similar.clone())
}

/// Returns the parser of options that take names of metrics.
pub(super) fn metric_parser() -> impl TypedValueParser<Value = String> {
    trimmed(PossibleValuesParser::new(Metrics::ALL.map(|metric| metric.name)))
}

/// Returns the parser of options that take kinds of messages; `--help` lists all kinds.
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

/// Returns the parser of options that take names of device states.
pub(super) fn state_parser() -> impl TypedValueParser<Value = StateName> {
    PossibleValuesParser::new(StateName::ALL.map(|(name, _)| name)).try_map(|name| {
        let found = StateName::ALL.into_iter().find(|(known, _)| *known == name);
        found.map(|(_, state)| state).ok_or("no state")
    })
}

/// Returns the parser of options that take a whole number in `range`.
pub(super) fn whole<T>(range: RangeInclusive<T>) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static
where
    T: FromStr + PartialOrd + Display + Clone + Send + Sync + 'static,
{
    move |text| {
        let number = text.trim().parse().ok().filter(|number| range.contains(number));
        number.ok_or_else(|| format!("must be a whole number from {} to {}", range.start(), range.end()))
    }
}

/// Like [`whole`], but accepts numbers outside `range`, for an option whose command checks the range itself. `range` is
/// only for the error, and must equal the range that the command checks.
pub(super) fn any_whole<T>(
    range: RangeInclusive<T>,
) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static
where
    T: FromStr + PartialOrd + Display + Clone + Send + Sync + 'static,
{
    // Only called with text that does not parse, which it refuses.
    let refuse = whole(range);
    move |text| text.trim().parse().or_else(|_| refuse(text))
}

/// Parses the number of an option whose command checks the range.
pub(super) fn parse_number(text: &str) -> Result<f64, String> {
    let number = text.trim().parse();
    number.map_err(|_| "must be a number, such as 0.5".to_owned())
}

/// Parses FIELD=VALUE into the field and its value.
pub(super) fn parse_field(text: &str) -> Result<(String, String), String> {
    let pair = text.split_once('=').filter(|(field, _)| !field.is_empty());
    let pair = pair.map(|(field, value)| (field.trim().to_owned(), value.trim().to_owned()));
    pair.ok_or_else(|| "must be FIELD=VALUE, such as devices=50".to_owned())
}

/// Parses the real time per TTI, as a duration or as a rate such as `50/s`, or `max`.
pub(crate) fn parse_pace(text: &str) -> Result<Pace, String> {
    if text == "max" {
        return Ok(Pace::Max);
    }
    let per_second = text.strip_suffix("/s").and_then(|rate| rate.trim().parse::<f64>().ok());
    // Rates in the range of durations: 1 µs to 10⁶ s per TTI.
    if let Some(rate) = per_second.filter(|rate| (1e-6..=1e6).contains(rate)) {
        return Ok(Pace::RealTime((1e6 / rate).round() as u64));
    }
    parse_duration(text)
        // The accepted range ends at 10¹² µs, which fits.
        .map(|duration| Pace::RealTime(duration.as_micros() as u64))
        .map_err(|_| format!("must be `max`, a rate such as 50/s, or {DURATION_HELP}"))
}

/// Parses a duration from 1 µs to 10⁶ s.
pub(crate) fn parse_duration(text: &str) -> Result<Duration, String> {
    // Deadlines are instants; adding a longer duration to one could overflow.
    let range = Duration::from_micros(1)..=Duration::from_secs(1_000_000);
    let duration = humantime::parse_duration(text).ok();
    duration
        .filter(|duration| range.contains(duration))
        .ok_or_else(|| format!("must be {DURATION_HELP}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_numbers_have_a_range() {
        let parse = whole(1..=12_u32);
        for (text, number) in [("1", 1), (" 12 ", 12), ("+3", 3)] {
            assert_eq!(parse(text), Ok(number), "{text:?}");
        }
        for invalid in ["", "many", "0", "13", "-1", "1.5", "99999999999999999999"] {
            let refusal = parse(invalid).expect_err(invalid);
            assert_eq!(refusal, "must be a whole number from 1 to 12", "{invalid:?}");
        }
    }

    #[test]
    fn any_whole_names_the_range_but_does_not_check_it() {
        let parse = any_whole(1..=12_u32);
        assert_eq!((parse("0"), parse("13")), (Ok(0), Ok(13)));
        let refusal = Err("must be a whole number from 1 to 12".to_owned());
        assert_eq!((parse("many"), parse("-1")), (refusal.clone(), refusal));
    }

    #[test]
    fn the_most_similar_name_is_suggested() {
        let known = ["harvest.lambda", "devices", "policy"];
        let similar = |word| most_similar_name(word, known.into_iter());
        assert_eq!(similar("harvest.lamda").as_deref(), Some("harvest.lambda"));
        assert_eq!(similar("device").as_deref(), Some("devices"));
        assert_eq!(similar("xyz"), None);
    }

    #[test]
    fn the_smaller_end_of_a_range_comes_first() {
        assert_eq!(
            (parse_range("1,5"), parse_range(" 2, 2 ")),
            (Ok((1.0, 5.0)), Ok((2.0, 2.0)))
        );
        let refusal = parse_range("5,1").expect_err("in the wrong order");
        assert_eq!(refusal, "5 is larger than 1; give the smaller number first");
        for bad in ["", "1", "1,many", "1,2,3"] {
            assert!(
                parse_range(bad).is_err_and(|refusal| refusal.contains("two numbers")),
                "{bad:?}"
            );
        }
        assert_eq!(parse_sizes("40,24"), Ok((40, 24)));
        assert!(parse_sizes("40").is_err_and(|refusal| refusal.contains("GRANT,ANSWER")));
    }

    #[test]
    fn durations_have_units_and_a_range() {
        for (text, micros) in [
            ("1us", 1),
            ("10ms", 10_000),
            ("1.5s", 1_500_000),
            ("1min", 60_000_000),
            ("1m30s", 90_000_000),
            ("1h", 3_600_000_000),
            ("1000000s", 1_000_000_000_000),
        ] {
            assert_eq!(parse_duration(text), Ok(Duration::from_micros(micros)), "{text}");
        }
        for invalid in [
            "",
            "10",
            "ms",
            "-1s",
            "0s",
            "999ns",
            "nans",
            "1x",
            "1000001s",
            "99999999999999999999s",
        ] {
            let refusal = parse_duration(invalid).expect_err(invalid);
            assert!(refusal.contains("1m30s"), "{invalid:?}: {refusal}");
        }
    }

    #[test]
    fn a_pace_round_trips() {
        for text in ["max", "4ms", "1m 30s 500us"] {
            assert_eq!(parse_pace(text).map(|pace| pace.to_string()), Ok(text.to_owned()));
        }
        for (rate, duration) in [("50/s", "20ms"), ("0.5/s", "2s"), ("1000000/s", "1us")] {
            assert_eq!(parse_pace(rate).map(|pace| pace.to_string()), Ok(duration.to_owned()));
        }
        for invalid in ["fast", "0/s", "-1/s", "1e7/s", "50/m"] {
            assert!(
                parse_pace(invalid).is_err_and(|refusal| refusal.contains("50/s")),
                "{invalid}"
            );
        }
    }
}
