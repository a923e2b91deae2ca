//! A policy that makes no decision itself: somebody outside is asked for each.
//!
//! A driver of the cycle asks, and goes on when it has an answer; the cycle never waits.
//!
//! ```text
//!            Stage::Plan                      Stage::Wake
//!   TTI k ─────────────► δ ──► reports? ──yes──────────────► whom? ──► each is woken ──┐
//!     ▲                           │ no            ▲            │ nobody, or nobody left │
//!     └───────────────────────────┴───────────────┼────────────┘                        │
//!                                                 └─────────────────────────────────────┘
//! ```
//! On the bus, the host of the base station asks ([`wire`] is what is said there); in memory, whoever steps the run;
//! and where decisions were kept, nobody needs to be asked.
//!
//! An answer cannot break a run: it is projected on what can be done. A δ plan is fitted to the devices
//! ([`Decision::plan`]). Of the wake-ups, those of devices that were not told to sleep, that were woken in this TTI
//! before, or that do not exist are dropped ([`Question::may_wake`]); an answer of which nothing is left ends the
//! wake-ups of the TTI. A device that cannot pay may be told to sense or woken, as by any policy: its action fails.

mod features;
mod memory;
mod question;
pub mod wire;

use std::collections::VecDeque;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};

pub use self::features::{DEVICE, Feature, GLOBAL};
pub use self::memory::Memory;
pub use self::question::{Answer, Answered, Decision, Question, Stage};
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// What has been asked and answered so far.
#[derive(Clone, Debug)]
pub struct External {
    /// The answer for the coming TTI.
    told: Option<Decision>,
    /// The TTI in which the next plan is asked for.
    next: Tti,
    /// See [`Question::heard`].
    heard: Vec<Report>,
    /// See [`Question::woken`].
    woken: Vec<bool>,
    /// Devices that are still to be woken.
    queue: VecDeque<DeviceId>,
    /// Whether no more wake-ups are asked for in this TTI.
    is_done: bool,
    memory: Memory,
}

impl External {
    /// Before TTI 0, for the devices in `known`.
    pub fn new(known: &Knowledge) -> Self {
        Self {
            told: None,
            next: Tti::ZERO,
            heard: Vec::new(),
            woken: vec![false; known.n()],
            queue: VecDeque::new(),
            is_done: true,
            memory: Memory::new(known),
        }
    }

    /// Whether a plan is to be told before TTI `k` begins.
    pub fn asks_for_plan(&self, k: Tti) -> bool {
        self.told.is_none() && k >= self.next
    }

    /// Whether it is to be told whom to wake in the TTI of `seen`: something was heard, there is somebody to wake, and
    /// the last answer was not empty.
    pub fn asks_whom(&self, seen: &Observation<'_>) -> bool {
        let mut devices = (0..self.woken.len() as u32).map(DeviceId);
        !self.is_done && self.queue.is_empty() && devices.any(|j| question::may_wake(seen, &self.woken, j))
    }

    /// The question of `stage` where the base station sees what is in `seen`.
    pub fn question<'a>(&'a self, stage: Stage, seen: Observation<'a>) -> Question<'a> {
        Question {
            stage,
            seen,
            heard: &self.heard,
            woken: &self.woken,
            memory: &self.memory,
        }
    }

    /// The answer at [`Stage::Plan`].
    pub fn tell_plan(&mut self, decision: Decision) {
        let Decision { plan, next } = decision;
        let plan = fitted(&plan, self.woken.len() as u32);
        self.told = Some(Decision { plan, next });
    }

    /// The answer at [`Stage::Wake`]: wake these, one after the other in this order.
    pub fn tell_whom(&mut self, seen: &Observation<'_>, devices: &[DeviceId]) {
        for &device in devices {
            if question::may_wake(seen, &self.woken, device) {
                self.woken[device.index()] = true;
                self.queue.push_back(device);
            }
        }
        self.is_done = self.queue.is_empty();
    }

    /// The plan that was told for the TTI of `seen`.
    ///
    /// # Panics
    /// If none was.
    pub fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        let Decision { plan, next } = self.told.take().expect("a driver tells the plan that is asked for");
        self.next = next.max(seen.now + 1);
        plan
    }

    /// The TTI in which the next plan is asked for.
    pub const fn next_decision(&self) -> Tti {
        self.next
    }

    /// The TTI has brought these reports, at least one.
    pub fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        self.memory.pass(seen.now, seen.plan);
        self.memory.hear_first(reports);
        self.heard.clear();
        self.heard.extend_from_slice(reports);
        self.woken.fill(false);
        self.queue.clear();
        self.is_done = false;
    }

    /// The next of those that are to be woken.
    pub fn next_wake_up(&mut self) -> Option<DeviceId> {
        self.queue.pop_front()
    }

    /// The TTIs before `end` are closed; those that were not before have passed under `plan`.
    pub fn closed(&mut self, end: Tti, plan: &Plan) {
        self.memory.pass(end, plan);
    }

    /// What the last wake-up brought.
    pub fn answered(&mut self, report: Option<&Report>) {
        if let Some(report) = report {
            self.memory.hear(report);
            self.heard.push(*report);
        }
    }
}

/// `plan` for the devices 0 to `devices` − 1.
fn fitted(plan: &Plan, devices: u32) -> Plan {
    let cycles = (0..devices).map(|j| plan.duty_cycle(DeviceId(j)));
    match plan {
        Plan::Bits { .. } => Plan::from_bits(cycles.map(|cycle| cycle == DutyCycle::SENSING)),
        Plan::Periodic(_) => Plan::Periodic(cycles.collect()),
    }
}
