//! What a run came to.

use reveille_common::score::{DeviceRecord, Digest, Metrics};
use reveille_common::totals::Totals;

use crate::policy::contract::Opaque;

/// The result of a run, whole or cut short.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// The run's fingerprint.
    pub digest: Digest,
    /// The metrics of its measured part.
    pub metrics: Metrics,
    /// The exact totals behind them.
    pub totals: Totals,
    /// Each device, in the order of ids.
    pub devices: Vec<DeviceRecord>,
    /// Figures of the deployment that the policy found out, by name.
    pub facts: Vec<(&'static str, f64)>,
    /// What the run has taught a policy that learns in it.
    pub learned: Option<Opaque>,
    /// TTIs that were run.
    pub ttis_done: u64,
    /// Whether that is all of them.
    pub complete: bool,
}
