//! A wake-up and what came of it as one thing.

use std::fmt;

use reveille_common::codec::CodecError;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Frame, Message, MessageKind, WakeOutcome};

/// A wake-up with its outcome.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Joined {
    /// The TTI.
    pub tti: Tti,
    /// The device that was to be woken.
    pub device: DeviceId,
    /// What came of it.
    pub outcome: WakeOutcome,
    /// Bytes on the air: the wake-up, and the report if there was one.
    pub bytes: usize,
}

impl fmt::Display for Joined {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            tti,
            device,
            outcome,
            bytes,
        } = self;
        let whose = format!("device {device}");
        write!(f, "{tti:>8} air   wake    {whose:<11} {bytes:>6} B  {outcome}")
    }
}

/// What a frame is, once wake-ups are joined.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Step {
    /// It stands for itself.
    Alone,
    /// It is a part of a wake-up that is not complete yet.
    Held,
    /// It completes this wake-up.
    Complete(Joined),
}

/// Joins wake-ups with their outcomes.
#[derive(Clone, Debug, Default)]
pub struct Join {
    /// The device that is being woken, and the bytes so far.
    waking: Option<(DeviceId, usize)>,
}

impl Join {
    /// Takes in `frame`, in which `message` was read. A wake-up whose outcome never comes, as it was left out, is
    /// forgotten with the next.
    pub fn take(&mut self, frame: &Frame, message: &Result<Message, CodecError>) -> Step {
        let bytes = frame.payload.len();
        let is_own = |device: DeviceId| frame.number == Some(device.0);
        match (frame.kind, &mut self.waking) {
            (MessageKind::Wake, waking) => {
                *waking = frame.number.map(|number| (DeviceId(number), bytes));
                Step::Held
            }
            (MessageKind::Report, Some((device, sum))) if is_own(*device) => {
                *sum += bytes;
                Step::Held
            }
            (MessageKind::Woken, Some((device, sum))) if is_own(*device) => {
                let (device, bytes) = (*device, *sum);
                self.waking = None;
                match message {
                    Ok(Message::Woken(woken)) => Step::Complete(Joined {
                        tti: frame.tti,
                        device,
                        outcome: woken.outcome,
                        bytes,
                    }),
                    Ok(_) | Err(_) => Step::Alone,
                }
            }
            _ => Step::Alone,
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::message::{Report, WakeUp, Woken};
    use reveille_common::units::Energy;

    use super::*;

    #[test]
    fn a_wake_up_comes_with_its_outcome() {
        let (tti, device) = (Tti(8), DeviceId(5));
        let report = |device| Report {
            device,
            tti,
            information: 0.25,
            battery: Energy::from_micro(2_000_000),
        };
        let outcome = WakeOutcome::Reported(report(device));
        let frames = [
            Frame::of(tti, DeviceId(1), &report(DeviceId(1))),
            Frame::of(tti, device, &WakeUp { tti }),
            Frame::of(tti, device, &report(device)),
            Frame::of(tti, device, &Woken { outcome }),
            Frame::of(tti, device, &report(device)),
        ];
        let mut join = Join::default();
        let steps = frames.each_ref().map(|frame| join.take(frame, &frame.message()));
        let bytes = frames[1].payload.len() + frames[2].payload.len();
        let joined = Joined {
            tti,
            device,
            outcome,
            bytes,
        };
        assert_eq!(
            steps,
            [Step::Alone, Step::Held, Step::Held, Step::Complete(joined), Step::Alone]
        );
        let text = joined.to_string();
        assert!(
            text.contains("wake    device 5") && text.contains("reported: I 0.2500"),
            "{text}"
        );
    }
}
