//! The forms in which programs in other languages are spoken to: JSON, which everybody reads, and CBOR, which is
//! shorter. Messages between parts of this program are in [`codec`](crate::codec)'s form.

use serde::de::{self, DeserializeOwned, SeqAccess, Visitor};
use serde::ser::SerializeSeq;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A form of messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Form {
    /// JSON (RFC 8259).
    #[default]
    Json,
    /// CBOR (RFC 8949).
    Cbor,
}

impl Form {
    /// `message` in this form.
    ///
    /// # Panics
    /// If `message` holds what has no such form, as a map whose keys are no texts.
    pub fn encode<T: Serialize>(self, message: &T) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(256);
        match self {
            Self::Json => serde_json::to_writer(&mut bytes, message).expect("the message has a form in JSON"),
            Self::Cbor => ciborium::into_writer(message, &mut bytes).expect("the message has a form in CBOR"),
        }
        bytes
    }

    /// The message in `bytes`.
    ///
    /// # Errors
    /// What is wrong with them, in words.
    pub fn decode<T: DeserializeOwned>(self, bytes: &[u8]) -> Result<T, String> {
        match self {
            Self::Json => serde_json::from_slice(bytes).map_err(|error| error.to_string()),
            Self::Cbor => {
                let mut rest = bytes;
                let message = ciborium::from_reader(&mut rest).map_err(|error| error.to_string())?;
                if rest.is_empty() {
                    Ok(message)
                } else {
                    Err(format!("{} bytes follow the message", rest.len()))
                }
            }
        }
    }
}

/// Numbers in rows of the same length. In JSON an array of rows; in CBOR one byte string, row by row, each number four
/// bytes in little-endian order, which arrays can be laid over.
#[derive(Clone, Debug, PartialEq)]
pub struct Rows {
    /// Numbers in a row, ≥ 1.
    pub width: usize,
    /// All numbers, row by row.
    pub values: Vec<f32>,
}

impl Serialize for Rows {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            let mut rows = serializer.serialize_seq(Some(self.values.len() / self.width.max(1)))?;
            for row in self.values.chunks_exact(self.width.max(1)) {
                rows.serialize_element(row)?;
            }
            rows.end()
        } else {
            let bytes: Vec<u8> = self.values.iter().flat_map(|value| value.to_le_bytes()).collect();
            serializer.serialize_bytes(&bytes)
        }
    }
}

impl<'de> Deserialize<'de> for Rows {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(RowsVisitor)
    }
}

/// Reads either form of [`Rows`]. A byte string does not say how long a row is: it is one.
struct RowsVisitor;

impl<'de> Visitor<'de> for RowsVisitor {
    type Value = Rows;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("rows of numbers, or a string of bytes")
    }

    fn visit_bytes<E: de::Error>(self, bytes: &[u8]) -> Result<Rows, E> {
        let (numbers, rest) = bytes.as_chunks::<4>();
        if !rest.is_empty() {
            return Err(E::custom("numbers of four bytes each were expected"));
        }
        let values: Vec<f32> = numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        let width = values.len().max(1);
        Ok(Rows { width, values })
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut rows: A) -> Result<Rows, A::Error> {
        let (mut width, mut values) = (None, Vec::new());
        while let Some(row) = rows.next_element::<Vec<f32>>()? {
            if *width.get_or_insert(row.len()) != row.len() {
                return Err(de::Error::custom("rows of different lengths"));
            }
            values.extend(row);
        }
        let width = width.unwrap_or(1).max(1);
        Ok(Rows { width, values })
    }
}

/// Small numbers: in JSON an array, in CBOR a byte string; either is read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Octets(pub Vec<u8>);

impl Serialize for Octets {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            self.0.serialize(serializer)
        } else {
            serializer.serialize_bytes(&self.0)
        }
    }
}

impl<'de> Deserialize<'de> for Octets {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(OctetsVisitor)
    }
}

/// Reads either form of [`Octets`].
struct OctetsVisitor;

impl<'de> Visitor<'de> for OctetsVisitor {
    type Value = Octets;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("an array of numbers from 0 to 255, or a string of bytes")
    }

    fn visit_bytes<E: de::Error>(self, bytes: &[u8]) -> Result<Octets, E> {
        Ok(Octets(bytes.to_vec()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut numbers: A) -> Result<Octets, A::Error> {
        let mut all = Vec::new();
        while let Some(number) = numbers.next_element()? {
            all.push(number);
        }
        Ok(Octets(all))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_and_octets_come_back_in_either_form() {
        let rows = Rows {
            width: 3,
            values: vec![0.1, -1.5, 1.0 / 3.0, f32::MIN_POSITIVE, 0.0, 7e12],
        };
        let octets = Octets(vec![0, 2, 255]);
        let json = Form::Json.encode(&(&rows, &octets));
        assert!(json.starts_with(b"[[[0.1,-1.5,"), "{}", String::from_utf8_lossy(&json));
        assert_eq!(
            Form::Json.decode::<(Rows, Octets)>(&json),
            Ok((rows.clone(), octets.clone()))
        );
        let cbor = Form::Cbor.encode(&(&rows, &octets));
        let (one_row, again) = Form::Cbor.decode::<(Rows, Octets)>(&cbor).expect("both");
        assert_eq!((one_row.values, one_row.width, again), (rows.values, 6, octets));
        // An array of numbers from 24 to 0 is one of a byte or two each, the string of bytes is shorter.
        assert!(cbor.len() < json.len());
    }

    #[test]
    fn what_is_none_is_refused() {
        for bad in ["[[1],[1,2]]", "[1]", "{}", "[[\"a\"]]", "[[1]"] {
            assert!(Form::Json.decode::<Rows>(bad.as_bytes()).is_err(), "{bad}");
        }
        for bad in ["[256]", "[-1]", "[1.5]", "\"a\"", "[1] 2"] {
            assert!(Form::Json.decode::<Octets>(bad.as_bytes()).is_err(), "{bad}");
        }
        assert!(Form::Cbor.decode::<Rows>(&[0x43, 0, 0, 0]).is_err(), "three bytes");
        assert!(Form::Cbor.decode::<Octets>(&[0x41, 7, 7]).is_err(), "a byte too many");
        assert!(Form::Cbor.decode::<Octets>(&[0xff]).is_err());
    }
}
