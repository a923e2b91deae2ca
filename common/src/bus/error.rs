//! Errors of the bus. Their texts reach the operator; `tests/program/bad_input.rs` expects some of them.

use std::time::Duration;

use crate::codec::CodecError;
use crate::keys::RunName;

/// An error on the bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// A text that is not an endpoint, and the reason.
    #[error("endpoint {0:?}: {1}; it must look like tcp/HOST:PORT, for example tcp/127.0.0.1:7447")]
    Endpoint(String, &'static str),
    /// An encrypted endpoint without certificates.
    #[error(
        "endpoint {0:?}: TLS needs certificates; give `bs`, `device` and other commands --tls FOLDER, which `reveille \
         tls init` writes, or use tcp/HOST:PORT without encryption"
    )]
    NoCertificate(String),
    /// An endpoint without encryption, although certificates are given.
    #[error("endpoint {0:?}: not encrypted, although --tls is given; use tls/HOST:PORT, or omit --tls")]
    NotEncrypted(String),
    /// An encrypted endpoint in a build without TLS.
    #[error("endpoint {0:?}: this build has no TLS; build it with `cargo build --release --features tls`")]
    NoTls(String),
    /// The BS cannot listen on this endpoint, for this reason.
    #[error(
        "cannot listen on {0}: {1}; if the port is in use, choose another with --listen, or tcp/127.0.0.1:0 for any \
         free one"
    )]
    Listen(String, String),
    /// No BS answers.
    #[error("no base station answers at {endpoint} within {patience:?}; check that it runs, and check the address")]
    Connect {
        /// The endpoint.
        endpoint: String,
        /// Time for which the client tried to connect.
        patience: Duration,
    },
    /// No BS completes a TLS handshake and opens a session.
    #[error(
        "no base station accepts a TLS connection at {endpoint} within {patience:?}; check that it runs, check the \
         address, and compare the certificates of both sides with `reveille tls show FOLDER`; the base station logs a \
         refused certificate"
    )]
    ConnectTls {
        /// The endpoint.
        endpoint: String,
        /// Time for which the client tried to connect.
        patience: Duration,
    },
    /// This machine cannot connect to this endpoint, whichever process listens, for this reason.
    #[error("cannot connect to {0}: {1}")]
    ConnectFailed(String, String),
    /// A base station answers, but does not serve this run.
    #[error("no base station of run {run} answers at {endpoint}; {hint}")]
    RunNotFound {
        /// The endpoint.
        endpoint: String,
        /// The requested run.
        run: RunName,
        /// A phrase that names the runs of the endpoint, from [`Bus::no_run_error`](super::Bus::no_run_error).
        hint: String,
    },
    /// A reply that cannot be decoded.
    #[error("the reply cannot be read: {0}")]
    InvalidReply(#[from] CodecError),
    /// The other side refused the query or could not decode it, or the base station refused this policy process.
    #[error("the base station refused: {0}")]
    Refused(String),
    /// Any other error that zenoh reports.
    #[error("zenoh: {0}")]
    Zenoh(String),
}

impl From<zenoh::Error> for BusError {
    fn from(error: zenoh::Error) -> Self {
        Self::Zenoh(error.to_string())
    }
}
