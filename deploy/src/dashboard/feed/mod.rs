//! The dashboard's copy of a run: its history, the curves over it and its current state. One thread applies the frames:
//! the thread of [`Feed::open`] for a live run, the reader of a recording with [`Feed::apply`]. `api` reads from many
//! requests. The JSON here is the page's data: a changed key needs a change in `page/*.js`, and often in
//! `tests/program/dashboard.rs` and `tests/browser/check.py`.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use reveille_bs::scenario::{FieldDifference, Scenario, preset_label};
use reveille_common::deployment::Deployment;
use reveille_common::geometry::voronoi_cells;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{EventUpdate, Frame, Message, MessageKind, WakeOutcome};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::units::Energy;
use reveille_view::batch_receiver::{BatchReceiver, lower_priority};
use reveille_view::compare::{FirstDifference, RunComparison, RunSide};
use reveille_view::history::{RunHistory, TtiSnapshot};
use reveille_view::traffic::TrafficStats;
use serde_json::{Value, json};
use tokio::sync::Notify;

use super::curves::{CURVE_METRICS, CurvePoint, Curves};
use super::events::{EventLog, cause_text};
use super::timeline::{TimelineCursor, TimelineRequest, battery_byte};

/// TTIs of a live run that stay available for inspection; `docs/inspecting.md` states the number.
const MAX_LIVE_TTIS: u64 = 100_000;
/// Frames that the queue holds. A full queue blocks the run or the reader of the bus.
const QUEUE_CAPACITY: usize = 65_536;
/// Longest single wait for frames; after it the thread waits again.
const POLL_INTERVAL: Duration = Duration::from_secs(1);

/// The place that the frames of a feed come from.
#[derive(Clone, Copy)]
pub(crate) enum FeedOrigin<'a> {
    /// A run in this process, with its run folder.
    OwnRun(&'a Path),
    /// A run of another process, which the dashboard joined late.
    OtherRun,
    /// A recording at this path.
    Recording(&'a Path),
}

/// A run that many clients can view.
pub(crate) struct Feed {
    /// Battery capacity by device.
    e_max: Vec<Energy>,
    /// The run folder or the recording.
    path: Option<PathBuf>,
    /// The part of the data that is constant during the run, as JSON.
    about: Value,
    /// The group of each device, if the policy has groups.
    groups: Option<Vec<u32>>,
    state: Mutex<FeedState>,
    /// Length K of the run.
    ttis: u64,
    /// Number of devices N.
    devices: u32,
    /// The run that this one is compared with.
    compared: Option<ComparedRun>,
    timeline: TimelineCursor,
    /// Notified when new data has arrived.
    pub changed: Notify,
    /// Whether no more frames will come.
    is_over: AtomicBool,
    /// Whether the base station is on the bus; always true for a recording.
    is_reachable: AtomicBool,
}

/// A recording that a run is compared with.
pub(crate) struct ComparedRun {
    /// Its data.
    pub feed: Arc<Feed>,
    /// The scenario fields in which the two runs differ.
    pub fields: Vec<FieldDifference>,
    /// The comparison, which already contains the whole recording.
    pub comparison: RunComparison,
}

struct FeedState {
    history: RunHistory,
    comparison: Option<RunComparison>,
    traffic: TrafficStats,
    curves: Curves,
    /// The reason why the feed is broken: the states no longer follow the run. `None` if they do.
    broken_reason: Option<String>,
    /// Outcomes so far of the current event.
    event_outcomes: Vec<String>,
    events: EventLog,
    /// Time of the first grant, and of the end of the feed.
    started: Option<Instant>,
    ended: Option<Instant>,
}

/// Sends frames to a feed.
#[derive(Clone)]
pub(crate) struct FeedHandle(SyncSender<FeedItem>);

enum FeedItem {
    Frame(Frame),
    /// The last item.
    End,
}

impl FeedHandle {
    /// Queues a frame and blocks while the queue is full. Returns false once the receiver has ended.
    pub(crate) fn send(&self, frame: Frame) -> bool {
        self.0.send(FeedItem::Frame(frame)).is_ok()
    }

    /// Ends the feed after the queued frames.
    pub(crate) fn end(&self) {
        let _gone = self.0.send(FeedItem::End).is_err();
    }
}

impl Feed {
    /// Creates the feed of the run called `run`, of `scenario`. The feed of a recording keeps all TTIs.
    pub(crate) fn new(
        run: &str,
        scenario: &Scenario,
        groups: Option<Vec<u32>>,
        origin: FeedOrigin<'_>,
        mut compared: Option<ComparedRun>,
    ) -> Arc<Self> {
        let deployment = Deployment::new(scenario);
        let positions = deployment.positions();
        let is_live = !matches!(origin, FeedOrigin::Recording(_));
        let path = match origin {
            FeedOrigin::OwnRun(path) | FeedOrigin::Recording(path) => {
                Some(std::path::absolute(path).unwrap_or_else(|_| path.to_owned()))
            }
            FeedOrigin::OtherRun => None,
        };
        let e_max: Vec<Energy> = deployment.devices.iter().map(|device| device.energy.e_max).collect();
        let about = json!({
            "run": run,
            "policy": scenario.policy.name(),
            "preset": preset_label(scenario),
            "seed": scenario.run.seed,
            "devices": scenario.run.devices,
            "ttis": scenario.run.ttis,
            "warm_up_end": scenario.warm_up_end(),
            "area": [scenario.area.width, scenario.area.height],
            "d_max": scenario.sensing.d_max,
            "positions": positions,
            "cells": voronoi_cells(&positions, scenario.area),
            "groups": groups,
            "e_max": e_max.iter().map(|energy| energy.units()).collect::<Vec<_>>(),
            "classes": scenario.classes.iter().map(|class| &class.name).collect::<Vec<_>>(),
            "device_classes": deployment.classes,
            "path": path,
            "is_whole_wall_time": matches!(origin, FeedOrigin::OwnRun(_)),
            "curves": CURVE_METRICS,
            "live": is_live,
            "compared": compared.is_some(),
        });
        let max_ttis = if is_live { MAX_LIVE_TTIS } else { u64::MAX };
        Arc::new(Self {
            e_max,
            path,
            about,
            groups,
            state: Mutex::new(FeedState {
                comparison: compared
                    .as_mut()
                    .map(|compared| std::mem::take(&mut compared.comparison)),
                history: RunHistory::new(scenario, max_ttis),
                traffic: TrafficStats::default(),
                curves: Curves::new(scenario.run.ttis),
                broken_reason: None,
                event_outcomes: Vec::new(),
                events: EventLog::new(positions),
                started: None,
                ended: None,
            }),
            ttis: scenario.run.ttis,
            devices: scenario.run.devices,
            compared,
            timeline: TimelineCursor::default(),
            changed: Notify::new(),
            is_over: AtomicBool::new(false),
            is_reachable: AtomicBool::new(true),
        })
    }

    /// Starts a thread that applies the frames sent through the returned handle. It ends the feed at
    /// [`FeedHandle::end`], or once all clones of the handle are dropped.
    ///
    /// # Errors
    /// If no thread can be started.
    pub(crate) fn open(self: &Arc<Self>) -> std::io::Result<FeedHandle> {
        let (sender, frames) = sync_channel(QUEUE_CAPACITY);
        let (feed, mut batches) = (Arc::clone(self), BatchReceiver::new(frames));
        let receive_loop = move || {
            lower_priority();
            let mut is_over = false;
            loop {
                match batches.next_batch(POLL_INTERVAL) {
                    Ok(batch) => {
                        let mut state = feed.lock();
                        for item in batch {
                            match item {
                                FeedItem::Frame(frame) => state.apply(frame),
                                FeedItem::End => is_over = true,
                            }
                        }
                    }
                    Err(RecvTimeoutError::Timeout) => continue,
                    Err(RecvTimeoutError::Disconnected) => is_over = true,
                }
                if is_over {
                    feed.end();
                    return;
                }
                feed.changed.notify_waiters();
            }
        };
        std::thread::Builder::new()
            .name("dashboard".to_owned())
            .spawn(receive_loop)?;
        Ok(FeedHandle(sender))
    }

    /// Applies the next frame to the history, the curves and the counts. Not for a feed with a thread ([`Self::open`]).
    pub(crate) fn apply(&self, frame: Frame) {
        self.lock().apply(frame);
    }

    /// Marks the feed as broken, for the given reason: the rest of the run is unreadable.
    pub(crate) fn mark_broken(&self, reason: String) {
        self.lock().broken_reason = Some(reason);
    }

    /// Records whether the base station is on the bus.
    pub(crate) fn set_reachable(&self, is_reachable: bool) {
        self.is_reachable.store(is_reachable, Ordering::Relaxed);
        self.changed.notify_waiters();
    }

    /// Ends the feed: no more frames come. Call it once.
    pub(crate) fn end(&self) {
        let mut state = self.lock();
        state.ended = Some(crate::runtime::now());
        // A run that was cut short cannot be compared beyond its end.
        let is_whole = state.history.available_ttis().1.0 >= self.ttis;
        if let Some(comparison) = state.comparison.as_mut().filter(|_| is_whole) {
            comparison.end(RunSide::This);
        }
        // Released before the notification: the readers that it wakes take the lock.
        drop(state);
        self.is_over.store(true, Ordering::Relaxed);
        self.changed.notify_waiters();
    }

    /// The data that is constant during the run.
    pub(crate) const fn about(&self) -> &Value {
        &self.about
    }

    /// The run folder or the recording; `None` for a run of another process.
    pub(crate) fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// The available TTIs and the latest states.
    pub(crate) fn current_json(&self) -> Value {
        let mut state = self.lock();
        let (first, next) = state.history.available_ttis();
        let snapshot = state.history.latest();
        let mut now = self.snapshot_json(Tti(next.0.saturating_sub(1)), &snapshot);
        let events = state.history.reconstruction().events();
        now["first"] = json!(first);
        now["next"] = json!(next);
        now["over"] = json!(self.is_over.load(Ordering::Relaxed));
        now["reachable"] = json!(self.is_reachable.load(Ordering::Relaxed));
        now["broken"] = json!(state.broken_reason);
        now["events"] = json!(events.events);
        now["missed"] = json!(events.misdetected);
        now["last_events"] = state.events.last_events(Tti(next.0.saturating_sub(1)));
        let wall_time = |started: Instant| state.ended.unwrap_or_else(crate::runtime::now) - started;
        now["wall_s"] = json!(state.started.map(|started| wall_time(started).as_secs_f64()));
        now["messages"] = json!(state.traffic.kinds().map(|(_, count)| count.messages).sum::<u64>());
        now
    }

    /// The data of TTI `tti`, if it is available.
    pub(crate) fn tti_json(&self, tti: Tti) -> Option<Value> {
        let state = self.lock();
        let snapshot = state.history.snapshot_at(tti)?;
        let last_events = state.events.last_events(tti);
        drop(state);
        let mut moment = self.snapshot_json(tti, &snapshot);
        moment["last_events"] = last_events;
        Some(moment)
    }

    fn snapshot_json(&self, tti: Tti, snapshot: &TtiSnapshot) -> Value {
        let woken: Vec<Value> = snapshot
            .woken
            .iter()
            .map(|(device, outcome)| json!({ "device": device, "outcome": outcome, "text": outcome.to_string() }))
            .collect();
        json!({
            "tti": tti,
            "states": state_codes(&snapshot.views),
            "batteries": self.batteries(&snapshot.views),
            "on": snapshot.planned_on.iter().map(|on| if *on { '1' } else { '0' }).collect::<String>(),
            "event": snapshot.event,
            "ended": snapshot.ended_event.map(|record| json!({
                "event": record.event,
                "delay": record.delay(),
                "cause": cause_text(&record),
                "information": record.tally.information(),
                "reports": record.tally.reports,
                "wake_ups": record.tally.wake_ups,
            })),
            "reported": snapshot.reporters,
            "lost": snapshot.lost_report_senders,
            "failed": snapshot.failed_reporters,
            "woken": woken,
            "belief": snapshot.belief.as_ref().map(|belief| &belief.places),
        })
    }

    /// Whether the feed has received all TTIs of the run.
    pub(crate) fn is_whole(&self) -> bool {
        self.lock().history.available_ttis().1.0 >= self.ttis
    }

    /// The run that this one is compared with, if any.
    pub(crate) fn compared_feed(&self) -> Option<&Self> {
        self.compared.as_ref().map(|compared| &*compared.feed)
    }

    /// Returns an object with the compared run's constant data, the fields of the scenarios that differ, the end of the
    /// compared TTIs, and the first difference of each kind of message; `None` without a compared run.
    pub(crate) fn comparison_json(&self) -> Option<Value> {
        let ComparedRun { feed, fields, .. } = self.compared.as_ref()?;
        let state = self.lock();
        let comparison = state.comparison.as_ref()?;
        let difference_json = |difference: &FirstDifference| {
            json!({
                "tti": difference.tti,
                "kind": difference.kind.name(),
                "this": difference.describe(RunSide::This),
                "other": difference.describe(RunSide::Other),
                "devices": difference.devices(),
            })
        };
        // The counts of both runs cover the same TTIs, also if this run is active or was cut short.
        let end = state.history.available_ttis().1;
        let last = Tti(end.0.saturating_sub(1));
        let (events, missed) = feed.lock().events.counted_until(last);
        Some(json!({
            "other": feed.about,
            "other_events": events,
            "other_missed": missed,
            "fields": fields,
            // A side that has ended counts as compared to `NEVER`; the run's own end limits that.
            "compared": comparison.compared_until().min(end),
            "differences": comparison.differences().into_iter().map(difference_json).collect::<Vec<_>>(),
        }))
    }

    /// The devices of a group of the policy; `None` if the group does not exist.
    pub(crate) fn group(&self, number: u32) -> Option<Vec<DeviceId>> {
        let ids = (0..).map(DeviceId).zip(self.groups.as_ref()?);
        let members: Vec<DeviceId> = ids.filter(|(_, group)| **group == number).map(|(id, _)| id).collect();
        (!members.is_empty()).then_some(members)
    }

    /// The points of all curves so far. The last point has the same frames as [`Self::current_json`].
    pub(super) fn curves(&self) -> Vec<CurvePoint> {
        let state = &mut *self.lock();
        state.curves.points(&mut state.history, &state.traffic)
    }

    /// The ended events of the TTIs from `from` up to but excluding `end`.
    pub(crate) fn events_json(&self, from: Tti, end: Tti) -> Value {
        self.lock().events.overlapping(from, end)
    }

    /// The next misdetection after TTI `tti`, or the previous one before it; JSON null without one.
    pub(crate) fn miss_json(&self, tti: Tti, is_next: bool) -> Value {
        let state = self.lock();
        let miss = if is_next {
            state.events.miss_after(tti)
        } else {
            state.events.miss_before(tti)
        };
        json!(miss)
    }

    /// Sums from TTI 0 to TTI `tti` of each device: TTIs in S1, and ended events and misdetections nearest to it.
    /// `None` if the TTI is not available.
    pub(crate) fn heat_json(&self, tti: Tti) -> Option<Value> {
        let state = self.lock();
        let mut run = state.history.run_until(tti)?;
        let (near_counts, near_miss_counts) = state.events.counts_until(tti);
        // The totals of many devices take long, and the run's frames wait for this lock.
        drop(state);
        let devices = run.mirror_mut().views_and_totals_at(tti);
        // Without energy, a TTI of δ = 1 is no look.
        let looks = devices
            .iter()
            .map(|(_, totals)| totals.sensing_ttis - totals.failed_ttis);
        let looks: Vec<u64> = looks.collect();
        Some(json!({ "tti": tti, "looks": looks, "events": near_counts, "misses": near_miss_counts }))
    }

    /// Encodes a part of the timeline; `None` if none of its TTIs is available.
    pub(super) fn timeline(&self, request: &TimelineRequest) -> Option<Vec<u8>> {
        // Only the copy holds the lock. The states are computed without it.
        let span = self.timeline.copy_span(&self.lock().history, request)?;
        Some(self.timeline.encode(request, span, &self.e_max))
    }

    /// Number of devices N.
    pub(crate) fn devices(&self) -> u32 {
        self.devices
    }

    /// Calls `read` with the run's history.
    pub(crate) fn history<T>(&self, read: impl FnOnce(&RunHistory) -> T) -> T {
        read(&self.lock().history)
    }

    fn lock(&self) -> MutexGuard<'_, FeedState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The batteries, two hexadecimal digits per device: 00 to ff of its E_max.
    fn batteries(&self, views: &[DeviceView]) -> String {
        let level = |(view, e_max): (&DeviceView, &Energy)| format!("{:02x}", battery_byte(view.battery, *e_max));
        views.iter().zip(&self.e_max).map(level).collect()
    }
}

impl FeedState {
    fn apply(&mut self, frame: Frame) {
        // Only between two grants: the outcomes of a grant, such as the end of an event, follow its first frame.
        let is_between_grants = matches!(frame.kind, MessageKind::Plan | MessageKind::World);
        if is_between_grants {
            self.curves.update(&mut self.history, &self.traffic);
        }
        self.traffic.count(&frame);
        if self.broken_reason.is_some() {
            // Later frames do not follow from the last known states.
            return;
        }
        if frame.kind == MessageKind::World {
            self.started.get_or_insert_with(crate::runtime::now);
        }
        self.record_outcome(&frame);
        if let Some(comparison) = &mut self.comparison {
            comparison.push(RunSide::This, &frame);
        }
        if let Err(error) = self.history.push(frame) {
            self.broken_reason = Some(format!(
                "device states are unknown from here on: {error}; restart the dashboard"
            ));
        }
    }

    /// Records the outcome that `frame` reports for an event.
    fn record_outcome(&mut self, frame: &Frame) {
        let is_outcome = matches!(
            frame.kind,
            MessageKind::Event | MessageKind::Report | MessageKind::Lost | MessageKind::Failed | MessageKind::Woken
        );
        let (true, Ok(message)) = (is_outcome, frame.message()) else {
            return;
        };
        let device = frame
            .number
            .map_or_else(String::new, |number| format!("device {number}"));
        if let Message::Event(EventUpdate::Started(_)) = message {
            self.event_outcomes.clear();
        } else if let Message::Event(EventUpdate::Ended(record)) = message {
            let (first, _) = self.history.available_ttis();
            self.events
                .push(record, std::mem::take(&mut self.event_outcomes), first);
        } else if let Message::Report(_) = message {
            self.event_outcomes.push(format!("{device} reported"));
        } else if let Message::Lost(_) = message {
            self.event_outcomes.push(format!("{device} reported, report lost"));
        } else if let Message::Failed(_) = message {
            self.event_outcomes.push(format!("{device} lacked energy to report"));
        } else if let Message::Woken(woken) = message {
            let outcome = match woken.outcome {
                WakeOutcome::Reported(_) => {
                    // The frame of its report came first, and was recorded as a report without a wake-up. The other
                    // outcomes of a wake-up have no separate frame.
                    self.event_outcomes.pop();
                    "woken"
                }
                WakeOutcome::Failed(_) => "woken, lacked energy to report",
                WakeOutcome::Missed => "missed the wake-up",
                WakeOutcome::Lost(_) => "woken, report lost",
                WakeOutcome::Late { .. } => "woken too late",
            };
            self.event_outcomes.push(format!("{device} {outcome}"));
        }
    }
}

/// The codes of the states, one character per device: `1` S1, `2` S2, `3` S3, `4` S4, `0` S4 without power for the
/// wake-up radio, `x` failed by an operator. `page/*.js` and `tests/program/dashboard.rs` read them.
pub(super) fn state_codes(views: &[DeviceView]) -> String {
    let code = |view: &DeviceView| match view.state {
        DeviceState::Idle => '1',
        DeviceState::Active => '2',
        DeviceState::Transmission => '3',
        DeviceState::Sleep { powered: true } => '4',
        DeviceState::Sleep { powered: false } => '0',
        DeviceState::Failed => 'x',
    };
    views.iter().map(code).collect()
}

#[cfg(test)]
mod tests;
