//! Filters for frames, from the options of `inspect tail`, `export` and the dashboard. The names in [`StateName::ALL`]
//! are values of `--state` and of the dashboard's query, listed in docs/inspecting.md. A new criterion also needs an
//! option in `deploy/src/cli/inspect.rs` and a field of `MessageQuery` in `deploy/src/dashboard/api.rs`.

use std::ops::RangeInclusive;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Frame, Message, MessageKind, Plane};
use reveille_common::state::DeviceState;

/// Criteria for frames; the default passes every frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Filter {
    /// Plane of the messages.
    pub plane: Option<Plane>,
    /// Kinds of messages; empty for all.
    pub kinds: Vec<MessageKind>,
    /// Devices that a message comes from, goes to or concerns. Messages to all devices pass too; an empty list passes
    /// nothing. `None` for all messages.
    pub devices: Option<Vec<DeviceId>>,
    /// TTIs of the messages.
    pub ttis: Option<RangeInclusive<u64>>,
    /// States of the device that a message comes from or goes to; empty for all.
    pub states: Vec<StateName>,
}

/// State of a device, as named on the command line. The names overlap: `S4` covers `unpowered`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StateName {
    /// S1: sensing.
    S1,
    /// S2: about to transmit.
    S2,
    /// S3: has transmitted.
    S3,
    /// S4: asleep, with or without power for the wake-up radio.
    S4,
    /// S4 without power for the wake-up radio.
    Unpowered,
    /// An operator has let the device fail.
    Failed,
}

impl StateName {
    /// Every state, with its name.
    pub const ALL: [(&'static str, Self); 6] = [
        ("S1", Self::S1),
        ("S2", Self::S2),
        ("S3", Self::S3),
        ("S4", Self::S4),
        ("unpowered", Self::Unpowered),
        ("failed", Self::Failed),
    ];

    /// Whether this name covers `state`.
    pub fn covers(self, state: DeviceState) -> bool {
        match self {
            Self::S1 => state == DeviceState::Idle,
            Self::S2 => state == DeviceState::Active,
            Self::S3 => state == DeviceState::Transmission,
            Self::S4 => matches!(state, DeviceState::Sleep { .. }),
            Self::Unpowered => state == DeviceState::Sleep { powered: false },
            Self::Failed => state == DeviceState::Failed,
        }
    }
}

impl Filter {
    /// Whether `frame`, whose decoded content is `message`, passes. `state` belongs to the device at the end of the
    /// frame's key, if known. `message` is needed only for a filter by device, and `state` only for one by state.
    pub fn passes(&self, frame: &Frame, message: Option<&Message>, state: Option<DeviceState>) -> bool {
        let Self {
            plane,
            kinds,
            devices,
            ttis,
            states,
        } = self;
        plane.is_none_or(|plane| frame.kind.plane() == plane)
            && (kinds.is_empty() || kinds.contains(&frame.kind))
            && ttis.as_ref().is_none_or(|ttis| ttis.contains(&frame.tti.0))
            && (states.is_empty() || state.is_some_and(|state| states.iter().any(|name| name.covers(state))))
            && devices.as_ref().is_none_or(|devices| {
                let is_concerned =
                    |device: &DeviceId| message.is_some_and(|message| message.concerns(frame.number, *device));
                devices.iter().any(is_concerned)
            })
    }

    /// Whether no frame of `tti` or later passes, since it is after the filter's TTIs.
    pub fn is_over(&self, tti: Tti) -> bool {
        self.ttis.as_ref().is_some_and(|ttis| tti.0 > *ttis.end())
    }

    /// First TTI whose frames may pass.
    pub fn first_tti(&self) -> Tti {
        Tti(self.ttis.as_ref().map_or(0, |ttis| *ttis.start()))
    }

    /// Checks that the plane excludes none of the kinds.
    ///
    /// # Errors
    /// If it does; the message uses the options of the command line, and the dashboard shows it too.
    pub fn check_kinds(&self) -> Result<(), String> {
        let Some(plane) = self.plane else { return Ok(()) };
        match self.kinds.iter().find(|kind| kind.plane() != plane) {
            Some(kind) => Err(format!(
                "--plane {} excludes --kind {}, which is on the plane {}",
                plane.name(),
                kind.name(),
                kind.plane().name()
            )),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::message::{FailedTransmission, Report, WakeOutcome, WakeUp, WakeUpResult};
    use reveille_common::units::Energy;

    use super::*;

    fn test_frames() -> Vec<Frame> {
        let report = |tti, device| Report {
            device: DeviceId(device),
            tti: Tti(tti),
            information: 0.5,
            battery: Energy::ZERO,
        };
        let failed = WakeUpResult {
            outcome: WakeOutcome::Failed(FailedTransmission {
                device: DeviceId(2),
                drained_energy: Energy::ZERO,
            }),
        };
        vec![
            Frame::new(Tti(4), DeviceId(1), &report(4, 1)),
            Frame::new(Tti(5), DeviceId(2), &WakeUp { tti: Tti(5) }),
            Frame::new(Tti(5), DeviceId(2), &failed),
            Frame::new(Tti(9), DeviceId(2), &report(9, 2)),
        ]
    }

    /// Returns the indices of the frames that pass.
    fn passing(filter: &Filter) -> Vec<usize> {
        let frames = test_frames();
        // The wake-up in TTI 5 reached an unpowered device.
        let states = [DeviceState::Transmission, DeviceState::Sleep { powered: false }];
        let passes = |index: &usize| {
            let frame = &frames[*index];
            let state = states[usize::from(frame.tti == Tti(5))];
            filter.passes(frame, frame.message().ok().as_ref(), Some(state))
        };
        (0..frames.len()).filter(passes).collect()
    }

    #[test]
    fn a_filter_passes_the_frames_that_match_all_its_fields() {
        let unrestricted = Filter::default();
        assert_eq!(passing(&unrestricted), [0, 1, 2, 3]);
        let cases = [
            (
                Filter {
                    plane: Some(Plane::Truth),
                    ..unrestricted.clone()
                },
                vec![2],
            ),
            (
                Filter {
                    kinds: vec![MessageKind::Report],
                    ..unrestricted.clone()
                },
                vec![0, 3],
            ),
            (
                Filter {
                    devices: Some(vec![DeviceId(2)]),
                    ..unrestricted.clone()
                },
                vec![1, 2, 3],
            ),
            (
                Filter {
                    devices: Some(Vec::new()),
                    ..unrestricted.clone()
                },
                vec![],
            ),
            (
                Filter {
                    ttis: Some(5..=8),
                    ..unrestricted.clone()
                },
                vec![1, 2],
            ),
            (
                Filter {
                    states: vec![StateName::Unpowered],
                    ..unrestricted.clone()
                },
                vec![1, 2],
            ),
            (
                Filter {
                    states: vec![StateName::S1, StateName::S4],
                    ..unrestricted.clone()
                },
                vec![1, 2],
            ),
            (
                Filter {
                    states: vec![StateName::S3],
                    ttis: Some(0..=4),
                    ..unrestricted.clone()
                },
                vec![0],
            ),
        ];
        for (filter, expected) in cases {
            assert_eq!(passing(&filter), expected, "{filter:?}");
        }
        let with_end = Filter {
            ttis: Some(2..=8),
            ..unrestricted
        };
        assert!(!with_end.is_over(Tti(8)) && with_end.is_over(Tti(9)) && with_end.first_tti() == Tti(2));
    }

    #[test]
    fn kinds_of_another_plane_are_refused() {
        let filter = Filter {
            plane: Some(Plane::Air),
            kinds: vec![MessageKind::Wake, MessageKind::Clock],
            ..Filter::default()
        };
        let message = filter.check_kinds().expect_err("refused");
        assert!(
            message.contains("--plane air") && message.contains("--kind clock"),
            "{message}"
        );
    }
}
