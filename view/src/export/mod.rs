//! Files of a run for other programs. A new format is a module here and a value of `inspect export --to`.
//!
//! - [`pcapng`]: packets for Wireshark, which [`dissector`] teaches to read them.
//! - [`perfetto`]: a trace of states, batteries and wake-ups, encoded by `protobuf`.
//! - [`table`]: one row per message, as CSV or Parquet.

pub mod dissector;
pub mod pcapng;
pub mod perfetto;
mod protobuf;
pub mod table;
