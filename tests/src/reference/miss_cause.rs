//! The cause of a missed event in the reference, from what its devices met. `docs/results.md` defines the causes;
//! removed devices do not occur here.

use reveille_common::totals::MissCause;

/// Returns the cause of a missed event. `obstacles` tells whether a device in range had δ = 1 without the energy to
/// sense, did not receive a wake-up, could not pay for a report, or sent a report that was lost. `detects` has an entry
/// for each device within d_max: whether it would detect the event.
pub(super) fn miss_cause(obstacles: [bool; 4], detects: &[bool]) -> MissCause {
    let causes = [
        MissCause::Unpowered,
        MissCause::WakeMissed,
        MissCause::NoEnergy,
        MissCause::Lost,
    ];
    match obstacles.iter().rposition(|is_met| *is_met) {
        Some(furthest) => causes[furthest],
        None if detects.is_empty() => MissCause::OutOfReach,
        None if detects.contains(&true) => MissCause::Asleep,
        None => MissCause::Undetected,
    }
}
