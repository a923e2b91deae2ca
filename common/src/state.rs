//! The states of a device (Sec. II), as messages and device checkpoints hold them: a change of the variants, the fields
//! or their order raises `WIRE_VERSION`. The state machine is `device/src/machine/`.

use serde::{Deserialize, Serialize};

use crate::units::Energy;

/// The state S^(j) of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum DeviceState {
    /// S1, "idle": sensing, waits for an event.
    Idle,
    /// S2, "active": has sensed an event or was woken, and is about to transmit. Left within the same TTI.
    Active,
    /// S3, "transmission": has sent its report in this TTI.
    Transmission,
    /// S4, "sleep": only the wake-up radio is on, if it has power.
    Sleep {
        /// Whether the wake-up radio has power and can receive.
        powered: bool,
    },
    /// An operator has let the device fail: its electronics are off, and its battery only charges.
    Failed,
}

/// The state and the battery of a device at the end of a TTI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceView {
    /// The state of the device.
    pub state: DeviceState,
    /// The energy in its battery.
    pub battery: Energy,
}
