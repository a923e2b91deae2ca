//! A run in a process of its own.

use std::process::{Command, Stdio};

use anyhow::Context;
use serde_json::Value;

/// The summary of the run that `reveille ARGUMENTS` plays.
///
/// # Errors
/// If there is none, with what was said.
pub fn played(arguments: &[&str]) -> anyhow::Result<Value> {
    let folder = std::env::temp_dir().join(format!("reveille-bench-{}", std::process::id()));
    let mut command = Command::new(std::env::current_exe()?);
    command
        .args(arguments)
        .args(["--json", "--quiet", "--out"])
        .arg(&folder)
        .stdin(Stdio::null());
    let output = command.output().context("cannot start reveille")?;
    anyhow::ensure!(
        output.status.success(),
        "reveille {}: {}",
        arguments.join(" "),
        String::from_utf8_lossy(&output.stderr)
    );
    std::fs::remove_dir_all(&folder)?;
    Ok(serde_json::from_slice(&output.stdout)?)
}
