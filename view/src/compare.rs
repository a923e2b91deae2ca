//! Two runs beside each other: where they first differ.
//!
//! What happens is compared, kind by kind: events, δ, reports, failures, wake-ups and what came of them. How it got
//! there is not: a run with lookahead has other grants and answers, and is the same run.

use std::collections::{BTreeMap, VecDeque};
use std::io::{Read, Seek};

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Frame, Message, MessageKind};
use reveille_common::plan::Plan;
use toml::{Table, Value};

use crate::line::{Line, whose};
use crate::recording::{Reader, RecordingError};

/// The kinds that are compared, in the order in which they come about in a TTI.
pub const COMPARED: [MessageKind; 8] = [
    MessageKind::Plan,
    MessageKind::Event,
    MessageKind::Gone,
    MessageKind::Report,
    MessageKind::Lost,
    MessageKind::Failed,
    MessageKind::Wake,
    MessageKind::Woken,
];

/// One of the two runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The one that is looked at.
    This,
    /// The one that it is compared with.
    Other,
}

impl Side {
    const fn opposite(self) -> Self {
        match self {
            Self::This => Self::Other,
            Self::Other => Self::This,
        }
    }
}

/// Where two runs first differ in messages of a kind.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// The TTI.
    pub tti: Tti,
    /// The kind.
    pub kind: MessageKind,
    /// The message of this run, where it has one there.
    pub this: Option<Frame>,
    /// The message of the other run, where it has one there.
    pub other: Option<Frame>,
}

impl Difference {
    /// What the run on `side` says there, in words; in all of its fields where both runs say the same in words.
    pub fn says(&self, side: Side) -> String {
        let (own, others) = match side {
            Side::This => (&self.this, &self.other),
            Side::Other => (&self.other, &self.this),
        };
        match (own, others) {
            (None, _) => "nothing".to_owned(),
            (Some(own), Some(others)) if words(own) == words(others) => Line::of(own).to_json(),
            (Some(own), _) => words(own),
        }
    }

    /// The devices that one plan lets sense where the other does not, where the difference is one of plans.
    pub fn devices(&self) -> Vec<DeviceId> {
        let plan = |frame: &Option<Frame>| match frame.as_ref()?.message() {
            Ok(Message::Plan(update)) => Some(update.plan),
            Ok(_) | Err(_) => None,
        };
        let (Some(this), Some(other)) = (plan(&self.this), plan(&self.other)) else {
            return Vec::new();
        };
        let ids = (0..reach(&this).max(reach(&other)) as u32).map(DeviceId);
        ids.filter(|device| this.duty_cycle(*device) != other.duty_cycle(*device))
            .collect()
    }
}

fn words(frame: &Frame) -> String {
    let (whose, says) = (whose(frame.kind, frame.number), Line::of(frame).says());
    if whose.is_empty() {
        says
    } else {
        format!("{whose}: {says}")
    }
}

/// The devices that a plan can say something of, or up to seven more.
fn reach(plan: &Plan) -> usize {
    match plan {
        Plan::Bits { bits } => bits.len() * 8,
        Plan::Periodic(cycles) => cycles.len(),
    }
}

/// Messages of one kind.
#[derive(Debug, Default)]
struct Kind {
    /// Those of the run on the side beside that are not compared yet: the other run has not come as far.
    waiting: VecDeque<Frame>,
    ahead: Option<Side>,
    first: Option<Difference>,
}

/// Two runs of which the frames come in one after the other, from either side.
#[derive(Debug, Default)]
pub struct Comparison {
    kinds: BTreeMap<MessageKind, Kind>,
    /// The TTI that each run has come to.
    reached: [Tti; 2],
}

impl Comparison {
    /// Takes in a frame of the run on `side`.
    pub fn take(&mut self, side: Side, frame: &Frame) {
        self.reach(side, frame.tti);
        if !COMPARED.contains(&frame.kind) {
            return;
        }
        let has_passed = self.reached[side.opposite() as usize] > frame.tti;
        let kind = self.kinds.entry(frame.kind).or_default();
        if kind.first.is_some() {
            return;
        }
        if kind.ahead == Some(side.opposite())
            && let Some(before) = kind.waiting.pop_front()
        {
            if before != *frame {
                kind.differ(Some((side.opposite(), before)), Some((side, frame.clone())));
            }
        } else if has_passed {
            // The other run has said nothing of the kind there.
            kind.differ(Some((side, frame.clone())), None);
        } else {
            kind.ahead = Some(side);
            kind.waiting.push_back(frame.clone());
        }
    }

    /// The run on `side` says nothing more.
    pub fn end(&mut self, side: Side) {
        self.reach(side, Tti::NEVER);
    }

    /// The TTIs before this one are compared.
    pub fn compared(&self) -> Tti {
        self.reached[0].min(self.reached[1])
    }

    /// The first difference of each kind that has one, the first of all in front.
    pub fn differences(&self) -> Vec<&Difference> {
        let mut all: Vec<&Difference> = self.kinds.values().filter_map(|kind| kind.first.as_ref()).collect();
        let order = |of: &Difference| COMPARED.iter().position(|kind| *kind == of.kind);
        all.sort_by_key(|difference| (difference.tti, order(difference)));
        all
    }

    /// The run on `side` has come to `tti`: what the other one says before that has no counterpart.
    fn reach(&mut self, side: Side, tti: Tti) {
        self.reached[side as usize] = tti;
        for kind in self.kinds.values_mut() {
            if kind.first.is_none() && kind.ahead == Some(side.opposite()) {
                let lone = kind.waiting.pop_front_if(|frame| frame.tti < tti);
                if let Some(frame) = lone {
                    kind.differ(Some((side.opposite(), frame)), None);
                }
            }
        }
    }
}

impl Kind {
    /// The two do not fit; the earlier one has no counterpart where their TTIs are not the same.
    fn differ(&mut self, one: Option<(Side, Frame)>, two: Option<(Side, Frame)>) {
        let Some(tti) = one.iter().chain(&two).map(|(_, frame)| frame.tti).min() else {
            return;
        };
        let kind = one.iter().chain(&two).map(|(_, frame)| frame.kind).next();
        let (mut this, mut other) = (None, None);
        for (side, frame) in one.into_iter().chain(two).filter(|(_, frame)| frame.tti == tti) {
            match side {
                Side::This => this = Some(frame),
                Side::Other => other = Some(frame),
            }
        }
        self.first = kind.map(|kind| Difference { tti, kind, this, other });
        self.waiting = VecDeque::new();
    }
}

/// Goes through two recordings beside each other, from where they stand. A recording that is torn is compared up to the
/// tear; why it cannot be read any further comes with its side.
pub fn recordings<R: Read + Seek>(
    this: &mut Reader<R>,
    other: &mut Reader<R>,
) -> (Comparison, Option<(Side, RecordingError)>) {
    let mut comparison = Comparison::default();
    while comparison.compared() < Tti::NEVER {
        // The one that is behind goes on, so that hardly a message has to wait for its counterpart.
        let [own, others] = comparison.reached;
        let (side, reader) = if own <= others {
            (Side::This, &mut *this)
        } else {
            (Side::Other, &mut *other)
        };
        match reader.next_frame() {
            Ok(Some(frame)) => comparison.take(side, &frame),
            Ok(None) => comparison.end(side),
            Err(error) => return (comparison, Some((side, error))),
        }
    }
    (comparison, None)
}

/// A field of a scenario that differs: its name, and both values.
pub type Field = (String, String, String);

/// The fields in which two scenario files differ, sorted by name. A field that one of them has not is `none` there.
///
/// # Errors
/// If one of the texts is not in TOML.
pub fn fields(this: &str, other: &str) -> Result<Vec<Field>, toml::de::Error> {
    let (mut these, mut others) = (BTreeMap::new(), BTreeMap::new());
    flatten("", this.parse()?, &mut these);
    flatten("", other.parse()?, &mut others);
    let mut names: Vec<&String> = these.keys().chain(others.keys()).collect();
    names.sort_unstable();
    names.dedup();
    let value = |of: &BTreeMap<String, String>, name: &str| of.get(name).cloned().unwrap_or_else(|| "none".to_owned());
    Ok(names
        .into_iter()
        .map(|name| (name.clone(), value(&these, name), value(&others, name)))
        .filter(|(_, this, other)| this != other)
        .collect())
}

fn flatten(path: &str, table: Table, into: &mut BTreeMap<String, String>) {
    for (name, value) in table {
        let path = if path.is_empty() {
            name
        } else {
            format!("{path}.{name}")
        };
        if let Value::Table(fields) = value {
            flatten(&path, fields, into);
        } else {
            into.insert(path, value.to_string());
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_bs::observe::frames::Framed;
    use reveille_bs::scenario::{Override, load};
    use reveille_lab::preparation::prepare;
    use reveille_lab::run::{Options, Run};

    use super::*;

    fn frames(set: &[&str], lookahead: bool) -> Vec<Frame> {
        let set = ["devices=30", "ttis=300", "policy.name=age-index"].iter().chain(set);
        let set: Vec<Override> = set.map(|set| Override::parse(set).expect("an override")).collect();
        let scenario = load("paper", &set).expect("a scenario");
        let mut frames = Vec::new();
        let options = Options {
            lookahead,
            ..Options::default()
        };
        Run::new(&prepare(&scenario), options).finish(&mut Framed::new(0, |frame| frames.push(frame)));
        frames
    }

    /// All of the frames of both, `stride` at a time from either.
    fn compared(this: &[Frame], other: &[Frame], stride: usize) -> Comparison {
        let mut comparison = Comparison::default();
        for at in (0..this.len().max(other.len())).step_by(stride) {
            for (side, frames) in [(Side::This, this), (Side::Other, other)] {
                for frame in frames.iter().skip(at).take(stride) {
                    comparison.take(side, frame);
                }
            }
        }
        comparison.end(Side::This);
        comparison.end(Side::Other);
        comparison
    }

    /// The first TTI and kind that differ, by a look at all frames of each TTI.
    fn brute_force(this: &[Frame], other: &[Frame]) -> Option<(Tti, MessageKind)> {
        (0..300).map(Tti).find_map(|tti| {
            let of = |frames: &[Frame], kind| -> Vec<Frame> {
                let own = frames.iter().filter(|frame| frame.tti == tti && frame.kind == kind);
                own.cloned().collect()
            };
            let kind = COMPARED.into_iter().find(|kind| of(this, *kind) != of(other, *kind));
            kind.map(|kind| (tti, kind))
        })
    }

    #[test]
    fn the_first_difference_is_that_of_a_look_at_every_tti() {
        let this = frames(&[], true);
        for set in [
            &["seed=2"][..],
            &["policy.age-index.price=0.5"],
            &["events.duration=3"],
            &["ttis=299"],
            &["policy.name=random"],
        ] {
            let other = frames(set, true);
            let expected = brute_force(&this, &other).expect("they differ");
            for stride in [1, 7, 1_000_000] {
                let comparison = compared(&this, &other, stride);
                // Whichever comes first.
                let mirrored = compared(&other, &this, stride);
                let kinds = |of: &Comparison| -> Vec<(Tti, MessageKind)> {
                    of.differences().into_iter().map(|one| (one.tti, one.kind)).collect()
                };
                assert_eq!(kinds(&comparison), kinds(&mirrored), "{set:?}, {stride}");
                let differences = comparison.differences();
                let first = differences.first().expect("they differ");
                assert_eq!((first.tti, first.kind), expected, "{set:?}, {stride}");
                assert_ne!(first.this, first.other, "{set:?}");
                assert_eq!(comparison.compared(), Tti::NEVER);
            }
        }
    }

    #[test]
    fn the_same_run_is_the_same_with_and_without_lookahead() {
        let set = ["policy.name=knn"];
        let (this, other) = (frames(&set, true), frames(&set, false));
        assert_ne!(this.len(), other.len(), "other grants");
        assert!(compared(&this, &other, 5).differences().is_empty());
    }

    #[test]
    fn a_changed_message_is_found_and_named() {
        let this = frames(&[], true);
        for kind in COMPARED {
            let Some(at) = this.iter().rposition(|frame| frame.kind == kind) else {
                let is_rare = matches!(kind, MessageKind::Lost | MessageKind::Failed | MessageKind::Gone);
                assert!(is_rare, "{kind:?}");
                continue;
            };
            let mut other = this.clone();
            other.remove(at);
            let comparison = compared(&this, &other, 3);
            let [only] = comparison.differences()[..] else {
                panic!("{kind:?}: {:?}", comparison.differences());
            };
            assert_eq!((only.tti, only.kind), (this[at].tti, kind));
            assert_eq!(
                (only.this.as_ref(), only.says(Side::Other)),
                (Some(&this[at]), "nothing".to_owned())
            );
        }
    }

    #[test]
    fn plans_name_the_devices_that_they_differ_in() {
        let (this, other) = (frames(&[], true), frames(&["policy.age-index.price=0.5"], true));
        let comparison = compared(&this, &other, 1);
        let first = comparison.differences()[0];
        assert_eq!(first.kind, MessageKind::Plan);
        let of = |frame: &Option<Frame>| match frame.as_ref().expect("a plan").message() {
            Ok(Message::Plan(update)) => update.plan,
            _ => panic!("no plan"),
        };
        let (one, two) = (of(&first.this), of(&first.other));
        let own =
            |j: &u32| one.duty_cycle(DeviceId(*j)).is_on(first.tti) != two.duty_cycle(DeviceId(*j)).is_on(first.tti);
        assert_eq!(first.devices(), (0..30).filter(own).map(DeviceId).collect::<Vec<_>>());
    }

    #[test]
    fn scenarios_differ_in_fields() {
        let (this, other) = ("seed = 1\n[a.b]\nc = [1]\nd = 'x'", "seed = 2\n[a.b]\nc = [1]");
        let expected = [("a.b.d", "\"x\"", "none"), ("seed", "1", "2")];
        let expected = expected.map(|(name, this, other)| (name.to_owned(), this.to_owned(), other.to_owned()));
        assert_eq!(fields(this, other).expect("TOML"), expected);
        assert!(fields("seed", other).is_err());
    }
}
