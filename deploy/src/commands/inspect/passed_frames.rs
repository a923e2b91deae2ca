//! The frames of a run that an observer has passed on. The scenario, the seed and the external inputs determine the
//! frames of a run, so the frames of a replay repeat them in the same order, and each is passed on once.

use reveille_common::ids::Tti;
use reveille_common::message::{Frame, Message, MessageKind, Plane, WorldUpdate};

/// Counts the frames that were passed on.
#[derive(Default)]
pub(super) struct PassedFrames {
    /// Number of frames passed on that a replay repeats. World frames and states do not count.
    passed: u64,
    /// Number of such frames received since the last restart.
    seen: u64,
    /// The TTI before which all states were passed on.
    states_end: Tti,
    /// The TTI before which all world frames were passed on.
    world_end: Tti,
    /// Whether `seen` is too low, because frames were lost since the last restart.
    has_gap: bool,
    /// The last TTI of the frames that count in `passed`.
    last_tti: Tti,
    /// Set after a gap: frames up to this TTI are not passed on, since the count does not show which ones were. The
    /// first frame of a later TTI clears it.
    skipped_until: Option<Tti>,
}

impl PassedFrames {
    /// The frames come from TTI 0 on again.
    pub(super) const fn restart(&mut self) {
        if self.has_gap && self.passed > 0 {
            self.skipped_until = Some(self.last_tti);
        }
        (self.seen, self.has_gap) = (0, false);
    }

    /// Notes that frames were lost, so that the count is too low. After the next restart the rest of the last passed
    /// TTI is skipped; if frames are being repeated now, it is skipped before the restart too.
    pub(super) const fn note_gap(&mut self) {
        self.has_gap = true;
        if self.seen < self.passed {
            self.skipped_until = Some(self.last_tti);
        }
    }

    /// Returns `frame` if it was not passed on before.
    pub(super) fn filter_new(&mut self, frame: Frame) -> Option<Frame> {
        if frame.kind == MessageKind::World {
            return self.filter_new_ttis(frame);
        }
        // A replay has no frames of the emulation plane and no states, but a resumed base station sends states again.
        if frame.kind.plane() == Plane::Emu {
            return Some(frame);
        }
        if frame.kind == MessageKind::States {
            let is_new = self.skipped_until.is_none() && self.seen >= self.passed && frame.tti >= self.states_end;
            self.states_end = self.states_end.max(frame.tti + 1);
            return is_new.then_some(frame);
        }
        if self.skipped_until.is_some_and(|last| frame.tti > last) {
            (self.skipped_until, self.passed) = (None, self.seen);
        }
        self.seen += 1;
        if self.skipped_until.is_some() || self.seen <= self.passed {
            return None;
        }
        (self.passed, self.last_tti) = (self.seen, self.last_tti.max(frame.tti));
        Some(frame)
    }

    /// Returns a world frame with its new TTIs. Grants divide the TTIs differently in a replay.
    fn filter_new_ttis(&mut self, frame: Frame) -> Option<Frame> {
        let Ok(Message::World(world)) = frame.message() else {
            return Some(frame);
        };
        if world.last < self.world_end {
            return None;
        }
        let first = world.first.max(self.world_end);
        self.world_end = world.last + 1;
        if first == world.first {
            return Some(frame);
        }
        Some(Frame::new(first, (), &WorldUpdate { first, ..world }))
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use reveille_common::ids::DeviceId;
    use reveille_common::message::WakeUp;

    use super::*;

    /// Receives frames of a run with two frames in each TTI. Returns the positions of the new ones.
    fn receive(passed: &mut PassedFrames, positions: Range<u64>) -> Vec<u64> {
        let frame = |position: u64| {
            let tti = Tti(position / 2);
            Frame::new(tti, DeviceId(position as u32), &WakeUp { tti })
        };
        positions
            .filter(|position| passed.filter_new(frame(*position)).is_some())
            .collect()
    }

    #[test]
    fn no_frame_is_repeated_after_a_gap_during_a_skip() {
        let mut passed = PassedFrames::default();
        assert_eq!(receive(&mut passed, 0..11), (0..11).collect::<Vec<_>>());
        passed.note_gap();
        assert_eq!(receive(&mut passed, 14..17), [14, 15, 16]);
        // The base station returns at an earlier TTI: the rest of TTI 8 is skipped.
        passed.restart();
        assert!(receive(&mut passed, 0..14).is_empty());
        passed.note_gap();
        assert_eq!(receive(&mut passed, 17..21), [18, 19, 20]);
        passed.restart();
        assert_eq!(receive(&mut passed, 0..30), (22..30).collect::<Vec<_>>());
    }

    #[test]
    fn later_ttis_are_complete_after_a_gap_in_repeated_frames() {
        let mut passed = PassedFrames::default();
        assert_eq!(receive(&mut passed, 0..11), (0..11).collect::<Vec<_>>());
        passed.restart();
        assert!(receive(&mut passed, 0..4).is_empty());
        passed.note_gap();
        assert_eq!(receive(&mut passed, 8..16), (12..16).collect::<Vec<_>>());
        passed.restart();
        assert_eq!(receive(&mut passed, 0..30), (16..30).collect::<Vec<_>>());
    }
}
