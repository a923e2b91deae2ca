//! A run as it can be looked at again: every TTI of it, with the states of all devices.
//!
//! Only frames are kept, and now and then the run as it was: what a TTI looked like is worked out from the last of
//! those before it. So a run of a hundred thousand TTIs takes little more memory than its messages, and any TTI of it
//! is at hand in milliseconds.

use std::collections::VecDeque;

use reveille_common::event::{EventRecord, Stimulus};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Belief, EventNews, Frame, Message, MessageKind, WakeOutcome};
use reveille_common::scenario::Scenario;
use reveille_common::state::DeviceView;
use reveille_common::totals::DeviceTotals;

use crate::filter::Filter;
use crate::mirror::Discrepancy;
use crate::replay::Replay;

/// TTIs from one run as it was to the next, at least.
const SPACING: u64 = 500;

/// A run, or as much of it as is kept.
pub struct Story {
    frames: VecDeque<Frame>,
    /// The number of the first frame that is kept, counted from the first of the run.
    first: u64,
    kept: VecDeque<Kept>,
    now: Replay,
    /// What has happened in the TTI that was reached last, without its states.
    latest: Moment,
    /// TTIs that can be looked at again, about.
    length: u64,
}

/// The run as it was.
struct Kept {
    /// The TTI that was to come next.
    next: Tti,
    /// The number of the frame that came next.
    frame: u64,
    run: Replay,
}

/// A TTI of a run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Moment {
    /// State and battery of all devices at its end, in the order of ids.
    pub views: Vec<DeviceView>,
    /// Which of them were told to sense in it.
    pub on: Vec<bool>,
    /// The event that was under way in it.
    pub event: Option<Stimulus>,
    /// The event that ended with it.
    pub ended: Option<EventRecord>,
    /// Devices that reported by themselves.
    pub reported: Vec<DeviceId>,
    /// Devices that reported by themselves, and whose reports were lost.
    pub lost: Vec<DeviceId>,
    /// Devices that detected the event and could not pay for a report.
    pub failed: Vec<DeviceId>,
    /// Devices that were woken, in this order, and what came of it.
    pub woken: Vec<(DeviceId, WakeOutcome)>,
    /// Where the base station believed the event to be, once it had heard all of that, where it has such a belief.
    pub belief: Option<Belief>,
}

impl Story {
    /// A run of `scenario` before TTI 0, of which at least the last `length` TTIs are kept.
    pub fn new(scenario: &Scenario, length: u64) -> Self {
        let now = Replay::new(scenario);
        let start = Kept {
            next: Tti::ZERO,
            frame: 0,
            run: now.clone(),
        };
        Self {
            frames: VecDeque::new(),
            first: 0,
            kept: VecDeque::from([start]),
            now,
            latest: Moment::default(),
            length,
        }
    }

    /// Goes on with `frame`.
    ///
    /// # Errors
    /// If it does not fit to what was before it. From there on states are not those of the run.
    pub fn take(&mut self, frame: Frame) -> Result<(), Discrepancy> {
        let next = self.now.mirror().next();
        let is_between = matches!(frame.kind, MessageKind::Plan | MessageKind::World);
        if is_between && self.kept.back().is_none_or(|kept| next - kept.next >= SPACING) {
            self.kept.push_back(Kept {
                next,
                frame: self.first + self.frames.len() as u64,
                run: self.now.clone(),
            });
            self.forget(next);
        }
        let taken = self.now.take(&frame);
        if is_between {
            self.latest = Moment::default();
        } else if Moment::NOTED.contains(&frame.kind)
            && let Ok(message) = frame.message()
        {
            self.latest.note(&frame, &message);
        }
        self.frames.push_back(frame);
        taken
    }

    /// The run as it is now.
    pub const fn now(&self) -> &Replay {
        &self.now
    }

    /// State and battery of all devices now, in the order of ids.
    pub fn views(&mut self) -> Vec<DeviceView> {
        self.now.mirror_mut().views()
    }

    /// The TTI that was reached last, as far as it has been told of.
    pub fn latest(&mut self) -> Moment {
        let views = self.views();
        let on = match self.now.mirror().now() {
            Some(tti) => on(&self.now, tti, views.len()),
            None => Vec::new(),
        };
        Moment {
            views,
            on,
            event: self.now.stimulus(),
            ..self.latest.clone()
        }
    }

    /// The TTIs that can be looked at: the first, and the one after the last.
    pub fn span(&self) -> (Tti, Tti) {
        let first = self.kept.front().map_or(Tti::ZERO, |kept| kept.next);
        (first, self.now.mirror().next())
    }

    /// TTI `tti`, if it can be looked at.
    pub fn at(&self, tti: Tti) -> Option<Moment> {
        let (first, end) = self.span();
        if tti < first || tti >= end {
            return None;
        }
        let kept = self.kept.iter().rev().find(|kept| kept.next <= tti)?;
        let mut run = kept.run.clone();
        let mut moment = Moment::default();
        for frame in self.frames.range((kept.frame - self.first) as usize..) {
            if frame.tti > tti {
                break;
            }
            let Ok(message) = frame.message() else { continue };
            if matches!(message, Message::World(_) | Message::Plan(_)) {
                moment = Moment::default();
            }
            // Its last TTI is still to come: what devices say in it is not heard yet.
            if let Message::World(world) = &message
                && world.last > tti
            {
                moment.views = run.mirror_mut().views_at(tti);
                moment.event = run.stimulus();
                self.note_starts(frame, tti, &mut moment);
                break;
            }
            // Where it does not fit, the states from there on are the best guess.
            let _discrepancy = run.take(frame).is_err();
            moment.note(frame, &message);
            moment.event = moment.event.or(run.stimulus());
        }
        if moment.views.is_empty() {
            moment.views = run.mirror_mut().views();
        }
        moment.on = on(&run, tti, moment.views.len());
        Some(moment)
    }

    /// The sums of `device` from the start of the run to the end of TTI `tti`, if that can be looked at.
    pub fn totals(&self, device: DeviceId, tti: Tti) -> Option<DeviceTotals> {
        let (first, end) = self.span();
        if tti < first || tti >= end {
            return None;
        }
        let kept = self.kept.iter().rev().find(|kept| kept.next <= tti)?;
        let mut run = kept.run.clone();
        for frame in self.frames.range((kept.frame - self.first) as usize..) {
            let is_later = match frame.message() {
                Ok(Message::World(world)) => world.last > tti,
                Ok(Message::Plan(update)) => update.from > tti,
                Ok(_) | Err(_) => false,
            };
            if is_later {
                break;
            }
            let _discrepancy = run.take(frame).is_err();
        }
        run.mirror().ledger(device, tti + 1).map(|ledger| ledger.whole)
    }

    /// State and battery of `device` in the TTIs from `from` up to and not including `end`, as far as they can be
    /// looked at, one after the other.
    pub fn history(&self, device: DeviceId, from: Tti, end: Tti) -> Vec<(Tti, DeviceView)> {
        let (first, last) = self.span();
        let (from, end) = (from.max(first), end.min(last));
        let mut history = Vec::new();
        let Some(kept) = self.kept.iter().rev().find(|kept| kept.next <= from) else {
            return history;
        };
        let mut run = kept.run.clone();
        let mut next = kept.next;
        let mut tell = |run: &mut Replay, until: Tti| {
            while next < until {
                if let Some(view) = run
                    .mirror_mut()
                    .view_at(device, next)
                    .filter(|_| next >= from && next < end)
                {
                    history.push((next, view));
                }
                next = next + 1;
            }
        };
        for frame in self.frames.range((kept.frame - self.first) as usize..) {
            if frame.tti > end {
                break;
            }
            match frame.message() {
                Ok(Message::Plan(_)) => {
                    let reached = run.mirror().next();
                    tell(&mut run, reached);
                }
                Ok(Message::World(world)) => {
                    let reached = run.mirror().next();
                    tell(&mut run, reached);
                    tell(&mut run, world.last.min(end));
                }
                _ => {}
            }
            let _discrepancy = run.take(frame).is_err();
        }
        let reached = run.mirror().next().min(end);
        tell(&mut run, reached);
        history
    }

    /// The frames that pass `filter`, `most` at the most, from the first on that is kept; each with its number.
    pub fn frames(&self, filter: &Filter, most: usize) -> Vec<(u64, &Frame)> {
        let start = self.frames.partition_point(|frame| frame.tti < filter.first());
        let mut states = self.states_before(filter, start);
        let numbered = (self.first + start as u64..).zip(self.frames.range(start..));
        let passing = numbered
            .take_while(|(_, frame)| !filter.is_over(frame.tti))
            .filter(|(_, frame)| {
                let state = states.as_mut().and_then(|run| {
                    let state = frame.device().and_then(|device| run.mirror_mut().state(device));
                    let _discrepancy = run.take(frame).is_err();
                    state
                });
                // Only whom it concerns takes reading it.
                let message = filter.devices.as_ref().and_then(|_| frame.message().ok());
                filter.passes(frame, message.as_ref(), state)
            });
        passing.take(most).collect()
    }

    /// The run as it was before the frame at `start`, where `filter` asks for states.
    fn states_before(&self, filter: &Filter, start: usize) -> Option<Replay> {
        let number = self.first + start as u64;
        let kept = self.kept.iter().rev().find(|kept| kept.frame <= number)?;
        let mut run = (!filter.states.is_empty()).then(|| kept.run.clone())?;
        for frame in self.frames.range((kept.frame - self.first) as usize..start) {
            let _discrepancy = run.take(frame).is_err();
        }
        Some(run)
    }

    /// The frame with this number, if it is kept.
    pub fn frame(&self, number: u64) -> Option<&Frame> {
        let at = number.checked_sub(self.first)?;
        self.frames.get(usize::try_from(at).ok()?)
    }

    /// Forgets what is further back than it has to be kept.
    fn forget(&mut self, next: Tti) {
        while let Some(second) = self.kept.get(1).filter(|second| next - second.next >= self.length) {
            let gone = second.frame - self.first;
            self.frames.drain(..gone as usize);
            self.first = second.frame;
            self.kept.pop_front();
        }
    }

    /// Notes an event that has started in a TTI up to `tti` of the grant that begins with `world`.
    fn note_starts(&self, world: &Frame, tti: Tti, moment: &mut Moment) {
        let start = self.frames.partition_point(|frame| frame.tti < world.tti);
        for frame in self.frames.range(start..) {
            if frame.tti > tti {
                return;
            }
            match frame.message() {
                Ok(Message::Event(EventNews::Started(event))) => moment.event = Some(event.stimulus),
                Ok(Message::Event(EventNews::Ended(record))) if record.last < tti => moment.event = None,
                _ => {}
            }
        }
    }
}

/// Which of `devices` are told to sense in TTI `tti`, by the plan in force.
fn on(run: &Replay, tti: Tti, devices: usize) -> Vec<bool> {
    let plan = run.mirror().plan();
    let ids = (0..).map(DeviceId).take(devices);
    ids.map(|id| plan.is_some_and(|plan| plan.duty_cycle(id).is_on(tti)))
        .collect()
}

impl Moment {
    /// The kinds that it notes.
    const NOTED: [MessageKind; 6] = [
        MessageKind::Report,
        MessageKind::Lost,
        MessageKind::Failed,
        MessageKind::Woken,
        MessageKind::Belief,
        MessageKind::Event,
    ];

    fn note(&mut self, frame: &Frame, message: &Message) {
        if let Message::Report(report) = message {
            self.reported.push(report.device);
        } else if let Message::Lost(lost) = message {
            self.lost.push(lost.report.device);
        } else if let Message::Failed(failed) = message {
            self.failed.push(failed.failure.device);
        } else if let (Message::Woken(woken), Some(number)) = (message, frame.number) {
            let device = DeviceId(number);
            // Its report was taken for one of its own.
            self.reported.retain(|reporter| *reporter != device);
            self.woken.push((device, woken.outcome));
        } else if let Message::Belief(belief) = message {
            self.belief = Some(belief.clone());
        } else if let Message::Event(EventNews::Ended(record)) = message {
            self.ended = Some(*record);
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_bs::observe::frames::Framed;
    use reveille_bs::observe::{Happening, Observer};
    use reveille_bs::scenario::{Override, load};
    use reveille_common::state::DeviceState;
    use reveille_lab::preparation::prepare;
    use reveille_lab::run::{Options, Run};

    use super::*;

    fn scenario() -> Scenario {
        let set = [
            "devices=40",
            "ttis=2600",
            "policy.name=knn",
            "events.alpha=0.3",
            "harvest.e_b=3",
        ];
        let set = set.map(|set| Override::parse(set).expect("an override"));
        load("paper", &set).expect("a scenario")
    }

    fn story(scenario: &Scenario, length: u64) -> Story {
        let mut story = Story::new(scenario, length);
        let take = |frame| story.take(frame).expect("it fits");
        Run::new(&prepare(scenario), Options::default()).finish(&mut Framed::new(0, take));
        story
    }

    /// The states at the end of every TTI, and who was heard of in it, from a run that goes through them one by one.
    #[derive(Default)]
    struct Witness {
        states: Vec<Vec<DeviceView>>,
        reports: Vec<usize>,
        wakes: Vec<usize>,
    }

    impl Observer for Witness {
        fn see(&mut self, happening: &Happening<'_>) {
            if let Happening::Granted(_) = happening {
                self.reports.push(0);
                self.wakes.push(0);
            } else if let Happening::Reported(_) = happening {
                *self.reports.last_mut().expect("a TTI") += 1;
            } else if let Happening::WakeUp { .. } = happening {
                *self.wakes.last_mut().expect("a TTI") += 1;
            } else if let Happening::States(views) = happening {
                self.states.push(views.to_vec());
            }
        }

        fn wants_states(&self) -> bool {
            true
        }
    }

    #[test]
    fn every_tti_can_be_looked_at_again() {
        let scenario = scenario();
        let mut witness = Witness::default();
        let options = Options {
            lookahead: false,
            ..Options::default()
        };
        Run::new(&prepare(&scenario), options).finish(&mut witness);
        let story = story(&scenario, u64::MAX);
        assert_eq!(story.span(), (Tti(0), Tti(2600)));
        assert_eq!(story.at(Tti(2600)), None);
        let mut sent = 0;
        for k in (0..2600).filter(|k| k % 7 == 0 || k % 500 < 3) {
            let moment = story.at(Tti(k)).expect("kept");
            assert_eq!(moment.views, witness.states[k as usize], "TTI {k}");
            assert_eq!(moment.reported.len(), witness.reports[k as usize], "TTI {k}");
            assert_eq!(moment.woken.len(), witness.wakes[k as usize], "TTI {k}");
            assert!(moment.reported.is_empty() || moment.event.is_some(), "TTI {k}");
            let transmitting = moment
                .views
                .iter()
                .filter(|view| view.state == DeviceState::Transmission);
            sent += transmitting.count();
        }
        assert!(sent > 20, "{sent}");
        let own: Vec<DeviceView> = witness.states[980..1120].iter().map(|views| views[7]).collect();
        let history = story.history(DeviceId(7), Tti(980), Tti(1120));
        assert_eq!(history.iter().map(|(_, view)| *view).collect::<Vec<_>>(), own);
        assert_eq!((history[0].0, history[139].0), (Tti(980), Tti(1119)));
    }

    #[test]
    fn what_is_far_back_is_forgotten() {
        let scenario = scenario();
        let (whole, short) = (story(&scenario, u64::MAX), story(&scenario, 700));
        let (first, end) = short.span();
        assert!(
            end == Tti(2600) && (700..1800).contains(&(end - first)),
            "{first} to {end}"
        );
        assert!(short.frames.len() < whole.frames.len() / 2);
        assert_eq!(short.at(Tti(first.0 - 1)), None);
        for k in (first.0..2600).step_by(41) {
            assert_eq!(short.at(Tti(k)), whole.at(Tti(k)), "TTI {k}");
        }
        let filter = Filter {
            ttis: Some(2000..=2010),
            ..Filter::default()
        };
        assert_eq!(short.frames(&filter, 1000), whole.frames(&filter, 1000));
        let (number, frame) = short.frames(&filter, 1)[0];
        assert_eq!(short.frame(number), Some(frame));
        assert_eq!(short.frame(0), None);
    }
}
