//! A replay: a run in memory that follows a run over the bus, from the scenario and the external inputs alone. It
//! restores the devices of a lost process, and it audits the run: an audit compares a run over the bus with its replay,
//! frame by frame. `deploy/src/audit.rs` feeds it with the frames of [`DigestFrameEncoder`]. Both runs must encode the
//! same frames in the same order.

use std::collections::VecDeque;
use std::fmt;

use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::observer::frames::FrameEncoder;
use reveille_bs::observer::{Notification, Observer};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{DeviceCheckpoint, DeviceStates, Frame, Message};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::Ledger;
use reveille_common::units::Energy;

use crate::external_inputs::{ExternalInput, ExternalInputs};
use crate::run::{Run, RunOptions};

/// Encodes the notifications that a digest covers, messages on the air and their outcomes, as frames. The fingerprint
/// of resume marks covers these frames too, so a change here needs a new `VERSION` in `resume_mark`.
#[derive(Clone, Copy, Debug, Default)]
pub struct DigestFrameEncoder(FrameEncoder);

impl DigestFrameEncoder {
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
            | Notification::ActionTaken(_)
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
    pub description: String,
}

impl fmt::Display for Divergence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "TTI {}: {}", self.tti, self.description)
    }
}

/// A run in memory that follows another run. A decision of a TTI must be added before a call advances past that TTI;
/// the call panics otherwise. After a divergence, frames must not be compared further.
pub struct Replay {
    prepared: PreparedRun,
    run: Run,
    /// The first TTI that is compared.
    compare_from: Tti,
    /// The TTI before which both runs are equal.
    compared_until: Tti,
    inputs: ExternalInputs,
    uncompared: UncomparedFrames,
}

/// The frames of a replay that are not compared yet.
#[derive(Default)]
struct UncomparedFrames {
    encoder: DigestFrameEncoder,
    /// The frames for which the run has no counterpart yet.
    queue: VecDeque<Frame>,
    /// The number of frames that were compared and equal, from the start of the comparison.
    equal_frames: u64,
    /// The number of compared frames that the replay still has to repeat after a restart.
    frames_to_skip: u64,
}

impl UncomparedFrames {
    fn add(&mut self, frame: Frame) {
        if self.frames_to_skip > 0 {
            self.frames_to_skip -= 1;
        } else {
            self.queue.push_back(frame);
        }
    }
}

impl Observer for UncomparedFrames {
    fn notify(&mut self, notification: &Notification<'_>) {
        let mut encoder = self.encoder;
        encoder.encode(notification, |frame| self.add(frame));
        self.encoder = encoder;
    }

    fn batteries_revealed(&mut self, tti: Tti, batteries: &[Energy]) {
        self.add(DigestFrameEncoder::batteries_frame(tti, batteries));
    }
}

impl Replay {
    /// Creates the replay of the run `prepared` with these `inputs`, before TTI 0. The comparison starts at TTI `from`.
    pub fn new(prepared: &PreparedRun, inputs: &ExternalInputs, from: Tti) -> Self {
        Self {
            run: start_run(prepared, inputs),
            prepared: prepared.clone(),
            compare_from: from,
            compared_until: from,
            inputs: inputs.clone(),
            uncompared: UncomparedFrames::default(),
        }
    }

    /// Adds an external input of a TTI that is not compared yet. A replay past that TTI restarts from TTI 0.
    pub fn add_input(&mut self, input: ExternalInput) {
        let tti = match &input {
            ExternalInput::Removal(removal) => removal.tti,
            ExternalInput::Decision(decision) => decision.tti,
            ExternalInput::Action(action) => action.tti,
        };
        // Added before a restart, which schedules all inputs.
        self.inputs.add(input.clone());
        if self.next_tti() > tti {
            self.restart();
        } else {
            self.run.schedule_input(input);
        }
    }

    /// The next TTI.
    pub const fn next_tti(&self) -> Tti {
        self.run.cycle().next_tti()
    }

    /// Advances to TTI `k`, after a restart if the replay is past it.
    ///
    /// # Panics
    /// If a decision before TTI `k` is missing.
    fn advance_to(&mut self, k: Tti) {
        if self.next_tti() > k {
            self.restart();
        }
        // Frames before `compare_from` are not compared and would only accumulate.
        self.run.advance(k.min(self.compare_from), &mut ());
        self.run.advance(k, &mut self.uncompared);
        assert!(
            self.run.missing_decision().is_none(),
            "a decision is added before the run continues from it"
        );
    }

    /// Replaces the run by one before TTI 0 and returns the old one.
    fn restart(&mut self) -> Run {
        self.uncompared.queue.clear();
        // The new run repeats its frames from `compare_from` on; the compared ones are skipped.
        self.uncompared.frames_to_skip = self.uncompared.equal_frames;
        std::mem::replace(&mut self.run, start_run(&self.prepared, &self.inputs))
    }

    /// Ends the comparison with the run.
    pub fn stop_comparing(&mut self) {
        self.compare_from = Tti::NEVER;
        self.uncompared = UncomparedFrames::default();
    }

    /// The TTI before which both runs are equal.
    pub const fn compared_until(&self) -> Tti {
        self.compared_until
    }

    /// Returns checkpoints of `count` devices from `first` on, before TTI `k`.
    ///
    /// # Panics
    /// If one of the devices does not exist, or a decision before TTI `k` is missing.
    pub fn checkpoints(&mut self, k: Tti, first: DeviceId, count: u32) -> Vec<DeviceCheckpoint> {
        self.advance_to(k);
        self.run.checkpoints(first, count)
    }

    /// Returns the ledgers of `count` devices from `first` on, before TTI `k`.
    ///
    /// # Panics
    /// As for [`Self::checkpoints`].
    pub fn ledgers(&mut self, k: Tti, first: DeviceId, count: u32) -> Vec<Ledger> {
        self.advance_to(k);
        self.run.ledgers(first, count)
    }

    /// Returns the outcome of the run before TTI `k`. The replay then restarts from TTI 0.
    pub fn outcome(&mut self, k: Tti) -> RunOutcome {
        self.advance_to(k);
        self.restart().partial_outcome()
    }

    /// Audits the run up to TTI `k`: compares its frames since the last comparison, all of them from TTIs before `k`. A
    /// frame that only the replay has is found by the next comparison with a frame, or by [`Self::compare_outcome`].
    ///
    /// # Errors
    /// If the runs differ; the error is the first divergence.
    pub fn compare(&mut self, k: Tti, live: &[Frame]) -> Result<(), Divergence> {
        // Never goes back: frames of later TTIs wait in `uncompared`, and a restart would only repeat them.
        self.advance_to(k.max(self.next_tti()));
        for frame in live {
            match self.uncompared.queue.pop_front() {
                Some(replayed) if replayed == *frame => self.uncompared.equal_frames += 1,
                replayed => return Err(frame_divergence(Some(frame), replayed.as_ref())),
            }
        }
        self.compared_until = k;
        Ok(())
    }

    /// Compares the outcome of the run, after all its frames have been compared.
    ///
    /// # Errors
    /// If the outcomes differ; the error is the first divergence.
    pub fn compare_outcome(&mut self, live: &RunOutcome) -> Result<(), Divergence> {
        self.advance_to(Tti(live.ttis_done));
        if let Some(extra_frame) = self.uncompared.queue.pop_front() {
            return Err(frame_divergence(None, Some(&extra_frame)));
        }
        compare_outcomes(live, &self.outcome(Tti(live.ttis_done)))
    }
}

fn start_run(prepared: &PreparedRun, inputs: &ExternalInputs) -> Run {
    let mut run = Run::new(prepared, RunOptions::default());
    run.schedule_inputs(inputs);
    run
}

/// Describes the difference between a frame of the run (`live`) and a frame of the replay (`replayed`).
fn frame_divergence(live: Option<&Frame>, replayed: Option<&Frame>) -> Divergence {
    if let (Some(live), Some(replayed)) = (live, replayed)
        && let Some(divergence) = battery_divergence(live, replayed)
    {
        return divergence;
    }
    let ttis = live.iter().chain(&replayed).map(|frame| frame.tti);
    let describe = |frame: Option<&Frame>| match frame {
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
        device: live
            .and_then(Frame::device)
            .or_else(|| replayed.and_then(Frame::device)),
        description: format!("the run had {}, the replay has {}", describe(live), describe(replayed)),
    }
}

/// Returns the first wrong battery reported to a run, if both frames hold batteries.
fn battery_divergence(live: &Frame, replayed: &Frame) -> Option<Divergence> {
    let (Ok(Message::States(live)), Ok(Message::States(computed))) = (live.message(), replayed.message()) else {
        return None;
    };
    let pairs = live.views.iter().zip(&computed.views).zip((0..).map(DeviceId));
    let ((reported, computed), device) = pairs
        .into_iter()
        .find(|((reported, computed), _)| reported != computed)?;
    // Exact: the levels can differ in any digit.
    let (reported, computed) = (reported.battery, computed.battery);
    Some(Divergence {
        tti: replayed.tti,
        device: Some(device),
        description: format!("the run has {reported} in the battery of device {device}, and the replay {computed}"),
    })
}

/// Compares the outcomes of a run and its replay.
///
/// # Errors
/// If they differ; the error is the first divergence.
fn compare_outcomes(live: &RunOutcome, replayed: &RunOutcome) -> Result<(), Divergence> {
    let tti = Tti(live.ttis_done);
    // The digest covers the ledgers too, but a differing ledger names its device.
    let differing = live.devices.iter().zip(&replayed.devices).find(|(a, b)| a != b);
    if let Some((summary, _)) = differing {
        return Err(Divergence {
            tti,
            device: Some(summary.device),
            description: format!("the ledger of device {} differs from the replay", summary.device),
        });
    }
    if live.digest == replayed.digest {
        return Ok(());
    }
    Err(Divergence {
        tti,
        device: None,
        description: format!("the digest is {}, and the replay has {}", live.digest, replayed.digest),
    })
}
