//! What the dashboard knows of a run: its story so far, curves over it, and where it is now.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use reveille_common::deployment::Deployment;
use reveille_common::geometry::cells;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{EventNews, Frame, Message, MessageKind, WakeOutcome};
use reveille_common::scenario::Scenario;
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::units::Energy;
use reveille_view::batches::{Batches, step_back};
use reveille_view::compare::{Comparison, Difference, Field, Side};
use reveille_view::story::{Moment, Story};
use reveille_view::traffic::Traffic;
use serde_json::{Value, json};
use tokio::sync::Notify;

/// TTIs of a run that goes on that can be looked at again.
const LIVE: u64 = 100_000;
/// Frames that may wait to be taken in.
const QUEUE: usize = 65_536;
/// How long to wait for a frame at a time.
const IDLE: Duration = Duration::from_secs(1);
/// The most points of a curve; with more, every other one is left out.
const POINTS: usize = 800;
/// TTIs from one point to the next at first, in a run that is long enough.
const SPACING: u64 = 10;
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
    e_max: Energy,
    /// What does not change in a run.
    about: Value,
    /// The group of each device, where the policy has groups.
    groups: Option<Vec<u32>>,
    known: Mutex<Known>,
    /// Length K of the run.
    ttis: u64,
    /// The run that it is compared with.
    beside: Option<Beside>,
    /// Rung when something has come.
    pub bell: Notify,
    /// Whether no more comes.
    is_over: AtomicBool,
}

/// A recording that a run is compared with.
pub struct Beside {
    /// What is known of it.
    pub feed: Arc<Feed>,
    /// The fields of the scenario in which they differ.
    pub fields: Vec<Field>,
    /// The comparison, with all of the recording taken in.
    pub comparison: Comparison,
}

struct Known {
    story: Story,
    comparison: Option<Comparison>,
    traffic: Traffic,
    /// A point of every curve.
    points: Vec<Value>,
    /// TTIs from one point to the next.
    spacing: u64,
    due: Tti,
    /// Why states are not those of the run any more, if it is so.
    broken: Option<String>,
    /// What came of the event under way.
    under_way: Vec<String>,
    /// What came of the last events, the latest first.
    ticker: VecDeque<Value>,
}

/// Hands frames to a feed.
#[derive(Clone)]
pub struct Hose(SyncSender<Item>);

enum Item {
    Frame(Frame),
    /// No more comes.
    End,
}

impl Hose {
    /// Takes in a frame; waits while too many are waiting. False once nobody takes them any more.
    pub fn take(&self, frame: Frame) -> bool {
        self.0.send(Item::Frame(frame)).is_ok()
    }

    /// No more comes: what is waiting is still taken in.
    pub fn end(&self) {
        let _gone = self.0.send(Item::End).is_err();
    }
}

impl Feed {
    /// The feed of the run called `run`, of `scenario`. `is_live` where it goes on; of a recording all is kept.
    pub fn new(
        run: &str,
        scenario: &Scenario,
        groups: Option<Vec<u32>>,
        is_live: bool,
        mut beside: Option<Beside>,
    ) -> Arc<Self> {
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
            "compared": beside.is_some(),
        });
        let length = if is_live { LIVE } else { u64::MAX };
        let e_max = deployment.devices.iter().map(|device| device.energy.e_max).max();
        Arc::new(Self {
            e_max: e_max.unwrap_or(Energy::ZERO),
            about,
            groups,
            known: Mutex::new(Known {
                comparison: beside.as_mut().map(|beside| std::mem::take(&mut beside.comparison)),
                story: Story::new(scenario, length),
                traffic: Traffic::default(),
                points: Vec::new(),
                spacing: (scenario.ttis / POINTS as u64).clamp(1, SPACING),
                due: Tti::ZERO,
                broken: None,
                under_way: Vec::new(),
                ticker: VecDeque::new(),
            }),
            ttis: scenario.ttis,
            beside,
            bell: Notify::new(),
            is_over: AtomicBool::new(false),
        })
    }

    /// Starts a thread that takes in what comes through the hose, until that is gone.
    ///
    /// # Errors
    /// If no thread can be started.
    pub fn open(self: &Arc<Self>) -> std::io::Result<Hose> {
        let (send, frames) = sync_channel(QUEUE);
        let (feed, mut batches) = (Arc::clone(self), Batches::new(frames));
        let take = move || {
            step_back();
            let mut is_over = false;
            loop {
                match batches.next(IDLE) {
                    Ok(batch) => {
                        let mut known = feed.known();
                        for item in batch {
                            match item {
                                Item::Frame(frame) => known.take(frame),
                                Item::End => is_over = true,
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
                feed.bell.notify_waiters();
            }
        };
        std::thread::Builder::new().name("dashboard".to_owned()).spawn(take)?;
        Ok(Hose(send))
    }

    /// Takes in a frame.
    pub fn take(&self, frame: Frame) {
        self.known().take(frame);
    }

    /// What comes next cannot be read, for the reason given.
    pub fn tear(&self, why: String) {
        self.known().broken = Some(why);
    }

    /// No more comes.
    pub fn end(&self) {
        let mut known = self.known();
        let (_, next) = known.story.span();
        if next > Tti::ZERO {
            known.draw(next);
        }
        // What a run that was cut short would have done is not known.
        let is_whole = next.0 >= self.ttis;
        if let Some(comparison) = known.comparison.as_mut().filter(|_| is_whole) {
            comparison.end(Side::This);
        }
        drop(known);
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
        let moment = known.story.latest();
        let mut now = self.told(Tti(next.0.saturating_sub(1)), &moment);
        let events = known.story.now().events();
        now["first"] = json!(first);
        now["next"] = json!(next);
        now["over"] = json!(self.is_over.load(Ordering::Relaxed));
        now["broken"] = json!(known.broken);
        now["events"] = json!(events.events);
        now["missed"] = json!(events.misdetected);
        now["ticker"] = json!(known.ticker);
        now["messages"] = json!(known.traffic.kinds().map(|(_, count)| count.messages).sum::<u64>());
        now
    }

    /// TTI `tti`, if it can be looked at.
    pub fn at(&self, tti: Tti) -> Option<Value> {
        let moment = self.known().story.at(tti)?;
        Some(self.told(tti, &moment))
    }

    fn told(&self, tti: Tti, moment: &Moment) -> Value {
        let woken: Vec<Value> = moment
            .woken
            .iter()
            .map(|(device, outcome)| json!({ "device": device, "outcome": outcome, "text": outcome.to_string() }))
            .collect();
        json!({
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
            "lost": moment.lost,
            "failed": moment.failed,
            "woken": woken,
            "belief": moment.belief.as_ref().map(|belief| &belief.places),
        })
    }

    /// Whether all TTIs of the run were taken in.
    pub fn is_whole(&self) -> bool {
        self.known().story.span().1.0 >= self.ttis
    }

    /// The run that it is compared with, if there is one.
    pub fn other(&self) -> Option<&Self> {
        self.beside.as_ref().map(|beside| &*beside.feed)
    }

    /// Where it first differs from the run that it is compared with, if there is one.
    pub fn compared(&self) -> Option<Value> {
        let Beside { feed, fields, .. } = self.beside.as_ref()?;
        let known = self.known();
        let comparison = known.comparison.as_ref()?;
        let told = |difference: &Difference| {
            json!({
                "tti": difference.tti,
                "kind": difference.kind.name(),
                "this": difference.says(Side::This),
                "other": difference.says(Side::Other),
                "devices": difference.devices(),
            })
        };
        Some(json!({
            "other": feed.about,
            "fields": fields,
            "compared": comparison.compared().min(known.story.span().1),
            "differences": comparison.differences().into_iter().map(told).collect::<Vec<_>>(),
        }))
    }

    /// The devices of a group of the policy; nothing if it has none of that number.
    pub fn group(&self, number: u32) -> Option<Vec<DeviceId>> {
        let ids = (0..).map(DeviceId).zip(self.groups.as_ref()?);
        let own: Vec<DeviceId> = ids.filter(|(_, group)| **group == number).map(|(id, _)| id).collect();
        (!own.is_empty()).then_some(own)
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
    fn take(&mut self, frame: Frame) {
        self.traffic.count(&frame);
        if self.broken.is_some() {
            // Nothing that comes fits to what was before it any more.
            return;
        }
        self.tick(&frame);
        if let Some(comparison) = &mut self.comparison {
            comparison.take(Side::This, &frame);
        }
        if let Err(error) = self.story.take(frame) {
            self.broken = Some(format!(
                "states are not known any more: {error}; start the dashboard once more"
            ));
        }
        let (_, next) = self.story.span();
        if next >= self.due && next > Tti::ZERO {
            self.draw(next);
        }
    }

    /// Notes what `frame` tells of events.
    fn tick(&mut self, frame: &Frame) {
        let is_news = matches!(
            frame.kind,
            MessageKind::Event | MessageKind::Report | MessageKind::Lost | MessageKind::Failed | MessageKind::Woken
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
        } else if let Message::Lost(_) = message {
            self.under_way.push(format!("{whose} reported, and that was lost"));
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
                WakeOutcome::Lost(_) => "woken, and its report was lost",
                WakeOutcome::Late { .. } => "woken too late",
            };
            self.under_way.push(format!("{whose} {came}"));
        }
    }

    /// One more point of every curve, before TTI `next`.
    fn draw(&mut self, next: Tti) {
        let point = self.point(next);
        self.points.push(point);
        if self.points.len() > POINTS {
            let mut is_odd = false;
            self.points.retain(|_| {
                is_odd = !is_odd;
                is_odd
            });
            self.spacing *= 2;
        }
        self.due = next + self.spacing;
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
        let metrics = self.story.now().metrics();
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
