//! Files of a run for other programs. `deploy/src/commands/inspect/export.rs` writes them. A new format is a module
//! here, a value of `ExportFormatArg` (`inspect export --to`), a row in docs/inspecting.md and a check in
//! `tests/recordings/check.py`.
//!
//! - [`pcapng`]: packets for Wireshark, which [`dissector`] teaches to read them.
//! - [`perfetto`]: a trace of states, batteries and wake-ups, encoded by `protobuf`.
//! - [`table`]: one row per message, as CSV or Parquet.
//! - [`device_rows`]: states, batteries and energies of all devices over time, as CSV.

pub mod device_rows;
pub mod dissector;
pub mod pcapng;
pub mod perfetto;
mod protobuf;
pub mod table;
