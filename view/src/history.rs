//! History of a run: the states of all devices in any past TTI.
//!
//! Only the frames and occasional snapshots of the run are stored. A TTI is recomputed from the last snapshot before
//! it. A run of 100 000 TTIs takes little more memory than its messages, and any TTI takes milliseconds.

use std::collections::VecDeque;

use reveille_bs::scenario::Scenario;
use reveille_common::event::{EventRecord, Stimulus};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{BeliefUpdate, EventUpdate, Frame, Message, MessageKind, WakeOutcome};
use reveille_common::state::DeviceView;
use reveille_common::totals::DeviceTotals;

use crate::device_mirror::Discrepancy;
use crate::filter::Filter;
use crate::reconstruction::Reconstruction;

/// Minimum distance between two snapshots, TTIs.
const SPACING: u64 = 500;

/// A run, or the stored part of it.
pub struct RunHistory {
    frames: VecDeque<Frame>,
    /// Number of the first stored frame, counted from the start of the run.
    first: u64,
    kept: VecDeque<HistorySnapshot>,
    now: Reconstruction,
    /// Messages of the current TTI, without device states.
    latest: TtiSnapshot,
    /// Approximate number of past TTIs to store.
    length: u64,
}

/// Snapshot of a run.
struct HistorySnapshot {
    /// The next TTI after the snapshot.
    next: Tti,
    /// Number of the next frame after the snapshot.
    frame: u64,
    run: Reconstruction,
}

/// A TTI of a run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TtiSnapshot {
    /// State and battery of all devices at its end, in the order of ids.
    pub views: Vec<DeviceView>,
    /// Whether the plan lets each device sense in it.
    pub on: Vec<bool>,
    /// The event in progress.
    pub event: Option<Stimulus>,
    /// The event that ended with it.
    pub ended: Option<EventRecord>,
    /// Devices that reported without a wake-up.
    pub reported: Vec<DeviceId>,
    /// Devices that reported without a wake-up, but whose reports were lost.
    pub lost: Vec<DeviceId>,
    /// Devices that detected the event but lacked the energy for a report.
    pub failed: Vec<DeviceId>,
    /// Woken devices, in the order of their wake-ups, with the outcomes.
    pub woken: Vec<(DeviceId, WakeOutcome)>,
    /// Position estimate of the base station after all reports of the TTI, if the policy keeps one.
    pub belief: Option<BeliefUpdate>,
}

impl RunHistory {
    /// Creates the history of a run of `scenario` before TTI 0. It keeps at least the last `length` TTIs.
    pub fn new(scenario: &Scenario, length: u64) -> Self {
        let now = Reconstruction::new(scenario);
        let start = HistorySnapshot {
            next: Tti::ZERO,
            frame: 0,
            run: now.clone(),
        };
        Self {
            frames: VecDeque::new(),
            first: 0,
            kept: VecDeque::from([start]),
            now,
            latest: TtiSnapshot::default(),
            length,
        }
    }

    /// Appends `frame`.
    ///
    /// # Errors
    /// If the frame contradicts the frames before it. The states from there on can differ from the run.
    pub fn push(&mut self, frame: Frame) -> Result<(), Discrepancy> {
        let next = self.now.mirror().next();
        let is_between = matches!(frame.kind, MessageKind::Plan | MessageKind::World);
        // Saved only between two grants, where no report or outcome is outstanding.
        if is_between && self.kept.back().is_none_or(|kept| next - kept.next >= SPACING) {
            self.kept.push_back(HistorySnapshot {
                next,
                frame: self.first + self.frames.len() as u64,
                run: self.now.clone(),
            });
            self.forget(next);
        }
        let taken = self.now.apply(&frame);
        if is_between {
            self.latest = TtiSnapshot::default();
        } else if TtiSnapshot::NOTED.contains(&frame.kind)
            && let Ok(message) = frame.message()
        {
            self.latest.note(&frame, &message);
        }
        // Stored even after an error, since frames are found by their numbers.
        self.frames.push_back(frame);
        taken
    }

    /// Current state of the run.
    pub const fn now(&self) -> &Reconstruction {
        &self.now
    }

    /// Current state and battery of all devices, in the order of ids.
    pub fn views(&mut self) -> Vec<DeviceView> {
        self.now.mirror_mut().views()
    }

    /// The current TTI, from the frames received so far.
    pub fn latest(&mut self) -> TtiSnapshot {
        let views = self.views();
        let on = match self.now.mirror().now() {
            Some(tti) => on(&self.now, tti, views.len()),
            None => Vec::new(),
        };
        TtiSnapshot {
            views,
            on,
            event: self.now.stimulus(),
            ..self.latest.clone()
        }
    }

    /// Range of the available TTIs: the first, and the one after the last.
    pub fn span(&self) -> (Tti, Tti) {
        let first = self.kept.front().map_or(Tti::ZERO, |kept| kept.next);
        (first, self.now.mirror().next())
    }

    /// Returns TTI `tti`, if available.
    pub fn at(&self, tti: Tti) -> Option<TtiSnapshot> {
        let (first, end) = self.span();
        if tti < first || tti >= end {
            return None;
        }
        let kept = self.kept.iter().rev().find(|kept| kept.next <= tti)?;
        let mut run = kept.run.clone();
        let mut moment = TtiSnapshot::default();
        for frame in self.frames.range((kept.frame - self.first) as usize..) {
            if frame.tti > tti {
                break;
            }
            let Ok(message) = frame.message() else { continue };
            if matches!(message, Message::World(_) | Message::Plan(_)) {
                moment = TtiSnapshot::default();
            }
            // `tti` lies inside the grant, whose later messages must not be applied.
            if let Message::World(world) = &message
                && world.last > tti
            {
                moment.views = run.mirror_mut().views_at(tti);
                moment.event = run.stimulus();
                self.note_starts(frame, tti, &mut moment);
                break;
            }
            // After a discrepancy the states are a best guess.
            let _discrepancy = run.apply(frame).is_err();
            moment.note(frame, &message);
            moment.event = moment.event.or(run.stimulus());
        }
        if moment.views.is_empty() {
            moment.views = run.mirror_mut().views();
        }
        moment.on = on(&run, tti, moment.views.len());
        Some(moment)
    }

    /// Totals of `device` from the start of the run to the end of TTI `tti`, if available.
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
            // Anything later would take the machines past `tti`, from where `ledger` cannot go back.
            if is_later {
                break;
            }
            let _discrepancy = run.apply(frame).is_err();
        }
        run.mirror().ledger(device, tti + 1).map(|ledger| ledger.whole)
    }

    /// State and battery of `device` in each available TTI from `from` up to but excluding `end`, in order.
    pub fn history(&self, device: DeviceId, from: Tti, end: Tti) -> Vec<(Tti, DeviceView)> {
        let (first, last) = self.span();
        let (from, end) = (from.max(first), end.min(last));
        let mut history = Vec::new();
        let Some(kept) = self.kept.iter().rev().find(|kept| kept.next <= from) else {
            return history;
        };
        let mut run = kept.run.clone();
        let mut next = kept.next;
        let mut tell = |run: &mut Reconstruction, until: Tti| {
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
                    // The TTIs up to here passed under the plan before this one.
                    let reached = run.mirror().next();
                    tell(&mut run, reached);
                }
                Ok(Message::World(world)) => {
                    let reached = run.mirror().next();
                    tell(&mut run, reached);
                    // All TTIs of a grant but the last are quiet, so their views are known before its messages.
                    tell(&mut run, world.last.min(end));
                }
                _ => {}
            }
            let _discrepancy = run.apply(frame).is_err();
        }
        let reached = run.mirror().next().min(end);
        tell(&mut run, reached);
        history
    }

    /// At most `most` stored frames that pass `filter`, from the oldest on, each with its number.
    pub fn frames(&self, filter: &Filter, most: usize) -> Vec<(u64, &Frame)> {
        let start = self.frames.partition_point(|frame| frame.tti < filter.first());
        let mut states = self.states_before(filter, start);
        let numbered = (self.first + start as u64..).zip(self.frames.range(start..));
        let passing = numbered
            .take_while(|(_, frame)| !filter.is_over(frame.tti))
            .filter(|(_, frame)| {
                let state = states.as_mut().and_then(|run| {
                    let state = frame.device().and_then(|device| run.mirror_mut().state(device));
                    let _discrepancy = run.apply(frame).is_err();
                    state
                });
                // Decoded only for a filter by device; all other criteria are in the frame.
                let message = filter.devices.as_ref().and_then(|_| frame.message().ok());
                filter.passes(frame, message.as_ref(), state)
            });
        passing.take(most).collect()
    }

    /// The run before the frame at `start`, if `filter` selects by state.
    fn states_before(&self, filter: &Filter, start: usize) -> Option<Reconstruction> {
        let number = self.first + start as u64;
        let kept = self.kept.iter().rev().find(|kept| kept.frame <= number)?;
        let mut run = (!filter.states.is_empty()).then(|| kept.run.clone())?;
        for frame in self.frames.range((kept.frame - self.first) as usize..start) {
            let _discrepancy = run.apply(frame).is_err();
        }
        Some(run)
    }

    /// The frame with this number, if stored.
    pub fn frame(&self, number: u64) -> Option<&Frame> {
        let at = number.checked_sub(self.first)?;
        self.frames.get(usize::try_from(at).ok()?)
    }

    /// Drops snapshots and frames older than `length` TTIs.
    fn forget(&mut self, next: Tti) {
        while let Some(second) = self.kept.get(1).filter(|second| next - second.next >= self.length) {
            // Frames before the second snapshot are needed only to continue from the first one.
            let gone = second.frame - self.first;
            self.frames.drain(..gone as usize);
            self.first = second.frame;
            self.kept.pop_front();
        }
    }

    /// Records the event that is in progress in TTI `tti`, which lies in the grant that begins with `world`.
    fn note_starts(&self, world: &Frame, tti: Tti, moment: &mut TtiSnapshot) {
        let start = self.frames.partition_point(|frame| frame.tti < world.tti);
        for frame in self.frames.range(start..) {
            if frame.tti > tti {
                return;
            }
            match frame.message() {
                Ok(Message::Event(EventUpdate::Started(event))) => moment.event = Some(event.stimulus),
                Ok(Message::Event(EventUpdate::Ended(record))) if record.last < tti => moment.event = None,
                _ => {}
            }
        }
    }
}

/// Whether the current plan lets each of the first `devices` devices sense in TTI `tti`.
fn on(run: &Reconstruction, tti: Tti, devices: usize) -> Vec<bool> {
    let plan = run.mirror().plan();
    let ids = (0..).map(DeviceId).take(devices);
    ids.map(|id| plan.is_some_and(|plan| plan.duty_cycle(id).is_on(tti)))
        .collect()
}

impl TtiSnapshot {
    /// The kinds that a snapshot records.
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
            // Its report came before the outcome and was recorded as one without a wake-up.
            self.reported.retain(|reporter| *reporter != device);
            self.woken.push((device, woken.outcome));
        } else if let Message::Belief(belief) = message {
            self.belief = Some(belief.clone());
        } else if let Message::Event(EventUpdate::Ended(record)) = message {
            self.ended = Some(*record);
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_bs::observer::frames::FrameObserver;
    use reveille_bs::observer::{Notification, Observer};
    use reveille_bs::scenario::{Override, load};
    use reveille_common::state::DeviceState;
    use reveille_lab::preparation::prepare;
    use reveille_lab::run::{Run, RunOptions};

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
        load("paper", &set).expect("a scenario").scenario
    }

    fn story(scenario: &Scenario, length: u64) -> RunHistory {
        let mut story = RunHistory::new(scenario, length);
        let take = |frame| story.push(frame).expect("it fits");
        Run::new(&prepare(scenario), RunOptions::default()).finish(&mut FrameObserver::new(0, take));
        story
    }

    /// Collects the states and messages of every TTI from a run that is stepped TTI by TTI.
    #[derive(Default)]
    struct StateCollector {
        states: Vec<Vec<DeviceView>>,
        reports: Vec<usize>,
        wakes: Vec<usize>,
    }

    impl Observer for StateCollector {
        fn notify(&mut self, notification: &Notification<'_>) {
            if let Notification::TtisGranted(_) = notification {
                self.reports.push(0);
                self.wakes.push(0);
            } else if let Notification::ReportReceived(_) = notification {
                *self.reports.last_mut().expect("a TTI") += 1;
            } else if let Notification::WakeUpSent { .. } = notification {
                *self.wakes.last_mut().expect("a TTI") += 1;
            } else if let Notification::DeviceStates(views) = notification {
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
        let mut witness = StateCollector::default();
        let options = RunOptions {
            lookahead: false,
            ..RunOptions::default()
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
