//! Detection in the reference, and the cause of a missed event, for `world.rs`. `docs/results.md` defines the causes.
//! Devices can fail here, but their processes are never lost.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_bs::scenario::Scenario;
use reveille_common::rng::{Purpose, unit_for_pair};
use reveille_common::sensing::DetectionKind;
use reveille_common::totals::MissCause;

/// Whether device `j` at a distance of `d` metres detects event number `event` if it senses.
pub(super) fn detects(scenario: &Scenario, event: u64, j: usize, d: f64) -> bool {
    let sensing = &scenario.sensing;
    let probability = match sensing.kind {
        DetectionKind::Range => 1.0,
        DetectionKind::Probabilistic => libm::exp(-sensing.eta * d),
    };
    d <= sensing.d_max && unit_for_pair(scenario.run.seed, Purpose::Detection, event, j as u64) < probability
}

/// Obstacle to a report of an event that a device in range met, in the order in which a report meets them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Obstacle {
    /// A device with δ = 1 would have detected the event, but an operator had failed it.
    FailedDevice,
    /// A device with δ = 1 would have detected the event, but lacked the energy to sense.
    NoPowerToSense,
    /// A device did not receive a wake-up.
    MissedWakeUp,
    /// A device could not pay for a report.
    UnpaidReport,
    /// A report was lost.
    LostReport,
}

/// Returns the cause of a missed event. `furthest_obstacle` is the last obstacle met, the closest to a report.
/// `would_detect` has an entry for each device within d_max that had not failed throughout: whether it would detect the
/// event. `is_out_of_reach` tells that no device is within d_max.
pub(super) fn miss_cause(
    furthest_obstacle: Option<Obstacle>,
    would_detect: &[bool],
    is_out_of_reach: bool,
) -> MissCause {
    match furthest_obstacle {
        Some(Obstacle::LostReport) => MissCause::Lost,
        Some(Obstacle::UnpaidReport) => MissCause::NoEnergy,
        Some(Obstacle::MissedWakeUp) => MissCause::WakeMissed,
        Some(Obstacle::NoPowerToSense) => MissCause::Unpowered,
        Some(Obstacle::FailedDevice) => MissCause::Failed,
        None if is_out_of_reach => MissCause::OutOfReach,
        None if would_detect.is_empty() => MissCause::Removed,
        None if would_detect.contains(&true) => MissCause::Asleep,
        None => MissCause::Undetected,
    }
}
