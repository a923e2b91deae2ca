//! `reveille policy-process`: the guard of the program that `--policy-command` names.

use std::os::unix::process::ExitStatusExt;
use std::process::ExitCode;

use crate::cli::PolicyProcessArgs;
use crate::policy_process::guard;

/// Starts the command, and ends with its exit code: 128 and the number of the signal, as shells have it, if that ended
/// it.
pub async fn run(args: &PolicyProcessArgs) -> anyhow::Result<ExitCode> {
    let status = guard(&args.command, args.parent).await?;
    let signal = || 128 + status.signal().unwrap_or_default();
    let code = status.code().unwrap_or_else(signal);
    Ok(u8::try_from(code).unwrap_or(u8::MAX).into())
}
