//! `reveille inspect export --to pcapng`: messages as packets for Wireshark, in pcapng (IETF draft-ietf-opsawg-pcapng),
//! with link type USER0 and virtual time.
//!
//! A packet is a header and the payload as encoded. The header is little-endian. Its fields are the number of the kind
//! (one byte, in the order of [`MessageKind::ALL`]), whether the message's bus key ends in a number (one byte, 0 or 1),
//! this number or 0 (four bytes), the TTI (eight bytes), and the text of `inspect tail` after its length in bytes (two
//! bytes). `dissector.lua` in this folder repeats the offsets and the link type: change both.
//!
//! The header and the order of [`MessageKind::ALL`] are thus part of the file format. A script dissects only files of
//! the same [`WIRE_VERSION`](reveille_common::codec::WIRE_VERSION), the first byte of each payload, and of the same
//! program: write both again after an update. `tests/recordings/check.py` reads the packets with tshark.

use core::time::Duration;
use std::io::Write;

use pcap_file::pcapng::PcapNgWriter;
use pcap_file::pcapng::blocks::enhanced_packet::EnhancedPacketBlock;
use pcap_file::pcapng::blocks::interface_description::{InterfaceDescriptionBlock, InterfaceDescriptionOption};
use pcap_file::{DataLink, Endianness, PcapError};
use reveille_common::message::{Frame, MessageKind};

use crate::frame_line::FrameLine;
use crate::recording::log_time;

/// Length of a packet header before the text and its length, bytes.
const HEADER_BYTES: usize = 14;
/// Most bytes of a text; longer ones are cut.
const MAX_TEXT_BYTES: usize = 1000;
/// Negative decimal exponent of the resolution of time stamps: 10⁻⁹ s.
const TIMESTAMP_RESOLUTION_EXPONENT: u8 = 9;

/// Writer of packets.
pub struct PacketWriter<W: Write>(PcapNgWriter<W>);

impl<W: Write> PacketWriter<W> {
    /// Writes the start of a file.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn begin(out: W) -> Result<Self, PcapError> {
        let mut writer = PcapNgWriter::with_endianness(out, Endianness::Little)?;
        writer.write_pcapng_block(InterfaceDescriptionBlock {
            linktype: DataLink::USER0,
            // 0 means no limit: packets are never truncated.
            snaplen: 0,
            options: vec![
                InterfaceDescriptionOption::IfName("reveille".into()),
                InterfaceDescriptionOption::IfTsResol(TIMESTAMP_RESOLUTION_EXPONENT),
            ],
        })?;
        Ok(Self(writer))
    }

    /// Writes the packet of a frame.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&mut self, frame: &Frame) -> Result<(), PcapError> {
        let packet = packet_bytes(frame);
        self.0.write_pcapng_block(EnhancedPacketBlock {
            interface_id: 0,
            timestamp: Duration::from_nanos(log_time(frame.tti)),
            original_len: packet.len() as u32,
            data: packet.into(),
            options: Vec::new(),
        })?;
        Ok(())
    }

    /// Completes the file and returns its output.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn finish(self) -> Result<W, PcapError> {
        let mut out = self.0.into_inner();
        out.flush().map_err(PcapError::IoError)?;
        Ok(out)
    }
}

/// Returns the number of a kind in packets, which is the index of its Lua table in the dissector too.
pub fn kind_number(kind: MessageKind) -> u8 {
    let index = MessageKind::ALL.iter().position(|other| *other == kind);
    index.expect("all kinds are listed") as u8
}

fn packet_bytes(frame: &Frame) -> Vec<u8> {
    let text = FrameLine::new(frame).text();
    let text = &text.as_bytes()[..text.floor_char_boundary(MAX_TEXT_BYTES)];
    let mut packet = Vec::with_capacity(HEADER_BYTES + 2 + text.len() + frame.payload.len());
    packet.push(kind_number(frame.kind));
    packet.push(u8::from(frame.number.is_some()));
    packet.extend(frame.number.unwrap_or(0).to_le_bytes());
    packet.extend(frame.tti.0.to_le_bytes());
    packet.extend((text.len() as u16).to_le_bytes());
    packet.extend(text);
    packet.extend(&frame.payload);
    packet
}

#[cfg(test)]
mod tests {
    use pcap_file::pcapng::PcapNgReader;
    use reveille_common::ids::{DeviceId, Tti};
    use reveille_common::message::WakeUp;

    use super::*;
    use crate::recording::NANOS_PER_TTI;

    #[test]
    fn a_packet_has_a_header_the_payload_and_its_virtual_time() {
        // Nanoseconds of this TTI exceed 32 bits.
        const TTI: u64 = 5_000_000;
        let frame = Frame::new(Tti(TTI), DeviceId(7), &WakeUp { tti: Tti(TTI) });
        let mut writer = PacketWriter::begin(Vec::new()).expect("begun");
        writer.write(&frame).expect("written");
        let bytes = writer.finish().expect("finished");
        let mut reader = PcapNgReader::new(&bytes[..]).expect("a section");
        let interface = reader.next_block().expect("a block").expect("whole").into_owned();
        assert_eq!(
            interface
                .into_interface_description()
                .map(|interface| interface.linktype),
            Some(DataLink::USER0)
        );
        let packet = reader.next_block().expect("a block").expect("whole").into_owned();
        let packet = packet.into_enhanced_packet().expect("a packet");
        assert_eq!(packet.timestamp.as_nanos(), u128::from(TTI * NANOS_PER_TTI));
        assert_eq!(packet.data[..6], [kind_number(MessageKind::Wake), 1, 7, 0, 0, 0]);
        assert_eq!(packet.data[6..HEADER_BYTES], TTI.to_le_bytes());
        let text = FrameLine::new(&frame).text();
        let (length, after) = packet.data[HEADER_BYTES..].split_at(2);
        assert_eq!(length, (text.len() as u16).to_le_bytes());
        assert_eq!(after, [text.as_bytes(), &frame.payload].concat());
        assert!(reader.next_block().is_none());
    }
}
