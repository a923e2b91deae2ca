//! Copies of messages for observers.

use serde::{Deserialize, Serialize};

use super::{Address, Addressee, Message, MessageKind, Payload};
use crate::codec::{self, CodecError};
use crate::ids::{DeviceId, Tti};

/// A copy of one message: what a tail shows, a recording holds and the tap of the bus carries.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Frame {
    /// The TTI that the BS was in.
    pub tti: Tti,
    /// Its kind.
    pub kind: MessageKind,
    /// The number at the end of its key, a device's or a host's, where the kind has one.
    pub number: Option<u32>,
    /// Its payload, as sent.
    pub payload: Vec<u8>,
}

impl Frame {
    /// A copy of `message`, from or to `address`, in TTI `tti`.
    pub fn of<P: Payload>(tti: Tti, address: P::Address, message: &P) -> Self {
        Self {
            tti,
            kind: P::KIND,
            number: address.number(),
            payload: codec::encode(message),
        }
    }

    /// The device that the message is to or from; none where the number in its key is a host's, or there is none.
    pub fn device(&self) -> Option<DeviceId> {
        let is_own = self.kind.addressee() == Addressee::Device;
        self.number.filter(|_| is_own).map(DeviceId)
    }

    /// The message.
    ///
    /// # Errors
    /// If the payload is of another version or not exactly one message of its kind: a stranger may have sent it.
    pub fn message(&self) -> Result<Message, CodecError> {
        Message::decode(self.kind, &self.payload)
    }
}

/// Emulation, BS → observers: copies of messages, in the order in which they were sent or heard.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TapBatch {
    /// The number of the first frame, counted since the run began. A gap to the batch before is what was left out.
    pub first: u64,
    /// The frames.
    pub frames: Vec<Frame>,
}
