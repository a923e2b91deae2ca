//! The physical world of a run: the start, position, detection and end of events (Sec. II). `bs/src/cycle.rs` advances
//! it; `tests/src/reference/` computes the same TTI by TTI, so change both.
//!
//! The world is ground truth. A base station and its policies never have access to a [`World`]; only the genie
//! receives events, through [`Oracle`]. Random draws depend on event and device only, never on the order of calls.

use crate::deployment::Deployment;
use crate::event::{ActiveEvent, EventProcess, Stimulus};
use crate::geometry::{Buckets, Point};
use crate::ids::{DeviceId, Tti};
use crate::plan::{DutyCycle, Plan};
use crate::radio::{Air, AirLosses};
use crate::scenario::Scenario;
use crate::sensing::Sensing;

/// A receiver of every event at its start, which no real base station can be: the genie.
pub trait Oracle {
    /// Receives an event that has started.
    fn reveal_event(&mut self, stimulus: &Stimulus);

    /// Returns whether a device must be woken in the TTI in which the revealed event started.
    fn needs_wake_up(&self) -> bool;

    /// Returns whether a device must be woken again, after no report of the event has arrived up to this TTI.
    fn needs_another_wake_up(&mut self) -> bool {
        false
    }
}

/// A change of the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum WorldChange {
    /// An event has started, in its TTI `start`.
    Started(ActiveEvent),
    /// The active event has ended without a report; this was its last TTI.
    Missed(Tti),
}

#[derive(Clone, Copy, Debug)]
struct CurrentEvent {
    event: ActiveEvent,
    /// Whether the oracle wakes any device in the event's first TTI.
    needs_wake_up: bool,
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
    /// The duty cycles that the devices last received, if they may miss plans; otherwise the plan applies.
    received_cycles: Option<Vec<DutyCycle>>,
    current: Option<CurrentEvent>,
    /// Devices that detect the active event in every TTI in which they have δ = 1 and can pay for it.
    potential_detectors: Vec<DeviceId>,
    /// The potential detectors with δ = 1 in the TTI from [`Self::advance`].
    detectors: Vec<DeviceId>,
}

impl World {
    /// Creates the world of `scenario` before TTI 0: its events, the losses on the air, and the positions of the
    /// devices in `deployment`.
    pub fn new<P>(scenario: &Scenario<P>, deployment: &Deployment) -> Self {
        Self::with_events(
            scenario,
            deployment,
            EventProcess::new(
                scenario.run.seed,
                scenario.area,
                &scenario.events,
                Tti(scenario.run.ttis),
            ),
        )
    }

    /// Creates the world like [`Self::new`], with the events of `process`, which may differ from the events of
    /// `scenario`: only tests call it directly.
    pub fn with_events<P>(scenario: &Scenario<P>, deployment: &Deployment, process: EventProcess) -> Self {
        let positions = deployment.positions();
        Self {
            seed: scenario.run.seed,
            sensing: scenario.sensing.clone(),
            // Every query has the radius d_max, so cells of that size suit it.
            buckets: Buckets::new(&positions, scenario.area, scenario.sensing.d_max),
            air: Air::new(scenario.run.seed, &scenario.radio),
            received_cycles: None,
            positions,
            process,
            current: None,
            potential_detectors: Vec::new(),
            detectors: Vec::new(),
        }
    }

    /// Sends `plan` on the air in TTI `from`, in the order of TTIs with [`Self::losses_at`]. Returns the number of
    /// devices that miss it.
    pub fn send_plan(&mut self, from: Tti, plan: &Plan) -> u64 {
        if !self.air.loses_plans() {
            return 0;
        }
        let devices = self.positions.len();
        // A device sleeps until its first plan, as in the device's state machine.
        let received_cycles = self
            .received_cycles
            .get_or_insert_with(|| vec![DutyCycle::ASLEEP; devices]);
        self.air
            .deliver_plan(from, plan, DeviceId(0), devices, |j, cycle| received_cycles[j] = cycle)
    }

    /// Changes the probability α that an event starts, from TTI `from` on, which must be the next TTI.
    pub fn set_event_rate(&mut self, from: Tti, alpha: f64) {
        self.process.set_alpha(from, alpha);
    }

    /// Returns the losses on the air in TTI `k`, which must not precede the TTI of the last call or plan.
    pub fn losses_at(&mut self, k: Tti) -> AirLosses {
        self.air.losses_at(k)
    }

    /// Advances the world from `k`, the first TTI not yet closed, to the first TTI before `horizon` in which a device
    /// may react to an event under `plan`. Returns that TTI, if any, which [`Self::close_tti`] must close before the
    /// next call. Appends all changes of the world on the way to `changes`, in order.
    ///
    /// If an `oracle` is given, no device senses and only the oracle reacts.
    #[inline]
    pub fn advance(
        &mut self,
        mut k: Tti,
        horizon: Tti,
        plan: &Plan,
        mut oracle: Option<&mut (impl Oracle + ?Sized)>,
        changes: &mut Vec<WorldChange>,
    ) -> Option<Tti> {
        self.detectors.clear();
        loop {
            let Some(CurrentEvent { event, needs_wake_up }) = self.current else {
                k = self.process.next_start();
                if k >= horizon {
                    return None;
                }
                changes.push(WorldChange::Started(self.start_event(oracle.as_deref_mut())));
                continue;
            };
            // Lazy: in the event's first TTI the answer that `start_event` received holds.
            let mut needs_another = || oracle.as_deref_mut().is_some_and(Oracle::needs_another_wake_up);
            if needs_wake_up && (k == event.start || needs_another()) {
                return Some(k);
            }
            let reaction = self.find_first_reaction(k, plan);
            if reaction <= event.last && reaction < horizon {
                return Some(reaction);
            }
            self.detectors.clear();
            // The event outlasts the horizon, where the plan may change: the next call searches from there.
            if event.last >= horizon || reaction <= event.last {
                return None;
            }
            self.end_event(event.last);
            changes.push(WorldChange::Missed(event.last));
            k = event.last + 1;
        }
    }

    /// Returns the stimulus of the active event, if any.
    pub fn stimulus(&self) -> Option<Stimulus> {
        self.current.map(|current| current.event.stimulus)
    }

    /// Returns the last TTI of the active event if no device reports it; 0 without an active event.
    pub fn event_last_tti(&self) -> Tti {
        self.current.map_or(Tti::ZERO, |current| current.event.last)
    }

    /// Returns the devices that detect the event in the TTI from [`Self::advance`], battery permitting, in any order.
    pub fn detectors(&self) -> &[DeviceId] {
        &self.detectors
    }

    /// Whether `device` is farther than d_max from the active event.
    ///
    /// # Panics
    /// If no event is active.
    pub fn is_beyond_d_max(&self, device: DeviceId) -> bool {
        let epicentre = self.stimulus().expect("an event is active").epicentre;
        self.positions[device.index()].distance(epicentre) > self.sensing.d_max
    }

    /// Closes TTI `tti`. Returns whether the active event ends with it: it was reported, or this was its last TTI.
    pub fn close_tti(&mut self, tti: Tti, is_reported: bool) -> bool {
        let ends = self
            .current
            .is_some_and(|current| is_reported || current.event.last == tti);
        if ends {
            self.end_event(tti);
        }
        ends
    }

    /// Returns the first TTI from `k` on in which any potential detector has δ = 1, and stores the detectors of
    /// that TTI. The last plan that a device received applies, `plan` or an earlier one.
    fn find_first_reaction(&mut self, k: Tti, plan: &Plan) -> Tti {
        let mut reaction = Tti::NEVER;
        for &device in &self.potential_detectors {
            let cycle = match &self.received_cycles {
                None => plan.duty_cycle(device),
                Some(received_cycles) => received_cycles[device.index()],
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

    fn start_event(&mut self, oracle: Option<&mut (impl Oracle + ?Sized)>) -> ActiveEvent {
        let event = self.process.start();
        let Stimulus { event: id, epicentre } = event.stimulus;
        let Self {
            seed,
            sensing,
            buckets,
            potential_detectors,
            ..
        } = self;
        // Detection is one draw per event and device, so the potential detectors are fixed for the whole event.
        potential_detectors.clear();
        let needs_wake_up = if let Some(oracle) = oracle {
            // The list stays empty: under a policy with an oracle no device senses.
            oracle.reveal_event(&event.stimulus);
            oracle.needs_wake_up()
        } else {
            buckets.within(epicentre, sensing.d_max, |j, d| {
                let device = DeviceId(j as u32);
                if sensing.detects(*seed, id, device, d) {
                    potential_detectors.push(device);
                }
            });
            false
        };
        self.current = Some(CurrentEvent { event, needs_wake_up });
        event
    }

    fn end_event(&mut self, last: Tti) {
        self.current = None;
        self.process.end(last);
    }
}
