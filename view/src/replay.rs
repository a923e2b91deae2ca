//! What a run came to, from what observers were told of it alone: metrics and digest, and whether all of it fits
//! together.

use reveille_common::codec;
use reveille_common::deployment::Deployment;
use reveille_common::event::{EventRecord, Stimulus};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{EventNews, Frame, Message, Plane};
use reveille_common::plan::Plan;
use reveille_common::scenario::Scenario;
use reveille_common::score::{Final, Metrics, Score};
use reveille_common::totals::EventTotals;

use crate::mirror::{Discrepancy, Mirror};

/// A run that is gone through once more, frame by frame.
///
/// The devices are [mirrored](Mirror), so that batteries, reports and failures are compared with what the machines do;
/// what an event came to is added up from the reports, and compared with what was told of it.
#[derive(Clone, Debug)]
pub struct Replay {
    scenario: Scenario,
    deployment: Deployment,
    mirror: Mirror,
    score: Score,
    plan: Option<Plan>,
    stimulus: Option<Stimulus>,
    /// The TTI of the information below.
    tti: Tti,
    /// Î of that TTI, from its reports.
    information: f64,
}

impl Replay {
    /// A run of `scenario` before TTI 0.
    pub fn new(scenario: &Scenario) -> Self {
        let deployment = Deployment::new(scenario);
        Self {
            mirror: Mirror::new(scenario, &deployment),
            score: Score::new(scenario, &deployment),
            scenario: scenario.clone(),
            deployment,
            plan: None,
            stimulus: None,
            tti: Tti::ZERO,
            information: 0.0,
        }
    }

    /// Goes on with `frame`.
    ///
    /// # Errors
    /// If it does not fit to what was before it.
    pub fn take(&mut self, frame: &Frame) -> Result<(), Discrepancy> {
        let tti = frame.tti;
        let refuse = |what: String| Discrepancy { tti, what };
        // Nothing that the run came to follows from the emulation plane, and it is not read.
        if frame.kind.plane() == Plane::Emu {
            return Ok(());
        }
        let message = match frame.message() {
            Ok(message) => message,
            // A stranger's message is no part of the run.
            Err(_) if frame.kind.plane() == Plane::Air => return Ok(()),
            Err(error) => return Err(refuse(format!("a {} that is none: {error}", frame.kind.name()))),
        };
        self.mirror.take(frame, &message)?;
        self.count(frame, message).map_err(refuse)
    }

    /// What the run came to, if it ended here, after the TTI that was reached last.
    pub fn finish(self) -> Final {
        let (alpha, end) = self.so_far();
        self.score.finish(alpha, end, &self.mirror.ledgers())
    }

    /// The metrics if it ended here.
    pub fn metrics(&self) -> Metrics {
        let (alpha, end) = self.so_far();
        self.score.metrics(alpha, end, &self.mirror.ledgers())
    }

    /// The start probability of events in the measured TTIs so far, and the TTI that is to come next.
    fn so_far(&self) -> (f64, Tti) {
        let (scenario, end) = (&self.scenario, self.mirror.next());
        let measured_from = scenario.warm_up_end();
        let alpha = scenario
            .events
            .mean_start_probability(scenario.seed, measured_from, end);
        (alpha, end)
    }

    /// The devices.
    pub const fn mirror(&self) -> &Mirror {
        &self.mirror
    }

    /// The devices, to be looked at.
    pub const fn mirror_mut(&mut self) -> &mut Mirror {
        &mut self.mirror
    }

    /// The event that is under way.
    pub const fn stimulus(&self) -> Option<Stimulus> {
        self.stimulus
    }

    /// Sums over the counted events that have ended.
    pub const fn events(&self) -> &EventTotals {
        self.score.events()
    }

    /// The TTIs that were gone through.
    pub fn ttis(&self) -> u64 {
        self.mirror.now().map_or(0, |last| last.0 + 1)
    }

    fn count(&mut self, frame: &Frame, message: Message) -> Result<(), String> {
        match message {
            Message::Plan(update) => {
                let is_new = self.plan.as_ref() != Some(&update.plan);
                self.score.plan(&update, is_new, codec::encoded_len(&update));
                let devices = u64::from(self.scenario.devices);
                self.score.plan_missed(update.from, devices, self.mirror.missed_plans());
                self.plan = Some(update.plan);
            }
            Message::Event(EventNews::Started(event)) => {
                if self.stimulus.is_some() {
                    return Err("an event starts while another is under way".to_owned());
                }
                self.stimulus = Some(event.stimulus);
                self.score.event_started(event);
            }
            Message::Event(EventNews::Ended(told)) => return self.event_ended(&told),
            Message::Report(report) => {
                self.fuse(report.tti, report.information);
                // What a woken device reports is counted with the wake-up.
                if !self.mirror.is_waking() {
                    self.under_way()?;
                    self.score.reported(&report);
                }
            }
            Message::Lost(lost) => {
                self.under_way()?;
                self.score.lost(&lost.report);
            }
            Message::Gone(outage) => self.score.gone(&outage),
            Message::Failed(failed) => {
                self.under_way()?;
                self.score.failed(&failed.failure);
            }
            Message::Wake(wake) => {
                self.under_way()?;
                self.score.wake_up(frame.tti, codec::encoded_len(&wake));
            }
            Message::Woken(woken) => {
                let epicentre = self.under_way()?.epicentre;
                let device = frame.number.map(DeviceId).ok_or("what came of a wake-up of nobody")?;
                let setup = self.deployment.devices.get(device.index());
                let place = setup.ok_or("what came of a wake-up of no device")?.position;
                let is_far = place.distance(epicentre) > self.scenario.sensing.d_max;
                self.score.woken(frame.tti, device, &woken.outcome, is_far);
            }
            Message::World(_)
            | Message::States(_)
            | Message::Belief(_)
            | Message::Clock(_)
            | Message::Answer(_)
            | Message::Join(_)
            | Message::Ready(_)
            | Message::Control(_)
            | Message::Describe(_)
            | Message::Log(_) => {}
        }
        Ok(())
    }

    fn event_ended(&mut self, told: &EventRecord) -> Result<(), String> {
        self.under_way()?;
        self.stimulus = None;
        let information = if self.score.is_reported() {
            self.information
        } else {
            0.0
        };
        let own = self.score.event_ended(told.last, information);
        if own == *told {
            Ok(())
        } else {
            Err(format!(
                "event {} came to {:?} by its messages, not to {:?}",
                told.event.0, own.tally, told.tally
            ))
        }
    }

    fn under_way(&self) -> Result<Stimulus, String> {
        self.stimulus.ok_or_else(|| "no event is under way".to_owned())
    }

    /// Adds what a report of TTI `tti` has brought.
    fn fuse(&mut self, tti: Tti, information: f64) {
        if tti != self.tti {
            (self.tti, self.information) = (tti, 0.0);
        }
        self.information = self.scenario.sensing.fuse(self.information, information);
    }
}
