//! One battery-less IoT device (IoTD): its energy ledger and its state machine, both without I/O. A tokio host runs
//! many devices in one process.

pub mod battery;
pub mod grant_follower;
#[cfg(feature = "host")]
pub mod host;
pub mod ledger;
pub mod machine;
