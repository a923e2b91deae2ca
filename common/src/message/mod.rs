//! The messages of the bus: every kind of message, declared once.
//!
//! There are three planes. The *air* plane holds the messages that a real deployment would send over the radio, the
//! *emulation* plane the messages that only the emulation needs. The *truth* plane is not sent: it tells observers
//! about the modelled world and the BS's conclusions. The table `messages!` below is the single list of kinds. The keys
//! ([`crate::keys`]), the typed bus (`crate::bus`), `reveille inspect` with its help and its page, and the fuzz target
//! use it. A new kind needs a row of the table, a payload in the file of its plane and, if it is sent, a right in
//! `bus/access.rs`. Rows and fields are encoded by position: a change is a new [`crate::codec::WIRE_VERSION`].
//! `view/src/schemas.rs` traces an enum in a payload only if it names it. Recordings and the Wireshark dissector
//! (`view/src/export/`) hold names, directions and help, and the dissector splits a direction at ` → `.
//!
//! The table omits the copies of messages for observers ([`Frame`]), which are not part of the run.

mod action;
mod air;
mod control;
mod emu;
mod inspect;
mod truth;

use std::fmt;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize};

use crate::codec::{self, CodecError};
use crate::ids::{DeviceId, HostId, Tti};

pub use action::{ActRequest, Change, DeviceRange, OperatorAction, Setting};
pub use air::{FailedTransmission, PlanUpdate, Report, WakeOutcome, WakeUp};
pub use control::{ClockCommand, ClockStatus, HostSummary, Pace};
pub use emu::{
    BusCredentials, ClockMessage, DeviceCheckpoint, DeviceSetup, GrantMessage, HostAnswer, HostCheckpoint, HostOffer,
    HostSetup, JoinReply, JoinRequest, Ready, ResumePoint, UnableDetectors,
};
pub use inspect::{DescribeRequest, Frame, FrameBatch, InputLogPart, InputLogRequest, ScenarioDescription};
pub use truth::{
    BeliefUpdate, DeviceRemoval, DeviceStates, EventUpdate, FailedReport, LostReport, WakeUpResult, WeightedPoint,
    WorldUpdate,
};

/// Declares the kinds of message: kind "name": payload, plane, access, address type, direction, help; the reply of a
/// query follows `=>`.
macro_rules! messages {
    ($(
        $kind:ident $name:literal: $payload:ty $(=> $reply:ty)?, $plane:ident, $access:ident, $address:ty,
        $direction:literal,
        $about:literal;
    )+) => {
        /// The kinds of message, each with its own key.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub enum MessageKind {
            $(#[doc = $about] $kind,)+
        }

        impl MessageKind {
            /// Every kind.
            pub const ALL: &[Self] = &[$(Self::$kind),+];

            /// The name of the kind in keys and on the command line.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$kind => $name,)+
                }
            }

            /// The plane of the kind.
            pub const fn plane(self) -> Plane {
                match self {
                    $(Self::$kind => Plane::$plane,)+
                }
            }

            /// The peers that may send and receive the kind.
            pub const fn access(self) -> Access {
                match self {
                    $(Self::$kind => Access::$access,)+
                }
            }

            /// The kind of number in its frames.
            pub const fn addressee(self) -> Addressee {
                match self {
                    $(Self::$kind => <$address as Address>::ADDRESSEE,)+
                }
            }

            /// The sender and the receiver, as text.
            pub const fn direction(self) -> &'static str {
                match self {
                    $(Self::$kind => $direction,)+
                }
            }

            /// One line of help.
            pub const fn about(self) -> &'static str {
                match self {
                    $(Self::$kind => $about,)+
                }
            }

            /// Passes the payload type of every kind to `visitor`.
            pub fn visit_types(visitor: &mut impl TypeVisitor) {
                $(visitor.visit::<$payload>();)+
            }
        }

        $(impl Payload for $payload {
            type Address = $address;
            const KIND: MessageKind = MessageKind::$kind;
        })+

        $($(impl Query for $payload {
            type Reply = $reply;
        })?)+

        /// A decoded message of any kind.
        #[derive(Clone, Debug, PartialEq, Serialize)]
        #[serde(untagged)]
        pub enum Message {
            $(#[doc = $about] $kind($payload),)+
        }

        impl Message {
            /// Decodes `payload` as a message of `kind`.
            ///
            /// # Errors
            /// If `payload` has another version or is not exactly one message of this kind.
            pub fn decode(kind: MessageKind, payload: &[u8]) -> Result<Self, CodecError> {
                match kind {
                    $(MessageKind::$kind => codec::decode(payload).map(Self::$kind),)+
                }
            }

            /// Deserializes a message of `kind` from a text format with named fields, such as JSON.
            ///
            /// # Errors
            /// If the text is not a message of this kind.
            pub fn deserialize<'de, D: Deserializer<'de>>(kind: MessageKind, text: D) -> Result<Self, D::Error> {
                match kind {
                    $(MessageKind::$kind => <$payload>::deserialize(text).map(Self::$kind),)+
                }
            }

            /// Encodes the message for the bus.
            pub fn encode(&self) -> Vec<u8> {
                match self {
                    $(Self::$kind(message) => codec::encode(message),)+
                }
            }

            /// Returns the length of the encoded message in bytes, without encoding it.
            pub fn encoded_len(&self) -> u64 {
                match self {
                    $(Self::$kind(message) => codec::encoded_len(message),)+
                }
            }

            /// The kind of the message.
            pub const fn kind(&self) -> MessageKind {
                match self {
                    $(Self::$kind(_) => MessageKind::$kind,)+
                }
            }

            /// Whether the message is to, from or about `device`; `number` is [`Frame::number`].
            pub fn concerns(&self, number: Option<u32>, device: DeviceId) -> bool {
                match self {
                    $(Self::$kind(message) => message.concerns(number, device),)+
                }
            }
        }

        impl fmt::Display for Message {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self {
                    $(Self::$kind(message) => message.fmt(f),)+
                }
            }
        }

        /// A decoded reply to a query of any kind.
        #[derive(Clone, Debug, PartialEq, Serialize)]
        #[serde(untagged)]
        pub enum Reply {
            $($(#[doc = concat!("To `", stringify!($payload), "`.")] $kind($reply),)?)+
        }

        impl Reply {
            /// Decodes the reply in `payload` to a query of `kind`; `None` if the kind is not a query.
            pub fn decode(kind: MessageKind, payload: &[u8]) -> Option<Result<Self, CodecError>> {
                $($(if kind == MessageKind::$kind {
                    return Some(codec::decode::<$reply>(payload).map(Self::$kind));
                })?)+
                None
            }

            /// Encodes the reply for the bus.
            pub fn encode(&self) -> Vec<u8> {
                match self {
                    $($(Self::$kind(reply) => codec::encode::<$reply>(reply),)?)+
                }
            }
        }
    };
}

messages! {
    Plan "plan": PlanUpdate, Air, Members, (), "BS → all devices",
        "The δ plan: the TTIs in which each device senses. Sent when it changes and for synchronisation.";
    Wake "wake": WakeUp, Air, Members, DeviceId, "BS → one device",
        "A wake-up signal for a device's wake-up radio.";
    Report "report": Report, Air, Members, DeviceId, "device → BS",
        "A report of a device in S3: information and battery level.";
    Clock "clock": ClockMessage, Emu, Members, (), "BS → all hosts",
        "The virtual clock: a grant of TTIs with the stimulus in the last one, or the end of the run.";
    Answer "answer": HostAnswer, Emu, Members, HostId, "host → BS",
        "A host's answer to a grant or wake-up: number of preceding reports, failed transmissions, sums.";
    Join "join": JoinRequest => JoinReply, Emu, Anyone, (), "host → BS",
        "A query: a host requests to join the run and receives an assignment.";
    Ready "ready": Ready => bool, Emu, Members, (), "host → BS",
        "A query: a host has made all subscriptions and waits for the first TTI.";
    Control "control": ClockCommand => ClockStatus, Emu, Anyone, (), "operator → BS",
        "A query: pause, step or resume the clock, or read its status.";
    Describe "describe": DescribeRequest => ScenarioDescription, Emu, Anyone, (), "observer → BS",
        "A query: the scenario of the run, with its scenario files.";
    Log "log": InputLogRequest => InputLogPart, Emu, Anyone, (), "observer → BS",
        "A query: a part of the input log, which holds device removals, external decisions and actions.";
    World "world": WorldUpdate, Truth, Members, (), "world → observers",
        "TTIs granted to the devices, and the stimulus in the last one.";
    Event "event": EventUpdate, Truth, Members, (), "world → observers",
        "The start of an event, or its end with its results.";
    Failed "failed": FailedReport, Truth, Members, DeviceId, "world → observers",
        "A device that detected an event but could not pay for a report.";
    Woken "woken": WakeUpResult, Truth, Members, DeviceId, "world → observers",
        "The outcome of a wake-up.";
    Belief "belief": BeliefUpdate, Truth, Members, (), "BS → observers",
        "The BS's belief about the epicentre after the reports of a TTI, if its policy maintains one.";
    Lost "lost": LostReport, Truth, Members, DeviceId, "world → observers",
        "A report of a device with δ = 1 that was lost on its way to the BS.";
    States "states": DeviceStates, Truth, Members, (), "world → observers",
        "State and battery level of all devices at the end of a TTI, if the recording includes them.";
    Removed "removed": DeviceRemoval, Truth, Members, (), "world → observers",
        "Devices removed from the run because their process was lost under --on-loss continue.";
    Act "act": ActRequest => Tti, Emu, Anyone, (), "operator → BS",
        "A query: fail or revive devices, add energy to them, or change a setting. Needs the run's key.";
    Action "action": OperatorAction, Truth, Members, (), "operator → observers",
        "An action of an operator that takes effect at the start of the TTI.";
}

/// Returns the kinds of message as a Markdown table, for the page on inspecting.
pub fn kinds_as_markdown() -> String {
    let row = |kind: &MessageKind| {
        let (name, plane, direction, about) = (kind.name(), kind.plane().name(), kind.direction(), kind.about());
        format!("| `{name}` | {plane} | {direction} | {about} |\n")
    };
    let rows: String = MessageKind::ALL.iter().map(row).collect();
    format!("| kind | plane | direction | meaning |\n|---|---|---|---|\n{rows}")
}

/// The planes: two on the bus, and one that only observers see.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Plane {
    /// Messages that a real deployment would send over the radio.
    Air,
    /// Messages that only the emulation needs.
    Emu,
    /// Ground truth of the modelled world, and the BS's conclusions from the reports; never sent.
    Truth,
}

impl Plane {
    /// Every plane.
    pub const ALL: [Self; 3] = [Self::Air, Self::Emu, Self::Truth];

    /// The name of the plane in keys and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Air => "air",
            Self::Emu => "emu",
            Self::Truth => "truth",
        }
    }
}

/// The peers that may send and receive a kind of message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// The BS and hosts to which it has given an assignment.
    Members,
    /// Any client that reaches the BS.
    Anyone,
}

/// The kind of [`Frame::number`] of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Addressee {
    /// No number.
    Unaddressed,
    /// A device: the receiver of a wake-up, the sender of a report.
    Device,
    /// A host: the sender of an answer.
    Host,
}

impl Addressee {
    /// The name of the number; empty without one.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unaddressed => "",
            Self::Device => "device",
            Self::Host => "host",
        }
    }
}

/// The address of a message: a device, a host, or `()` for a kind without a number.
pub trait Address: Copy {
    /// The kind of number.
    const ADDRESSEE: Addressee;

    /// Returns the number.
    fn number(self) -> Option<u32>;
}

impl Address for () {
    const ADDRESSEE: Addressee = Addressee::Unaddressed;

    fn number(self) -> Option<u32> {
        None
    }
}

impl Address for DeviceId {
    const ADDRESSEE: Addressee = Addressee::Device;

    fn number(self) -> Option<u32> {
        Some(self.0)
    }
}

impl Address for HostId {
    const ADDRESSEE: Addressee = Addressee::Host;

    fn number(self) -> Option<u32> {
        Some(self.0)
    }
}

/// A payload with a fixed kind, so that a key can only carry its own type.
pub trait Payload: Concerns + fmt::Display + Serialize + DeserializeOwned {
    /// The address that goes with it.
    type Address: Address;
    /// The kind of the payload.
    const KIND: MessageKind;
}

/// A visitor of payload types.
pub trait TypeVisitor {
    /// Visits one type.
    fn visit<P: Payload>(&mut self);
}

/// A payload that gets a reply.
pub trait Query: Payload {
    /// The type of the reply.
    type Reply: Serialize + DeserializeOwned;
}

/// A message that may concern a device.
pub trait Concerns {
    /// Whether the message is to, from or about `device`; `number` is [`Frame::number`]. Most messages concern no
    /// single device.
    fn concerns(&self, number: Option<u32>, device: DeviceId) -> bool {
        let _ = (number, device);
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io;
    use crate::units::Energy;

    #[test]
    fn the_inspecting_page_contains_the_table_of_kinds() {
        io::assert_table("docs/inspecting.md", "kinds", &kinds_as_markdown());
    }

    #[test]
    fn a_message_is_decoded_by_its_kind() {
        let report = Report {
            device: DeviceId(3),
            tti: Tti(5),
            information: 0.25,
            battery: Energy::from_micro(1_500_000),
        };
        let message = Message::decode(MessageKind::Report, &codec::encode(&report)).expect("a report");
        assert_eq!((message.kind(), &message), (Report::KIND, &Message::Report(report)));
        assert_eq!(message.encode(), codec::encode(&report));
        assert_eq!(message.encoded_len(), codec::encoded_len(&report));
        assert!(message.concerns(Some(3), DeviceId(3)) && !message.concerns(Some(3), DeviceId(4)));
        assert_eq!(message.to_string(), "I 0.25, battery 1.5 left");
        assert!(Message::decode(MessageKind::Wake, &codec::encode(&report)).is_err());
    }

    #[test]
    fn only_queries_have_replies() {
        let payload = codec::encode(&true);
        let kinds_with_reply = MessageKind::ALL
            .iter()
            .filter(|&&kind| Reply::decode(kind, &payload).is_some());
        let queries = [
            MessageKind::Join,
            MessageKind::Ready,
            MessageKind::Control,
            MessageKind::Describe,
            MessageKind::Log,
            MessageKind::Act,
        ];
        assert!(kinds_with_reply.eq(&queries));
        let reply = Reply::decode(MessageKind::Ready, &payload)
            .expect("a query")
            .expect("a reply");
        assert_eq!((reply.encode(), reply), (payload, Reply::Ready(true)));
    }
}
