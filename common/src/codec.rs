//! The wire format of all messages: one version byte, then bincode with variable-length integers. A change of a
//! message, or of a type in it, raises [`WIRE_VERSION`]. Recordings and device checkpoints store the format. Byte
//! metrics count the lengths from [`encoded_len`]; digests do not depend on the encoding.
//!
//! bincode is unmaintained upstream. Only this file names it, so that another encoding can replace it here.

use serde::Serialize;
use serde::de::DeserializeOwned;

/// The version of the wire format. A host and a BS with different versions refuse each other, and a program refuses
/// recordings with another version. `tests/untrusted_clients/bus.py` repeats the number.
pub const WIRE_VERSION: u8 = 11;

/// Maximum length of a payload that [`decode`] accepts, in bytes. [`encode`] does not check it.
pub(crate) const MAX_PAYLOAD: usize = 64 << 20;

const CONFIG: bincode::config::Configuration<
    bincode::config::LittleEndian,
    bincode::config::Varint,
    bincode::config::Limit<MAX_PAYLOAD>,
> = bincode::config::standard().with_limit::<MAX_PAYLOAD>();

/// The reason why a payload is not a message.
#[derive(Debug, thiserror::Error)]
pub enum CodecError {
    /// The payload is empty.
    #[error("the payload is empty")]
    Empty,
    /// A program with another version of the wire format sent it.
    #[error(
        "the payload has wire version {0}, this program speaks version {WIRE_VERSION}: use the same release of \
            reveille on both sides"
    )]
    Version(u8),
    /// The bytes are not a message of the expected kind.
    #[error("the payload is malformed: {0}")]
    Malformed(String),
    /// Bytes follow the message.
    #[error("{0} bytes follow the message")]
    Trailing(usize),
}

/// Encodes `message` as a payload.
///
/// # Panics
/// If `message` holds a type without a wire format (maps of unknown length); the messages of this crate do not.
pub fn encode<T: Serialize>(message: &T) -> Vec<u8> {
    let mut payload = Vec::with_capacity(64);
    payload.push(WIRE_VERSION);
    bincode::serde::encode_into_std_write(message, &mut payload, CONFIG).expect("messages have a wire form");
    payload
}

/// Decodes the message in `payload`.
///
/// # Errors
/// If `payload` has another version or is not exactly one message of type `T`.
pub fn decode<T: DeserializeOwned>(payload: &[u8]) -> Result<T, CodecError> {
    match payload.split_first() {
        None => Err(CodecError::Empty),
        Some((&WIRE_VERSION, body)) => {
            let (message, used) =
                bincode::serde::decode_from_slice(body, CONFIG).map_err(|e| CodecError::Malformed(e.to_string()))?;
            if used == body.len() {
                Ok(message)
            } else {
                Err(CodecError::Trailing(body.len() - used))
            }
        }
        Some((&version, _)) => Err(CodecError::Version(version)),
    }
}

/// Returns the length of [`encode`]'s payload in bytes, without encoding it.
///
/// # Panics
/// If [`encode`] panics.
pub fn encoded_len<T: Serialize>(message: &T) -> u64 {
    // The version byte.
    let mut counter = ByteCounter(1);
    bincode::serde::encode_into_std_write(message, &mut counter, CONFIG).expect("messages have a wire form");
    counter.0
}

struct ByteCounter(u64);

impl std::io::Write for ByteCounter {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0 += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::Tti;
    use crate::message::WakeUp;

    #[test]
    fn a_message_round_trips_and_encoded_len_is_exact() {
        // 250 is the largest integer that takes one byte.
        for tti in [0, 250, 251, 70_000, u64::MAX] {
            let wake = WakeUp { tti: Tti(tti) };
            let payload = encode(&wake);
            assert_eq!(decode::<WakeUp>(&payload).expect("valid"), wake);
            assert_eq!(encoded_len(&wake), payload.len() as u64, "TTI {tti}");
        }
    }

    #[test]
    fn invalid_payloads_are_refused() {
        let other_version = WIRE_VERSION + 1;
        let valid = encode(&WakeUp { tti: Tti(3) });
        let with_trailing_byte = [&valid[..], &[0]].concat();
        assert!(matches!(decode::<WakeUp>(&[]), Err(CodecError::Empty)));
        assert!(matches!(
            decode::<WakeUp>(&[other_version, 3]),
            Err(CodecError::Version(version)) if version == other_version
        ));
        assert!(matches!(decode::<WakeUp>(&valid[..1]), Err(CodecError::Malformed(_))));
        assert!(matches!(
            decode::<WakeUp>(&with_trailing_byte),
            Err(CodecError::Trailing(1))
        ));
    }
}
