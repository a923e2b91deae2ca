//! The exit codes of the command, all of them.

use std::process::ExitCode;

/// How the command ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// It did what was asked.
    Done,
    /// It could not, and said why.
    Failed,
    /// The command line is wrong, or asks for what this build cannot do. clap ends with the same code.
    Usage,
    /// A signal has ended it: what there is so far is kept. The code is that of shells for Ctrl-C.
    Interrupted,
}

impl Exit {
    /// Every way to end.
    const ALL: [Self; 4] = [Self::Done, Self::Failed, Self::Usage, Self::Interrupted];

    /// The exit code.
    pub const fn code(self) -> u8 {
        match self {
            Self::Done => 0,
            Self::Failed => 1,
            Self::Usage => 2,
            Self::Interrupted => 130,
        }
    }

    /// The line of `--help`.
    const fn about(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Failed => "failed; standard error says why",
            Self::Usage => "the command line is wrong, or this build lacks the feature",
            Self::Interrupted => "interrupted by Ctrl-C, SIGTERM or a closed terminal; what is finished is kept",
        }
    }

    /// Ends the program at once.
    pub fn now(self) -> ! {
        std::process::exit(i32::from(self.code()))
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit.code())
    }
}

/// The part of `--help` that lists the exit codes.
pub fn help() -> String {
    let lines = Exit::ALL.map(|exit| format!("  {:>3}  {}", exit.code(), exit.about()));
    format!("Exit codes:\n{}", lines.join("\n"))
}
