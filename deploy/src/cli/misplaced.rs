//! Options given to a subcommand that lacks them, and unknown subcommands of a subcommand. clap would suggest an option
//! with a similar name; the error here names the subcommands that have the option. For a subcommand without a similar
//! name, the error here lists the possible ones. Tests here check that each reason is about an option that its command
//! lacks.

use std::ffi::OsString;

use clap::builder::StyledStr;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Arg, Command, Error};

/// The commands of a run. For an option of several of them, other commands are not named.
const RUN_COMMANDS: [&str; 4] = ["up", "run", "bs", "device"];
/// Maximum number of subcommands that the error names. A more common option is better found in `--help`.
const MAX_NAMED: usize = 4;

/// The command, options that it lacks (none listed: any option), and why it lacks them. The first matching entry
/// applies. A new option of one of [`RUN_COMMANDS`] may need an entry for the others.
const REASONS: [(&str, &[&str], &str); 7] = [
    ("run", &["pace", "paused"], "runs without a clock"),
    (
        "run",
        &[
            "processes",
            "on-loss",
            "loss-timeout",
            "audit",
            "run",
            "listen",
            "join-timeout",
            "key-file",
            "tls",
            "connect",
            "count",
            "connect-timeout",
        ],
        "runs in memory, without device processes",
    ),
    (
        "run",
        &["policy-command", "decision-timeout", "on-undecided"],
        "asks no policy process",
    ),
    ("run", &["dashboard"], "serves no dashboard"),
    (
        "up",
        &["join-timeout", "key-file", "tls", "connect", "count", "connect-timeout"],
        "starts its device processes itself",
    ),
    (
        "bs",
        &["processes", "connect", "count", "connect-timeout"],
        "waits for processes that `reveille device` starts",
    ),
    (
        "device",
        &[],
        "receives the scenario and the clock from the base station",
    ),
];

/// Explains the `error` of the command line `args` of `program`, if it is about an option that other subcommands have,
/// or about an unknown subcommand of a subcommand.
pub(crate) fn explain_misplaced(mut error: Error, mut program: Command, args: &[OsString]) -> Error {
    if error.kind() == ErrorKind::InvalidSubcommand {
        return list_subcommands(error, &program, args);
    }
    let (ErrorKind::UnknownArgument, Some(ContextValue::String(given))) =
        (error.kind(), error.get(ContextKind::InvalidArg))
    else {
        return error;
    };
    let words = called_words(&program, args);
    if begins_own_option(&program, &words, given) {
        return error;
    }
    let Some(hint) = compose_hint(&program, &words, given) else {
        return error;
    };
    error.remove(ContextKind::SuggestedArg);
    error.insert(
        ContextKind::Suggested,
        ContextValue::StyledStrs(vec![StyledStr::from(hint)]),
    );
    // The usage of clap contains its suggestion.
    program.build();
    let called = words
        .iter()
        .try_fold(&mut program, |command, word| command.find_subcommand_mut(word));
    if let Some(called) = called {
        error.insert(ContextKind::Usage, ContextValue::StyledStr(called.render_usage()));
    }
    error
}

/// Whether `given` is the beginning of an option that the called subcommand has, such as `--device` of `--devices`.
fn begins_own_option(program: &Command, words: &[String], given: &str) -> bool {
    let called = words
        .iter()
        .try_fold(program, |command, word| command.find_subcommand(word));
    let (Some(called), Some(beginning)) = (called, given.strip_prefix("--")) else {
        return false;
    };
    let mut options = called.get_arguments().filter(|arg| !arg.is_hide_set());
    options.any(|arg| arg.get_long().is_some_and(|long| long.starts_with(beginning)))
}

/// Adds the subcommands of the called subcommand to the error about an unknown one, unless clap suggests one.
fn list_subcommands(mut error: Error, program: &Command, args: &[OsString]) -> Error {
    let words = called_words(program, args);
    let called = words
        .iter()
        .try_fold(program, |command, word| command.find_subcommand(word));
    let Some(called) = called.filter(|_| !words.is_empty() && error.get(ContextKind::SuggestedSubcommand).is_none())
    else {
        return error;
    };
    let visible = called.get_subcommands().filter(|below| !below.is_hide_set());
    let names: Vec<String> = visible.map(|below| format!("`{}`", below.get_name())).collect();
    let hint = format!("`{}` has the subcommands {}", words.join(" "), names.join(", "));
    error.insert(
        ContextKind::Suggested,
        ContextValue::StyledStrs(vec![StyledStr::from(hint)]),
    );
    error
}

/// Returns the words of `args` that name the called subcommand of `program`.
fn called_words(program: &Command, args: &[OsString]) -> Vec<String> {
    let (mut command, mut words) = (program, Vec::new());
    for arg in args.iter().skip(1).filter_map(|arg| arg.to_str()) {
        if let Some(below) = command.find_subcommand(arg) {
            words.push(arg.to_owned());
            command = below;
        } else if !words.is_empty() {
            // Values of global options may come before the first word only.
            break;
        }
    }
    words
}

/// Returns the text that names the subcommands with the option `given`; `None` without such subcommands, or if there
/// are more than [`MAX_NAMED`].
fn compose_hint(program: &Command, command_words: &[String], given: &str) -> Option<String> {
    let given = given.split('=').next()?;
    let mut owners = find_owners(program, "", given);
    let called = command_words.join(" ");
    if RUN_COMMANDS.contains(&&*called) {
        let is_of_run = |(words, _): &(String, String)| RUN_COMMANDS.contains(&&**words);
        if owners.iter().any(is_of_run) {
            owners.retain(is_of_run);
        }
    }
    let (_, long) = owners.first().filter(|_| owners.len() <= MAX_NAMED)?;
    let label = if given.starts_with("--") {
        format!("`{given}`")
    } else {
        format!("`{given}` (`--{long}`)")
    };
    let quoted: Vec<String> = owners.iter().map(|(words, _)| format!("`{words}`")).collect();
    let owner_list = match &quoted[..] {
        [before @ .., last] if !before.is_empty() => format!("{} and {last}", before.join(", ")),
        _ => quoted.concat(),
    };
    let applies = |options: &[&str]| options.is_empty() || options.contains(&&**long);
    let reason = REASONS
        .iter()
        .find(|(command, options, _)| *command == called && applies(options))
        .map(|(command, _, reason)| format!("; `{command}` {reason}"));
    Some(format!(
        "{label} is an option of {owner_list}{}",
        reason.unwrap_or_default()
    ))
}

/// Returns the visible subcommands below `command` that have the option `given`: the words of each, and the long name
/// of the option.
fn find_owners(command: &Command, words: &str, given: &str) -> Vec<(String, String)> {
    let mut found = Vec::new();
    for below in command.get_subcommands().filter(|below| !below.is_hide_set()) {
        let words = format!("{words} {}", below.get_name()).trim_start().to_owned();
        let option = below.get_arguments().find(|arg| is_option(arg, given));
        found.extend(
            option
                .and_then(Arg::get_long)
                .map(|long| (words.clone(), long.to_owned())),
        );
        found.extend(find_owners(below, &words, given));
    }
    found
}

/// Whether `arg` is the option written as `given`, such as `--pace` or `-P`.
fn is_option(arg: &Arg, given: &str) -> bool {
    let long = arg.get_long().map(|long| format!("--{long}"));
    let short = arg.get_short().map(|short| format!("-{short}"));
    !arg.is_hide_set() && (long.as_deref() == Some(given) || short.as_deref() == Some(given))
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;
    use crate::cli::Cli;

    /// Returns the error of a command line.
    fn refusal(line: &str) -> String {
        let args: Vec<OsString> = line.split(' ').map(OsString::from).collect();
        let error = Cli::command().try_get_matches_from(&args).expect_err(line);
        explain_misplaced(error, Cli::command(), &args).to_string()
    }

    /// Returns the long names of the visible options of a top-level command.
    fn options(command: &str) -> Vec<String> {
        let program = Cli::command();
        let command = program.find_subcommand(command).expect("a command");
        let visible = command.get_arguments().filter(|arg| !arg.is_hide_set());
        visible.filter_map(|arg| arg.get_long().map(str::to_owned)).collect()
    }

    #[test]
    fn an_option_of_other_subcommands_is_explained() {
        for (line, hint, usage) in [
            (
                "reveille run --pace 10ms",
                "tip: `--pace` is an option of `up` and `bs`; `run` runs without a clock\n",
                "Usage: reveille run [OPTIONS]\n",
            ),
            (
                "reveille -v run --processes=3",
                "tip: `--processes` is an option of `up`; `run` runs in memory, without device processes\n",
                "Usage: reveille run [OPTIONS]\n",
            ),
            (
                "reveille bs -P 3",
                "tip: `-P` (`--processes`) is an option of `up`; `bs` waits for processes that `reveille device` \
                 starts\n",
                "Usage: reveille bs [OPTIONS]\n",
            ),
            (
                "reveille up --input-log a",
                "tip: `--input-log` is an option of `run`\n",
                "Usage: reveille up [OPTIONS]\n",
            ),
            (
                "reveille inspect record --pair-wake-ups",
                "tip: `--pair-wake-ups` is an option of `inspect tail`\n",
                "Usage: reveille inspect record [OPTIONS] <FILE>\n",
            ),
        ] {
            let refusal = refusal(line);
            assert!(refusal.contains(hint) && refusal.contains(usage), "{line}: {refusal}");
            assert!(!refusal.contains("similar"), "{line}: {refusal}");
        }
        for line in ["reveille run --pases 3", "reveille up --device 10"] {
            let unknown = refusal(line);
            assert!(!unknown.contains("is an option of"), "{unknown}");
        }
    }

    #[test]
    fn the_subcommands_are_listed_for_an_unknown_one() {
        let unknown = refusal("reveille clock act explode 3");
        let hint = "tip: `clock act` has the subcommands `fail`, `revive`, `energy`, `set`\n";
        assert!(unknown.contains(hint), "{unknown}");
        let similar = refusal("reveille clock act fial 3");
        assert!(
            similar.contains("'fail'") && !similar.contains("has the subcommands"),
            "{similar}"
        );
    }

    #[test]
    fn every_option_of_another_command_of_a_run_is_explained() {
        for called in RUN_COMMANDS {
            let own = options(called);
            for option in RUN_COMMANDS.iter().flat_map(|command| options(command)) {
                if !own.contains(&option) {
                    let refusal = refusal(&format!("reveille {called} --{option}"));
                    let hint = format!("`--{option}` is an option of ");
                    assert!(refusal.contains(&hint), "{called} --{option}: {refusal}");
                }
            }
        }
    }

    #[test]
    fn reasons_are_about_options_that_a_command_lacks() {
        for (command, listed, _) in REASONS {
            let own = options(command);
            for option in listed {
                assert!(!own.contains(&(*option).to_owned()), "{command} has --{option}");
                let mut all = RUN_COMMANDS.iter().flat_map(|command| options(command));
                assert!(all.any(|other| other == *option), "no command has --{option}");
            }
        }
    }
}
