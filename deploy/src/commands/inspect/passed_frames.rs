//! The frames of a run that an observer has passed on. The scenario, the seed and the external inputs determine the
//! frames of a run, so the frames of a replay repeat them in the same order, and each is passed on once.

use reveille_common::ids::Tti;
use reveille_common::message::{Frame, Message, MessageKind, Plane, WorldUpdate};

/// Counts the frames that were passed on.
#[derive(Default)]
pub(super) struct PassedFrames {
    /// Frames passed on so far that a replay repeats, without [`MessageKind::World`].
    passed: u64,
    /// Frames of that kind since the last restart.
    seen: u64,
    /// The TTI before which all world frames were passed on.
    world_end: Tti,
}

impl PassedFrames {
    /// The frames come from TTI 0 on again.
    pub(super) const fn restart(&mut self) {
        self.seen = 0;
    }

    /// Returns `frame` if it was not passed on before.
    pub(super) fn filter_new(&mut self, frame: Frame) -> Option<Frame> {
        if frame.kind == MessageKind::World {
            return self.filter_new_ttis(frame);
        }
        // A replay has no frames of these kinds.
        if frame.kind.plane() == Plane::Emu || frame.kind == MessageKind::States {
            return Some(frame);
        }
        self.seen += 1;
        if self.seen <= self.passed {
            return None;
        }
        self.passed = self.seen;
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
