//! The tokio shell of a device: one task, one mailbox, one [`Machine`].

use std::sync::Arc;

use reveille_common::event::Stimulus;
use reveille_common::ids::Tti;
use reveille_common::message::{Answer, WakeOutcome};
use reveille_common::plan::DutyCycle;
use tokio::sync::mpsc::UnboundedReceiver;

use crate::host::round::{Part, Round};
use crate::host::uplink::Uplink;
use crate::machine::{Machine, Physics, Sensed};

/// What reaches a device.
pub enum Input {
    /// Air: δ from a TTI on.
    Duty(Tti, DutyCycle),
    /// Emulation: end all TTIs before this one and add the sums to the round.
    Settle(Tti, Arc<Round>),
    /// Emulation: begin this TTI, if it has not begun, and add state and battery to the round.
    View(Tti, Arc<Round>),
    /// The physical world in a TTI.
    Sense(Tti, Stimulus, Arc<Round>),
    /// Air: the wake-up radio in a TTI, and what the world shows when the device is awake.
    Wake(Tti, Option<Stimulus>),
}

/// A device's task.
pub struct Actor {
    machine: Machine,
    physics: Arc<Physics>,
    uplink: Arc<Uplink>,
    /// The last wake-up and what came of it: the BS may ask again.
    last_wake: Option<(Tti, WakeOutcome)>,
}

impl Actor {
    /// The task of `machine`.
    pub const fn new(machine: Machine, physics: Arc<Physics>, uplink: Arc<Uplink>) -> Self {
        Self {
            machine,
            physics,
            uplink,
            last_wake: None,
        }
    }

    /// Lives until the mailbox is closed.
    pub async fn run(mut self, mut mailbox: UnboundedReceiver<Input>) {
        while let Some(input) = mailbox.recv().await {
            match input {
                Input::Duty(from, duty) => self.machine.set_duty(from, duty),
                Input::Settle(k, round) => {
                    self.machine.settle(k);
                    round.add(
                        &Part::Books(self.machine.id(), Box::new(self.machine.ledger())),
                        &self.uplink,
                    );
                }
                Input::View(tti, round) => {
                    self.machine.begin(tti);
                    round.add(&Part::View(self.machine.id(), self.machine.view()), &self.uplink);
                }
                Input::Sense(tti, stimulus, round) => self.sense(tti, &stimulus, &round),
                Input::Wake(tti, stimulus) => self.wake(tti, stimulus.as_ref()),
            }
        }
    }

    fn sense(&mut self, tti: Tti, stimulus: &Stimulus, round: &Round) {
        let sensed = self.machine.sense(tti, stimulus, &self.physics);
        tracing::trace!(%tti, device = %self.machine.id(), ?sensed, state = ?self.machine.state(), "sensed");
        let part = match sensed {
            Sensed::Nothing => Part::Nothing,
            Sensed::Failed(failure) => Part::Failed(failure),
            Sensed::Reported(report) => {
                self.uplink.report(&report);
                Part::Reported(report)
            }
        };
        round.add(&part, &self.uplink);
    }

    fn wake(&mut self, tti: Tti, stimulus: Option<&Stimulus>) {
        let outcome = match self.last_wake {
            Some((last, outcome)) if last == tti => outcome,
            Some(_) | None => self.machine.wake(tti, stimulus, &self.physics),
        };
        tracing::trace!(%tti, device = %self.machine.id(), ?outcome, state = ?self.machine.state(), "woken");
        self.last_wake = Some((tti, outcome));
        let device = self.machine.id();
        match outcome {
            // What is lost on its way was sent.
            WakeOutcome::Reported(report) | WakeOutcome::Lost(report) => self.uplink.report(&report),
            WakeOutcome::Failed(_) | WakeOutcome::Unheard | WakeOutcome::Late { .. } => {
                self.uplink.answer(&Answer::NotWoken { device, tti, outcome });
            }
        }
    }
}
