//! Files that other tools open.

pub mod dissector;
pub mod pcapng;
pub mod perfetto;
mod protobuf;
pub mod table;
