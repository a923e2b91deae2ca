//! History of a run: the states of all devices in any past TTI, for the dashboard.
//!
//! Only the frames and occasional snapshots of the run are stored. A TTI is recomputed from the last snapshot before
//! it. A run of 100 000 TTIs takes little more memory than its messages, and any TTI takes milliseconds. Nothing here
//! is written to a file.

use std::collections::VecDeque;

use reveille_bs::scenario::Scenario;
use reveille_common::event::{EventRecord, Stimulus};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{BeliefUpdate, EventUpdate, Frame, Message, MessageKind, Plane, WakeOutcome};
use reveille_common::state::DeviceView;
use reveille_common::totals::DeviceTotals;

use crate::device_mirror::Discrepancy;
use crate::filter::Filter;
use crate::reconstruction::Reconstruction;

/// Minimum distance between two snapshots, TTIs.
const MIN_SNAPSHOT_SPACING: u64 = 500;

/// A run, or the stored part of it.
pub struct RunHistory {
    /// The stored frames, of all planes.
    frames: VecDeque<Frame>,
    /// Number of the first stored frame, counted from the start of the run.
    first_frame: u64,
    snapshots: VecDeque<ResumeSnapshot>,
    /// The run after all frames so far.
    reconstruction: Reconstruction,
    /// Messages of the current TTI, without device states.
    latest: TtiSnapshot,
    /// Approximate number of past TTIs to store; the snapshots' spacing adds to it.
    max_ttis: u64,
}

/// Snapshot of a run, from which later TTIs of the same [`RunHistory`] can be computed.
#[derive(Clone, Debug)]
pub struct ResumeSnapshot {
    /// The next TTI after the snapshot. No device is past it.
    next_tti: Tti,
    /// Number of the next frame after the snapshot.
    next_frame: u64,
    run: Reconstruction,
}

/// A copy of the part of a history that some TTIs need, so that they can be computed without the history.
#[derive(Debug)]
pub struct HistorySpan {
    snapshot: ResumeSnapshot,
    /// The frames after the snapshot, without the emulation plane, each with its number.
    frames: Vec<(u64, Frame)>,
    from: Tti,
    end: Tti,
}

/// A TTI of a run. `snapshot_json` in `deploy/src/dashboard/feed/mod.rs` sends every field to the page.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TtiSnapshot {
    /// State and battery of all devices at its end, in the order of ids.
    pub views: Vec<DeviceView>,
    /// Whether the plan lets each device sense in it, in the order of ids.
    pub planned_on: Vec<bool>,
    /// The event in progress.
    pub event: Option<Stimulus>,
    /// The event that ended with it.
    pub ended_event: Option<EventRecord>,
    /// Devices that reported without a wake-up.
    pub reporters: Vec<DeviceId>,
    /// Devices that reported without a wake-up, but whose reports were lost.
    pub lost_report_senders: Vec<DeviceId>,
    /// Devices that detected the event but lacked the energy for a report.
    pub failed_reporters: Vec<DeviceId>,
    /// Woken devices, in the order of their wake-ups, with the outcomes.
    pub woken: Vec<(DeviceId, WakeOutcome)>,
    /// Position estimate of the base station after all reports of the TTI, if the policy keeps one.
    pub belief: Option<BeliefUpdate>,
}

impl RunHistory {
    /// Creates the history of a run of `scenario` before TTI 0. It keeps at least the last `max_ttis` TTIs.
    pub fn new(scenario: &Scenario, max_ttis: u64) -> Self {
        let reconstruction = Reconstruction::new(scenario);
        let start = ResumeSnapshot {
            next_tti: Tti::ZERO,
            next_frame: 0,
            run: reconstruction.clone(),
        };
        Self {
            frames: VecDeque::new(),
            first_frame: 0,
            snapshots: VecDeque::from([start]),
            reconstruction,
            latest: TtiSnapshot::default(),
            max_ttis,
        }
    }

    /// Appends `frame`. Frames must come in the order of the run: searches rely on TTIs that never decrease.
    ///
    /// # Errors
    /// If the frame contradicts the frames before it. It is stored all the same, and more frames may follow, but the
    /// states from there on can differ from the run.
    pub fn push(&mut self, frame: Frame) -> Result<(), Discrepancy> {
        let next = self.reconstruction.mirror().next_tti();
        let is_between_grants = matches!(frame.kind, MessageKind::Plan | MessageKind::World);
        // Saved only between two grants, where no report or outcome is outstanding.
        let is_due = |snapshot: &ResumeSnapshot| next - snapshot.next_tti >= MIN_SNAPSHOT_SPACING;
        if is_between_grants && self.snapshots.back().is_none_or(is_due) {
            self.snapshots.push_back(ResumeSnapshot {
                next_tti: next,
                next_frame: self.first_frame + self.frames.len() as u64,
                run: self.reconstruction.clone(),
            });
            self.drop_old(next);
        }
        let result = self.reconstruction.apply(&frame);
        if is_between_grants {
            self.latest = TtiSnapshot::default();
        } else if TtiSnapshot::RECORDED_KINDS.contains(&frame.kind)
            && let Ok(message) = frame.message()
        {
            self.latest.record(&frame, &message);
        }
        // Stored even after an error, since frames are found by their numbers.
        self.frames.push_back(frame);
        result
    }

    /// The run after all frames so far.
    pub const fn reconstruction(&self) -> &Reconstruction {
        &self.reconstruction
    }

    /// Current state and battery of all devices, in the order of ids.
    pub fn views(&mut self) -> Vec<DeviceView> {
        self.reconstruction.mirror_mut().views()
    }

    /// The current TTI, from the frames received so far.
    pub fn latest(&mut self) -> TtiSnapshot {
        let views = self.views();
        let planned_on = match self.reconstruction.mirror().current_tti() {
            Some(tti) => sensing_flags(&self.reconstruction, tti, views.len()),
            None => Vec::new(),
        };
        // An event that ends with the current TTI is still in progress in it.
        let ended_stimulus = self.latest.ended_event.map(|record| Stimulus {
            event: record.event,
            epicentre: record.epicentre,
        });
        TtiSnapshot {
            views,
            planned_on,
            event: self.reconstruction.stimulus().or(ended_stimulus),
            ..self.latest.clone()
        }
    }

    /// Range of the available TTIs: the first, and the one after the last.
    pub fn available_ttis(&self) -> (Tti, Tti) {
        let first = self.snapshots.front().map_or(Tti::ZERO, |snapshot| snapshot.next_tti);
        (first, self.reconstruction.mirror().next_tti())
    }

    /// Returns TTI `tti`, if available.
    pub fn snapshot_at(&self, tti: Tti) -> Option<TtiSnapshot> {
        let (first, end) = self.available_ttis();
        if tti < first || tti >= end {
            return None;
        }
        let snapshot = self.snapshots.iter().rev().find(|snapshot| snapshot.next_tti <= tti)?;
        let mut run = snapshot.run.clone();
        let mut tti_snapshot = TtiSnapshot::default();
        for frame in self.frames.range((snapshot.next_frame - self.first_frame) as usize..) {
            if frame.tti > tti {
                break;
            }
            let Ok(message) = frame.message() else { continue };
            if matches!(message, Message::World(_) | Message::Plan(_)) {
                tti_snapshot = TtiSnapshot::default();
            }
            // `tti` lies inside the grant, whose later messages must not be applied.
            if let Message::World(world) = &message
                && world.last > tti
            {
                tti_snapshot.views = run.mirror_mut().views_at(tti);
                tti_snapshot.event = run.stimulus();
                self.record_event_at(frame, tti, &mut tti_snapshot);
                break;
            }
            // After a discrepancy the states are a best guess.
            let _discrepancy = run.apply(frame).is_err();
            tti_snapshot.record(frame, &message);
            tti_snapshot.event = tti_snapshot.event.or(run.stimulus());
        }
        if tti_snapshot.views.is_empty() {
            tti_snapshot.views = run.mirror_mut().views();
        }
        tti_snapshot.planned_on = sensing_flags(&run, tti, tti_snapshot.views.len());
        Some(tti_snapshot)
    }

    /// The run before the first plan or grant that goes beyond TTI `tti`, if that TTI is available.
    /// [`DeviceMirror::views_and_totals_at`](crate::device_mirror::DeviceMirror::views_and_totals_at) advances its
    /// devices to `tti`.
    pub fn run_until(&self, tti: Tti) -> Option<Reconstruction> {
        let (first, end) = self.available_ttis();
        if tti < first || tti >= end {
            return None;
        }
        let snapshot = self.snapshots.iter().rev().find(|snapshot| snapshot.next_tti <= tti)?;
        let mut run = snapshot.run.clone();
        for frame in self.frames.range((snapshot.next_frame - self.first_frame) as usize..) {
            let is_later = match frame.message() {
                Ok(Message::World(world)) => world.last > tti,
                Ok(Message::Plan(update)) => update.from > tti,
                Ok(_) | Err(_) => false,
            };
            // Anything later would take the machines past `tti`, from where they cannot go back.
            if is_later {
                break;
            }
            let _discrepancy = run.apply(frame).is_err();
        }
        Some(run)
    }

    /// Totals of `device` from the start of the run to the end of TTI `tti`, if available.
    pub fn totals(&self, device: DeviceId, tti: Tti) -> Option<DeviceTotals> {
        self.run_until(tti)?.mirror_mut().totals_at(device, tti)
    }

    /// State and battery of `device` in each available TTI from `from` up to but excluding `end`, in order.
    pub fn device_views(&self, device: DeviceId, from: Tti, end: Tti) -> Vec<(Tti, DeviceView)> {
        let mut views = Vec::new();
        if let Some(span) = self.span(from, end, None) {
            span.for_each_tti(&[device], |tti, view| {
                views.extend(view.first().map(|view| (tti, *view)));
            });
        }
        views
    }

    /// Copies the data of the available TTIs from `from` up to but excluding `end`. Starts at `earlier_snapshot`, which
    /// [`HistorySpan::for_each_tti`] returned for this history, if it is closer to `from` than the history's own
    /// snapshots. `None` if no such TTI is available.
    pub fn span(&self, from: Tti, end: Tti, earlier_snapshot: Option<ResumeSnapshot>) -> Option<HistorySpan> {
        let (available_from, available_end) = self.available_ttis();
        let (from, end) = (from.max(available_from), end.min(available_end));
        if from >= end {
            return None;
        }
        let stored = self.snapshots.iter().rev().find(|snapshot| snapshot.next_tti <= from)?;
        let is_closer = |earlier: &ResumeSnapshot| earlier.next_tti <= from && earlier.next_tti > stored.next_tti;
        let snapshot = earlier_snapshot.filter(is_closer).unwrap_or_else(|| stored.clone());
        let numbered =
            (snapshot.next_frame..).zip(self.frames.range((snapshot.next_frame - self.first_frame) as usize..));
        let frames = numbered
            .take_while(|(_, frame)| frame.tti < end)
            .filter(|(_, frame)| frame.kind.plane() != Plane::Emu)
            .map(|(number, frame)| (number, frame.clone()))
            .collect();
        Some(HistorySpan {
            snapshot,
            frames,
            from,
            end,
        })
    }

    /// The stored frames that pass `filter`, from the oldest on, each with its number.
    pub fn frames<'a>(&'a self, filter: &'a Filter) -> impl Iterator<Item = (u64, &'a Frame)> {
        let start = self.frames.partition_point(|frame| frame.tti < filter.first_tti());
        let mut states = self.states_before(filter, start);
        let numbered = (self.first_frame + start as u64..).zip(self.frames.range(start..));
        numbered
            .take_while(|(_, frame)| !filter.is_over(frame.tti))
            .filter(move |(_, frame)| {
                let state = states.as_mut().and_then(|run| {
                    let state = frame.device().and_then(|device| run.mirror_mut().state(device));
                    let _discrepancy = run.apply(frame).is_err();
                    state
                });
                // Decoded only for a filter by device; all other criteria are in the frame.
                let message = filter.devices.as_ref().and_then(|_| frame.message().ok());
                filter.passes(frame, message.as_ref(), state)
            })
    }

    /// The run before the frame at `start`, if `filter` selects by state.
    fn states_before(&self, filter: &Filter, start: usize) -> Option<Reconstruction> {
        let number = self.first_frame + start as u64;
        let snapshot = self
            .snapshots
            .iter()
            .rev()
            .find(|snapshot| snapshot.next_frame <= number)?;
        let mut run = (!filter.states.is_empty()).then(|| snapshot.run.clone())?;
        for frame in self
            .frames
            .range((snapshot.next_frame - self.first_frame) as usize..start)
        {
            let _discrepancy = run.apply(frame).is_err();
        }
        Some(run)
    }

    /// The frame with this number, if stored.
    pub fn frame(&self, number: u64) -> Option<&Frame> {
        let index = number.checked_sub(self.first_frame)?;
        self.frames.get(usize::try_from(index).ok()?)
    }

    /// Drops snapshots and frames older than `max_ttis` TTIs.
    fn drop_old(&mut self, next_tti: Tti) {
        while let Some(second) = self
            .snapshots
            .get(1)
            .filter(|second| next_tti - second.next_tti >= self.max_ttis)
        {
            // Frames before the second snapshot are needed only to continue from the first one.
            let dropped_frames = second.next_frame - self.first_frame;
            self.frames.drain(..dropped_frames as usize);
            self.first_frame = second.next_frame;
            self.snapshots.pop_front();
        }
    }

    /// Records the event that is in progress in TTI `tti`, which lies in the grant that begins with `world`.
    fn record_event_at(&self, world: &Frame, tti: Tti, tti_snapshot: &mut TtiSnapshot) {
        let start = self.frames.partition_point(|frame| frame.tti < world.tti);
        for frame in self.frames.range(start..) {
            if frame.tti > tti {
                return;
            }
            match frame.message() {
                Ok(Message::Event(EventUpdate::Started(event))) => tti_snapshot.event = Some(event.stimulus),
                Ok(Message::Event(EventUpdate::Ended(record))) if record.last < tti => tti_snapshot.event = None,
                _ => {}
            }
        }
    }
}

impl HistorySpan {
    /// The TTIs of the span: the first, and the one after the last.
    pub const fn ttis(&self) -> (Tti, Tti) {
        (self.from, self.end)
    }

    /// The frames of the span's TTIs, without the emulation plane.
    pub fn frames(&self) -> impl Iterator<Item = &Frame> {
        let frames = self.frames.iter().map(|(_, frame)| frame);
        frames.filter(|frame| frame.tti >= self.from)
    }

    /// Calls `visit` with each TTI and the views of `devices` in it, in the order of `devices`. A device that does not
    /// exist has no view. Returns a snapshot near the end, from which a later span can continue.
    pub fn for_each_tti(self, devices: &[DeviceId], mut visit: impl FnMut(Tti, &[DeviceView])) -> ResumeSnapshot {
        let Self {
            snapshot,
            frames,
            from,
            end,
        } = self;
        let mut end_snapshot = snapshot.clone();
        let ResumeSnapshot { mut run, next_tti, .. } = snapshot;
        let mut next = next_tti;
        let mut views = Vec::with_capacity(devices.len());
        let mut visit_until = |run: &mut Reconstruction, next: &mut Tti, until: Tti| {
            *next = (*next).max(from.min(until));
            while *next < until {
                views.clear();
                views.extend(devices.iter().filter_map(|id| run.mirror_mut().view_at(*id, *next)));
                visit(*next, &views);
                *next = *next + 1;
            }
        };
        let last_grant = frames.iter().rposition(|(_, frame)| frame.kind == MessageKind::World);
        for (index, (number, frame)) in frames.iter().enumerate() {
            match frame.message() {
                Ok(Message::Plan(_)) => {
                    // The TTIs up to here passed under the plan before this one.
                    let reached = run.mirror().next_tti().min(end);
                    visit_until(&mut run, &mut next, reached);
                }
                Ok(Message::World(world)) => {
                    let reached = run.mirror().next_tti().min(end);
                    visit_until(&mut run, &mut next, reached);
                    // Taken before the last grant: more messages of its TTIs can follow.
                    if Some(index) == last_grant {
                        end_snapshot = ResumeSnapshot {
                            next_tti: next,
                            next_frame: *number,
                            run: run.clone(),
                        };
                    }
                    // All TTIs of a grant but the last are quiet, so their views are known before its messages.
                    visit_until(&mut run, &mut next, world.last.min(end));
                }
                _ => {}
            }
            let _discrepancy = run.apply(frame).is_err();
        }
        let reached = run.mirror().next_tti().min(end);
        visit_until(&mut run, &mut next, reached);
        end_snapshot
    }
}

/// Whether the current plan lets each of the first `devices` devices sense in TTI `tti`.
fn sensing_flags(run: &Reconstruction, tti: Tti, devices: usize) -> Vec<bool> {
    let plan = run.mirror().plan();
    let ids = (0..).map(DeviceId).take(devices);
    ids.map(|id| plan.is_some_and(|plan| plan.duty_cycle(id).is_on(tti)))
        .collect()
}

impl TtiSnapshot {
    /// The kinds that [`Self::record`] handles; `push` passes no others.
    const RECORDED_KINDS: [MessageKind; 6] = [
        MessageKind::Report,
        MessageKind::Lost,
        MessageKind::Failed,
        MessageKind::Woken,
        MessageKind::Belief,
        MessageKind::Event,
    ];

    /// Records a message of the TTI. A new kind here also belongs in [`Self::RECORDED_KINDS`].
    fn record(&mut self, frame: &Frame, message: &Message) {
        if let Message::Report(report) = message {
            self.reporters.push(report.device);
        } else if let Message::Lost(lost) = message {
            self.lost_report_senders.push(lost.report.device);
        } else if let Message::Failed(failed) = message {
            self.failed_reporters.push(failed.failure.device);
        } else if let (Message::Woken(woken), Some(number)) = (message, frame.number) {
            let device = DeviceId(number);
            // Its report came before the outcome and was recorded as one without a wake-up.
            self.reporters.retain(|reporter| *reporter != device);
            self.woken.push((device, woken.outcome));
        } else if let Message::Belief(belief) = message {
            self.belief = Some(belief.clone());
        } else if let Message::Event(EventUpdate::Ended(record)) = message {
            self.ended_event = Some(*record);
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

    fn test_scenario() -> Scenario {
        let fields = [
            "devices=40",
            "ttis=2600",
            "policy.name=knn",
            "events.alpha=0.3",
            "harvest.e_b=3",
        ];
        let overrides = fields.map(|field| Override::parse(field).expect("an override"));
        load("paper", &overrides).expect("a scenario").scenario
    }

    /// Returns the history of a whole run that keeps at most about `max_ttis`.
    fn history_of(scenario: &Scenario, max_ttis: u64) -> RunHistory {
        let mut history = RunHistory::new(scenario, max_ttis);
        let push = |frame| history.push(frame).expect("a consistent frame");
        Run::new(&prepare(scenario), RunOptions::default()).finish(&mut FrameObserver::new(0, push));
        history
    }

    /// Collects the states and counts the messages of every TTI. Needs a run without lookahead: one entry for each
    /// grant.
    #[derive(Default)]
    struct StateCollector {
        states: Vec<Vec<DeviceView>>,
        report_counts: Vec<usize>,
        wake_up_counts: Vec<usize>,
    }

    impl Observer for StateCollector {
        fn notify(&mut self, notification: &Notification<'_>) {
            if let Notification::TtisGranted(_) = notification {
                self.report_counts.push(0);
                self.wake_up_counts.push(0);
            } else if let Notification::ReportReceived(_) = notification {
                *self.report_counts.last_mut().expect("a TTI") += 1;
            } else if let Notification::WakeUpSent { .. } = notification {
                *self.wake_up_counts.last_mut().expect("a TTI") += 1;
            } else if let Notification::DeviceStates(views) = notification {
                self.states.push(views.to_vec());
            }
        }

        fn states_due(&self) -> Tti {
            Tti::ZERO
        }
    }

    #[test]
    fn a_history_equals_the_states_of_a_run_by_single_ttis() {
        let scenario = test_scenario();
        let mut collector = StateCollector::default();
        let options = RunOptions {
            lookahead: false,
            ..RunOptions::default()
        };
        Run::new(&prepare(&scenario), options).finish(&mut collector);
        let history = history_of(&scenario, u64::MAX);
        assert_eq!(history.available_ttis(), (Tti(0), Tti(2600)));
        assert_eq!(history.snapshot_at(Tti(2600)), None);
        let mut transmissions = 0;
        // A sample of TTIs, with some neighbours.
        for k in (0..2600).filter(|k| k % 7 == 0 || k % 500 < 3) {
            let tti_snapshot = history.snapshot_at(Tti(k)).expect("snapshot");
            assert_eq!(tti_snapshot.views, collector.states[k as usize], "TTI {k}");
            assert_eq!(
                tti_snapshot.reporters.len(),
                collector.report_counts[k as usize],
                "TTI {k}"
            );
            assert_eq!(
                tti_snapshot.woken.len(),
                collector.wake_up_counts[k as usize],
                "TTI {k}"
            );
            assert!(
                tti_snapshot.reporters.is_empty() || tti_snapshot.event.is_some(),
                "TTI {k}"
            );
            let transmitting = tti_snapshot
                .views
                .iter()
                .filter(|view| view.state == DeviceState::Transmission);
            transmissions += transmitting.count();
        }
        assert!(transmissions > 20, "only {transmissions} transmissions");
        let expected: Vec<DeviceView> = collector.states[980..1120].iter().map(|views| views[7]).collect();
        let views = history.device_views(DeviceId(7), Tti(980), Tti(1120));
        assert_eq!(views.iter().map(|(_, view)| *view).collect::<Vec<_>>(), expected);
        assert_eq!((views[0].0, views[139].0), (Tti(980), Tti(1119)));
    }

    #[test]
    fn consecutive_spans_give_the_same_views_as_one() {
        let scenario = test_scenario();
        let history = history_of(&scenario, u64::MAX);
        let devices = [DeviceId(3), DeviceId(7), DeviceId(39)];
        let expected: Vec<Vec<DeviceView>> = (700..1400)
            .map(|k| {
                let views = history.snapshot_at(Tti(k)).expect("an available TTI").views;
                devices.iter().map(|id| views[id.index()]).collect()
            })
            .collect();
        // Spans of 1 to 97 TTIs, each from the snapshot of the one before, end inside grants too.
        let (mut earlier_snapshot, mut from, mut found) = (None, 700, Vec::new());
        for length in (1..98).step_by(6).cycle() {
            let end = (from + length).min(1400);
            let span = history
                .span(Tti(from), Tti(end), earlier_snapshot.take())
                .expect("available TTIs");
            assert_eq!(span.ttis(), (Tti(from), Tti(end)));
            earlier_snapshot = Some(span.for_each_tti(&devices, |tti, views| {
                assert_eq!(tti, Tti(700 + found.len() as u64));
                found.push(views.to_vec());
            }));
            from = end;
            if end == 1400 {
                break;
            }
        }
        assert_eq!(found, expected);
        assert!(history.span(Tti(2600), Tti(2700), None).is_none());
    }

    #[test]
    fn a_limited_history_keeps_the_last_ttis() {
        let scenario = test_scenario();
        let (full, limited) = (history_of(&scenario, u64::MAX), history_of(&scenario, 700));
        let (first, end) = limited.available_ttis();
        assert!(
            end == Tti(2600) && (700..1800).contains(&(end - first)),
            "available TTIs: {first} to {end}"
        );
        assert!(limited.frames.len() < full.frames.len() / 2);
        assert_eq!(limited.snapshot_at(Tti(first.0 - 1)), None);
        for k in (first.0..2600).step_by(41) {
            assert_eq!(limited.snapshot_at(Tti(k)), full.snapshot_at(Tti(k)), "TTI {k}");
        }
        let filter = Filter {
            ttis: Some(2000..=2010),
            ..Filter::default()
        };
        assert!(limited.frames(&filter).eq(full.frames(&filter)));
        let (number, frame) = limited.frames(&filter).next().expect("a frame in these TTIs");
        assert_eq!(limited.frame(number), Some(frame));
        assert_eq!(limited.frame(0), None);
    }
}
