//! What can go wrong on the bus.

use std::time::Duration;

use crate::codec::CodecError;
use crate::keys::RunName;

/// What can go wrong on the bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// A text that is not an endpoint.
    #[error("endpoint {0:?}: {1}; it must look like tcp/HOST:PORT, for example tcp/127.0.0.1:7447")]
    Endpoint(String, &'static str),
    /// The BS cannot listen.
    #[error(
        "cannot listen on {0}: {1}. Is the port in use? Choose another with --listen, or \
         tcp/127.0.0.1:0 for any free one"
    )]
    Listen(String, String),
    /// No BS answers.
    #[error("no base station answers at {endpoint} within {patience:?}. Is it running, and is the address right?")]
    Connect {
        /// The endpoint.
        endpoint: String,
        /// How long the connection was tried.
        patience: Duration,
    },
    /// This machine cannot connect, whoever listens.
    #[error("cannot connect to {0}: {1}")]
    Hindered(String, String),
    /// The BS is there, but does not answer for this run.
    #[error("nobody answers for run {run} at {endpoint}. {hint}")]
    NoRun {
        /// The endpoint.
        endpoint: String,
        /// The run asked for.
        run: RunName,
        /// The runs that there are.
        hint: String,
    },
    /// A reply that cannot be read.
    #[error("the reply cannot be read: {0}")]
    Reply(#[from] CodecError),
    /// The other side will not answer the question, or could not read it.
    #[error("the base station refused: {0}")]
    Refused(String),
    /// Anything else that zenoh reports.
    #[error("zenoh: {0}")]
    Zenoh(String),
}

impl From<zenoh::Error> for BusError {
    fn from(error: zenoh::Error) -> Self {
        Self::Zenoh(error.to_string())
    }
}
