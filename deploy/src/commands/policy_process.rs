//! `reveille policy-process`: the guard of the program that `--policy-command` names.

use std::process::ExitCode;

use crate::cli::PolicyProcessArgs;
use crate::policy_process::guard;

/// Starts the command, and ends with its exit code.
pub async fn run(args: &PolicyProcessArgs) -> anyhow::Result<ExitCode> {
    guard(&args.command, args.parent).await
}
