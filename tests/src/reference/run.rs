//! The result of a run of the reference, which tests compare with a run of the emulator.

use reveille_common::event::EventRecord;
use reveille_common::score::EventActivity;
use reveille_common::totals::{DeviceTotals, EventTotals, Ledger, RadioLosses};

use super::device::ReferenceState;

/// Result of a run of the reference.
#[derive(Clone, Debug)]
pub struct ReferenceRun {
    /// Ended events, in order.
    pub events: Vec<EventRecord>,
    /// Ledgers by device.
    pub ledgers: Vec<Ledger>,
    /// Activity of each device over the counted events.
    pub activity: Vec<EventActivity>,
    /// Sum of the ledgers over the measured part.
    pub measured: DeviceTotals,
    /// Sums over the counted events.
    pub totals: EventTotals,
    /// Mean probability, over the measured part, that an event starts in a TTI without an active event. NaN without a
    /// measured TTI.
    pub start_probability: f64,
    /// Wake-ups sent in measured TTIs, for any event.
    pub wake_ups: u64,
    /// Radio losses in measured TTIs.
    pub losses: RadioLosses,
    /// TTIs from the first report to the last, summed over the counted events.
    pub wake_up_span_ttis: u64,
    /// Reports that arrived in measured TTIs.
    pub arrived_reports: u64,
    /// Wake-ups that a device did not receive, in all TTIs; `losses` counts the measured ones.
    pub missed_wake_ups: u64,
    /// TTIs with wake-up decisions that excluded a device in S4, estimated as unable to report.
    pub exclusions: u64,
    /// State and battery of each device at the end of each TTI.
    pub trace: Vec<Vec<(ReferenceState, u64)>>,
    /// TTI in which a decision was too close to call: rounding could change it. Results from there on are undefined.
    pub ambiguous: Option<u64>,
}
