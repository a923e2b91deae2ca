//! Disks and networks with limits, and reports of checks that cannot run on this machine, for `tests/program/`. Uses
//! the commands `mount`, `umount` and `ip` of Linux.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::Command;

/// In-memory file system mounted at a path; unmounted on drop. The folder at the path stays.
pub struct Mount<'f>(&'f Path);

impl<'f> Mount<'f> {
    /// Mounts a disk of 256 KiB at `path`, created if missing; `None` if that fails, as without root rights.
    pub fn small(path: &'f Path) -> Option<Self> {
        Self::tmpfs(path, "size=256k")
    }

    /// Mounts an empty read-only disk at `path`, created if missing; `None` if that fails, as without root rights.
    pub fn read_only(path: &'f Path) -> Option<Self> {
        Self::tmpfs(path, "ro,size=64k")
    }

    /// Mounts a tmpfs at `path` with these options of `mount`.
    fn tmpfs(path: &'f Path, mount_options: &str) -> Option<Self> {
        fs::create_dir_all(path).ok()?;
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", mount_options, "none"]).arg(path);
        succeeds(&mut mount).then_some(Self(path))
    }
}

impl Drop for Mount<'_> {
    fn drop(&mut self) {
        // Detach lazily: a process of a failed test can still have files open here.
        let _ = Command::new("umount").arg("-l").arg(self.0).status();
    }
}

/// Network namespace with a loopback interface and few ephemeral ports; removed on drop.
pub struct FewPorts(String);

impl FewPorts {
    /// Creates the namespace `name` with `port_count` ephemeral ports; `None` if that fails, as without root rights or
    /// the command `ip`. The name must be unique on this machine, for example from
    /// [`unique_run`](crate::process::unique_run).
    pub fn make(name: &str, port_count: u32) -> Option<Self> {
        if !succeeds(Command::new("ip").args(["netns", "add", name])) {
            return None;
        }
        let namespace = Self(name.to_owned());
        let set_up = format!(
            "ip link set lo up && echo 40000 {} > /proc/sys/net/ipv4/ip_local_port_range",
            40_000 + port_count - 1
        );
        succeeds(namespace.command(Path::new("sh")).args(["-c", &set_up])).then_some(namespace)
    }

    /// Returns a command that runs `program` in the namespace. It has no arguments yet.
    pub fn command(&self, program: &Path) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.0]).arg(program);
        command
    }
}

impl Drop for FewPorts {
    fn drop(&mut self) {
        let _ = Command::new("ip").args(["netns", "del", &self.0]).status();
    }
}

fn succeeds(command: &mut Command) -> bool {
    command.output().is_ok_and(|output| output.status.success())
}

/// Prints that a check is skipped, and the reason. For checks that need root rights, which continuous integration may
/// lack; others use [`skip_except_in_ci`]. Does not use `eprintln!`, whose output a passing test hides.
pub fn print_skipped(reason: &str) {
    let _unread = writeln!(std::io::stderr(), "SKIPPED: {reason}").is_err();
}

/// Prints that a check is skipped, and the reason; fails in continuous integration, which has the program that the
/// check needs. `.ci/run` applies the same rule to its checks.
///
/// # Panics
/// If the variable `CI` is `true`.
pub fn skip_except_in_ci(reason: &str) {
    print_skipped(reason);
    assert!(
        std::env::var_os("CI").is_none_or(|ci| ci != "true"),
        "CI=true: {reason}"
    );
}
