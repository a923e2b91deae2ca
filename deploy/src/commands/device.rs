//! `reveille device`: a process that runs devices. Tests wait for the note `joined`. With `--parent`, it is a child of
//! `up`, prints no notes about its join and ends with its parent; `child_process` writes the options and the key of a
//! child.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, ToSocketAddrs, UdpSocket};
use std::process::ExitCode;
use std::time::Duration;

use futures::future::try_join_all;
use reveille_common::bus::{Bus, Endpoint, Role};
use reveille_common::message::HostOffer;
use reveille_device::host::{self, HostConfig, HostError, HostEvent, MAX_INLINE_DEVICES};
use rustix::process::Signal;

use crate::cli::DeviceArgs;
use crate::display::note;
use crate::exit::ExitReason;
use crate::signals::{SignalMode, Signals};
use crate::{child_process, file_limits, key, tls};

/// Time for which the devices of `up` wait to join and for a lost base station: in effect unlimited, since it ends with
/// the base station's process.
pub(super) const CHILD_PATIENCE: Duration = Duration::from_hours(24 * 365);

/// Returns the name under which the operator finds this process: its pid, and its machine and address unless the
/// connection stays within one machine. In a container the machine is the container.
pub(super) fn process_name(endpoint: &str) -> String {
    let pid = std::process::id();
    let address = outgoing_address(endpoint);
    if address.is_some_and(|address| address.is_loopback()) {
        return format!("the process with pid {pid}");
    }
    let uname = rustix::system::uname();
    let machine = uname.nodename().to_string_lossy();
    let address = address.map_or_else(String::new, |address| format!(" ({address})"));
    format!("the process with pid {pid} on {machine}{address}")
}

/// Splits the name of a process into its pid, machine and address; a part that it lacks is empty.
pub(super) fn split_process_name(name: &str) -> (&str, &str, &str) {
    let text = name.strip_prefix("the process with pid ").unwrap_or("");
    let (pid, place) = text.split_once(" on ").unwrap_or((text, ""));
    let parts = place.strip_suffix(')').and_then(|place| place.split_once(" ("));
    let (machine, address) = parts.unwrap_or((place, ""));
    (pid, machine, address)
}

/// Returns the address of this machine from which `endpoint` is reached; `None` if it is unknown.
fn outgoing_address(endpoint: &str) -> Option<IpAddr> {
    let (_protocol, address) = endpoint.split_once('/')?;
    let remote = address.to_socket_addrs().ok()?.next()?;
    let any: IpAddr = if remote.is_ipv4() {
        Ipv4Addr::UNSPECIFIED.into()
    } else {
        Ipv6Addr::UNSPECIFIED.into()
    };
    // A UDP socket only looks up the route: nothing is sent.
    let socket = UdpSocket::bind((any, 0)).ok()?;
    socket.connect(remote).ok()?;
    Some(socket.local_addr().ok()?.ip())
}

/// Runs devices to the end of a run.
pub(crate) async fn run(args: &DeviceArgs) -> anyhow::Result<ExitCode> {
    // Before anything else: the parent may end at any moment, and a child must not outlive it.
    if let Some(parent) = args.parent {
        child_process::exit_with_parent(parent, Signal::KILL)?;
    }
    let tls_files = tls::files_of_role(args.tls.as_deref(), &[Role::Device])?;
    let signals = Signals::install(SignalMode::HasNoResults)?;
    file_limits::ensure_for_device_process()?;
    // `up` reports on behalf of its children.
    let is_standalone = args.parent.is_none();
    let report_event = |event: HostEvent| match event {
        HostEvent::Joined { host, first, last } if is_standalone => {
            note!("joined run {} as host {host} with devices {first} to {last}", args.run);
        }
        HostEvent::StandsBy if is_standalone && args.range.is_some() => {
            note!(
                "another process has devices of --range in run {}; waiting for them",
                args.run
            );
        }
        HostEvent::StandsBy if is_standalone => {
            note!(
                "all devices of run {} have a host; standing by to take over lost devices",
                args.run
            );
        }
        HostEvent::Joined { .. } | HostEvent::StandsBy => {}
    };
    let key = match &args.key_file {
        Some(path) => Some(key::read(path)?),
        // The key that a parent passes to its child.
        None => key::inherited(),
    };
    // Each range is a separate host, because a host has consecutive devices.
    let offers: Vec<HostOffer> = match &args.range {
        Some(ranges) => ranges.0.iter().copied().map(HostOffer::Exactly).collect(),
        None => vec![args.count.map_or(HostOffer::Share, HostOffer::AtMost)],
    };
    let total_devices = offers
        .iter()
        .fold(0, |sum: u32, offer| sum.saturating_add(offer.max_devices()));
    let config = HostConfig {
        offer: offers[0],
        name: tokio::task::spawn_blocking({
            let endpoint = args.connect.clone();
            move || process_name(&endpoint)
        })
        .await?,
        key,
        patience: if is_standalone {
            args.connect_timeout
        } else {
            CHILD_PATIENCE
        },
        stands_by: true,
        // Tuned processes handle messages on the thread that delivers them, if their devices are few. A host knows only
        // its own devices, and the hosts here share a link.
        forces_worker: args.untuned || (offers.len() > 1 && total_devices > MAX_INLINE_DEVICES),
    };
    let work = async {
        let endpoint = Endpoint {
            address: &args.connect,
            tls: tls_files.as_ref(),
        };
        let bus = Bus::connect_with_hosts(args.host_count, endpoint, args.run.clone(), args.connect_timeout).await?;
        let hosts = offers.iter().map(|offer| {
            let config = HostConfig {
                offer: *offer,
                ..config.clone()
            };
            host::run_host(&bus, config, &report_event)
        });
        let result = try_join_all(hosts).await;
        bus.close().await;
        result
    };
    match signals.unless_interrupted(work).await {
        Some(Ok(_)) => Ok(ExitReason::Done.into()),
        // `up` ended the run and reports the cause; its child has not failed, and `supervisor` must not report it.
        Some(Err(HostError::RunFailed(_))) if !is_standalone => Ok(ExitReason::Done.into()),
        Some(Err(error)) => Err(error.into()),
        None => Ok(ExitReason::Interrupted.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_process_has_its_pid_machine_and_address() {
        let local = process_name("tcp/127.0.0.1:7447");
        let pid = std::process::id().to_string();
        assert_eq!(split_process_name(&local), (&*pid, "", ""));
        // An address of the range for documentation, to which no machine has a closer route than its default one.
        let remote = process_name("tcp/192.0.2.1:7447");
        assert_eq!(split_process_name(&remote).0, pid, "{remote}");
        let name = "the process with pid 8 on d5f1 (172.18.0.4)";
        assert_eq!(split_process_name(name), ("8", "d5f1", "172.18.0.4"));
        assert_eq!(split_process_name("the process with pid 8 on d5f1"), ("8", "d5f1", ""));
        assert_eq!(split_process_name("a foreign host"), ("", "", ""));
    }
}
