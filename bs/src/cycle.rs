//! The cycle of a TTI: world, base station and score, wired together. No I/O.
//!
//! ```text
//!                  grant()              gathered()              woken()
//!   between TTIs ─────────► Granted ─────────────► Waking ◄──────────────┐
//!      ▲                       │                     │   └───────────────┘ the policy asks for one more
//!      │                       │ nobody to wake      │
//!      └───────────────────────┴─────────────────────┘ the TTI closes
//! ```
//! [`Granted`] and [`Waking`] are given out by one step and used up by the next: the order is held by types.
//!
//! Where somebody outside decides ([`external`](crate::policy::external)), the cycle asks. A plan is asked for between
//! TTIs ([`Cycle::question`], answered by [`Cycle::decide`]); whom to wake, after reports, by a step of its own,
//! [`Step::Asks`], whose [`Asking`] is used up by [`Cycle::wake`]. Policies of this program are never asked.
//!
//! A grant covers one or more TTIs. All but the last are *quiet*: no device can detect anything in them, whatever its
//! battery, because no event is active or no device that could sense it has δ = 1. The clock knows that from the plan
//! and from the world that it plays; the policy sees none of it. A driver that asks for one TTI at a time gets the same
//! run.
//!
//! A policy that decides in every TTI decides for all of them at once: where a TTI is quiet, that nothing was heard is
//! known before any device has gone through it. Only who is told the true batteries must wait for them.

use reveille_common::codec;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Failure, Outage, PlanUpdate, Report, WakeOutcome, WakeUp};
use reveille_common::plan::Plan;
use reveille_common::scenario::Scenario;
use reveille_common::score::{Final, Score};
use reveille_common::totals::{EventTotals, Ledger};
use reveille_common::units::Energy;
use reveille_common::world::{Turn, World};

use crate::grant::Grant;
use crate::observe::{Happening, Observer};
use crate::outcome::Outcome;
use crate::policy::external::{Decision, Question, Stage};
use crate::prepared::Prepared;
use crate::station::Station;

/// Plans that go with a grant at the most. More would not be faster, and all of them have to be decided, sent and kept
/// before anybody answers.
const AHEAD: usize = 64;

/// A grant that is out. [`Cycle::gathered`] takes it back.
#[derive(Debug)]
#[must_use = "the TTIs are open until their reports are gathered"]
#[non_exhaustive]
pub struct Granted {
    /// The TTIs that are granted.
    pub grant: Grant,
    /// What goes out on the air in them, TTI by TTI: a new plan, or the plan in force once more for synchronisation.
    pub updates: Vec<PlanUpdate>,
}

/// A wake-up that is out. [`Cycle::woken`] takes it back.
#[derive(Debug)]
#[must_use = "the TTI is open until it is known what came of the wake-up"]
pub struct Waking {
    tti: Tti,
    device: DeviceId,
    sent: Tti,
    is_late: bool,
}

impl Waking {
    /// The device to wake.
    pub const fn device(&self) -> DeviceId {
        self.device
    }

    /// Whether the event is over when the device is awake. Ground truth.
    pub const fn is_late(&self) -> bool {
        self.is_late
    }

    /// What goes out on the air.
    pub const fn message(&self) -> WakeUp {
        WakeUp { tti: self.sent }
    }
}

/// A question for somebody outside: whom to wake. [`Cycle::wake`] takes it back. A copy goes with a copy of its cycle.
#[derive(Clone, Debug)]
#[must_use = "the TTI is open until it is answered"]
pub struct Asking {
    tti: Tti,
}

/// What follows the reports of a TTI.
#[derive(Debug)]
pub enum Step {
    /// Send this wake-up and tell [`Cycle::woken`] what came of it.
    WakeUp(Waking),
    /// Ask whom to wake ([`Cycle::question_of`]) and tell [`Cycle::wake`].
    Asks(Asking),
    /// The TTI is closed; the next may be granted.
    Closed,
}

/// A run as its clock drives it.
pub struct Cycle {
    scenario: Scenario,
    world: World,
    station: Station,
    score: Score,
    next: Tti,
    is_open: bool,
    /// Wake-ups of the open TTI.
    wake_ups: u64,
    /// What the world did in the last grant; kept for its memory.
    turns: Vec<Turn>,
}

impl Cycle {
    /// The cycle of a run before TTI 0.
    pub fn new(prepared: &Prepared) -> Self {
        Self::with_world(prepared, World::new(&prepared.scenario, &prepared.deployment))
    }

    /// As [`Self::new`], in a world of the caller's, such as one with scripted events.
    pub fn with_world(prepared: &Prepared, world: World) -> Self {
        let known = prepared.knowledge();
        let mind = prepared.mind(&known);
        Self::with_station(prepared, world, Station::new(known, mind))
    }

    /// As [`Self::with_world`], with a base station of the caller's, such as one whose decisions are recorded.
    pub fn with_station(prepared: &Prepared, world: World, station: Station) -> Self {
        Self {
            scenario: prepared.scenario.clone(),
            world,
            station,
            score: Score::new(&prepared.scenario, &prepared.deployment),
            next: Tti::ZERO,
            is_open: false,
            wake_ups: 0,
            turns: Vec::new(),
        }
    }

    /// The next TTI to be granted.
    pub const fn next_tti(&self) -> Tti {
        self.next
    }

    /// Whether a grant is out, or a TTI not closed.
    pub const fn is_open(&self) -> bool {
        self.is_open
    }

    /// The plan in force.
    pub const fn plan(&self) -> &Plan {
        self.station.plan()
    }

    /// Sums over the counted events that have ended.
    pub const fn event_totals(&self) -> &EventTotals {
        self.score.events()
    }

    /// Ground truth for a driver that owns all devices: who detects the event in the granted TTI, battery permitting.
    pub fn detectors(&self) -> &[DeviceId] {
        self.world.detectors()
    }

    /// Whether the true batteries are to be told before the next grant.
    pub fn wants_batteries(&self) -> bool {
        self.station.wants_batteries(self.next)
    }

    /// Whether the true batteries will be wanted after every grant.
    pub fn will_want_batteries(&self) -> bool {
        self.station.is_told_batteries()
    }

    /// The battery levels of all devices, in the order of ids, at the end of the last TTI. To be told between TTIs.
    pub fn tell_batteries(&mut self, levels: impl IntoIterator<Item = Energy>, observer: &mut impl Observer) {
        self.station.tell_batteries(levels);
        observer.told(self.next, self.station.batteries());
    }

    /// What somebody outside is to decide before the next grant; after the true batteries have been told where they are
    /// wanted. Nothing where a policy of this program decides, the last plan holds on, or it was answered.
    pub fn question(&self) -> Option<Question<'_>> {
        let asks = !self.is_open && self.station.asks_for_plan(self.next);
        asks.then(|| self.station.question(self.next, Stage::Plan))?
    }

    /// Between TTIs, what somebody outside would be asked for a plan of the next one, whether it is asked or the run is
    /// at its end. Nothing where a policy of this program decides.
    pub fn outlook(&self) -> Option<Question<'_>> {
        (!self.is_open).then(|| self.station.question(self.next, Stage::Plan))?
    }

    /// The answer to [`Self::question`].
    ///
    /// # Panics
    /// If nobody has asked.
    pub fn decide(&mut self, decision: Decision) {
        assert!(self.question().is_some(), "no plan was asked for");
        self.station.tell_plan(decision);
    }

    /// What somebody outside is to decide within a TTI: whom to wake.
    pub fn question_of(&self, asking: &Asking) -> Question<'_> {
        let question = self.station.question(asking.tti, Stage::Wake);
        question.expect("who is asked decides")
    }

    /// The answer to [`Step::Asks`]: these devices are woken, one after the other in this order, before it is asked
    /// again; nobody ends the wake-ups of the TTI. What cannot be done is left out, see
    /// [`external`](crate::policy::external).
    #[expect(clippy::needless_pass_by_value, reason = "a question is used up by its answer")]
    pub fn wake(&mut self, asking: Asking, devices: &[DeviceId], observer: &mut impl Observer) -> Step {
        self.station.tell_whom(asking.tti, devices);
        self.next_step(asking.tti, observer)
    }

    /// A copy of the run that goes on from here, where somebody outside decides.
    pub fn branch(&self) -> Option<Self> {
        Some(Self {
            station: self.station.branch()?,
            scenario: self.scenario.clone(),
            world: self.world.clone(),
            score: self.score.clone(),
            turns: self.turns.clone(),
            ..*self
        })
    }

    /// Grants TTIs from [`Self::next_tti`] on, at most up to and not including `horizon`.
    ///
    /// # Panics
    /// If the last grant is still open, `horizon` is not after the next TTI, or a [`Self::question`] is not answered.
    pub fn grant(&mut self, horizon: Tti, observer: &mut impl Observer) -> Granted {
        assert!(!self.is_open, "TTI {} is still open", self.next);
        let first = self.next;
        assert!(first < horizon, "a grant covers at least one TTI");
        let foresees = !self.station.is_told_batteries();
        let mut updates = Vec::new();
        let last = loop {
            updates.extend(self.announce(observer));
            let span = self.span(horizon, observer);
            if !foresees
                || updates.len() >= AHEAD
                || span.stimulus.is_some()
                || span.last + 1 >= horizon
                || self.station.asks_for_plan(span.last + 1)
                || observer.wants_states()
            {
                break span;
            }
            self.station.gathered(span.last, &[]);
            self.next = span.last + 1;
        };
        self.is_open = true;
        Granted {
            grant: Grant { first, ..last },
            updates,
        }
    }

    /// What goes out on the air in the next TTI.
    fn announce(&mut self, observer: &mut impl Observer) -> Option<PlanUpdate> {
        let k = self.next;
        let (update, is_new) = self.station.announce(k)?;
        self.score.plan(&update, is_new, codec::encoded_len(&update));
        let missed = self.world.plan_sent(k, &update.plan);
        self.score.plan_missed(k, u64::from(self.scenario.devices), missed);
        observer.see(&Happening::Plan {
            update: &update,
            is_new,
        });
        Some(update)
    }

    /// The TTIs from the next on, before `horizon` and before anything goes out on the air again, as far as all but the
    /// last are quiet.
    fn span(&mut self, horizon: Tti, observer: &mut impl Observer) -> Grant {
        let grant = self.play(self.next, horizon.min(self.station.next_announcement(self.next)));
        observer.see(&Happening::Granted(&grant));
        for turn in self.turns.drain(..) {
            match turn {
                Turn::Started(event) => {
                    self.score.event_started(event);
                    observer.see(&Happening::EventStarted(&event));
                }
                Turn::Missed(last) => observer.see(&Happening::EventEnded(&self.score.event_ended(last, 0.0))),
            }
        }
        grant
    }

    fn play(&mut self, first: Tti, horizon: Tti) -> Grant {
        let Self {
            world, station, turns, ..
        } = self;
        let (plan, genie) = station.commands();
        let stimulated = world.play(first, horizon, plan, genie, turns);
        Grant {
            first,
            last: stimulated.unwrap_or(Tti(horizon.0 - 1)),
            stimulus: stimulated.and_then(|_| world.stimulus()),
            until: world.until(),
        }
    }

    /// The devices have done the grant; these are its reports and the devices that failed to report, in any order.
    #[expect(clippy::needless_pass_by_value, reason = "a grant is used up by its reports")]
    pub fn gathered(
        &mut self,
        granted: Granted,
        reports: &mut [Report],
        failures: &mut [Failure],
        observer: &mut impl Observer,
    ) -> Step {
        let tti = granted.grant.last;
        reports.sort_unstable_by_key(|report| report.device);
        failures.sort_unstable_by_key(|failure| failure.device);
        let arrived = self.carry(tti, reports, observer);
        for failure in failures.iter() {
            self.score.failed(failure);
            observer.see(&Happening::Failed { tti, failure });
        }
        self.station.gathered(tti, &reports[..arrived]);
        self.wake_ups = 0;
        self.next_step(tti, observer)
    }

    /// Carries the `reports` of a TTI to the base station. Gives how many arrive: those are the first then, in order.
    fn carry(&mut self, tti: Tti, reports: &mut [Report], observer: &mut impl Observer) -> usize {
        let air = self.world.air(tti);
        let mut arrived = 0;
        for at in 0..reports.len() {
            let report = reports[at];
            if air.loses_report(report.device) {
                self.score.lost(&report);
                observer.see(&Happening::Lost(&report));
            } else {
                self.score.reported(&report);
                observer.see(&Happening::Reported(&report));
                reports[arrived] = report;
                arrived += 1;
            }
        }
        arrived
    }

    /// Devices are gone from the last granted TTI on. The station is told nothing: it hears no more of them.
    pub fn gone(&mut self, outage: &Outage, observer: &mut impl Observer) {
        self.score.gone(outage);
        observer.see(&Happening::Gone(outage));
    }

    /// Whether `device` is gone.
    pub fn is_gone(&self, device: DeviceId) -> bool {
        self.score.is_gone(device)
    }

    /// What came of the wake-up that the last [`Step`] asked for.
    #[expect(clippy::needless_pass_by_value, reason = "a wake-up is used up by its outcome")]
    pub fn woken(&mut self, waking: Waking, outcome: &WakeOutcome, observer: &mut impl Observer) -> Step {
        let Waking { tti, device, .. } = waking;
        let air = self.world.air(tti);
        let outcome = &outcome.over(|device| air.loses_report(device));
        self.score.woken(tti, device, outcome, self.world.is_far(device));
        observer.see(&Happening::Woken { tti, device, outcome });
        let report = match outcome {
            WakeOutcome::Reported(report) => Some(report),
            WakeOutcome::Failed(_) | WakeOutcome::Unheard | WakeOutcome::Lost(_) | WakeOutcome::Late { .. } => None,
        };
        self.station.woken(tti, device, report);
        self.next_step(tti, observer)
    }

    /// The group that each device is in, in the order of ids, where the policy groups them by place.
    pub fn groups(&self) -> Option<&[u32]> {
        self.station.mind().groups()
    }

    /// The run's outcome. `ledgers` are the devices' books in the order of ids.
    ///
    /// # Panics
    /// If the last grant is still open.
    pub fn finish(self, ledgers: &[Ledger]) -> Outcome {
        assert!(!self.is_open, "TTI {} is still open", self.next);
        let (events, measured_from) = (&self.scenario.events, self.scenario.warm_up_end());
        let alpha = events.mean_start_probability(self.scenario.seed, measured_from, self.next);
        let Final {
            digest,
            metrics,
            totals,
            devices,
        } = self.score.finish(alpha, self.next, ledgers);
        Outcome {
            facts: self.station.mind().facts(),
            learned: self.station.mind().learned(),
            digest,
            metrics,
            totals,
            devices,
            ttis_done: self.next.0,
            complete: self.next.0 == self.scenario.ttis,
        }
    }

    /// The policy's next wake-up in `tti`, or the end of it.
    fn next_step(&mut self, tti: Tti, observer: &mut impl Observer) -> Step {
        if let Some(device) = self.station.next_wake_up(tti) {
            let sent = self.scenario.radio.sent(tti, self.wake_ups);
            let is_late = self.scenario.radio.is_late(sent, self.world.until());
            self.wake_ups += 1;
            let waking = Waking {
                tti,
                device,
                sent,
                is_late,
            };
            self.score.wake_up(tti, codec::encoded_len(&waking.message()));
            observer.see(&Happening::WakeUp { tti, device, sent });
            return Step::WakeUp(waking);
        }
        if self.station.asks_whom(tti) {
            return Step::Asks(Asking { tti });
        }
        if observer.wants_beliefs() {
            let places = self.station.belief();
            if !places.is_empty() {
                observer.see(&Happening::Believed { tti, places: &places });
            }
        }
        if self.world.close(tti, self.score.is_reported()) {
            let record = self.score.event_ended(tti, self.station.information());
            observer.see(&Happening::EventEnded(&record));
        }
        self.station.closed(tti);
        observer.see(&Happening::Closed(tti));
        (self.is_open, self.next) = (false, tti + 1);
        Step::Closed
    }
}
