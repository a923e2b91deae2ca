//! Encoder for Protocol Buffers fields, used by `perfetto` with the field numbers of Perfetto's schema. Protocol
//! Buffers define the bytes.

/// An encoded message, to which fields can be appended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Proto(Vec<u8>);

impl Proto {
    /// Creates a message without fields.
    pub(super) const fn new() -> Self {
        Self(Vec::new())
    }

    /// Appends an integer, enumeration or Boolean field.
    #[must_use]
    pub(super) fn number(mut self, field: u32, value: u64) -> Self {
        self.key(field, 0);
        self.varint(value);
        self
    }

    /// Appends a 64-bit integer field, always of eight bytes.
    #[must_use]
    pub(super) fn fixed(mut self, field: u32, value: u64) -> Self {
        self.key(field, 1);
        self.0.extend(value.to_le_bytes());
        self
    }

    /// Appends a double-precision field.
    #[must_use]
    pub(super) fn double(self, field: u32, value: f64) -> Self {
        self.fixed(field, value.to_bits())
    }

    /// Appends a string field.
    #[must_use]
    pub(super) fn text(mut self, field: u32, value: &str) -> Self {
        self.bytes(field, value.as_bytes());
        self
    }

    /// Appends an embedded message.
    #[must_use]
    pub(super) fn message(mut self, field: u32, value: &Self) -> Self {
        self.bytes(field, &value.0);
        self
    }

    /// Returns the encoded bytes.
    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.0
    }

    fn bytes(&mut self, field: u32, value: &[u8]) {
        self.key(field, 2);
        self.varint(value.len() as u64);
        self.0.extend(value);
    }

    fn key(&mut self, field: u32, wire_type: u32) {
        // Wire types: 0 varint, 1 eight bytes, 2 a length and its bytes.
        self.varint(u64::from(field << 3 | wire_type));
    }

    fn varint(&mut self, mut value: u64) {
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
        assert_eq!(Proto::new().number(1, 150).into_bytes(), [0x08, 0x96, 0x01]);
        assert_eq!(Proto::new().text(2, "testing").into_bytes(), b"\x12\x07testing");
        let inner = Proto::new().number(1, 150);
        assert_eq!(
            Proto::new().message(3, &inner).into_bytes(),
            [0x1a, 0x03, 0x08, 0x96, 0x01]
        );
        assert_eq!(
            Proto::new().double(1, 1.0).into_bytes(),
            [9, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f]
        );
    }
}
