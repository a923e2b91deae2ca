//! Comparison of two runs: the first difference in each kind of message. `reveille compare` and the dashboard use it.
//!
//! Only decisions and outcomes are compared: actions of operators, removals, δ plans, events, reports that arrive, are
//! lost or fail, wake-ups and their outcomes. Grants and answers are ignored, so a run with lookahead equals the same
//! run without it. A new kind of message is compared only if it is in `COMPARED`.

use std::collections::{BTreeMap, VecDeque};
use std::io::{Read, Seek};

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Frame, Message, MessageKind};
use reveille_common::plan::Plan;

use crate::frame_line::{FrameLine, key_owner};
use crate::recording::{RecordingError, RecordingReader};

/// The kinds that are compared, in the order of their occurrence in a TTI. The differences of a TTI have this order.
const COMPARED: [MessageKind; 9] = [
    MessageKind::Action,
    MessageKind::Plan,
    MessageKind::Event,
    MessageKind::Removed,
    MessageKind::Report,
    MessageKind::Lost,
    MessageKind::Failed,
    MessageKind::Wake,
    MessageKind::Woken,
];

/// One of the two runs. As a number it is an index of `RunComparison::reached`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunSide {
    /// The run under examination.
    This,
    /// The run that it is compared with.
    Other,
}

impl RunSide {
    const fn opposite(self) -> Self {
        match self {
            Self::This => Self::Other,
            Self::Other => Self::This,
        }
    }
}

/// First difference between two runs in messages of one kind.
#[derive(Clone, Debug, PartialEq)]
pub struct FirstDifference {
    /// TTI of the difference.
    pub tti: Tti,
    /// Kind of message.
    pub kind: MessageKind,
    /// Message of this run at that place, if any.
    pub this: Option<Frame>,
    /// Message of the other run at that place, if any.
    pub other: Option<Frame>,
}

impl FirstDifference {
    /// Describes the message of the run on `side`. If both messages read alike, the description lists all fields as
    /// JSON.
    pub fn describe(&self, side: RunSide) -> String {
        let (described, opposite) = match side {
            RunSide::This => (&self.this, &self.other),
            RunSide::Other => (&self.other, &self.this),
        };
        match (described, opposite) {
            (None, _) => "nothing".to_owned(),
            (Some(described), Some(opposite)) if describe_frame(described) == describe_frame(opposite) => {
                FrameLine::new(described).to_json()
            }
            (Some(described), _) => describe_frame(described),
        }
    }

    /// Devices with different duty cycles in the two plans; empty if the difference is not between plans.
    pub fn devices(&self) -> Vec<DeviceId> {
        let plan = |frame: &Option<Frame>| match frame.as_ref()?.message() {
            Ok(Message::Plan(update)) => Some(update.plan),
            Ok(_) | Err(_) => None,
        };
        let (Some(this), Some(other)) = (plan(&self.this), plan(&self.other)) else {
            return Vec::new();
        };
        let ids = (0..covered_devices(&this).max(covered_devices(&other)) as u32).map(DeviceId);
        ids.filter(|device| this.duty_cycle(*device) != other.duty_cycle(*device))
            .collect()
    }
}

fn describe_frame(frame: &Frame) -> String {
    let (address, text) = (key_owner(frame.kind, frame.number), FrameLine::new(frame).text());
    if address.is_empty() {
        text
    } else {
        format!("{address}: {text}")
    }
}

/// Number of devices that a plan covers, rounded up to a multiple of eight for a bit map.
fn covered_devices(plan: &Plan) -> usize {
    match plan {
        Plan::Bits { bits } => bits.len() * 8,
        Plan::Periodic(cycles) => cycles.len(),
    }
}

/// Comparison of the messages of one kind.
#[derive(Debug, Default)]
struct KindComparison {
    /// Messages of the run that is ahead, which wait for their counterparts from the other run.
    waiting: VecDeque<Frame>,
    /// Run of the waiting messages; kept when none waits any more.
    ahead: Option<RunSide>,
    first_difference: Option<FirstDifference>,
}

/// Comparison of two runs whose frames arrive interleaved.
#[derive(Debug, Default)]
pub struct RunComparison {
    kinds: BTreeMap<MessageKind, KindComparison>,
    /// The TTI that each run has reached, by [`RunSide`].
    reached: [Tti; 2],
}

impl RunComparison {
    /// Adds a frame of the run on `side`. The frames of each side must come in order of TTI, none after [`Self::end`].
    pub fn push(&mut self, side: RunSide, frame: &Frame) {
        // First, so that older messages of the other run without a counterpart are found before this one is matched.
        self.advance(side, frame.tti);
        if !COMPARED.contains(&frame.kind) {
            return;
        }
        let other_has_passed = self.reached[side.opposite() as usize] > frame.tti;
        let comparison = self.kinds.entry(frame.kind).or_default();
        // After a first difference, later messages of the kind have no certain counterparts.
        if comparison.first_difference.is_some() {
            return;
        }
        if comparison.ahead == Some(side.opposite())
            && let Some(counterpart) = comparison.waiting.pop_front()
        {
            if counterpart != *frame {
                comparison.record_difference(Some((side, frame.clone())), Some((side.opposite(), counterpart)));
            }
        } else if other_has_passed {
            // The other run is past this TTI without such a message.
            comparison.record_difference(Some((side, frame.clone())), None);
        } else {
            comparison.ahead = Some(side);
            comparison.waiting.push_back(frame.clone());
        }
    }

    /// Marks the run on `side` as ended.
    pub fn end(&mut self, side: RunSide) {
        self.advance(side, Tti::NEVER);
    }

    /// End of the compared TTIs, exclusive.
    pub fn compared_until(&self) -> Tti {
        self.reached[0].min(self.reached[1])
    }

    /// First difference of each kind that has one, ordered by TTI and then by kind.
    pub fn differences(&self) -> Vec<&FirstDifference> {
        let found = self.kinds.values().filter_map(|kind| kind.first_difference.as_ref());
        let mut all: Vec<&FirstDifference> = found.collect();
        let order = |difference: &FirstDifference| COMPARED.iter().position(|kind| *kind == difference.kind);
        all.sort_by_key(|difference| (difference.tti, order(difference)));
        all
    }

    /// Advances the run on `side` to `tti`. Earlier messages of the other run then have no counterpart.
    fn advance(&mut self, side: RunSide, tti: Tti) {
        self.reached[side as usize] = tti;
        for kind in self.kinds.values_mut() {
            if kind.first_difference.is_none() && kind.ahead == Some(side.opposite()) {
                // One frame is enough: `record_difference` clears the queue.
                let unmatched = kind.waiting.pop_front_if(|frame| frame.tti < tti);
                if let Some(frame) = unmatched {
                    kind.record_difference(Some((side.opposite(), frame)), None);
                }
            }
        }
    }
}

impl KindComparison {
    /// Records the first difference. If the TTIs differ, only the earlier message is kept, without a counterpart. Does
    /// nothing without any message.
    fn record_difference(&mut self, message: Option<(RunSide, Frame)>, counterpart: Option<(RunSide, Frame)>) {
        let Some(tti) = message.iter().chain(&counterpart).map(|(_, frame)| frame.tti).min() else {
            return;
        };
        let kind = message.iter().chain(&counterpart).map(|(_, frame)| frame.kind).next();
        let (mut this, mut other) = (None, None);
        for (side, frame) in message
            .into_iter()
            .chain(counterpart)
            .filter(|(_, frame)| frame.tti == tti)
        {
            match side {
                RunSide::This => this = Some(frame),
                RunSide::Other => other = Some(frame),
            }
        }
        self.first_difference = kind.map(|kind| FirstDifference { tti, kind, this, other });
        self.waiting = VecDeque::new();
    }
}

/// Compares two recordings from their current positions. A torn recording is compared up to the tear; the error is
/// returned with its side.
pub fn compare_recordings<R: Read + Seek>(
    this: &mut RecordingReader<R>,
    other: &mut RecordingReader<R>,
) -> (RunComparison, Option<(RunSide, RecordingError)>) {
    let mut comparison = RunComparison::default();
    while comparison.compared_until() < Tti::NEVER {
        // The run that is behind is read next, so that few messages wait for their counterparts.
        let [this_reached, other_reached] = comparison.reached;
        let (side, reader) = if this_reached <= other_reached {
            (RunSide::This, &mut *this)
        } else {
            (RunSide::Other, &mut *other)
        };
        match reader.next_frame() {
            Ok(Some(frame)) => comparison.push(side, &frame),
            Ok(None) => comparison.end(side),
            Err(error) => return (comparison, Some((side, error))),
        }
    }
    (comparison, None)
}

#[cfg(test)]
mod tests {
    use reveille_bs::observer::frames::FrameObserver;
    use reveille_bs::scenario::{Override, load};
    use reveille_lab::preparation::prepare;
    use reveille_lab::run::{Run, RunOptions};

    use super::*;

    /// Length of the runs; a case below has one TTI less.
    const TTIS: u64 = 300;

    /// Returns the frames of a run of 30 devices and [`TTIS`] TTIs with `fields` of the form `field=value`.
    fn frames(fields: &[&str], lookahead: bool) -> Vec<Frame> {
        let ttis = format!("ttis={TTIS}");
        let all_fields = ["devices=30", &ttis, "policy.name=age-index"];
        let all_fields = all_fields.iter().chain(fields);
        let overrides: Vec<Override> = all_fields
            .map(|field| Override::parse(field).expect("an override"))
            .collect();
        let scenario = load("paper", &overrides).expect("a scenario").scenario;
        let mut frames = Vec::new();
        let options = RunOptions {
            lookahead,
            ..RunOptions::default()
        };
        Run::new(&prepare(&scenario), options).finish(&mut FrameObserver::new(0, |frame| frames.push(frame)));
        frames
    }

    /// Compares all frames of both runs, feeding `stride` frames of each side at a time.
    fn compare_all(this: &[Frame], other: &[Frame], stride: usize) -> RunComparison {
        let mut comparison = RunComparison::default();
        for start in (0..this.len().max(other.len())).step_by(stride) {
            for (side, frames) in [(RunSide::This, this), (RunSide::Other, other)] {
                for frame in frames.iter().skip(start).take(stride) {
                    comparison.push(side, frame);
                }
            }
        }
        comparison.end(RunSide::This);
        comparison.end(RunSide::Other);
        comparison
    }

    /// Finds the first TTI and kind that differ by searching all frames of each TTI.
    fn brute_force(this: &[Frame], other: &[Frame]) -> Option<(Tti, MessageKind)> {
        (0..TTIS).map(Tti).find_map(|tti| {
            let of_kind = |frames: &[Frame], kind| -> Vec<Frame> {
                let selected = frames.iter().filter(|frame| frame.tti == tti && frame.kind == kind);
                selected.cloned().collect()
            };
            let kind = COMPARED
                .into_iter()
                .find(|kind| of_kind(this, *kind) != of_kind(other, *kind));
            kind.map(|kind| (tti, kind))
        })
    }

    #[test]
    fn the_first_difference_equals_a_brute_force_search() {
        let this = frames(&[], true);
        for fields in [
            &["seed=2"][..],
            &["policy.age-index.price=0.5"],
            &["events.duration=3"],
            &["ttis=299"],
            &["policy.name=random"],
        ] {
            let other = frames(fields, true);
            let expected = brute_force(&this, &other).expect("a difference");
            for stride in [1, 7, 1_000_000] {
                let comparison = compare_all(&this, &other, stride);
                // The result must not depend on which run is `this`.
                let mirrored = compare_all(&other, &this, stride);
                let positions = |comparison: &RunComparison| -> Vec<(Tti, MessageKind)> {
                    let differences = comparison.differences().into_iter();
                    differences
                        .map(|difference| (difference.tti, difference.kind))
                        .collect()
                };
                assert_eq!(
                    positions(&comparison),
                    positions(&mirrored),
                    "{fields:?}, stride {stride}"
                );
                let differences = comparison.differences();
                let first = differences.first().expect("a difference");
                assert_eq!((first.tti, first.kind), expected, "{fields:?}, stride {stride}");
                assert_ne!(first.this, first.other, "{fields:?}");
                assert_eq!(comparison.compared_until(), Tti::NEVER);
            }
        }
    }

    #[test]
    fn lookahead_makes_no_difference() {
        let fields = ["policy.name=knn"];
        let (this, other) = (frames(&fields, true), frames(&fields, false));
        assert_ne!(this.len(), other.len(), "lookahead changes the grants");
        assert!(compare_all(&this, &other, 5).differences().is_empty());
    }

    #[test]
    fn a_missing_message_is_the_only_difference() {
        let this = frames(&[], true);
        for kind in COMPARED {
            let Some(index) = this.iter().rposition(|frame| frame.kind == kind) else {
                let may_miss = [
                    MessageKind::Action,
                    MessageKind::Lost,
                    MessageKind::Failed,
                    MessageKind::Removed,
                ];
                assert!(may_miss.contains(&kind), "the run has no {kind:?}");
                continue;
            };
            let mut other = this.clone();
            other.remove(index);
            let comparison = compare_all(&this, &other, 3);
            let [difference] = comparison.differences()[..] else {
                panic!("{kind:?}: {:?}", comparison.differences());
            };
            assert_eq!((difference.tti, difference.kind), (this[index].tti, kind));
            assert_eq!(
                (difference.this.as_ref(), difference.describe(RunSide::Other)),
                (Some(&this[index]), "nothing".to_owned())
            );
        }
    }

    #[test]
    fn a_difference_of_plans_lists_the_devices() {
        let (this, other) = (frames(&[], true), frames(&["policy.age-index.price=0.5"], true));
        let comparison = compare_all(&this, &other, 1);
        let first = comparison.differences()[0];
        assert_eq!(first.kind, MessageKind::Plan);
        let plan_of = |frame: &Option<Frame>| match frame.as_ref().expect("a plan").message() {
            Ok(Message::Plan(update)) => update.plan,
            _ => panic!("not a plan"),
        };
        let (this, other) = (plan_of(&first.this), plan_of(&first.other));
        let differs =
            |j: &u32| this.duty_cycle(DeviceId(*j)).is_on(first.tti) != other.duty_cycle(DeviceId(*j)).is_on(first.tti);
        assert_eq!(
            first.devices(),
            (0..30).filter(differs).map(DeviceId).collect::<Vec<_>>()
        );
    }
}
