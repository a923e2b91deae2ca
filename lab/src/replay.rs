//! A replay: a run in memory that follows a run over the bus. It restores the devices of a lost process and audits the
//! run, from the scenario, the seed and the external inputs alone.

use std::collections::VecDeque;
use std::fmt;

use reveille_bs::cycle::{Outcome, PreparedRun};
use reveille_bs::observer::frames::Frames;
use reveille_bs::observer::{Notification, Observer};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{DeviceCheckpoint, DeviceStates, Frame, Message};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::Ledger;
use reveille_common::units::Energy;

use crate::external_inputs::{ExternalInput, ExternalInputs};
use crate::run::{Run, RunOptions};

/// Encodes the notifications that a digest covers, messages on the air and their outcomes, as frames.
#[derive(Clone, Copy, Debug, Default)]
pub struct DigestFrames(Frames);

impl DigestFrames {
    /// Encodes the `batteries` that a policy receives before it decides TTI `tti`. A digest covers the decisions but
    /// not the batteries. This frame exposes a host that reports wrong ones, and names the device.
    pub fn batteries_frame(tti: Tti, batteries: &[Energy]) -> Frame {
        let view = |battery: &Energy| DeviceView {
            // Only batteries are compared; the state is a placeholder.
            state: DeviceState::Sleep { powered: true },
            battery: *battery,
        };
        let views = batteries.iter().map(view).collect();
        Frame::new(tti, (), &DeviceStates { views })
    }

    /// Passes the frames of `notification` to `take`, if a digest covers it.
    pub fn encode(&mut self, notification: &Notification<'_>, take: impl FnMut(Frame)) {
        match notification {
            // Grants and observers change no outcome, so no digest covers them.
            Notification::TtisGranted(_)
            | Notification::TtiClosed(_)
            | Notification::BeliefUpdated { .. }
            | Notification::DeviceStates(_) => {}
            Notification::PlanSent { .. }
            | Notification::EventStarted(_)
            | Notification::ReportReceived(_)
            | Notification::ReportLost(_)
            | Notification::DevicesRemoved(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpSent { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::EventEnded(_) => self.0.encode(notification, take),
        }
    }
}

/// The first difference between a run and its replay.
#[derive(Clone, Debug, PartialEq)]
pub struct Divergence {
    /// The TTI.
    pub tti: Tti,
    /// The device concerned, if there is only one.
    pub device: Option<DeviceId>,
    /// A message with the content of the run and of the replay.
    pub what: String,
}

impl fmt::Display for Divergence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "TTI {}: {}", self.tti, self.what)
    }
}

/// A run in memory that follows another run.
pub struct Replay {
    prepared: PreparedRun,
    run: Run,
    /// The first TTI that is compared.
    from: Tti,
    compared: Tti,
    inputs: ExternalInputs,
    ahead: UncomparedFrames,
}

/// The frames of a replay that are not compared yet.
#[derive(Default)]
struct UncomparedFrames {
    noting: DigestFrames,
    /// The frames for which the run has no counterpart yet.
    frames: VecDeque<Frame>,
    /// The number of frames that were equal in both.
    same: u64,
    /// The number of compared frames that the replay still has to repeat after a restart.
    again: u64,
}

impl UncomparedFrames {
    fn take(&mut self, frame: Frame) {
        if self.again > 0 {
            self.again -= 1;
        } else {
            self.frames.push_back(frame);
        }
    }
}

impl Observer for UncomparedFrames {
    fn notify(&mut self, notification: &Notification<'_>) {
        let mut noting = self.noting;
        noting.encode(notification, |frame| self.take(frame));
        self.noting = noting;
    }

    fn batteries_revealed(&mut self, tti: Tti, batteries: &[Energy]) {
        self.take(DigestFrames::batteries_frame(tti, batteries));
    }
}

impl Replay {
    /// Creates the replay of the run `prepared` with these `inputs`, before TTI 0. The comparison starts at TTI `from`.
    pub fn new(prepared: &PreparedRun, inputs: &ExternalInputs, from: Tti) -> Self {
        Self {
            run: begin(prepared, inputs),
            prepared: prepared.clone(),
            from,
            compared: from,
            inputs: inputs.clone(),
            ahead: UncomparedFrames::default(),
        }
    }

    /// Adds an external input of a TTI that is not compared yet.
    pub fn add_input(&mut self, input: ExternalInput) {
        let tti = match &input {
            ExternalInput::Outage(outage) => outage.tti,
            ExternalInput::Decision(decision) => decision.tti,
        };
        // Added before a restart, which schedules all inputs.
        self.inputs.add(input.clone());
        if self.next_tti() > tti {
            self.begin_anew();
        } else {
            self.run.schedule_input(input);
        }
    }

    /// The next TTI.
    pub const fn next_tti(&self) -> Tti {
        self.run.cycle().next_tti()
    }

    /// Advances to TTI `k`, after a restart if the replay is past it.
    fn reach(&mut self, k: Tti) {
        if self.next_tti() > k {
            self.begin_anew();
        }
        // Frames before `from` are not compared and would only accumulate.
        self.run.advance(k.min(self.from), &mut ());
        self.run.advance(k, &mut self.ahead);
        assert!(
            self.run.missing_decision().is_none(),
            "a decision is added before the run continues from it"
        );
    }

    fn begin_anew(&mut self) -> Run {
        self.ahead.frames.clear();
        // The new run repeats its frames from `from` on; the compared ones are skipped.
        self.ahead.again = self.ahead.same;
        std::mem::replace(&mut self.run, begin(&self.prepared, &self.inputs))
    }

    /// Ends the comparison with the run.
    pub fn stop_comparing(&mut self) {
        self.from = Tti::NEVER;
        self.ahead = UncomparedFrames::default();
    }

    /// The TTI before which both runs are equal.
    pub const fn compared(&self) -> Tti {
        self.compared
    }

    /// Returns checkpoints of `count` devices from `first` on, before TTI `k`.
    pub fn devices(&mut self, k: Tti, first: DeviceId, count: u32) -> Vec<DeviceCheckpoint> {
        self.reach(k);
        self.run.checkpoints(first, count)
    }

    /// Returns the ledgers of `count` devices from `first` on, before TTI `k`.
    pub fn ledgers(&mut self, k: Tti, first: DeviceId, count: u32) -> Vec<Ledger> {
        self.reach(k);
        self.run.ledgers(first, count)
    }

    /// Returns the outcome of the run before TTI `k`. The replay then restarts from TTI 0.
    pub fn outcome(&mut self, k: Tti) -> Outcome {
        self.reach(k);
        self.begin_anew().partial_outcome()
    }

    /// Compares the frames of the run since the last comparison, all of them from TTIs before `k`.
    ///
    /// # Errors
    /// If the runs differ; the error is the first divergence.
    pub fn compare(&mut self, k: Tti, live: &[Frame]) -> Result<(), Divergence> {
        // Never goes back: frames of later TTIs wait in `ahead`, and a restart would only repeat them.
        self.reach(k.max(self.next_tti()));
        for frame in live {
            match self.ahead.frames.pop_front() {
                Some(own) if own == *frame => self.ahead.same += 1,
                own => return Err(difference(Some(frame), own.as_ref())),
            }
        }
        self.compared = k;
        Ok(())
    }

    /// Compares the outcome of the run, after all its frames have been compared.
    ///
    /// # Errors
    /// If the outcomes differ; the error is the first divergence.
    pub fn compare_outcome(&mut self, live: &Outcome) -> Result<(), Divergence> {
        self.reach(Tti(live.ttis_done));
        if let Some(own) = self.ahead.frames.pop_front() {
            return Err(difference(None, Some(&own)));
        }
        same_outcome(live, &self.outcome(Tti(live.ttis_done)))
    }
}

/// Creates a run before TTI 0.
fn begin(prepared: &PreparedRun, inputs: &ExternalInputs) -> Run {
    let mut run = Run::new(prepared, RunOptions::default());
    run.schedule_inputs(inputs);
    run
}

/// Describes the difference between a frame of the run (`had`) and a frame of the replay (`has`).
fn difference(had: Option<&Frame>, has: Option<&Frame>) -> Divergence {
    if let (Some(had), Some(has)) = (had, has)
        && let Some(lie) = lie(had, has)
    {
        return lie;
    }
    let ttis = had.iter().chain(&has).map(|frame| frame.tti);
    let say = |frame: Option<&Frame>| match frame {
        None => "nothing more".to_owned(),
        Some(frame) => {
            let number = frame.number.map_or_else(String::new, |number| format!(" {number}"));
            let text = frame
                .message()
                .map_or_else(|error| error.to_string(), |m| m.to_string());
            format!("{}{number} ({text})", frame.kind.name())
        }
    };
    Divergence {
        // The runs diverge at the earlier of the two frames, which the other run lacks.
        tti: ttis.min().unwrap_or_default(),
        device: had.and_then(Frame::device).or_else(|| has.and_then(Frame::device)),
        what: format!("the run had {}, the replay has {}", say(had), say(has)),
    }
}

/// Returns the first wrong battery reported to a run, if both frames hold batteries.
fn lie(had: &Frame, has: &Frame) -> Option<Divergence> {
    let (Ok(Message::States(had)), Ok(Message::States(own))) = (had.message(), has.message()) else {
        return None;
    };
    let pairs = had.views.iter().zip(&own.views).zip((0..).map(DeviceId));
    let ((said, held), device) = pairs.into_iter().find(|((said, held), _)| said != held)?;
    let (said, held) = (said.battery.units(), held.battery.units());
    Some(Divergence {
        tti: has.tti,
        device: Some(device),
        what: format!("the run has {said:.2} units in the battery of device {device}, and the replay {held:.2}"),
    })
}

/// Compares the outcomes of a run and its replay.
///
/// # Errors
/// If they differ; the error is the first divergence.
fn same_outcome(live: &Outcome, replayed: &Outcome) -> Result<(), Divergence> {
    let tti = Tti(live.ttis_done);
    // The digest covers the ledgers too, but a differing ledger names its device.
    let differing = live.devices.iter().zip(&replayed.devices).find(|(a, b)| a != b);
    if let Some((device, _)) = differing {
        return Err(Divergence {
            tti,
            device: Some(device.device),
            what: format!("the ledger of device {} differs from the replay", device.device),
        });
    }
    if live.digest == replayed.digest {
        return Ok(());
    }
    Err(Divergence {
        tti,
        device: None,
        what: format!("the digest is {}, and the replay has {}", live.digest, replayed.digest),
    })
}
