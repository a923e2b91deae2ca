//! The exit codes of `reveille`, their lines in `--help`, and the errors of commands that have a code other than 1.
//! `main` turns the error of a command into its code. Scripts and tests rely on the numbers; `docs/command-line.md`
//! lists them. The file also keeps the message of the last panic: `run_folder` stores it as the cause of a failed run.

use std::borrow::Cow;
use std::fmt;
use std::process::ExitCode;
use std::sync::{Mutex, PoisonError};

use reveille_bs::server::BsError;

/// The outcome of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitReason {
    /// Success.
    Done,
    /// Failure, with a message.
    Failed,
    /// Wrong command line, or a request that this build does not support. clap uses the same code.
    Usage,
    /// Ended by a signal; after a first signal the results so far are kept. Shells use the same code for Ctrl-C.
    Interrupted,
}

/// The message of the last panic, with its place.
static LAST_PANIC: Mutex<Option<String>> = Mutex::new(None);

/// Keeps the message of every panic for [`last_panic`]. The message is still printed.
pub(crate) fn keep_panic_messages() {
    let print = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        let message = panic.payload_as_str().unwrap_or("no message").to_owned();
        let place = panic
            .location()
            .map_or_else(String::new, |place| format!(" at {place}"));
        *LAST_PANIC.lock().unwrap_or_else(PoisonError::into_inner) = Some(format!("panicked{place}: {message}"));
        print(panic);
    }));
}

/// Returns the message of the last panic; `None` without a panic, or before [`keep_panic_messages`].
pub(crate) fn last_panic() -> Option<String> {
    LAST_PANIC.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

impl ExitReason {
    /// All outcomes, in the order of `--help`. The compiler does not notice a missing one.
    const ALL: [Self; 4] = [Self::Done, Self::Failed, Self::Usage, Self::Interrupted];

    /// The outcome of a command that returned `error`. An error with a code other than 1 must be a type named here and
    /// keep it: `context` does, a new `anyhow!` does not.
    pub fn from_error(error: &anyhow::Error) -> Self {
        // A run over the bus that a signal stops ends with an error of the base station.
        let is_bs_interruption = error.downcast_ref::<BsError>().is_some_and(BsError::is_interruption);
        if is_bs_interruption || error.is::<Interrupted>() {
            Self::Interrupted
        } else if error.is::<InvalidUsage>() {
            Self::Usage
        } else {
            Self::Failed
        }
    }

    /// The exit code.
    pub const fn code(self) -> u8 {
        match self {
            Self::Done => 0,
            Self::Failed => 1,
            Self::Usage => 2,
            Self::Interrupted => 130,
        }
    }

    /// The line of `--help`, without the code.
    const fn about(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Failed => "failed; the cause is on standard error",
            Self::Usage => "invalid command line, or this build lacks the required feature",
            Self::Interrupted => "interrupted by Ctrl-C, SIGTERM or a closed terminal; finished results are kept",
        }
    }

    /// Ends the program immediately.
    pub fn exit_now(self) -> ! {
        std::process::exit(i32::from(self.code()))
    }
}

/// The error of a command ended by a signal. Its text names the results that are kept.
#[derive(Debug)]
pub(crate) struct Interrupted(pub Cow<'static, str>);

impl Interrupted {
    /// The error of a command without results to keep.
    pub(crate) const WITHOUT_RESULTS: Self = Self(Cow::Borrowed("interrupted"));
    /// The error of a run that has not begun.
    pub(crate) const BEFORE_RUN: Self = Self(Cow::Borrowed("interrupted before the first TTI"));
    /// The error of a resumed run whose replay has not ended.
    pub(crate) const DURING_REPLAY: Self = Self(Cow::Borrowed("interrupted during the replay; resume the run again"));
}

impl fmt::Display for Interrupted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Interrupted {}

impl From<ExitReason> for ExitCode {
    fn from(exit: ExitReason) -> Self {
        Self::from(exit.code())
    }
}

/// The error of a command line whose options contradict each other. Its text names the options.
#[derive(Debug)]
pub(crate) struct InvalidUsage(pub String);

impl fmt::Display for InvalidUsage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for InvalidUsage {}

/// The part of `--help` that lists the exit codes.
pub(crate) fn exit_codes_help() -> String {
    let lines = ExitReason::ALL.map(|exit| format!("  {:>3}  {}", exit.code(), exit.about()));
    format!("Exit codes:\n{}", lines.join("\n"))
}
