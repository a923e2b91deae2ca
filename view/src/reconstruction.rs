//! Reconstruction of a run from observer frames alone: metrics, digest and a consistency check. `inspect verify`, the
//! dashboard (through [`crate::history`]) and tests use it. Its score must count as `bs/src/cycle.rs` does, in the same
//! order; `recording/tests.rs` compares the digests.

use reveille_bs::scenario::Scenario;
use reveille_common::codec;
use reveille_common::deployment::Deployment;
use reveille_common::event::{EventRecord, Stimulus};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{EventUpdate, Frame, Message, Plane};
use reveille_common::plan::Plan;
use reveille_common::score::{FinalScore, Metrics, Score};
use reveille_common::totals::EventTotals;

use crate::device_mirror::{DeviceMirror, Discrepancy};

/// A run reconstructed frame by frame.
///
/// The [mirrored](DeviceMirror) machines check batteries, reports and failures. The totals of an event are summed from
/// its reports and compared with its record.
#[derive(Clone, Debug)]
pub struct Reconstruction {
    scenario: Scenario,
    deployment: Deployment,
    mirror: DeviceMirror,
    score: Score,
    /// The latest plan that was counted.
    counted_plan: Option<Plan>,
    /// The event in progress.
    stimulus: Option<Stimulus>,
    /// TTI of `information`.
    information_tti: Tti,
    /// Î of that TTI, from its reports.
    information: f64,
}

impl Reconstruction {
    /// Creates the reconstruction of a run of `scenario` before TTI 0.
    pub fn new(scenario: &Scenario) -> Self {
        let deployment = Deployment::new(scenario);
        Self {
            mirror: DeviceMirror::new(scenario, &deployment),
            score: Score::new(scenario, &deployment),
            scenario: scenario.clone(),
            deployment,
            counted_plan: None,
            stimulus: None,
            information_tti: Tti::ZERO,
            information: 0.0,
        }
    }

    /// Applies `frame`. Frames must come in the order of the run from TTI 0 on.
    ///
    /// # Errors
    /// If the frame contradicts the frames before it. Later frames can still be applied, but the results may be wrong.
    pub fn apply(&mut self, frame: &Frame) -> Result<(), Discrepancy> {
        let tti = frame.tti;
        let discrepancy = |description: String| Discrepancy { tti, description };
        // The emulation plane has no influence on results, so it is not decoded.
        if frame.kind.plane() == Plane::Emu {
            return Ok(());
        }
        let message = match frame.message() {
            Ok(message) => message,
            // A malformed message on the air was sent by a foreign client and is not part of the run.
            Err(_) if frame.kind.plane() == Plane::Air => return Ok(()),
            Err(error) => return Err(discrepancy(format!("malformed {}: {error}", frame.kind.name()))),
        };
        self.count_unable_detectors(&message);
        // First, since `count_message` asks the mirror about missed plans and the open wake-up.
        self.mirror.apply(frame, &message)?;
        self.count_message(frame, message).map_err(discrepancy)
    }

    /// Returns the score of the run if it ended after the current TTI.
    pub fn finish(self) -> FinalScore {
        let (alpha, end) = self.alpha_and_end();
        self.score.finish(alpha, end, &self.mirror.ledgers())
    }

    /// Metrics of the run if it ended after the current TTI.
    pub fn metrics(&self) -> Metrics {
        let (alpha, end) = self.alpha_and_end();
        self.score.metrics(alpha, end, &self.mirror.ledgers())
    }

    /// Start probability of events in the measured TTIs so far, and the next TTI.
    fn alpha_and_end(&self) -> (f64, Tti) {
        let (scenario, end) = (&self.scenario, self.mirror.next_tti());
        let measured_from = scenario.warm_up_end();
        let alpha = scenario
            .events
            .mean_start_probability(scenario.run.seed, measured_from, end);
        (alpha, end)
    }

    /// The mirrored devices.
    pub const fn mirror(&self) -> &DeviceMirror {
        &self.mirror
    }

    /// The mirrored devices, for access that advances them.
    pub const fn mirror_mut(&mut self) -> &mut DeviceMirror {
        &mut self.mirror
    }

    /// The event in progress.
    pub const fn stimulus(&self) -> Option<Stimulus> {
        self.stimulus
    }

    /// Totals of the counted events that have ended.
    pub const fn events(&self) -> &EventTotals {
        self.score.events()
    }

    /// Number of TTIs applied: the TTIs up to the last one of the latest grant.
    pub fn ttis_applied(&self) -> u64 {
        self.mirror.current_tti().map_or(0, |last| last.0 + 1)
    }

    /// Counts the devices that could not sense in the last grant, before `message` ends its event or begins another
    /// grant. Only then are its removals known.
    fn count_unable_detectors(&mut self, message: &Message) {
        let is_end = matches!(message, Message::World(_) | Message::Event(EventUpdate::Ended(_)));
        // An event that the world ends follows the next grant, which can have the stimulus of another event.
        if is_end && self.stimulus.is_some() && self.mirror.stimulus() == self.stimulus {
            self.score.record_unable_detectors(self.mirror.unable_detectors());
        }
    }

    /// Counts a message that the mirror has applied.
    fn count_message(&mut self, frame: &Frame, message: Message) -> Result<(), String> {
        match message {
            Message::Plan(update) => {
                let is_new = self.counted_plan.as_ref() != Some(&update.plan);
                self.score.record_plan(&update, is_new, codec::encoded_len(&update));
                let devices = u64::from(self.scenario.run.devices);
                self.score
                    .record_missed_plans(update.from, devices, self.mirror.missed_plan_count());
                self.counted_plan = Some(update.plan);
            }
            Message::Event(EventUpdate::Started(event)) => {
                if self.stimulus.is_some() {
                    return Err("an event starts while another is active".to_owned());
                }
                self.stimulus = Some(event.stimulus);
                self.score.record_event_start(event);
            }
            Message::Event(EventUpdate::Ended(record)) => return self.check_event_record(&record),
            Message::Report(report) => {
                self.fuse_report(report.tti, report.information);
                // A woken device's report is counted with its wake-up.
                if !self.mirror.has_open_wake_up() {
                    self.active_event()?;
                    self.score.record_report(&report);
                }
            }
            Message::Lost(lost) => {
                self.active_event()?;
                self.score.record_lost_report(&lost.report);
            }
            Message::Removed(removal) => self.score.record_removal(&removal),
            Message::Action(action) => self.score.record_action(&action),
            Message::Failed(failed) => {
                self.active_event()?;
                self.score.record_failed_transmission(&failed.failure);
            }
            Message::Wake(wake) => {
                self.active_event()?;
                self.score.record_wake_up(frame.tti, codec::encoded_len(&wake));
            }
            Message::Woken(woken) => {
                let epicentre = self.active_event()?.epicentre;
                let device = frame.number.map(DeviceId).ok_or("an outcome without a device")?;
                let setup = self.deployment.devices.get(device.index());
                let position = setup.ok_or("an outcome of a device that does not exist")?.position;
                // The rule of `World::is_beyond_d_max`.
                let is_beyond_d_max = position.distance(epicentre) > self.scenario.sensing.d_max;
                self.score
                    .record_wake_up_outcome(frame.tti, device, &woken.outcome, is_beyond_d_max);
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
            | Message::Log(_)
            | Message::Act(_) => {}
        }
        Ok(())
    }

    /// Ends the event in progress and compares its totals with `record`.
    fn check_event_record(&mut self, record: &EventRecord) -> Result<(), String> {
        self.active_event()?;
        self.stimulus = None;
        // Without a report, `information` belongs to an earlier event.
        let information = if self.score.is_reported() {
            self.information
        } else {
            0.0
        };
        let recomputed = self.score.record_event_end(record.last, information);
        if recomputed == *record {
            Ok(())
        } else {
            Err(format!(
                "the messages of event {} give {recomputed:?}, and its record says {record:?}",
                record.event.0
            ))
        }
    }

    fn active_event(&self) -> Result<Stimulus, String> {
        self.stimulus.ok_or_else(|| "no event is active".to_owned())
    }

    /// Adds the information of a report of TTI `tti`.
    fn fuse_report(&mut self, tti: Tti, information: f64) {
        if tti != self.information_tti {
            (self.information_tti, self.information) = (tti, 0.0);
        }
        self.information = self.scenario.sensing.fuse(self.information, information);
    }
}
