//! The tokio task of a device, with one mailbox and one [`Machine`]. It executes commands in the order in which the
//! host (`mod.rs`) sends them, which must be the order within a TTI: a command for an earlier TTI can panic.

use std::sync::Arc;

use reveille_common::event::Stimulus;
use reveille_common::ids::Tti;
use reveille_common::message::{Change, HostAnswer, UnableDetectors, WakeOutcome};
use reveille_common::plan::DutyCycle;
use tokio::sync::mpsc::UnboundedReceiver;

use super::answer_round::{AnswerRound, DeviceAnswer, Uplink};
use crate::machine::{Machine, Physics, SenseOutcome};

/// A command to a device. A command with a round adds exactly one part to it; [`AnswerRound::new`] gets their number.
pub(crate) enum DeviceCommand {
    /// Air plane: δ from a TTI on.
    Duty(Tti, DutyCycle),
    /// Emulation plane: a change that an operator makes at the start of a TTI.
    Change(Tti, Change),
    /// Emulation plane: end all TTIs before this one and add the ledger to the round, which sends it whole or only its
    /// totals, by its request.
    AdvanceTo(Tti, Arc<AnswerRound>),
    /// Emulation plane: begin this TTI, if it has not begun, and add state and battery to the round.
    View(Tti, Arc<AnswerRound>),
    /// The stimulus of the physical world in a TTI.
    Sense(Tti, Stimulus, Arc<AnswerRound>),
    /// Air plane: a wake-up signal in a TTI, and the stimulus that the device senses once it is awake.
    Wake(Tti, Option<Stimulus>),
}

/// A device's task.
pub(crate) struct Actor {
    machine: Machine,
    physics: Arc<Physics>,
    uplink: Arc<Uplink>,
    /// The last wake-up and its outcome, because the base station may repeat the wake-up.
    last_wake: Option<(Tti, WakeOutcome)>,
}

impl Actor {
    /// Creates the task of `machine`.
    pub(crate) const fn new(machine: Machine, physics: Arc<Physics>, uplink: Arc<Uplink>) -> Self {
        Self {
            machine,
            physics,
            uplink,
            last_wake: None,
        }
    }

    /// Runs until the mailbox is closed, at the end of the host.
    pub(crate) async fn run(mut self, mut mailbox: UnboundedReceiver<DeviceCommand>) {
        while let Some(command) = mailbox.recv().await {
            match command {
                DeviceCommand::Duty(from, duty) => self.machine.set_duty(from, duty),
                DeviceCommand::Change(tti, change) => self.machine.apply(tti, &change),
                DeviceCommand::AdvanceTo(k, round) => {
                    self.machine.advance_to(k);
                    round.add(
                        &DeviceAnswer::Ledger(self.machine.id(), Box::new(self.machine.ledger())),
                        &self.uplink,
                    );
                }
                DeviceCommand::View(tti, round) => {
                    self.machine.begin(tti);
                    round.add(
                        &DeviceAnswer::View(self.machine.id(), self.machine.view()),
                        &self.uplink,
                    );
                }
                DeviceCommand::Sense(tti, stimulus, round) => self.sense(tti, &stimulus, &round),
                DeviceCommand::Wake(tti, stimulus) => self.wake(tti, stimulus.as_ref()),
            }
        }
    }

    fn sense(&mut self, tti: Tti, stimulus: &Stimulus, round: &AnswerRound) {
        let sensed = self.machine.sense(tti, stimulus, &self.physics);
        tracing::trace!(%tti, device = %self.machine.id(), ?sensed, state = ?self.machine.state(), "sensed");
        let answer = match sensed {
            SenseOutcome::Nothing => DeviceAnswer::Nothing,
            SenseOutcome::Failed => DeviceAnswer::Unable(UnableDetectors::FAILED),
            SenseOutcome::Unpowered => DeviceAnswer::Unable(UnableDetectors::UNPOWERED),
            SenseOutcome::TransmissionFailed(failure) => DeviceAnswer::Failed(failure),
            SenseOutcome::Reported(report) => {
                // Sent before the part is added, since the answer must follow the reports whose number it states.
                self.uplink.send_report(&report);
                DeviceAnswer::Reported(report)
            }
        };
        round.add(&answer, &self.uplink);
    }

    fn wake(&mut self, tti: Tti, stimulus: Option<&Stimulus>) {
        let outcome = match self.last_wake {
            // A repeated wake-up must not consume energy again.
            Some((last, outcome)) if last == tti => outcome,
            Some(_) | None => self.machine.wake(tti, stimulus, &self.physics),
        };
        tracing::trace!(%tti, device = %self.machine.id(), ?outcome, state = ?self.machine.state(), "woken");
        self.last_wake = Some((tti, outcome));
        let device = self.machine.id();
        match outcome {
            // The modelled air loses a report after transmission, and the base station draws that loss itself.
            WakeOutcome::Reported(report) | WakeOutcome::Lost(report) => self.uplink.send_report(&report),
            WakeOutcome::Failed(_) | WakeOutcome::Missed | WakeOutcome::Late { .. } => {
                self.uplink.send_answer(&HostAnswer::NoReport { device, tti, outcome });
            }
        }
    }
}
