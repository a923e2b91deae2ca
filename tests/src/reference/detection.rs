//! Detection in the reference, and the cause of a missed event. `docs/results.md` defines the causes. Devices can fail
//! here, but their processes are never lost.
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

/// Returns the cause of a missed event. `obstacles` tells whether a device in range had δ = 1 without the energy to
/// sense, did not receive a wake-up, could not pay for a report, or sent a report that was lost. `would_detect` has an
/// entry for each device within d_max that had not failed throughout: whether it would detect the event.
/// `is_out_of_reach` tells that no device is within d_max.
pub(super) fn miss_cause(obstacles: [bool; 4], would_detect: &[bool], is_out_of_reach: bool) -> MissCause {
    // In the order of `obstacles`: the last obstacle met is closest to a report.
    let causes = [
        MissCause::Unpowered,
        MissCause::WakeMissed,
        MissCause::NoEnergy,
        MissCause::Lost,
    ];
    match obstacles.iter().rposition(|is_met| *is_met) {
        Some(furthest) => causes[furthest],
        None if is_out_of_reach => MissCause::OutOfReach,
        None if would_detect.is_empty() => MissCause::Removed,
        None if would_detect.contains(&true) => MissCause::Asleep,
        None => MissCause::Undetected,
    }
}
