//! Encodings for programs in other languages: JSON, which is widely supported, and CBOR, which is shorter. Policy
//! processes rely on both forms: `docs/policy-port.md` describes them, `python/reveille/policy_client.py` reads them.
//! Messages between parts of this program use the wire format of [`codec`](crate::codec), which cannot decode
//! [`FloatRows`] and [`Octets`].

use serde::de::{self, DeserializeOwned, SeqAccess, Visitor};
use serde::ser::SerializeSeq;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// An encoding of messages. A policy process names it by its word, `json` or `cbor`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Encoding {
    /// JSON (RFC 8259).
    #[default]
    Json,
    /// CBOR (RFC 8949).
    Cbor,
}

impl Encoding {
    /// Encodes `message`.
    ///
    /// # Panics
    /// If `message` cannot be encoded, for example a map whose keys are not texts.
    pub fn encode<T: Serialize>(self, message: &T) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(256);
        match self {
            Self::Json => serde_json::to_writer(&mut bytes, message).expect("the message has a form in JSON"),
            Self::Cbor => ciborium::into_writer(message, &mut bytes).expect("the message has a form in CBOR"),
        }
        bytes
    }

    /// Decodes the message in `bytes`.
    ///
    /// # Errors
    /// If `bytes` is not exactly one message of type `T`; the text describes the error.
    pub fn decode<T: DeserializeOwned>(self, bytes: &[u8]) -> Result<T, String> {
        match self {
            Self::Json => serde_json::from_slice(bytes).map_err(|error| error.to_string()),
            Self::Cbor => {
                let mut unread = bytes;
                let message = ciborium::from_reader(&mut unread).map_err(|error| error.to_string())?;
                // ciborium stops after the first item.
                if unread.is_empty() {
                    Ok(message)
                } else {
                    Err(format!("{} bytes follow the message", unread.len()))
                }
            }
        }
    }
}

/// Numbers in rows of equal length. JSON: an array of rows. CBOR: one byte string, row by row, with four little-endian
/// bytes per number, which arrays can use without conversion. Decoded from CBOR, all values form one row.
#[derive(Clone, Debug, PartialEq)]
pub struct FloatRows {
    /// Number of values in a row, ≥ 1.
    pub width: usize,
    /// All values, row by row; a multiple of `width`, or JSON omits the values after the last whole row.
    pub values: Vec<f32>,
}

impl Serialize for FloatRows {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            let mut rows = serializer.serialize_seq(Some(self.values.len() / self.width.max(1)))?;
            // `chunks_exact` panics at a width of 0.
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

impl<'de> Deserialize<'de> for FloatRows {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(RowsVisitor)
    }
}

/// A visitor that reads both encodings of [`FloatRows`]. A byte string has no row length.
struct RowsVisitor;

impl<'de> Visitor<'de> for RowsVisitor {
    type Value = FloatRows;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("rows of numbers, or a string of bytes")
    }

    fn visit_bytes<E: de::Error>(self, bytes: &[u8]) -> Result<FloatRows, E> {
        let (numbers, extra_bytes) = bytes.as_chunks::<4>();
        if !extra_bytes.is_empty() {
            return Err(E::custom("expected numbers of four bytes each"));
        }
        let values: Vec<f32> = numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        let width = values.len().max(1);
        Ok(FloatRows { width, values })
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut rows: A) -> Result<FloatRows, A::Error> {
        let (mut width, mut values) = (None, Vec::new());
        while let Some(row) = rows.next_element::<Vec<f32>>()? {
            if *width.get_or_insert(row.len()) != row.len() {
                return Err(de::Error::custom("rows of different lengths"));
            }
            values.extend(row);
        }
        let width = width.unwrap_or(1).max(1);
        Ok(FloatRows { width, values })
    }
}

/// Small numbers: an array in JSON, a byte string in CBOR. Both are accepted in both encodings.
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

/// A visitor that reads both encodings of [`Octets`].
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
        let mut octets = Vec::new();
        while let Some(number) = numbers.next_element()? {
            octets.push(number);
        }
        Ok(Octets(octets))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_and_octets_round_trip_in_both_encodings() {
        let rows = FloatRows {
            width: 3,
            values: vec![0.1, -1.5, 1.0 / 3.0, f32::MIN_POSITIVE, 0.0, 7e12],
        };
        let octets = Octets(vec![0, 2, 255]);
        let json = Encoding::Json.encode(&(&rows, &octets));
        assert!(json.starts_with(b"[[[0.1,-1.5,"), "{}", String::from_utf8_lossy(&json));
        assert_eq!(
            Encoding::Json.decode::<(FloatRows, Octets)>(&json),
            Ok((rows.clone(), octets.clone()))
        );
        let cbor = Encoding::Cbor.encode(&(&rows, &octets));
        // CBOR holds the rows as one byte string, without their width.
        let (decoded_rows, decoded_octets) = Encoding::Cbor.decode::<(FloatRows, Octets)>(&cbor).expect("both");
        assert_eq!(
            (decoded_rows.values, decoded_rows.width, decoded_octets),
            (rows.values, 6, octets)
        );
        assert!(
            cbor.len() < json.len(),
            "{} bytes of CBOR, {} of JSON",
            cbor.len(),
            json.len()
        );
    }

    #[test]
    fn invalid_values_are_refused() {
        for text in ["[[1],[1,2]]", "[1]", "{}", "[[\"a\"]]", "[[1]"] {
            assert!(Encoding::Json.decode::<FloatRows>(text.as_bytes()).is_err(), "{text}");
        }
        for text in ["[256]", "[-1]", "[1.5]", "\"a\"", "[1] 2"] {
            assert!(Encoding::Json.decode::<Octets>(text.as_bytes()).is_err(), "{text}");
        }
        assert!(
            Encoding::Cbor.decode::<FloatRows>(&[0x43, 0, 0, 0]).is_err(),
            "a number has four bytes"
        );
        assert!(
            Encoding::Cbor.decode::<Octets>(&[0x41, 7, 7]).is_err(),
            "a byte follows the octets"
        );
        assert!(Encoding::Cbor.decode::<Octets>(&[0xff]).is_err());
    }
}
