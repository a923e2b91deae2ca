//! How a host follows the virtual clock: which grant it can follow, whose δ changes, who is to listen. No I/O.
//!
//! Messages may be lost, come twice, or be meant for another TTI. A grant is followed when all that goes with it is
//! there, and once; what is asked again is answered again.

use std::collections::BTreeMap;

use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{PlanUpdate, Tick, WakeUp};
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::radio::{Air, Radio};

/// What is asked of the devices.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Question {
    /// A grant that ends with this TTI.
    Grant(Tti),
    /// The ledgers.
    Ledgers,
}

/// What a host does with a question.
#[derive(Clone, Debug, PartialEq)]
pub enum Heed<T> {
    /// It has this question already: the answer goes out again, once there is one.
    Again,
    /// It cannot follow, since a message is missing or this one is stale. It does not answer, and is asked again.
    Wait,
    /// It does this.
    Do(T),
}

/// A grant to be carried out. Devices are numbered as the host carries them, from 0.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Turn {
    /// Whose δ is another from which TTI on, in the order of TTIs.
    pub changes: Vec<(usize, Tti, DutyCycle)>,
    /// Who has δ = 1 in the grant's last TTI, within d_max of what the world shows then.
    pub listeners: Vec<usize>,
}

/// A wake-up to be heard.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Call {
    /// Which of the host's devices hears it, from 0.
    pub device: usize,
    /// The TTI in whose books it is.
    pub tti: Tti,
    /// What the world shows when it is awake; nothing if the event is over by then.
    pub stimulus: Option<Stimulus>,
}

/// What a host knows of the clock and of its devices' δ.
#[derive(Clone, Debug)]
pub struct Follower {
    first: DeviceId,
    positions: Vec<Point>,
    d_max: f64,
    end: Tti,
    duties: Vec<DutyCycle>,
    radio: Radio,
    air: Air,
    /// The TTI from which the plan that this host has holds.
    plan_from: Option<Tti>,
    /// Plans that hold from TTIs on that have not been granted, in their order.
    coming: BTreeMap<Tti, Plan>,
    /// The first TTI that has not been granted.
    next: Tti,
    tick: Option<Tick>,
    asked: Option<Question>,
}

/// Where a follower begins: what it carries, and how far that has come.
#[derive(Clone, Debug)]
pub struct Beginning {
    /// The first of its devices.
    pub first: DeviceId,
    /// Where they are, in the order of ids, m.
    pub positions: Vec<Point>,
    /// δ of each.
    pub duties: Vec<DutyCycle>,
    /// The first TTI to be granted.
    pub next: Tti,
    /// The TTI from which the plan holds that they have.
    pub plan: Option<Tti>,
}

impl Follower {
    /// A host in a run that ends before TTI `end`, whose devices hear events within `d_max`, m; `seed` and `radio` are
    /// the run's.
    pub fn new(beginning: Beginning, d_max: f64, end: Tti, seed: u64, radio: &Radio) -> Self {
        let Beginning {
            first,
            positions,
            duties,
            next,
            plan,
        } = beginning;
        assert_eq!(positions.len(), duties.len(), "a δ for each device");
        Self {
            first,
            positions,
            d_max,
            end,
            duties,
            radio: *radio,
            air: Air::new(seed, radio),
            plan_from: plan,
            coming: BTreeMap::new(),
            next,
            tick: None,
            asked: None,
        }
    }

    /// The last TTI granted; 0 before the first grant.
    pub fn granted(&self) -> Tti {
        self.tick.map_or(Tti::ZERO, |tick| tick.last)
    }

    /// The first TTI that has not been granted.
    pub const fn next(&self) -> Tti {
        self.next
    }

    /// A plan is kept for the grant that it goes with. Whether there is one: plans of granted TTIs, sent again as a
    /// rule, have no use.
    pub fn plan(&mut self, update: PlanUpdate) -> bool {
        let PlanUpdate { from, plan } = update;
        let is_due = from >= self.next && from < self.end;
        if is_due {
            self.coming.insert(from, plan);
        }
        is_due
    }

    /// The clock grants TTIs.
    pub fn grant(&mut self, tick: Tick) -> Heed<Turn> {
        let question = Question::Grant(tick.last);
        if self.asked == Some(question) {
            return Heed::Again;
        }
        let own = || self.coming.range(..=tick.last).map(|(from, _)| *from);
        let plan = own().next_back().or(self.plan_from);
        if tick.first != self.next
            || tick.last < tick.first
            || tick.last >= self.end
            || plan != Some(tick.plan)
            || own().count() != tick.plans as usize
        {
            return Heed::Wait;
        }
        let changes = self.follow(tick.last);
        let listeners = match &tick.stimulus {
            Some(stimulus) => self.listeners(tick.last, stimulus),
            None => Vec::new(),
        };
        self.next = tick.last.saturating_add(1);
        (self.tick, self.asked) = (Some(tick), Some(question));
        Heed::Do(Turn { changes, listeners })
    }

    /// The run has ended before TTI `end`, and the ledgers are asked for.
    pub fn finish(&mut self, end: Tti) -> Heed<()> {
        if self.asked == Some(Question::Ledgers) {
            return Heed::Again;
        }
        if end != self.next {
            return Heed::Wait;
        }
        self.asked = Some(Question::Ledgers);
        Heed::Do(())
    }

    /// A wake-up for `device`. Nothing if it is none of this host's, or outside its TTI.
    pub fn wake(&self, device: DeviceId, wake: WakeUp) -> Option<Call> {
        let device = device.index().checked_sub(self.first.index())?;
        let tick = self.tick.filter(|_| device < self.duties.len())?;
        let stimulus = tick.stimulus?;
        let is_of_it = self.radio.may_be_sent(wake.tti, tick.last);
        is_of_it.then(|| Call {
            device,
            tti: tick.last,
            stimulus: (!self.radio.is_late(wake.tti, tick.until)).then_some(stimulus),
        })
    }

    /// Takes over the plans that go with a grant up to TTI `last`.
    fn follow(&mut self, last: Tti) -> Vec<(usize, Tti, DutyCycle)> {
        let mut changes = Vec::new();
        let later = self.coming.split_off(&last.saturating_add(1));
        for (from, plan) in std::mem::replace(&mut self.coming, later) {
            self.plan_from = Some(from);
            let air = self.air.at(from);
            for (j, duty) in self.duties.iter_mut().enumerate() {
                let device = DeviceId(self.first.0 + j as u32);
                let new = plan.duty_cycle(device);
                if *duty != new && !air.misses_plan(device) {
                    *duty = new;
                    changes.push((j, from, new));
                }
            }
        }
        changes
    }

    fn listeners(&self, tti: Tti, stimulus: &Stimulus) -> Vec<usize> {
        let is_near = |j: &usize| self.positions[*j].distance(stimulus.epicentre) <= self.d_max;
        (0..self.duties.len())
            .filter(|&j| self.duties[j].is_on(tti))
            .filter(is_near)
            .collect()
    }
}

#[cfg(test)]
mod tests;
