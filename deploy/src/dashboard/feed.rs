//! What the dashboard knows of a run: its story so far, curves over it, and where it is now.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use reveille_common::deployment::Deployment;
use reveille_common::geometry::cells;
use reveille_common::ids::Tti;
use reveille_common::message::{EventNews, Frame, Message, MessageKind, WakeOutcome};
use reveille_common::scenario::Scenario;
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::units::Energy;
use reveille_view::story::Story;
use reveille_view::traffic::Traffic;
use serde_json::{Value, json};
use tokio::sync::Notify;

/// TTIs of a run that goes on that can be looked at again.
const LIVE: u64 = 100_000;
/// Frames that may wait to be taken in.
const QUEUE: usize = 65_536;
/// Points of a curve, about.
const POINTS: u64 = 400;
/// Time between two points of a curve of a run that goes on, at least.
const BEAT: Duration = Duration::from_millis(100);
/// Metrics that have a curve.
const CURVES: [&str; 6] = [
    "info_p1",
    "misdetection_pct",
    "detection_delay_ttis",
    "energy_sensing_per_device_tti",
    "energy_sleep_per_device_tti",
    "energy_report_per_device_tti",
];
/// Events that are told of.
const TICKER: usize = 6;
/// Quantiles of batteries that have a curve.
const QUANTILES: [f64; 3] = [0.05, 0.5, 0.95];

/// A run, to be looked at by many.
pub struct Feed {
    scenario: Scenario,
    is_live: bool,
    e_max: Energy,
    /// What does not change in a run.
    about: Value,
    known: Mutex<Known>,
    /// Rung when something has come.
    pub bell: Notify,
    /// Whether no more comes.
    is_over: AtomicBool,
}

struct Known {
    story: Story,
    traffic: Traffic,
    /// A point of every curve.
    points: Vec<Value>,
    due: Tti,
    /// When the last point was made.
    told: Instant,
    /// Why states are not those of the run any more, if it is so.
    broken: Option<String>,
    /// What came of the event under way.
    under_way: Vec<String>,
    /// What came of the last events, the latest first.
    ticker: VecDeque<Value>,
}

/// Hands frames to a feed.
#[derive(Clone)]
pub struct Hose(SyncSender<Frame>);

impl Hose {
    /// Takes in a frame; waits while too many are waiting.
    pub fn take(&self, frame: Frame) {
        let _gone = self.0.send(frame).is_err();
    }
}

impl Feed {
    /// The feed of the run called `run`, of `scenario`. `is_live` where it goes on; of a recording all is kept.
    pub fn new(run: &str, scenario: &Scenario, groups: Option<&[u32]>, is_live: bool) -> Arc<Self> {
        let deployment = Deployment::new(scenario);
        let positions = deployment.positions();
        let e_max: Vec<f64> = deployment
            .devices
            .iter()
            .map(|device| device.energy.e_max.units())
            .collect();
        let about = json!({
            "run": run,
            "policy": scenario.policy.name(),
            "preset": scenario.preset,
            "seed": scenario.seed,
            "devices": scenario.devices,
            "ttis": scenario.ttis,
            "warm_up_end": scenario.warm_up_end(),
            "area": [scenario.area.width, scenario.area.height],
            "d_max": scenario.sensing.d_max,
            "positions": positions,
            "cells": cells(&positions, scenario.area),
            "groups": groups,
            "e_max": e_max,
            "curves": CURVES,
            "live": is_live,
        });
        let length = if is_live { LIVE } else { u64::MAX };
        let e_max = deployment.devices.iter().map(|device| device.energy.e_max).max();
        Arc::new(Self {
            scenario: scenario.clone(),
            is_live,
            e_max: e_max.unwrap_or(Energy::ZERO),
            about,
            known: Mutex::new(Known {
                story: Story::new(scenario, length),
                traffic: Traffic::default(),
                points: Vec::new(),
                due: Tti::ZERO,
                told: crate::wall::now(),
                broken: None,
                under_way: Vec::new(),
                ticker: VecDeque::new(),
            }),
            bell: Notify::new(),
            is_over: AtomicBool::new(false),
        })
    }

    /// Starts a thread that takes in what comes through the hose, until that is gone.
    ///
    /// # Errors
    /// If no thread can be started.
    pub fn open(self: &Arc<Self>) -> std::io::Result<Hose> {
        let (send, frames): (_, Receiver<Frame>) = sync_channel(QUEUE);
        let feed = Arc::clone(self);
        let take = move || {
            while let Ok(frame) = frames.recv() {
                feed.take(frame);
                feed.bell.notify_waiters();
            }
            feed.end();
        };
        std::thread::Builder::new().name("dashboard".to_owned()).spawn(take)?;
        Ok(Hose(send))
    }

    /// Takes in a frame.
    pub fn take(&self, frame: Frame) {
        let mut known = self.known();
        known.traffic.count(&frame);
        known.tick(&frame);
        if let Err(error) = known.story.take(frame) {
            known.broken.get_or_insert_with(|| error.to_string());
        }
        let (_, next) = known.story.span();
        // While a run goes on, nobody sees more points in a second.
        let is_soon = self.is_live && known.told.elapsed() < BEAT;
        if next >= known.due && next > Tti::ZERO && !is_soon {
            known.told = crate::wall::now();
            let point = known.point(next);
            known.points.push(point);
            known.due = next + (self.scenario.ttis / POINTS).max(1);
        }
    }

    /// No more comes.
    pub fn end(&self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.bell.notify_waiters();
    }

    /// What does not change in the run.
    pub const fn about(&self) -> &Value {
        &self.about
    }

    /// Where the run is: the TTIs that can be looked at, and the states of the last.
    pub fn now(&self) -> Value {
        let mut known = self.known();
        let (first, next) = known.story.span();
        let views = known.story.views();
        let events = known.story.now().events();
        json!({
            "first": first,
            "next": next,
            "over": self.is_over.load(Ordering::Relaxed),
            "broken": known.broken,
            "states": states(&views),
            "batteries": self.batteries(&views),
            "event": known.story.now().stimulus(),
            "events": events.events,
            "missed": events.misdetected,
            "ticker": known.ticker,
            "messages": known.traffic.kinds().map(|(_, count)| count.messages).sum::<u64>(),
        })
    }

    /// TTI `tti`, if it can be looked at.
    pub fn at(&self, tti: Tti) -> Option<Value> {
        let moment = self.known().story.at(tti)?;
        let woken: Vec<Value> = moment
            .woken
            .iter()
            .map(|(device, outcome)| json!({ "device": device, "outcome": outcome, "text": outcome.to_string() }))
            .collect();
        Some(json!({
            "tti": tti,
            "states": states(&moment.views),
            "batteries": self.batteries(&moment.views),
            "on": moment.on.iter().map(|on| if *on { '1' } else { '0' }).collect::<String>(),
            "event": moment.event,
            "ended": moment.ended.map(|record| json!({
                "event": record.event,
                "delay": record.delay(),
                "information": record.tally.information(),
                "reports": record.tally.reports,
                "wake_ups": record.tally.wake_ups,
            })),
            "reported": moment.reported,
            "failed": moment.failed,
            "woken": woken,
        }))
    }

    /// The points of all curves so far.
    pub fn curves(&self) -> Value {
        json!(self.known().points)
    }

    /// Does `look` with the story.
    pub fn story<T>(&self, look: impl FnOnce(&Story) -> T) -> T {
        look(&self.known().story)
    }

    fn known(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Two hexadecimal digits a device: its battery, 00 to ff of the largest E_max.
    fn batteries(&self, views: &[DeviceView]) -> String {
        let most = self.e_max.micro().max(1);
        let level = |view: &DeviceView| format!("{:02x}", (view.battery.micro() * 255).div_ceil(most).min(255));
        views.iter().map(level).collect()
    }
}

impl Known {
    /// Notes what `frame` tells of events.
    fn tick(&mut self, frame: &Frame) {
        let is_news = matches!(
            frame.kind,
            MessageKind::Event | MessageKind::Report | MessageKind::Failed | MessageKind::Woken
        );
        let (true, Ok(message)) = (is_news, frame.message()) else {
            return;
        };
        let whose = frame.number.map_or_else(String::new, |number| number.to_string());
        if let Message::Event(EventNews::Started(_)) = message {
            self.under_way.clear();
        } else if let Message::Event(news) = message {
            let (tti, text) = (frame.tti, news.to_string());
            self.ticker
                .push_front(json!({ "tti": tti, "text": text, "who": self.under_way }));
            self.ticker.truncate(TICKER);
        } else if let Message::Report(_) = message {
            self.under_way.push(format!("{whose} reported"));
        } else if let Message::Failed(_) = message {
            self.under_way.push(format!("{whose} could not pay"));
        } else if let Message::Woken(woken) = message {
            let came = match woken.outcome {
                WakeOutcome::Reported(_) => {
                    // Its report was noted before.
                    self.under_way.pop();
                    "woken"
                }
                WakeOutcome::Failed(_) => "woken and could not pay",
                WakeOutcome::Unheard => "did not hear",
            };
            self.under_way.push(format!("{whose} {came}"));
        }
    }

    /// A point of every curve, before TTI `next`.
    fn point(&mut self, next: Tti) -> Value {
        let views = self.story.views();
        let mut levels: Vec<Energy> = views.iter().map(|view| view.battery).collect();
        levels.sort_unstable();
        let quantile = |share: f64| {
            let at = (share * levels.len().saturating_sub(1) as f64).round() as usize;
            levels.get(at).map(|level| level.units())
        };
        let metrics = self.story.now().clone().finish().metrics;
        let value = |name: &str| metrics.value(name).filter(|value| value.is_finite());
        let ttis = self.traffic.ttis().max(1) as f64;
        json!({
            "tti": next,
            "metrics": CURVES.map(value),
            "batteries": QUANTILES.map(quantile),
            "control": self.traffic.control().bytes as f64 / ttis,
            "uplink": self.traffic.uplink().bytes as f64 / ttis,
        })
    }
}

/// A letter a device: `1` S1, `2` S2, `3` S3, `4` S4, `0` S4 without power for the wake-up radio.
pub(super) fn states(views: &[DeviceView]) -> String {
    let letter = |view: &DeviceView| match view.state {
        DeviceState::Idle => '1',
        DeviceState::Active => '2',
        DeviceState::Transmission => '3',
        DeviceState::Sleep { powered: true } => '4',
        DeviceState::Sleep { powered: false } => '0',
    };
    views.iter().map(letter).collect()
}
