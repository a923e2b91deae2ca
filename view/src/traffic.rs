//! How many messages there are, and how many bytes: by kind and plane, a TTI, a device.

use std::collections::BTreeMap;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Addressee, Frame, Message, MessageKind, Plane};
use serde::Serialize;

/// Messages and their bytes, as encoded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Count {
    /// Messages; one to many is one.
    pub messages: u64,
    /// Their bytes.
    pub bytes: u64,
}

impl Count {
    fn add(&mut self, bytes: usize) {
        self.messages += 1;
        self.bytes += bytes as u64;
    }

    fn sum(counts: impl Iterator<Item = Self>) -> Self {
        counts.fold(Self::default(), |sum, one| Self {
            messages: sum.messages + one.messages,
            bytes: sum.bytes + one.bytes,
        })
    }
}

/// The traffic of a run, or of a part of it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    kinds: BTreeMap<MessageKind, Count>,
    /// By device, of the kinds that have one in their keys.
    devices: BTreeMap<DeviceId, BTreeMap<MessageKind, Count>>,
    first: Option<Tti>,
    last: Option<Tti>,
}

impl Traffic {
    /// Counts `frame`.
    pub fn count(&mut self, frame: &Frame) {
        let bytes = frame.payload.len();
        self.kinds.entry(frame.kind).or_default().add(bytes);
        if let (Addressee::Device, Some(number)) = (frame.kind.addressee(), frame.number) {
            let device = self.devices.entry(DeviceId(number)).or_default();
            device.entry(frame.kind).or_default().add(bytes);
        }
        // Nothing needs to be heard of the TTIs that devices go through.
        let last = match (frame.kind == MessageKind::World).then(|| frame.message()) {
            Some(Ok(Message::World(world))) => world.last,
            Some(Ok(_) | Err(_)) | None => frame.tti,
        };
        self.first = Some(self.first.map_or(frame.tti, |first| first.min(frame.tti)));
        self.last = Some(self.last.map_or(last, |before| before.max(last)));
    }

    /// The TTIs from that of the first message to that of the last, both counted; 0 where there was none.
    pub fn ttis(&self) -> u64 {
        self.first.zip(self.last).map_or(0, |(first, last)| last - first + 1)
    }

    /// The first and the last TTI.
    pub fn span(&self) -> Option<(Tti, Tti)> {
        self.first.zip(self.last)
    }

    /// By kind, those that there were.
    pub fn kinds(&self) -> impl Iterator<Item = (MessageKind, Count)> {
        self.kinds.iter().map(|(kind, count)| (*kind, *count))
    }

    /// Of one kind.
    pub fn kind(&self, kind: MessageKind) -> Count {
        self.kinds.get(&kind).copied().unwrap_or_default()
    }

    /// Of a plane.
    pub fn plane(&self, plane: Plane) -> Count {
        Count::sum(
            self.kinds()
                .filter(|(kind, _)| kind.plane() == plane)
                .map(|(_, count)| count),
        )
    }

    /// What the BS puts on the air: plans and wake-ups.
    pub fn control(&self) -> Count {
        Count::sum(
            [MessageKind::Plan, MessageKind::Wake]
                .map(|kind| self.kind(kind))
                .into_iter(),
        )
    }

    /// What the devices put on the air: reports.
    pub fn uplink(&self) -> Count {
        self.kind(MessageKind::Report)
    }

    /// Control bytes as a share of all bytes on the air, `[0, 1]`; nothing where there are none.
    pub fn control_share(&self) -> Option<f64> {
        let all = self.plane(Plane::Air).bytes;
        (all > 0).then(|| self.control().bytes as f64 / all as f64)
    }

    /// By device, those that there was something of: its messages by kind.
    pub fn devices(&self) -> impl Iterator<Item = (DeviceId, &BTreeMap<MessageKind, Count>)> {
        self.devices.iter().map(|(device, kinds)| (*device, kinds))
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::message::{PlanUpdate, Report, WakeUp};
    use reveille_common::plan::Plan;
    use reveille_common::units::Energy;

    use super::*;

    #[test]
    fn messages_are_counted_by_kind_plane_and_device() {
        let plan = PlanUpdate {
            from: Tti(3),
            plan: Plan::from_chosen(8, &[DeviceId(1)]),
        };
        let report = |tti, device| {
            let report = Report {
                device: DeviceId(device),
                tti: Tti(tti),
                information: 0.5,
                battery: Energy::ZERO,
            };
            Frame::of(Tti(tti), DeviceId(device), &report)
        };
        let frames = [
            Frame::of(Tti(3), (), &plan),
            report(4, 1),
            Frame::of(Tti(4), DeviceId(2), &WakeUp { tti: Tti(4) }),
            report(4, 2),
            report(12, 1),
        ];
        let mut traffic = Traffic::default();
        for frame in &frames {
            traffic.count(frame);
        }
        let bytes = |of: &[usize]| of.iter().map(|at| frames[*at].payload.len() as u64).sum::<u64>();
        let count = |of: &[usize]| Count {
            messages: of.len() as u64,
            bytes: bytes(of),
        };
        assert_eq!(traffic.ttis(), 10);
        assert_eq!(traffic.control(), count(&[0, 2]));
        assert_eq!(traffic.uplink(), count(&[1, 3, 4]));
        assert_eq!(traffic.plane(Plane::Air), count(&[0, 1, 2, 3, 4]));
        assert_eq!(traffic.plane(Plane::Emu), Count::default());
        let share = bytes(&[0, 2]) as f64 / bytes(&[0, 1, 2, 3, 4]) as f64;
        assert!((traffic.control_share().expect("there is traffic") - share).abs() < 1e-12);
        let second: Vec<_> = traffic
            .devices()
            .nth(1)
            .expect("two devices")
            .1
            .values()
            .copied()
            .collect();
        assert_eq!(second, [count(&[2]), count(&[3])]);
        assert_eq!(Traffic::default().control_share(), None);
    }
}
