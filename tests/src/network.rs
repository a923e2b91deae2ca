//! A network with few ports.

use std::path::Path;
use std::process::Command;

/// A network of its own with a loopback, gone with it.
pub struct FewPorts(String);

impl FewPorts {
    /// Makes one whose connections have `ports` ports between them; `None` where that is not allowed, as it takes root.
    pub fn make(name: &str, ports: u32) -> Option<Self> {
        if !is_done(Command::new("ip").args(["netns", "add", name])) {
            return None;
        }
        let network = Self(name.to_owned());
        let range = format!(
            "ip link set lo up && echo 40000 {} > /proc/sys/net/ipv4/ip_local_port_range",
            40_000 + ports - 1
        );
        is_done(network.command(Path::new("sh")).args(["-c", &range])).then_some(network)
    }

    /// A command that runs in it.
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

fn is_done(command: &mut Command) -> bool {
    command.output().is_ok_and(|end| end.status.success())
}
