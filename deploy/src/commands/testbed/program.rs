//! Runs the programs of the engine and of compose, and explains their failures.

use std::io::ErrorKind;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::{Command, ExitCode, Output, Stdio};

use anyhow::anyhow;

/// Runs a command with this program's terminal, and returns its exit code.
pub(super) fn exit_code_in_foreground(command: &mut Command) -> anyhow::Result<ExitCode> {
    let status = command.status()?;
    // A shell reports a signal in the same way.
    let code = status.code().or_else(|| status.signal().map(|signal| 128 + signal));
    Ok(ExitCode::from(
        code.and_then(|code| u8::try_from(code).ok()).unwrap_or(1),
    ))
}

/// Runs a command without input, and returns its output.
pub(super) fn execute(command: &[&str]) -> anyhow::Result<Output> {
    execute_in_background(Command::new(command[0]).args(&command[1..]))
}

/// Runs a command in a separate process group: Ctrl-C must end this program, not the command that it waits for.
pub(super) fn execute_in_background(command: &mut Command) -> anyhow::Result<Output> {
    let program = command.get_program().to_string_lossy().into_owned();
    command.stdin(Stdio::null()).process_group(0).output().map_err(|error| {
        if error.kind() == ErrorKind::NotFound {
            anyhow!(
                "{program}: command not found; install Docker with compose, such as the Debian packages docker.io \
                     and docker-compose"
            )
        } else {
            anyhow!("{program}: cannot start it: {error}")
        }
    })
}

/// Returns an output as text, without the last line break. Empty cells at its end stay.
pub(super) fn text_of(output: &[u8]) -> String {
    String::from_utf8_lossy(output)
        .trim_end_matches(['\r', '\n'])
        .to_owned()
}

/// Returns the error for a failed command, with the fix if the cause is a usual one.
pub(super) fn explain_failure(command: &str, stderr: &str) -> anyhow::Error {
    let lower = stderr.to_lowercase();
    let fix = if lower.contains("permission denied") && lower.contains("docker") {
        "; this user may not use Docker: add the user to the group `docker`, or use sudo"
    } else if lower.contains("cannot connect to the docker daemon") || lower.contains("connection refused") {
        "; no engine answers: start it, such as with `systemctl start docker`"
    } else if lower.contains("is not connected to") {
        "; the container is disconnected already: end that with `restore`"
    } else if lower.contains("no such container") || lower.contains("no such object") {
        "; the container was removed during the command: start the testbed again with `reveille testbed up`"
    } else if lower.contains("is not running") {
        "; the container has ended: `reveille testbed status` shows its state"
    } else {
        ""
    };
    anyhow!("docker {command}: {stderr}{fix}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn usual_causes_are_explained() {
        for (stderr, fix) in [
            (
                "Got permission denied while trying to connect to the Docker daemon socket",
                "add the user to the group `docker`",
            ),
            (
                "Cannot connect to the Docker daemon at unix:///var/run/docker.sock. Is the docker daemon running?",
                "systemctl start docker",
            ),
            ("Error: No such object: 0f3a", "the container was removed"),
            (
                "Error response from daemon: No such container: bs",
                "the container was removed",
            ),
            (
                "Error response from daemon: Container 0f3a is not running",
                "the container has ended",
            ),
            ("no such file", "docker ps: no such file"),
        ] {
            let error = explain_failure("ps", stderr).to_string();
            assert!(error.contains(fix) && error.contains(stderr), "{error}");
        }
    }

    #[test]
    fn a_missing_program_is_named_with_the_packages() {
        let error = execute(&["no-such-program"]).expect_err("no program").to_string();
        assert!(
            error.starts_with("no-such-program: command not found; install Docker"),
            "{error}"
        );
    }

    #[test]
    fn the_last_empty_cell_of_an_output_is_kept() {
        assert_eq!(text_of(b"a\tb\nc\t\n"), "a\tb\nc\t");
    }
}
