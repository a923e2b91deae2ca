//! Mutual TLS between sessions: the roles of certificates, the files of a role, and the zenoh settings for them. The
//! common name of a certificate is the name of its role, from which `access` derives the rights of a peer. `reveille
//! tls init` writes the files (`deploy/src/commands/tls.rs`).
//!
//! zenoh 1.10.2 reads and writes a TLS stream in two tasks without a lock (zenoh issue 2557). On two threads the tasks
//! corrupt its state: links fail with "handshake not complete". A process with TLS therefore must run all tasks of
//! zenoh on one thread (`deploy/src/child_process.rs`). The close of a link blocks this thread until the peer has
//! acknowledged the last bytes, or for `TLS_LINGER_TIMEOUT` seconds if the link is cut. zenoh reads that limit when it
//! is compiled, and `.cargo/config.toml` sets it.

use std::path::{Path, PathBuf};

use super::BusError;

/// The role of a process on the bus, which its certificate names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The base station.
    Bs,
    /// A device process.
    Device,
    /// A program that shows a run.
    Observer,
    /// A program that shows a run, controls its clock and acts on its devices.
    Operator,
    /// A policy process.
    Policy,
    /// A router between networks, which forwards the messages of all other roles.
    Router,
}

impl Role {
    /// Every role.
    pub const ALL: [Self; 6] = [
        Self::Bs,
        Self::Device,
        Self::Observer,
        Self::Operator,
        Self::Policy,
        Self::Router,
    ];

    /// The common name of the role's certificates, and the name of its folder.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bs => "bs",
            Self::Device => "device",
            Self::Observer => "observer",
            Self::Operator => "operator",
            Self::Policy => "policy",
            Self::Router => "router",
        }
    }
}

/// The paths of the files that a process of one role needs, in PEM format.
#[derive(Clone, Debug)]
pub struct TlsFiles {
    /// Certificate of the authority (CA) that the process trusts.
    pub ca: PathBuf,
    /// Certificate of the process.
    pub certificate: PathBuf,
    /// Private key of the process.
    pub key: PathBuf,
}

impl TlsFiles {
    /// Returns the paths in `folder`, the folder of a role.
    pub fn new(folder: &Path) -> Self {
        Self {
            ca: folder.join("ca.pem"),
            certificate: folder.join("cert.pem"),
            key: folder.join("key.pem"),
        }
    }

    /// Returns the zenoh settings of a session that listens, or of one that connects.
    ///
    /// # Errors
    /// If a path is not UTF-8.
    pub(super) fn settings(&self, listens: bool) -> Result<[(&'static str, String); 4], BusError> {
        let (certificate, key) = if listens {
            ("listen_certificate", "listen_private_key")
        } else {
            ("connect_certificate", "connect_private_key")
        };
        let quoted =
            |path: &Path| serde_json::to_string(path).map_err(|e| BusError::Zenoh(format!("{}: {e}", path.display())));
        Ok([
            ("root_ca_certificate", quoted(&self.ca)?),
            (certificate, quoted(&self.certificate)?),
            (key, quoted(&self.key)?),
            // Both sides show a certificate. The names of the base station's certificate are checked by default.
            ("enable_mtls", "true".to_owned()),
        ])
    }
}

/// The endpoint of a base station: its address, `tcp/HOST:PORT` or `tls/HOST:PORT`, and the files for TLS.
#[derive(Clone, Copy, Debug)]
pub struct Endpoint<'a> {
    /// The address.
    pub address: &'a str,
    /// The files of this process's role, if the address is `tls/…`.
    pub tls: Option<&'a TlsFiles>,
}

impl<'a> From<&'a str> for Endpoint<'a> {
    fn from(address: &'a str) -> Self {
        Self { address, tls: None }
    }
}

impl<'a> From<&'a String> for Endpoint<'a> {
    fn from(address: &'a String) -> Self {
        address.as_str().into()
    }
}

impl<'a> Endpoint<'a> {
    /// Returns the protocol, the name or address of the machine, and the port.
    ///
    /// # Errors
    /// If the address is invalid, its protocol and the files do not go together, or this build has no TLS.
    pub(super) fn parse(self) -> Result<(&'a str, &'a str, u16), BusError> {
        let refuse = |why| BusError::Endpoint(self.address.to_owned(), why);
        let (protocol, address) = self.address.split_once('/').ok_or_else(|| refuse("no protocol"))?;
        match (protocol, self.tls) {
            ("tcp", None) => {}
            ("tls", Some(_)) if cfg!(feature = "tls") => {}
            ("tls", _) if !cfg!(feature = "tls") => return Err(BusError::NoTls(self.address.to_owned())),
            ("tls", None) => return Err(BusError::NoCertificate(self.address.to_owned())),
            ("tcp", Some(_)) => return Err(BusError::NotEncrypted(self.address.to_owned())),
            _ => return Err(refuse("only the protocols tcp and tls are supported")),
        }
        let (hostname, port) = address.rsplit_once(':').ok_or_else(|| refuse("no port"))?;
        if hostname.is_empty() || hostname.contains(['/', '?', '#', ',']) {
            return Err(refuse("no host"));
        }
        let port = port
            .parse()
            .map_err(|_| refuse("the port is not a number up to 65535"))?;
        Ok((protocol, hostname, port))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(address: &str) -> Result<(&str, &str, u16), BusError> {
        Endpoint::from(address).parse()
    }

    #[test]
    fn cargo_sets_the_short_limit_for_cut_links() {
        let limits = [option_env!("TCP_LINGER_TIMEOUT"), option_env!("TLS_LINGER_TIMEOUT")];
        assert_eq!(
            limits,
            [Some("1"); 2],
            "build in a folder to which .cargo/config.toml applies"
        );
    }

    #[test]
    fn invalid_endpoints_are_refused() {
        assert_eq!(parse("tcp/127.0.0.1:7447").expect("valid"), ("tcp", "127.0.0.1", 7447));
        assert_eq!(parse("tcp/[::1]:0").expect("valid"), ("tcp", "[::1]", 0));
        for endpoint in [
            "",
            "tcp",
            "tcp/",
            "tcp/host",
            "tcp/:1",
            "tcp/host:",
            "tcp/host:65536",
            "udp/host:1",
            "host:1",
            "tcp/a/b:1",
            "tcp/a:1,tcp/b:1",
        ] {
            assert!(matches!(parse(endpoint), Err(BusError::Endpoint(..))), "{endpoint}");
        }
    }

    #[test]
    fn a_protocol_that_does_not_fit_the_certificates_is_refused() {
        let files = TlsFiles::new(Path::new("certs/device"));
        let with_files = |address| Endpoint {
            address,
            tls: Some(&files),
        };
        assert!(matches!(
            with_files("tcp/host:1").parse(),
            Err(BusError::NotEncrypted(_))
        ));
        let (encrypted, without_files) = (with_files("tls/host:1").parse(), parse("tls/host:1"));
        if cfg!(feature = "tls") {
            assert_eq!(encrypted.expect("valid"), ("tls", "host", 1));
            assert!(matches!(without_files, Err(BusError::NoCertificate(_))));
        } else {
            assert!(matches!(encrypted, Err(BusError::NoTls(_))));
            assert!(matches!(without_files, Err(BusError::NoTls(_))));
        }
    }
}
