//! A frame as one line: text for a reader, or JSON for programs and recordings. The JSON form is a file format of
//! version [`VERSION`](crate::recording::VERSION): recordings hold it, `schemas` describes it, and `from_json` must
//! read what [`FrameLine::to_json`] writes. `wake_up_pairs` prints the same columns as text. `inspect tail` prints both
//! forms.
//!
//! Reading restores the payload by encoding the message again. This needs one encoding for each message, and the
//! feature `float_roundtrip` of `serde_json`.

use std::fmt::{self, Write as _};

use reveille_common::codec::CodecError;
use reveille_common::ids::Tti;
use reveille_common::message::{Frame, Message, MessageKind};
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;

/// A frame with its message, decoded once.
#[derive(Debug)]
pub struct FrameLine<'a> {
    /// The frame.
    pub frame: &'a Frame,
    /// Decoded message, or the error for a malformed payload.
    pub message: Result<Message, CodecError>,
}

/// Reason why a JSON line is not a frame.
#[derive(Debug, thiserror::Error)]
pub(crate) enum LineError {
    /// The line has another structure.
    #[error("{0}")]
    Json(#[from] serde_json::Error),
    /// Unknown kind of message.
    #[error("there is no kind of message {0:?} on the plane {1:?}")]
    Kind(String, String),
    /// A malformed payload is not in hexadecimal digits. `recording` also reports text that is not UTF-8 with it.
    #[error("the malformed payload does not consist of pairs of hexadecimal digits")]
    Hex,
}

/// JSON object of a frame, for writing. Its fields are keys of the file format, in this order; [`ParsedLine`] reads
/// them.
#[derive(Serialize)]
struct WrittenLine<'a> {
    tti: u64,
    plane: &'static str,
    kind: &'static str,
    number: Option<u32>,
    bytes: usize,
    message: LineBody<'a>,
}

/// Value of the key `message`.
#[derive(Serialize)]
#[serde(untagged)]
enum LineBody<'a> {
    Message(&'a Message),
    Malformed { malformed: String, payload: String },
}

/// JSON object of a frame, for reading. `bytes` is not read: it follows from the payload.
#[derive(Deserialize)]
struct ParsedLine<'a> {
    tti: u64,
    plane: String,
    kind: String,
    number: Option<u32>,
    #[serde(borrow)]
    message: &'a RawValue,
}

/// [`LineBody::Malformed`], for reading; the text of the error is not read.
#[derive(Deserialize)]
struct Malformed {
    payload: String,
}

impl<'a> FrameLine<'a> {
    /// Decodes `frame`.
    pub fn new(frame: &'a Frame) -> Self {
        Self {
            message: frame.message(),
            frame,
        }
    }

    /// Describes the message, or the error for a malformed payload.
    pub fn text(&self) -> String {
        match &self.message {
            Ok(message) => message.to_string(),
            Err(error) => format!("not a message: {error}"),
        }
    }

    /// Encodes the frame as a JSON object on one line: `tti`, `plane`, `kind`, `number`, `bytes`, and `message` with
    /// all fields. For a malformed payload, `malformed` holds the error and `payload` the bytes in hexadecimal digits.
    pub fn to_json(&self) -> String {
        let Frame {
            tti,
            kind,
            number,
            payload,
        } = self.frame;
        let line = WrittenLine {
            tti: tti.0,
            plane: kind.plane().name(),
            kind: kind.name(),
            number: *number,
            bytes: payload.len(),
            message: match &self.message {
                Ok(message) => LineBody::Message(message),
                Err(error) => LineBody::Malformed {
                    malformed: error.to_string(),
                    payload: to_hex(payload),
                },
            },
        };
        serde_json::to_string(&line).expect("messages have a form in JSON")
    }
}

impl fmt::Display for FrameLine<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Frame { tti, kind, number, .. } = self.frame;
        let (plane, name, bytes) = (kind.plane().name(), kind.name(), self.frame.payload.len());
        let (address, text) = (key_owner(*kind, *number), self.text());
        write!(f, "{tti:>8} {plane:<5} {name:<7} {address:<11} {bytes:>6} B  {text}")
    }
}

/// Names the owner of the number in a key, such as `device 7`; an empty text for a kind without a number.
pub fn key_owner(kind: MessageKind, number: Option<u32>) -> String {
    number.map_or_else(String::new, |number| format!("{} {number}", kind.addressee().name()))
}

/// Parses a JSON line into a frame; the inverse of [`FrameLine::to_json`].
///
/// # Errors
/// If the line is not a frame.
pub(crate) fn from_json(text: &str) -> Result<Frame, LineError> {
    let parsed: ParsedLine<'_> = serde_json::from_str(text)?;
    let is_named = |kind: &&MessageKind| kind.name() == parsed.kind && kind.plane().name() == parsed.plane;
    let Some(&kind) = MessageKind::ALL.iter().find(is_named) else {
        return Err(LineError::Kind(parsed.kind, parsed.plane));
    };
    let mut body = serde_json::Deserializer::from_str(parsed.message.get());
    let payload = match Message::deserialize(kind, &mut body) {
        Ok(message) => message.encode(),
        // An object for a malformed payload is tried last, since it cannot be a message of the kind.
        Err(error) => match serde_json::from_str::<Malformed>(parsed.message.get()) {
            Ok(Malformed { payload }) => parse_hex(&payload).ok_or(LineError::Hex)?,
            Err(_) => return Err(error.into()),
        },
    };
    Ok(Frame {
        tti: Tti(parsed.tti),
        kind,
        number: parsed.number,
        payload,
    })
}

/// Encodes bytes in hexadecimal digits.
pub fn to_hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _infallible = write!(text, "{byte:02x}");
        text
    })
}

fn parse_hex(hex: &str) -> Option<Vec<u8>> {
    let pairs = hex.as_bytes().chunks(2);
    pairs
        .map(|pair| u8::from_str_radix(std::str::from_utf8(pair).ok().filter(|pair| pair.len() == 2)?, 16).ok())
        .collect()
}

#[cfg(test)]
mod tests {
    use reveille_common::ids::{DeviceId, HostId};
    use reveille_common::message::{HostAnswer, Report, WakeOutcome, WakeUp};
    use reveille_common::units::Energy;

    use super::*;

    #[test]
    fn a_frame_round_trips() {
        let tti = Tti(7);
        let report = Report {
            device: DeviceId(3),
            tti,
            information: 0.1 + 0.2,
            battery: Energy::from_micro(123_456_789),
        };
        let answer = HostAnswer::NoReport {
            device: DeviceId(4),
            tti,
            outcome: WakeOutcome::Missed,
        };
        let malformed = Frame {
            payload: vec![3, 255, 0, 16],
            ..Frame::new(tti, DeviceId(9), &WakeUp { tti })
        };
        for frame in [
            Frame::new(tti, DeviceId(3), &report),
            Frame::new(tti, HostId(0), &answer),
            malformed,
        ] {
            assert_eq!(from_json(&FrameLine::new(&frame).to_json()).expect("a frame"), frame);
        }
    }

    #[test]
    fn an_invalid_line_is_refused() {
        let line = |plane: &str, kind: &str, message: &str| {
            format!(r#"{{"tti":1,"plane":"{plane}","kind":"{kind}","number":null,"bytes":2,"message":{message}}}"#)
        };
        assert!(from_json(&line("air", "wake", r#"{"tti":1}"#)).is_ok());
        for invalid in [
            line("emu", "wake", r#"{"tti":1}"#),
            line("air", "wake", "{}"),
            line("air", "wake", r#"{"malformed":"x","payload":"0g"}"#),
            line("air", "wake", r#"{"malformed":"x","payload":"012"}"#),
            "{}".to_owned(),
            String::new(),
        ] {
            assert!(from_json(&invalid).is_err(), "{invalid}");
        }
    }
}
