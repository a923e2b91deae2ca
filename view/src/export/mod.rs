//! Export of runs to the file formats of other tools.

pub mod dissector;
pub mod pcapng;
pub mod perfetto;
mod protobuf;
pub mod table;
