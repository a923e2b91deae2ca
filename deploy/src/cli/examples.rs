//! The examples at the end of each command's help. Tests here check each help (its first sentence, two examples that
//! parse) and the refusals of number options, whose types `is_number` lists. Lower bounds on counts in tests only
//! ensure that the loops find commands and options.

/// Returns the last part of a command's help: two commands that work as they are written. Every visible command needs
/// it as its `after_help`.
macro_rules! examples {
    ($first:literal, $second:literal $(,)?) => {
        concat!("Examples:\n  ", $first, "\n  ", $second)
    };
}
pub(super) use examples;

#[cfg(test)]
mod tests {
    use std::any::TypeId;
    use std::num::NonZero;

    use clap::{Arg, Command, CommandFactory};

    use crate::cli::Cli;

    /// Most characters of an example, so that a terminal of this width does not wrap it.
    const MAX_COLUMNS: usize = 100;
    /// Most words in the first sentence of a command's help.
    const MAX_WORDS: usize = 25;

    /// Returns every visible command with the words that call it, the program first.
    fn commands() -> Vec<(Vec<String>, Command)> {
        fn add(words: &[String], command: &Command, commands: &mut Vec<(Vec<String>, Command)>) {
            commands.push((words.to_vec(), command.clone()));
            let visible = command.get_subcommands().filter(|subcommand| !subcommand.is_hide_set());
            for subcommand in visible {
                let words = [words, &[subcommand.get_name().to_owned()]].concat();
                add(&words, subcommand, commands);
            }
        }
        let mut commands = Vec::new();
        add(&["reveille".to_owned()], &Cli::command(), &mut commands);
        assert!(commands.len() > 40, "only {} commands", commands.len());
        commands
    }

    /// Returns the examples at the end of the help of `command`.
    fn examples_of(command: &Command) -> Vec<String> {
        let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
        let (_, examples) = help.rsplit_once("Examples:\n").unwrap_or_default();
        examples.lines().map(str::to_owned).collect()
    }

    #[test]
    fn each_help_starts_with_one_short_sentence() {
        for (words, command) in commands() {
            let words = words.join(" ");
            let about = command.get_about().map(ToString::to_string).unwrap_or_default();
            assert!(about.starts_with(char::is_uppercase), "{words}: {about:?}");
            let sentence = about.trim_end_matches('.');
            let is_one_sentence = !sentence.contains(". ") && !sentence.contains('\n');
            assert!(is_one_sentence, "{words}: more than one sentence: {about:?}");
            let length = sentence.split_whitespace().count();
            assert!(length <= MAX_WORDS, "{words}: {length} words: {about:?}");
            // `--help` shows the long form, which must start in the same way.
            let long = command
                .get_long_about()
                .map_or_else(|| about.clone(), ToString::to_string);
            assert!(long.starts_with(sentence), "{words}: {long:?}");
        }
    }

    #[test]
    fn each_help_ends_with_two_examples_that_parse() {
        for (words, command) in commands() {
            let words = words.join(" ");
            assert!(command.get_after_long_help().is_none(), "{words}");
            let examples = examples_of(&command);
            assert_eq!(examples.len(), 2, "{words}: {examples:?}");
            assert_ne!(examples[0], examples[1], "{words}");
            for example in &examples {
                let line = example.strip_prefix("  ").unwrap_or_default();
                assert!(line.starts_with("reveille "), "{words}: {example:?}");
                assert!(example.chars().count() <= MAX_COLUMNS, "{words}: {example:?}");
                // The words are split as in a shell only if they have neither quotes nor comments.
                assert!(!line.contains(['\'', '"', '#', '\\']), "{words}: {example:?}");
                if let Err(error) = Cli::command().try_get_matches_from(line.split_whitespace()) {
                    panic!("{words}: {line}: {error}");
                }
            }
            let calls_command = |example: &String| example.trim_start().starts_with(&words);
            assert!(
                examples.iter().any(calls_command),
                "{words}: no example of this command: {examples:?}"
            );
        }
    }

    /// Whether the values of `arg` are numbers.
    fn is_number(arg: &Arg) -> bool {
        let value_type = arg.get_value_parser().type_id();
        let number_types = [
            TypeId::of::<u16>(),
            TypeId::of::<u32>(),
            TypeId::of::<u64>(),
            TypeId::of::<usize>(),
            TypeId::of::<NonZero<usize>>(),
            TypeId::of::<i32>(),
            TypeId::of::<i64>(),
            TypeId::of::<f64>(),
        ];
        arg.get_action().takes_values() && number_types.iter().any(|number_type| value_type == *number_type)
    }

    #[test]
    fn an_invalid_number_is_refused_with_the_allowed_numbers() {
        let mut option_count = 0;
        for (words, command) in commands() {
            let number_args = command
                .get_arguments()
                .filter(|arg| is_number(arg) && !arg.is_hide_set());
            for arg in number_args {
                option_count += 1;
                let option = arg.get_long().map(|long| format!("--{long}"));
                let invalid_argument = match &option {
                    Some(option) => format!("{option}=many"),
                    None => "many".to_owned(),
                };
                let line: Vec<String> = words.iter().cloned().chain([invalid_argument]).collect();
                let refusal = Cli::command().try_get_matches_from(&line).map(drop);
                let refusal = refusal.expect_err("no number").to_string();
                let allowed = ["must be a whole number from ", "must be a number"];
                let names_allowed_numbers = allowed.iter().any(|text| refusal.contains(text));
                assert!(names_allowed_numbers, "{}: {refusal}", line.join(" "));
                // A negative number must not be read as an option.
                let negative = option.into_iter().chain(["-5".to_owned()]);
                let line: Vec<String> = words.iter().cloned().chain(negative).collect();
                let refusal = Cli::command().try_get_matches_from(&line).map(drop);
                let refusal = refusal.map_or_else(|error| error.to_string(), |()| String::new());
                assert!(
                    !refusal.contains("unexpected argument"),
                    "{}: {refusal}",
                    line.join(" ")
                );
            }
        }
        assert!(option_count > 40, "only {option_count} number options");
    }
}
