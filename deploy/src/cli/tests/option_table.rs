//! Compares the table of options in `docs/command-line.md` with the options of the commands that execute runs or
//! their devices: names, commands and the defaults that clap knows. Meanings, and defaults that only a help text states
//! (`[default: …]`), are not compared.

use std::collections::{BTreeMap, BTreeSet};

use clap::{Arg, Command, CommandFactory};

use crate::cli::Cli;

/// The page with the table.
const PAGE: &str = include_str!("../../../../docs/command-line.md");
/// The heading above the table, which ends before the next heading of this level.
const HEADING: &str = "## Options of a run\n";
/// The commands in the table.
const COMMANDS: [&str; 4] = ["up", "run", "bs", "device"];

/// An option, such as `--scenario` or `-s, --scenario`, with a command that has it.
type CommandOption = (String, &'static str);

/// Returns the text between backquotes in a cell.
fn quoted(cell: &str) -> impl Iterator<Item = &str> {
    cell.split('`').skip(1).step_by(2)
}

/// Returns the cells of each row of the table, without its head.
fn table_rows() -> Vec<Vec<&'static str>> {
    let (_, section) = PAGE.split_once(HEADING).expect("the heading");
    let section = section.split("\n## ").next().unwrap_or_default();
    let lines = section.lines().filter(|line| line.starts_with('|'));
    let cells = |line: &'static str| line.trim_matches('|').split('|').map(str::trim).collect();
    let rows: Vec<Vec<&str>> = lines.map(cells).collect();
    assert_eq!(rows[0], ["option", "commands", "meaning", "default"]);
    rows.into_iter().skip(2).collect()
}

/// Returns the name of an option in the table: `-s, --scenario` for the cell "`-s`, `--scenario`".
fn name_in_table(cell: &str) -> String {
    let words = quoted(cell).map(|text| text.split(' ').next().unwrap_or_default());
    words.collect::<Vec<_>>().join(", ")
}

/// Returns the name of an option of a command in the same form.
fn name_in_program(arg: &Arg) -> Option<String> {
    let long = arg.get_long().map(|long| format!("--{long}"))?;
    Some(
        arg.get_short()
            .map_or(long.clone(), |short| format!("-{short}, {long}")),
    )
}

/// Returns the options of a command that `--help` shows.
fn visible_options(command: &'static str, program: &Command) -> Vec<(CommandOption, Arg)> {
    let subcommand = program.find_subcommand(command).expect("a command");
    let visible = subcommand.get_arguments().filter(|arg| !arg.is_hide_set());
    visible
        .filter_map(|arg| Some(((name_in_program(arg)?, command), arg.clone())))
        .collect()
}

#[test]
fn the_table_lists_every_option_of_a_run() {
    let program = Cli::command();
    let args: BTreeMap<CommandOption, Arg> = COMMANDS
        .into_iter()
        .flat_map(|command| visible_options(command, &program))
        .collect();
    let mut listed = BTreeSet::new();
    for row in table_rows() {
        let [option, commands, meaning, default] = row[..] else {
            panic!("not four cells: {row:?}");
        };
        assert!(!meaning.is_empty(), "{option}");
        for command in quoted(commands) {
            let command = COMMANDS.into_iter().find(|known| *known == command);
            let command = command.unwrap_or_else(|| panic!("{option}: not a command of a run: {commands}"));
            let entry = (name_in_table(option), command);
            let arg = args.get(&entry);
            let arg = arg.unwrap_or_else(|| panic!("{command} has no option {}", entry.0));
            for value in arg.get_default_values() {
                let value = value.to_str().expect("text");
                assert!(
                    !arg.get_action().takes_values() || default.contains(&format!("`{value}`")),
                    "{option} of {command}: the default is {value}, not {default}"
                );
            }
            assert!(listed.insert(entry), "{option} of {command} has two rows");
        }
    }
    let missing: Vec<&CommandOption> = args.keys().filter(|entry| !listed.contains(*entry)).collect();
    assert!(missing.is_empty(), "docs/command-line.md lacks the options {missing:?}");
}
