//! Pairs of a wake-up and its outcome, shown as one line by `inspect tail --pair-wake-ups`. The line has the columns of
//! [`FrameLine`](crate::frame_line::FrameLine), and the plane and the kind of a wake-up; change both.

use std::fmt;

use reveille_common::codec::CodecError;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Frame, Message, MessageKind, WakeOutcome};

/// A wake-up with its outcome.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WakeUpExchange {
    /// TTI of the wake-up.
    pub tti: Tti,
    /// The addressed device.
    pub device: DeviceId,
    /// Outcome of the wake-up.
    pub outcome: WakeOutcome,
    /// Bytes on the air: the wake-up, and the report if one arrived.
    pub bytes: usize,
}

impl fmt::Display for WakeUpExchange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            tti,
            device,
            outcome,
            bytes,
        } = self;
        let address = format!("device {device}");
        write!(f, "{tti:>8} air   wake    {address:<11} {bytes:>6} B  {outcome}")
    }
}

/// Role of a frame in the pairing of wake-ups with outcomes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PairStep {
    /// Not part of a wake-up, or an outcome that cannot be decoded: `inspect tail` shows the frame as a line.
    Unpaired,
    /// Part of a wake-up that is still incomplete. `inspect tail` does not show the frame.
    Pending,
    /// Last part of a wake-up, which is complete with it.
    Paired(WakeUpExchange),
}

/// Pairs wake-ups with their outcomes. A run has at most one open wake-up at a time.
#[derive(Clone, Debug, Default)]
pub struct WakeUpPairer {
    /// Device of the open wake-up, and its bytes so far.
    open_wake_up: Option<(DeviceId, usize)>,
}

impl WakeUpPairer {
    /// Adds `frame`, whose decoded content is `message`. A wake-up without an outcome, as when that frame was dropped,
    /// is discarded at the next wake-up.
    pub fn push(&mut self, frame: &Frame, message: &Result<Message, CodecError>) -> PairStep {
        let bytes = frame.payload.len();
        let is_for = |device: DeviceId| frame.number == Some(device.0);
        match (frame.kind, &mut self.open_wake_up) {
            (MessageKind::Wake, open_wake_up) => {
                *open_wake_up = frame.number.map(|number| (DeviceId(number), bytes));
                PairStep::Pending
            }
            (MessageKind::Report, Some((device, bytes_so_far))) if is_for(*device) => {
                *bytes_so_far += bytes;
                PairStep::Pending
            }
            (MessageKind::Woken, Some((device, bytes_so_far))) if is_for(*device) => {
                let (device, bytes) = (*device, *bytes_so_far);
                self.open_wake_up = None;
                match message {
                    Ok(Message::Woken(woken)) => PairStep::Paired(WakeUpExchange {
                        tti: frame.tti,
                        device,
                        outcome: woken.outcome,
                        bytes,
                    }),
                    Ok(_) | Err(_) => PairStep::Unpaired,
                }
            }
            _ => PairStep::Unpaired,
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::message::{Report, WakeUp, WakeUpResult};
    use reveille_common::units::Energy;

    use super::*;

    #[test]
    fn a_wake_up_is_paired_with_its_outcome() {
        let (tti, device) = (Tti(8), DeviceId(5));
        let report = |device| Report {
            device,
            tti,
            information: 0.25,
            battery: Energy::from_micro(2_000_000),
        };
        let outcome = WakeOutcome::Reported(report(device));
        let frames = [
            Frame::new(tti, DeviceId(1), &report(DeviceId(1))),
            Frame::new(tti, device, &WakeUp { tti }),
            Frame::new(tti, device, &report(device)),
            Frame::new(tti, device, &WakeUpResult { outcome }),
            Frame::new(tti, device, &report(device)),
        ];
        let mut pairer = WakeUpPairer::default();
        let steps = frames.each_ref().map(|frame| pairer.push(frame, &frame.message()));
        let bytes = frames[1].payload.len() + frames[2].payload.len();
        let exchange = WakeUpExchange {
            tti,
            device,
            outcome,
            bytes,
        };
        assert_eq!(
            steps,
            [
                PairStep::Unpaired,
                PairStep::Pending,
                PairStep::Pending,
                PairStep::Paired(exchange),
                PairStep::Unpaired
            ]
        );
        let text = exchange.to_string();
        assert!(
            text.contains("wake    device 5") && text.contains("reported: I 0.25"),
            "{text}"
        );
    }
}
