//! Traffic statistics: messages and bytes by kind, plane and device, for `inspect stats` and the dashboard. The fields
//! of [`MessageCount`] are keys in `inspect stats --json`.

use std::collections::BTreeMap;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Addressee, Frame, Message, MessageKind, Plane};
use serde::Serialize;

/// Number of messages and of their encoded bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct MessageCount {
    /// Messages; a broadcast counts once.
    pub messages: u64,
    /// Encoded bytes.
    pub bytes: u64,
}

impl MessageCount {
    fn add(&mut self, bytes: usize) {
        self.messages += 1;
        self.bytes += bytes as u64;
    }

    fn sum(counts: impl Iterator<Item = Self>) -> Self {
        counts.fold(Self::default(), |sum, count| Self {
            messages: sum.messages + count.messages,
            bytes: sum.bytes + count.bytes,
        })
    }
}

/// Traffic of a run or part of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TrafficStats {
    /// Counts by kind.
    kinds: BTreeMap<MessageKind, MessageCount>,
    /// Counts by device, for kinds with a device in their keys.
    devices: BTreeMap<DeviceId, BTreeMap<MessageKind, MessageCount>>,
    first_tti: Option<Tti>,
    last_tti: Option<Tti>,
    /// The first and the last TTI to count; without a last one, all from the first on.
    bounds: (Tti, Option<Tti>),
}

impl TrafficStats {
    /// Counts only the TTIs from `since` to `until`, inclusive; to the end without `until`.
    pub fn within(since: Tti, until: Option<Tti>) -> Self {
        Self {
            bounds: (since, until),
            ..Self::default()
        }
    }

    /// Counts `frame`, unless its TTI is out of bounds.
    pub fn count(&mut self, frame: &Frame) {
        self.cover(frame);
        let (since, until) = self.bounds;
        if frame.tti < since || until.is_some_and(|until| frame.tti > until) {
            return;
        }
        let bytes = frame.payload.len();
        self.kinds.entry(frame.kind).or_default().add(bytes);
        if let (Addressee::Device, Some(number)) = (frame.kind.addressee(), frame.number) {
            let device_kinds = self.devices.entry(DeviceId(number)).or_default();
            device_kinds.entry(frame.kind).or_default().add(bytes);
        }
    }

    /// Adds the TTIs of `frame` to the range.
    fn cover(&mut self, frame: &Frame) {
        // The TTI of an emulation message can be one after the last, when the base station collects the ledgers.
        if frame.kind.plane() == Plane::Emu {
            return;
        }
        // A grant can cover TTIs without messages, so its last TTI counts.
        let last = match (frame.kind == MessageKind::World).then(|| frame.message()) {
            Some(Ok(Message::World(world))) => world.last,
            Some(Ok(_) | Err(_)) | None => frame.tti,
        };
        // A grant can begin or end out of bounds.
        let (since, until) = self.bounds;
        let (first, last) = (frame.tti.max(since), until.map_or(last, |until| last.min(until)));
        if first <= last {
            self.first_tti = Some(self.first_tti.map_or(first, |earlier| earlier.min(first)));
            self.last_tti = Some(self.last_tti.map_or(last, |earlier| earlier.max(last)));
        }
    }

    /// Number of TTIs in [`Self::tti_range`], inclusive; 0 without them.
    pub fn ttis(&self) -> u64 {
        self.first_tti
            .zip(self.last_tti)
            .map_or(0, |(first, last)| last - first + 1)
    }

    /// The first and the last TTI with a message or a grant; `None` without them. Emulation messages do not count.
    pub fn tti_range(&self) -> Option<(Tti, Tti)> {
        self.first_tti.zip(self.last_tti)
    }

    /// Counts by kind, for kinds with messages.
    pub fn kinds(&self) -> impl Iterator<Item = (MessageKind, MessageCount)> {
        self.kinds.iter().map(|(kind, count)| (*kind, *count))
    }

    /// Count of one kind.
    pub fn kind(&self, kind: MessageKind) -> MessageCount {
        self.kinds.get(&kind).copied().unwrap_or_default()
    }

    /// Count of a plane.
    pub fn plane(&self, plane: Plane) -> MessageCount {
        MessageCount::sum(
            self.kinds()
                .filter(|(kind, _)| kind.plane() == plane)
                .map(|(_, count)| count),
        )
    }

    /// Count of the base station's messages on the air: plans and wake-ups. A new kind from the base station on the air
    /// plane belongs here.
    pub fn control(&self) -> MessageCount {
        MessageCount::sum(
            [MessageKind::Plan, MessageKind::Wake]
                .map(|kind| self.kind(kind))
                .into_iter(),
        )
    }

    /// Count of the devices' messages that arrive over the air: reports, without lost ones.
    pub fn uplink(&self) -> MessageCount {
        self.kind(MessageKind::Report)
    }

    /// Control bytes as a share of all bytes on the air, `[0, 1]`; `None` without such bytes.
    pub fn control_share(&self) -> Option<f64> {
        let all = self.plane(Plane::Air).bytes;
        (all > 0).then(|| self.control().bytes as f64 / all as f64)
    }

    /// Counts by device and kind, for devices with messages.
    pub fn devices(&self) -> impl Iterator<Item = (DeviceId, &BTreeMap<MessageKind, MessageCount>)> {
        self.devices.iter().map(|(device, kinds)| (*device, kinds))
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::message::{PlanUpdate, Report, WakeUp, WorldUpdate};
    use reveille_common::plan::Plan;
    use reveille_common::units::Energy;

    use super::*;

    #[test]
    fn bounds_limit_the_messages_and_cut_the_grants() {
        let grant = |first, last| {
            let world = WorldUpdate {
                first: Tti(first),
                last: Tti(last),
                stimulus: None,
                stimulus_last: Tti(last),
            };
            Frame::new(Tti(first), (), &world)
        };
        let frames = [grant(0, 9), grant(10, 23), grant(24, 24)];
        let count = |since, until| {
            let mut traffic = TrafficStats::within(Tti(since), until);
            for frame in &frames {
                traffic.count(frame);
            }
            (
                traffic.kind(MessageKind::World).messages,
                traffic.ttis(),
                traffic.tti_range(),
            )
        };
        assert_eq!(count(0, None), (3, 25, Some((Tti(0), Tti(24)))));
        assert_eq!(count(8, Some(Tti(11))), (1, 4, Some((Tti(8), Tti(11)))));
        // No message is of these TTIs, but a grant covers them.
        assert_eq!(count(12, Some(Tti(20))), (0, 9, Some((Tti(12), Tti(20)))));
        assert_eq!(count(25, None), (0, 0, None));
    }

    #[test]
    fn messages_are_counted_by_kind_plane_and_device() {
        let plan = PlanUpdate {
            from: Tti(3),
            plan: Plan::from_devices(8, &[DeviceId(1)]),
        };
        let report = |tti, device| {
            let report = Report {
                device: DeviceId(device),
                tti: Tti(tti),
                information: 0.5,
                battery: Energy::ZERO,
            };
            Frame::new(Tti(tti), DeviceId(device), &report)
        };
        let frames = [
            Frame::new(Tti(3), (), &plan),
            report(4, 1),
            Frame::new(Tti(4), DeviceId(2), &WakeUp { tti: Tti(4) }),
            report(4, 2),
            report(12, 1),
        ];
        let mut traffic = TrafficStats::default();
        for frame in &frames {
            traffic.count(frame);
        }
        let bytes = |indices: &[usize]| {
            indices
                .iter()
                .map(|index| frames[*index].payload.len() as u64)
                .sum::<u64>()
        };
        let count = |indices: &[usize]| MessageCount {
            messages: indices.len() as u64,
            bytes: bytes(indices),
        };
        assert_eq!(traffic.ttis(), 10);
        assert_eq!(traffic.control(), count(&[0, 2]));
        assert_eq!(traffic.uplink(), count(&[1, 3, 4]));
        assert_eq!(traffic.plane(Plane::Air), count(&[0, 1, 2, 3, 4]));
        assert_eq!(traffic.plane(Plane::Emu), MessageCount::default());
        let control_share = bytes(&[0, 2]) as f64 / bytes(&[0, 1, 2, 3, 4]) as f64;
        assert!((traffic.control_share().expect("messages") - control_share).abs() < 1e-12);
        let device_2: Vec<_> = traffic
            .devices()
            .nth(1)
            .expect("two devices")
            .1
            .values()
            .copied()
            .collect();
        assert_eq!(device_2, [count(&[2]), count(&[3])]);
        assert_eq!(TrafficStats::default().control_share(), None);
    }
}
