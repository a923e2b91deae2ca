//! Wake-ups up to a target information: the best candidates in order, until Î ≥ I_min. The policies `knn` and
//! `adjusted` use it; their digests depend on the devices that it returns and on their order.

use reveille_common::ids::DeviceId;
use reveille_common::message::Report;

use super::candidates::WakeUpCandidates;
use super::posterior::EpicentreBelief;
use super::ranking::i_min;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// Wakes candidates until the information about the event reaches `I_min` (Sec. V-A, Algorithm 1).
#[derive(Clone, Debug)]
pub(crate) struct InformationTarget {
    i_min: f64,
    candidates: WakeUpCandidates,
}

impl InformationTarget {
    /// Creates the target for the devices in `known`, with the `I_min` of their deployment and the ranking of its
    /// settings.
    pub(crate) fn new(known: &Knowledge) -> Self {
        Self {
            i_min: i_min(&known.positions(), known.area, &known.sensing),
            candidates: WakeUpCandidates::new(known),
        }
    }

    /// Target information, `[0, Ψ]`.
    pub(crate) const fn i_min(&self) -> f64 {
        self.i_min
    }

    /// Begins an event with its first reports. Returns whether more information is wanted.
    pub(crate) fn start_event(&mut self, seen: &Observation<'_>, reports: &[Report]) -> bool {
        let wants_more = !self.is_reached(seen);
        if wants_more {
            self.candidates.start_event(seen, reports);
        } else {
            // The belief of the previous event must not remain visible for this one.
            self.candidates.clear();
        }
        wants_more
    }

    /// The belief over the epicentre, if the ranking uses one and candidates were needed.
    pub(crate) const fn belief(&self) -> Option<&EpicentreBelief> {
        self.candidates.belief()
    }

    /// Adds the answer to the last wake-up; `seen` already includes its information.
    pub(crate) fn add_wake_up_answer(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        if let Some(report) = report.filter(|_| !self.is_reached(seen)) {
            self.candidates.add_report(seen, report);
        }
    }

    /// Returns the next device to wake for which `may_wake` holds, or `None` if the target is reached or no candidate
    /// is left.
    pub(crate) fn next_device(
        &mut self,
        seen: &Observation<'_>,
        may_wake: impl Fn(DeviceId) -> bool,
    ) -> Option<DeviceId> {
        if self.is_reached(seen) {
            return None;
        }
        self.candidates.next_candidate(seen, may_wake).map(|(device, _)| device)
    }

    fn is_reached(&self, seen: &Observation<'_>) -> bool {
        seen.information >= self.i_min
    }
}
