//! The top-level help of [`super::Cli`], which lists the commands by purpose. clap groups options, but not commands. A
//! test checks that every visible command is in exactly one group.

use std::fmt::Write as _;

use clap::builder::Styles;
use clap::{Command, Subcommand};

use crate::display::{WIDTH, wrap_text};

/// Columns for the name of a command in the list, with the indent of two.
const NAME_WIDTH: usize = 13;
/// Help of `help`, the command that clap adds.
const HELP_ABOUT: &str = "Print this message or the help of a command";

/// The title of each group, and its commands.
const GROUPS: [(&str, &[&str]); 5] = [
    (
        "Run",
        &["up", "run", "bs", "device", "router", "link", "clock", "testbed"],
    ),
    ("Look", &["inspect", "compare", "dashboard", "figures"]),
    ("Study", &["sweep", "merge", "report", "analyse"]),
    ("Train", &["train", "tune"]),
    ("Tools", &["scenario", "tls", "bench", "help"]),
];

/// Returns the template of the top-level help.
pub(super) fn help_template() -> String {
    let program = super::Command::augment_subcommands(Command::new("reveille"));
    let styles = Styles::styled();
    let (header, literal) = (styles.get_header(), styles.get_literal());
    let mut text = "{about-with-newline}\n{usage-heading} {usage}\n".to_owned();
    for (title, names) in GROUPS {
        let _infallible = writeln!(text, "\n{header}{title}:{header:#}");
        for name in names {
            let styled_about = program.find_subcommand(name).and_then(Command::get_about);
            let about = styled_about.map_or_else(|| HELP_ABOUT.to_owned(), ToString::to_string);
            let wrapped_about = wrap_text(&about, WIDTH - NAME_WIDTH).replace('\n', &format!("\n{:NAME_WIDTH$}", ""));
            let _infallible = writeln!(
                text,
                "  {literal}{name:<width$}{literal:#}{wrapped_about}",
                width = NAME_WIDTH - 2
            );
        }
    }
    text + &format!("\n{header}Options:{header:#}\n{{options}}{{after-help}}")
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;
    use crate::cli::Cli;

    #[test]
    fn every_command_is_in_exactly_one_group() {
        let mut program = Cli::command();
        program.build();
        let visible = program.get_subcommands().filter(|command| !command.is_hide_set());
        let mut commands: Vec<&str> = visible.map(Command::get_name).collect();
        let mut grouped: Vec<&str> = GROUPS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
        commands.sort_unstable();
        grouped.sort_unstable();
        assert_eq!(grouped, commands);
    }

    #[test]
    fn the_help_lists_every_command_with_its_description() {
        for help in [Cli::command().render_help(), Cli::command().render_long_help()] {
            let help = help.to_string();
            for (title, names) in GROUPS {
                assert!(help.contains(&format!("\n{title}:\n  {}", names[0])), "{help}");
            }
            for part in [
                "Usage: reveille [OPTIONS] <COMMAND>\n",
                "\nOptions:\n  -v, --verbose",
                "Examples:",
                "Exit codes",
            ] {
                assert!(help.contains(part), "no {part:?}: {help}");
            }
            let list = help.lines().skip(1).take_while(|line| *line != "Options:");
            assert!(list.map(|line| line.chars().count()).max() <= Some(WIDTH), "{help}");
        }
    }
}
