//! One battery-less IoT device (IoTD): its energy ledger and its state machine, both without I/O, and the tokio shell
//! that carries many of them in one process.

pub mod battery;
pub mod books;
mod ears;
pub mod follower;
#[cfg(feature = "host")]
pub mod host;
pub mod machine;
