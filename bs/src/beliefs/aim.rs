//! Waking up to a given information: the best candidates, one after the other, until Î ≥ I_min.

use reveille_common::ids::DeviceId;
use reveille_common::message::Report;

use crate::beliefs::candidates::Candidates;
use crate::beliefs::posterior::Belief;
use crate::beliefs::ranking::i_min;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// Wakes up candidates until the information about the event reaches `I_min` (Sec. V-A, Algorithm 1).
#[derive(Clone, Debug)]
pub struct Aim {
    i_min: f64,
    candidates: Candidates,
}

impl Aim {
    /// For the devices in `known`, with the `I_min` of their deployment and the ranking of its settings.
    pub fn new(known: &Knowledge) -> Self {
        Self {
            i_min: i_min(&known.positions(), known.area, &known.sensing),
            candidates: Candidates::new(known),
        }
    }

    /// The information aimed for, `[0, Ψ]`.
    pub const fn i_min(&self) -> f64 {
        self.i_min
    }

    /// Begins an event with its first reports. Whether more are wanted.
    pub fn start(&mut self, seen: &Observation<'_>, reports: &[Report]) -> bool {
        let wants_more = !self.is_reached(seen);
        if wants_more {
            self.candidates.start(seen, reports);
        } else {
            self.candidates.clear();
        }
        wants_more
    }

    /// Where the event is believed to be, where candidates are ranked by that and were asked for.
    pub const fn belief(&self) -> Option<&Belief> {
        self.candidates.belief()
    }

    /// Takes in the answer of a device that was woken.
    pub fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        if let Some(report) = report.filter(|_| !self.is_reached(seen)) {
            self.candidates.add(seen, report);
        }
    }

    /// The next device to wake among those for which `may_wake` holds, or none: enough is known, or nobody is left.
    pub fn next(&mut self, seen: &Observation<'_>, may_wake: impl Fn(DeviceId) -> bool) -> Option<DeviceId> {
        if self.is_reached(seen) {
            return None;
        }
        self.candidates.next(seen, may_wake).map(|(device, _)| device)
    }

    fn is_reached(&self, seen: &Observation<'_>) -> bool {
        seen.information >= self.i_min
    }
}
