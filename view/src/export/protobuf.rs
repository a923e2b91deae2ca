//! Encoder for Protocol Buffers messages, used by `perfetto` with the field numbers of Perfetto's schema. The bytes
//! follow <https://protobuf.dev/programming-guides/encoding>.

/// An encoded message, to which fields can be appended. Fields keep the order of the calls, and a repeated call repeats
/// the field. Negative integers and field numbers of 2²⁹ or more are not supported.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct ProtoMessage(Vec<u8>);

impl ProtoMessage {
    /// Creates a message without fields.
    pub(super) const fn new() -> Self {
        Self(Vec::new())
    }

    /// Appends an integer, enumeration or Boolean field.
    #[must_use]
    pub(super) fn varint(mut self, field_number: u32, value: u64) -> Self {
        self.push_tag(field_number, 0);
        self.push_varint(value);
        self
    }

    /// Appends a 64-bit integer field, always of eight bytes.
    #[must_use]
    pub(super) fn fixed64(mut self, field_number: u32, value: u64) -> Self {
        self.push_tag(field_number, 1);
        self.0.extend(value.to_le_bytes());
        self
    }

    /// Appends a double-precision field.
    #[must_use]
    pub(super) fn double(self, field_number: u32, value: f64) -> Self {
        self.fixed64(field_number, value.to_bits())
    }

    /// Appends a string field.
    #[must_use]
    pub(super) fn string(mut self, field_number: u32, value: &str) -> Self {
        self.push_length_delimited(field_number, value.as_bytes());
        self
    }

    /// Appends an embedded message.
    #[must_use]
    pub(super) fn message(mut self, field_number: u32, value: &Self) -> Self {
        self.push_length_delimited(field_number, &value.0);
        self
    }

    /// Returns the encoded bytes.
    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.0
    }

    fn push_length_delimited(&mut self, field_number: u32, value: &[u8]) {
        self.push_tag(field_number, 2);
        self.push_varint(value.len() as u64);
        self.0.extend(value);
    }

    fn push_tag(&mut self, field_number: u32, wire_type: u32) {
        // Wire types: 0 varint, 1 eight bytes, 2 a length and its bytes.
        self.push_varint(u64::from(field_number << 3 | wire_type));
    }

    fn push_varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Examples from the Protocol Buffers encoding guide.
    #[test]
    fn fields_are_encoded_as_in_the_guide() {
        assert_eq!(ProtoMessage::new().varint(1, 150).into_bytes(), [0x08, 0x96, 0x01]);
        assert_eq!(
            ProtoMessage::new().string(2, "testing").into_bytes(),
            b"\x12\x07testing"
        );
        let inner = ProtoMessage::new().varint(1, 150);
        assert_eq!(
            ProtoMessage::new().message(3, &inner).into_bytes(),
            [0x1a, 0x03, 0x08, 0x96, 0x01]
        );
        assert_eq!(
            ProtoMessage::new().double(1, 1.0).into_bytes(),
            [9, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f]
        );
    }
}
