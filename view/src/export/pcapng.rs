//! Messages as packets, for Wireshark: pcapng (IETF draft-ietf-opsawg-pcapng), link type USER0, with virtual time.
//!
//! A packet is a header and the payload as encoded. The header, little-endian: the number of the kind (one byte, in the
//! order of [`MessageKind::ALL`]), whether a number follows (one byte, 0 or 1), the number at the end of the key (four
//! bytes), the TTI (eight bytes).

use std::io::{self, Write};

use reveille_common::message::{Frame, MessageKind};

use crate::recording::NANOS_PER_TTI;

/// LINKTYPE_USER0.
const LINK_TYPE: u16 = 147;
/// Bytes of the header of a packet.
pub const HEADER: usize = 14;

const SECTION: u32 = 0x0A0D_0D0A;
const INTERFACE: u32 = 1;
const PACKET: u32 = 6;
/// The option that gives the unit of time stamps.
const RESOLUTION: u16 = 9;
/// Time stamps are in 10⁻⁹ s.
const NANOSECONDS: u8 = 9;
/// The option that names the interface.
const NAME: u16 = 2;

/// Writes packets.
pub struct Packets<W> {
    out: W,
}

impl<W: Write> Packets<W> {
    /// Begins a file.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn begin(mut out: W) -> io::Result<Self> {
        let mut section = Vec::new();
        section.extend(0x1A2B_3C4D_u32.to_le_bytes());
        section.extend(1_u16.to_le_bytes());
        section.extend(0_u16.to_le_bytes());
        // The length of the section is not told.
        section.extend(u64::MAX.to_le_bytes());
        block(&mut out, SECTION, &section)?;
        let mut interface = Vec::new();
        interface.extend(LINK_TYPE.to_le_bytes());
        interface.extend(0_u16.to_le_bytes());
        // Packets are whole, however long.
        interface.extend(0_u32.to_le_bytes());
        option(&mut interface, NAME, b"reveille");
        option(&mut interface, RESOLUTION, &[NANOSECONDS]);
        option(&mut interface, 0, &[]);
        block(&mut out, INTERFACE, &interface)?;
        Ok(Self { out })
    }

    /// Writes the packet of a frame.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write(&mut self, frame: &Frame) -> io::Result<()> {
        let packet = packet(frame);
        let (at, length) = (frame.tti.0 * NANOS_PER_TTI, packet.len() as u32);
        let mut body = Vec::with_capacity(packet.len() + 20);
        body.extend(0_u32.to_le_bytes());
        body.extend(((at >> 32) as u32).to_le_bytes());
        body.extend((at as u32).to_le_bytes());
        body.extend(length.to_le_bytes());
        body.extend(length.to_le_bytes());
        body.extend(packet);
        block(&mut self.out, PACKET, &body)
    }

    /// Ends the file. Gives back what it was written to.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn finish(mut self) -> io::Result<W> {
        self.out.flush()?;
        Ok(self.out)
    }
}

/// The number of a kind in packets.
pub fn number(kind: MessageKind) -> u8 {
    let at = MessageKind::ALL.iter().position(|known| *known == kind);
    at.expect("all kinds are listed") as u8
}

fn packet(frame: &Frame) -> Vec<u8> {
    let mut packet = Vec::with_capacity(HEADER + frame.payload.len());
    packet.push(number(frame.kind));
    packet.push(u8::from(frame.number.is_some()));
    packet.extend(frame.number.unwrap_or(0).to_le_bytes());
    packet.extend(frame.tti.0.to_le_bytes());
    packet.extend(&frame.payload);
    packet
}

/// A block: its type, its length before and after it, its body filled up to four bytes.
fn block(out: &mut impl Write, kind: u32, body: &[u8]) -> io::Result<()> {
    let filled = body.len().next_multiple_of(4);
    let length = (filled as u32 + 12).to_le_bytes();
    out.write_all(&kind.to_le_bytes())?;
    out.write_all(&length)?;
    out.write_all(body)?;
    out.write_all(&[0; 3][..filled - body.len()])?;
    out.write_all(&length)
}

fn option(out: &mut Vec<u8>, code: u16, value: &[u8]) {
    out.extend(code.to_le_bytes());
    out.extend((value.len() as u16).to_le_bytes());
    out.extend(value);
    out.extend(&[0; 3][..value.len().next_multiple_of(4) - value.len()]);
}

#[cfg(test)]
mod tests {
    use reveille_common::ids::{DeviceId, Tti};
    use reveille_common::message::WakeUp;

    use super::*;

    #[test]
    fn blocks_have_their_lengths_on_both_ends() {
        let frame = Frame::of(Tti(5_000_000), DeviceId(7), &WakeUp { tti: Tti(5_000_000) });
        let mut packets = Packets::begin(Vec::new()).expect("begun");
        packets.write(&frame).expect("written");
        let bytes = packets.finish().expect("finished");
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
        let (mut at, mut kinds) = (0, Vec::new());
        while at < bytes.len() {
            let length = word(at + 4) as usize;
            assert_eq!((length % 4, word(at + length - 4) as usize), (0, length));
            kinds.push(word(at));
            at += length;
        }
        assert_eq!(kinds, [SECTION, INTERFACE, PACKET]);
        let start = bytes.len() - word(bytes.len() - 4) as usize;
        let nanos = (u64::from(word(start + 12)) << 32) | u64::from(word(start + 16));
        assert_eq!(nanos, 5_000_000 * 1_000_000);
        let packet = &bytes[start + 28..start + 28 + word(start + 20) as usize];
        assert_eq!(packet[..6], [number(MessageKind::Wake), 1, 7, 0, 0, 0]);
        assert_eq!(packet[HEADER..], frame.payload);
    }
}
