//! Former names of commands, options and values of version 0.1, which are still accepted with a warning, so that
//! scripts continue to work. A command, option or value that is renamed needs an entry here. Renamed metrics have
//! theirs in `FORMER_NAMES` (`common/src/score/metrics.rs`).

use std::ffi::OsString;

use reveille_common::score::Metrics;

/// The command, the former name of its option, and the name of today.
const RENAMED_OPTIONS: [(&str, &str, &str); 7] = [
    ("run", "--inputs", "--input-log"),
    ("train record", "--told", "--true-batteries"),
    ("train record", "--every", "--stride"),
    ("device", "--patience", "--connect-timeout"),
    ("device", "--among", "--host-count"),
    ("inspect tail", "--join", "--pair-wake-ups"),
    ("figures", "--together", "--combine"),
];

/// The former command, the command of today, and the options with which it acts like the former one.
const RENAMED_COMMANDS: [(&str, &str, &[&str]); 1] = [("inspect compare", "compare", &["--exit-code"])];

/// The command, its former option, and the argument that replaces it.
const OPTIONS_NOW_ARGUMENTS: [(&str, &str, &str); 3] = [
    ("inspect tail", "--from", "FILE"),
    ("inspect stats", "--from", "FILE"),
    ("dashboard", "--from", "FILE"),
];

/// Returns the name of today for a value.
type CurrentName = fn(&str) -> &str;

/// The command, its option whose values changed their names, and the name of today for a value.
const RENAMED_VALUES: [(&str, &str, CurrentName); 3] = [
    ("inspect tail", "--state", |state| {
        if state == "deaf" { "unpowered" } else { state }
    }),
    ("figures sweep", "--y", Metrics::current_name),
    ("sweep", "--ci-metrics", Metrics::current_name),
];

/// Replaces former names in the command line `args`, the program first, and returns it with a warning for each.
pub(crate) fn replace_former_names(args: impl IntoIterator<Item = OsString>) -> (Vec<OsString>, Vec<String>) {
    let mut args: Vec<OsString> = args.into_iter().collect();
    let mut warnings = Vec::new();
    let warning = |former: &str, current: &str| {
        format!("{former} is now called {current}; the former name will be removed in a later version")
    };
    for (command, former, current) in RENAMED_OPTIONS {
        for index in argument_range(&args, command) {
            let Some(text) = args[index].to_str() else { continue };
            let (name, value) = text.split_at(text.find('=').unwrap_or(text.len()));
            if name == former {
                args[index] = format!("{current}{value}").into();
                warnings.push(warning(former, current));
            }
        }
    }
    for (command, option, current_name) in RENAMED_VALUES {
        for index in argument_range(&args, command) {
            let Some(text) = args[index].to_str() else { continue };
            let value = text.strip_prefix(option).and_then(|rest| rest.strip_prefix('='));
            let value = value.or_else(|| (args[index - 1] == option).then_some(text));
            let Some(list) = value else { continue };
            let items = || list.split(',').map(str::trim);
            let current_items: Vec<&str> = items().map(current_name).collect();
            let renamed = items()
                .zip(&current_items)
                .filter(|(former, current)| former != *current);
            warnings.extend(renamed.map(|(former, current)| warning(former, current)));
            args[index] = format!("{}{}", &text[..text.len() - list.len()], current_items.join(",")).into();
        }
    }
    for (command, option, argument) in OPTIONS_NOW_ARGUMENTS {
        for index in argument_range(&args, command).rev() {
            let Some(text) = args[index].to_str() else { continue };
            let value = text.strip_prefix(option).and_then(|rest| rest.strip_prefix('='));
            match value.map(OsString::from) {
                Some(value) => args[index] = value,
                None if text == option => drop(args.remove(index)),
                None => continue,
            }
            warnings.push(format!(
                "{option} {argument} is now the argument {argument}; the option will be removed in a later version"
            ));
        }
    }
    // Last, since it moves the words of the command, which the loops above look for.
    for (former, current, options) in RENAMED_COMMANDS {
        let positions = command_word_positions(&args, former);
        if let [before @ .., last] = &positions[..] {
            let current_words = std::iter::once(current)
                .chain(options.iter().copied())
                .map(OsString::from);
            args.splice(*last..=*last, current_words);
            for index in before.iter().rev() {
                args.remove(*index);
            }
            let replacement = [&[current], options].concat().join(" ");
            warnings.push(warning(&format!("`{former}`"), &format!("`{replacement}`")));
        }
    }
    (args, warnings)
}

/// Returns the positions of the arguments of `command`; empty if `args` call another command.
fn argument_range(args: &[OsString], command: &str) -> std::ops::Range<usize> {
    command_word_positions(args, command)
        .last()
        .map_or(0..0, |last| last + 1..args.len())
}

/// Returns the positions of the words of `command` in `args`; empty if `args` call another command.
fn command_word_positions(args: &[OsString], command: &str) -> Vec<usize> {
    // Global options may precede each word of the command. Of those in `Cli`, only `--log-format` takes a value.
    let is_global = |index: usize| {
        let is_value = args.get(index - 1).is_some_and(|arg| arg == "--log-format");
        is_value || args[index].to_str().is_some_and(|arg| arg.starts_with('-'))
    };
    let (mut index, mut positions) = (1, Vec::new());
    for word in command.split(' ') {
        while index < args.len() && is_global(index) {
            index += 1;
        }
        if args.get(index).is_none_or(|arg| arg != word) {
            return Vec::new();
        }
        positions.push(index);
        index += 1;
    }
    positions
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the replaced command line, and the number of warnings.
    fn replace(line: &str) -> (String, usize) {
        let (args, warnings) = replace_former_names(line.split(' ').map(OsString::from));
        let args: Vec<_> = args.iter().map(|arg| arg.to_str().expect("text")).collect();
        (args.join(" "), warnings.len())
    }

    #[test]
    fn old_names_are_replaced_only_in_their_command() {
        for (line, expected, warning_count) in [
            ("reveille -v run --inputs a.log", "reveille -v run --input-log a.log", 1),
            (
                "reveille run --inputs=a.log -n 3",
                "reveille run --input-log=a.log -n 3",
                1,
            ),
            (
                "reveille train record --told --every 9",
                "reveille train record --true-batteries --stride 9",
                2,
            ),
            (
                "reveille device --patience 3s --among 2",
                "reveille device --connect-timeout 3s --host-count 2",
                2,
            ),
            (
                "reveille train dt a --patience 3",
                "reveille train dt a --patience 3",
                0,
            ),
            (
                "reveille inspect tail --join",
                "reveille inspect tail --pair-wake-ups",
                1,
            ),
            (
                "reveille inspect tail --state S1,deaf",
                "reveille inspect tail --state S1,unpowered",
                1,
            ),
            (
                "reveille inspect tail --state=deaf",
                "reveille inspect tail --state=unpowered",
                1,
            ),
            (
                "reveille figures sweep t --y dark_pct",
                "reveille figures sweep t --y unpowered_pct",
                1,
            ),
            (
                "reveille sweep --ci-metrics=a,gone_pct",
                "reveille sweep --ci-metrics=a,removed_pct",
                1,
            ),
            (
                "reveille inspect tail --run deaf",
                "reveille inspect tail --run deaf",
                0,
            ),
            ("reveille figures --together t", "reveille figures --combine t", 1),
            (
                "reveille train -v record --told",
                "reveille train -v record --true-batteries",
                1,
            ),
            (
                "reveille --log-format json run --inputs a",
                "reveille --log-format json run --input-log a",
                1,
            ),
            (
                "reveille up --policy-command run --inputs a",
                "reveille up --policy-command run --inputs a",
                0,
            ),
        ] {
            assert_eq!(replace(line), (expected.to_owned(), warning_count), "{line}");
        }
    }

    #[test]
    fn former_options_of_arguments_and_former_commands_are_replaced() {
        for (line, expected, warning_count) in [
            (
                "reveille inspect tail --from r.mcap --since 3",
                "reveille inspect tail r.mcap --since 3",
                1,
            ),
            (
                "reveille inspect stats --from=r.mcap",
                "reveille inspect stats r.mcap",
                1,
            ),
            (
                "reveille dashboard --compare b.mcap --from a.mcap",
                "reveille dashboard --compare b.mcap a.mcap",
                1,
            ),
            (
                "reveille figures timeline --from 3",
                "reveille figures timeline --from 3",
                0,
            ),
            (
                "reveille -v inspect --log-format json compare a b",
                "reveille -v --log-format json compare --exit-code a b",
                1,
            ),
        ] {
            assert_eq!(replace(line), (expected.to_owned(), warning_count), "{line}");
        }
    }
}
