//! Checks of the whole command line against clap's own definition of it. `cli/examples.rs` checks the helps and every
//! number option.

mod option_table;

use clap::{Arg, Command, CommandFactory};

use super::Cli;

#[test]
fn the_command_line_is_consistent() {
    Cli::command().debug_assert();
}

/// Each number is one that its command cannot use. The list is not complete; its upper ends are `MAX_DEVICES`,
/// `MAX_TTIS`, `MAX_SEEDS` of sweeps, and the largest numbers of the types.
#[test]
fn numbers_below_a_range_are_refused_with_the_range() {
    for (line, range) in [
        ("bench scale --devices 0", "from 1 to 1000000"),
        ("bench scale --ttis 0", "from 1 to 1000000000"),
        ("bench watch --devices 0", "from 1 to 1000000"),
        ("bench watch --ttis 0", "from 1 to 1000000000"),
        ("bench memory --devices 10,0", "from 1 to 1000000"),
        ("bench memory --ttis 0", "from 1 to 1000000000"),
        ("bench study --seeds 0", "from 1 to 1000"),
        ("train q-learning --devices 0 --out a", "from 1 to 1000000"),
        ("train record --stride 1 --out a", "from 2 to 4294967295"),
        ("sweep --seeds 0", "from 1 to 10000000"),
        ("sweep --min-seeds 1", "from 2 to 10000000"),
        ("analyse battery --devices 1", "from 2 to 1000000"),
        ("analyse battery --ttis 0", "from 1 to "),
        ("figures q-table a --devices 0", "from 1 to 1000000"),
        ("device --run a --connect b --host-count 0", "from 1 to 4294967295"),
        ("device --run a --connect b --parent 0", "from 1 to 2147483647"),
        ("bench bare-host zenoh a 3,4 -1 5", "from 0 to 4294967295"),
        ("bench bare-host zenoh a 3,4 0 many", "from 1 to 2147483647"),
    ] {
        let words = ["reveille"].into_iter().chain(line.split(' '));
        let refusal = Cli::command().try_get_matches_from(words).expect_err(line).to_string();
        let expected = format!("must be a whole number {range}");
        assert!(refusal.contains(&expected), "{line}: {refusal}");
    }
}

/// Returns the visible commands below `command` and the command itself.
fn commands(command: &Command) -> Vec<Command> {
    let visible = command.get_subcommands().filter(|below| !below.is_hide_set());
    visible.flat_map(commands).chain([command.clone()]).collect()
}

/// Returns a valid item of an option that takes a list: its first default or possible value, or else 7.
fn sample_item(arg: &Arg) -> String {
    let default_list = arg.get_default_values().first().and_then(|value| value.to_str());
    let first_default = default_list.and_then(|text| text.split(',').next()).map(str::to_owned);
    let first_possible = || {
        arg.get_possible_values()
            .first()
            .map(|value| value.get_name().to_owned())
    };
    first_default.or_else(first_possible).unwrap_or_else(|| "7".to_owned())
}

#[test]
fn the_items_of_a_list_may_have_spaces_around_them() {
    let mut option_count = 0;
    for command in commands(&Cli::command()) {
        for arg in command
            .get_arguments()
            .filter(|arg| arg.get_value_delimiter() == Some(','))
        {
            option_count += 1;
            let (id, value) = (arg.get_id().as_str(), sample_item(arg));
            // Exactly two items, because `--epsilon` of a training takes two.
            let line = format!("--{}={value}, {value}", arg.get_long().expect("an option"));
            let without_required = command
                .clone()
                .mut_args(|arg| arg.required(false))
                .subcommand_required(false);
            let matches = without_required.try_get_matches_from([command.get_name(), &line]);
            let matches = matches.unwrap_or_else(|error| panic!("{} {line}: {error}", command.get_name()));
            if let Ok(Some(mut items)) = matches.try_get_many::<String>(id) {
                assert!(
                    items.all(|item| *item == value),
                    "{} {line}: {items:?}",
                    command.get_name()
                );
            }
        }
    }
    // A lower bound, so that the loop finds the options.
    assert!(option_count > 15, "only {option_count} options take a list");
}
