//! Copies of messages for observers ([`Frame`], the unit of a recording), and the observers' queries about a run.
//! Fields are encoded by position: a change raises `WIRE_VERSION`. The JSON form of a frame is in
//! `view/src/frame_line.rs`. `deploy/` sends the requests and reads the replies.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Address, Addressee, Concerns, Message, MessageKind, Payload};
use crate::codec::{self, CodecError};
use crate::ids::{DeviceId, Tti};

/// A copy of one message, as `reveille inspect` shows it, a recording stores it and the bus's tap carries it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Frame {
    /// The current TTI of the BS.
    pub tti: Tti,
    /// The kind of the message.
    pub kind: MessageKind,
    /// The device or host of [`MessageKind::addressee`], if the kind has one. A report has its device, although its key
    /// on the bus names the host.
    pub number: Option<u32>,
    /// The payload as sent.
    pub payload: Vec<u8>,
}

impl Frame {
    /// Copies `message`, from or to `address`, in TTI `tti`.
    pub fn new<P: Payload>(tti: Tti, address: P::Address, message: &P) -> Self {
        Self {
            tti,
            kind: P::KIND,
            number: address.number(),
            payload: codec::encode(message),
        }
    }

    /// Returns the device that sent or received the message; `None` if the kind has a host or no number.
    pub fn device(&self) -> Option<DeviceId> {
        let names_device = self.kind.addressee() == Addressee::Device;
        self.number.filter(|_| names_device).map(DeviceId)
    }

    /// Decodes the message.
    ///
    /// # Errors
    /// If the payload has another version or is not exactly one message of its kind, as from a foreign sender.
    pub fn message(&self) -> Result<Message, CodecError> {
        Message::decode(self.kind, &self.payload)
    }
}

/// Emulation, BS → observers: copies of messages, in the order of sending and receiving.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameBatch {
    /// The number of the first frame, counted from the start of the run. A gap to the previous batch shows dropped
    /// frames.
    pub first: u64,
    /// The frames.
    pub frames: Vec<Frame>,
}

/// Emulation, observer → BS, a query: the scenario of the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DescribeRequest;

impl Concerns for DescribeRequest {}

impl fmt::Display for DescribeRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("requests the scenario")
    }
}

/// Emulation, BS → observer: the reply to [`DescribeRequest`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ScenarioDescription {
    /// The text of the scenario file.
    pub scenario: String,
    /// The files that it names: path relative to the scenario file, and bytes.
    pub files: Vec<(String, Vec<u8>)>,
}

/// Emulation, observer → BS, a query: a part of the run's input log. The log grows during the run and can be longer
/// than the maximum length of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputLogRequest {
    /// The first byte to read, counted from 0.
    pub from: u64,
}

impl Concerns for InputLogRequest {}

impl fmt::Display for InputLogRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "requests the input log from byte {}", self.from)
    }
}

/// Emulation, BS → observer: the reply to [`InputLogRequest`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputLogPart {
    /// Up to [`InputLogPart::MAX_BYTES`] bytes of the log, or one longer line. Empty at the end of the log or without
    /// one.
    pub bytes: Vec<u8>,
}

impl InputLogPart {
    /// Length in bytes of a part, except a longer one with a single line. A shorter part ends the log: writer
    /// (`deploy/src/input_log.rs`) and reader rely on it. A message can be longer (`MAX_PAYLOAD` in `codec.rs`).
    pub const MAX_BYTES: u64 = 4 << 20;
}
