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
        // A replay has no frames of the emulation plane and no states, but a resumed base station sends states again.
        if frame.kind.plane() == Plane::Emu {
            return Some(frame);
        }
        if frame.kind == MessageKind::States {
            let is_new = self.seen >= self.passed && frame.tti >= self.states_end;
            self.states_end = self.states_end.max(frame.tti + 1);
            return is_new.then_some(frame);
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
