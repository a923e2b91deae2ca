//! The physical world of a run: when events start, where they are, who detects them, and when they end (Sec. II).
//!
//! The world is ground truth. A base station and its policies are never handed a [`World`]; the genie alone is told of
//! events, by the door [`Oracle`].

use crate::deployment::Deployment;
use crate::event::{ActiveEvent, EventProcess, Stimulus};
use crate::geometry::{Buckets, Point};
use crate::ids::{DeviceId, Tti};
use crate::plan::{DutyCycle, Plan};
use crate::radio::{Air, Moment};
use crate::scenario::Scenario;
use crate::sensing::Sensing;

/// Somebody who is told of every event when it starts, as no real base station is: the genie.
pub trait Oracle {
    /// An event has started. Whether anybody is to be woken for it in this TTI.
    fn told(&mut self, stimulus: &Stimulus) -> bool;

    /// Nothing was heard of the event, of which it was told, up to this TTI. Whether anybody is to be woken once more.
    fn is_told_again(&mut self) -> bool {
        false
    }
}

/// What the world does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Turn {
    /// An event has started, in its TTI `start`.
    Started(ActiveEvent),
    /// The event under way has ended without a report; this was its last TTI.
    Missed(Tti),
}

/// The event under way.
#[derive(Clone, Copy, Debug)]
struct Current {
    event: ActiveEvent,
    /// Whether the oracle wakes somebody in its first TTI.
    is_told: bool,
}

/// The world of one run.
#[derive(Clone, Debug)]
pub struct World {
    seed: u64,
    sensing: Sensing,
    positions: Vec<Point>,
    buckets: Buckets,
    process: EventProcess,
    air: Air,
    /// δ as the devices have it, where they may miss plans.
    heard: Option<Vec<DutyCycle>>,
    current: Option<Current>,
    /// Devices that detect the event under way in any TTI in which they have δ = 1.
    audience: Vec<DeviceId>,
    detectors: Vec<DeviceId>,
}

impl World {
    /// The world of `scenario` before TTI 0, with its devices as in `deployment`.
    pub fn new(scenario: &Scenario, deployment: &Deployment) -> Self {
        Self::with_events(
            scenario,
            deployment,
            EventProcess::new(scenario.seed, scenario.area, &scenario.events, Tti(scenario.ttis)),
        )
    }

    /// As [`Self::new`], with the events of `process`.
    pub fn with_events(scenario: &Scenario, deployment: &Deployment, process: EventProcess) -> Self {
        let positions = deployment.positions();
        Self {
            seed: scenario.seed,
            sensing: scenario.sensing.clone(),
            buckets: Buckets::new(&positions, scenario.area, scenario.sensing.d_max),
            air: Air::new(scenario.seed, &scenario.radio),
            heard: None,
            positions,
            process,
            current: None,
            audience: Vec::new(),
            detectors: Vec::new(),
        }
    }

    /// `plan` goes out on the air in TTI `from`. Gives how many devices miss it: they keep the one that they have.
    pub fn plan_sent(&mut self, from: Tti, plan: &Plan) -> u64 {
        if !self.air.loses_plans() {
            return 0;
        }
        let now = self.air.at(from);
        let heard = self
            .heard
            .get_or_insert_with(|| vec![DutyCycle::ASLEEP; self.positions.len()]);
        let mut missed = 0;
        for (cycle, device) in heard.iter_mut().zip((0..).map(DeviceId)) {
            if now.misses_plan(device) {
                missed += 1;
            } else {
                *cycle = plan.duty_cycle(device);
            }
        }
        missed
    }

    /// The air in TTI `k`, none before that of the last call.
    pub fn air(&mut self, k: Tti) -> Moment {
        self.air.at(k)
    }

    /// Plays the TTIs from `k` on, up to and not including `horizon`, until one in which a device may react to an event
    /// under `plan`; gives that TTI. `turns` are filled with what the world does on the way, in order.
    ///
    /// With an `oracle` nobody senses by itself, and the oracle alone reacts.
    pub fn play(
        &mut self,
        mut k: Tti,
        horizon: Tti,
        plan: &Plan,
        mut oracle: Option<&mut (impl Oracle + ?Sized)>,
        turns: &mut Vec<Turn>,
    ) -> Option<Tti> {
        self.detectors.clear();
        loop {
            let Some(Current { event, is_told }) = self.current else {
                k = self.process.next_start();
                if k >= horizon {
                    return None;
                }
                turns.push(Turn::Started(self.start(oracle.as_deref_mut())));
                continue;
            };
            let mut is_told_again = || oracle.as_deref_mut().is_some_and(Oracle::is_told_again);
            if is_told && (k == event.start || is_told_again()) {
                return Some(k);
            }
            let reaction = self.first_reaction(k, plan);
            if reaction <= event.last && reaction < horizon {
                return Some(reaction);
            }
            self.detectors.clear();
            if event.last >= horizon || reaction <= event.last {
                return None;
            }
            self.end(event.last);
            turns.push(Turn::Missed(event.last));
            k = event.last + 1;
        }
    }

    /// What the world shows the devices, while an event is under way.
    pub fn stimulus(&self) -> Option<Stimulus> {
        self.current.map(|current| current.event.stimulus)
    }

    /// The last TTI of the event under way, if nobody reports it; 0 while none is.
    pub fn until(&self) -> Tti {
        self.current.map_or(Tti::ZERO, |current| current.event.last)
    }

    /// The devices that detect the event in the TTI that [`Self::play`] gave, battery permitting, in no order.
    pub fn detectors(&self) -> &[DeviceId] {
        &self.detectors
    }

    /// Whether `device` is farther than d_max from the event under way.
    ///
    /// # Panics
    /// While no event is.
    pub fn is_far(&self, device: DeviceId) -> bool {
        let epicentre = self.stimulus().expect("an event is under way").epicentre;
        self.positions[device.index()].distance(epicentre) > self.sensing.d_max
    }

    /// TTI `tti` closes. Whether the event under way ends with it: it was reported, or this was its last TTI.
    pub fn close(&mut self, tti: Tti, is_reported: bool) -> bool {
        let ends = self
            .current
            .is_some_and(|current| is_reported || current.event.last == tti);
        if ends {
            self.end(tti);
        }
        ends
    }

    /// The first TTI from `k` on in which somebody of the audience has δ = 1; fills the detectors of that TTI. What a
    /// device has heard counts, `plan` or one before it.
    fn first_reaction(&mut self, k: Tti, plan: &Plan) -> Tti {
        let mut reaction = Tti::NEVER;
        for &device in &self.audience {
            let cycle = match &self.heard {
                None => plan.duty_cycle(device),
                Some(heard) => heard[device.index()],
            };
            let next_on = cycle.next_on(k);
            if next_on < reaction {
                self.detectors.clear();
                reaction = next_on;
            }
            if next_on == reaction {
                self.detectors.push(device);
            }
        }
        reaction
    }

    fn start(&mut self, oracle: Option<&mut (impl Oracle + ?Sized)>) -> ActiveEvent {
        let event = self.process.start();
        let Stimulus { event: id, epicentre } = event.stimulus;
        let Self {
            seed,
            sensing,
            buckets,
            audience,
            ..
        } = self;
        audience.clear();
        let is_told = if let Some(oracle) = oracle {
            oracle.told(&event.stimulus)
        } else {
            buckets.within(epicentre, sensing.d_max, |j, d| {
                let device = DeviceId(j as u32);
                if sensing.detects(*seed, id, device, d) {
                    audience.push(device);
                }
            });
            false
        };
        self.current = Some(Current { event, is_told });
        event
    }

    fn end(&mut self, last: Tti) {
        self.current = None;
        self.process.end(last);
    }
}
