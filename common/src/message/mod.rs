//! What crosses the bus: every kind of message, declared once.
//!
//! Three planes: on the *air* plane travels what a real deployment would send over the radio, on the *emulation* plane
//! what only the emulation needs; on the plane of *truth* nothing travels, it is what observers are told of the
//! modelled world, and of what the BS makes of it, besides. The table `messages!` below is the one list of kinds: the
//! keys ([`crate::keys`]), the typed bus (`crate::bus`), `reveille inspect`, its help and its page, and the fuzz target
//! read it. A new kind is a row of the table and a file with its payload.
//!
//! Not in the table: the copies of all of them for observers ([`Frame`]), which are no part of the run.

mod answer;
mod belief;
mod clock;
mod control;
mod describe;
mod frame;
mod join;
mod log;
mod outage;
mod plan;
mod ready;
mod report;
mod setup;
mod truth;
mod wake;

use std::fmt;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize};

use crate::codec::{self, CodecError};
use crate::ids::{DeviceId, HostId};

pub use answer::Answer;
pub use belief::{Belief, Likely};
pub use clock::{Clock, Tick};
pub use control::{ClockCommand, ClockStatus, LostHost, Pace};
pub use describe::{Describe, Description};
pub use frame::{Frame, TapBatch};
pub use join::{JoinReply, JoinRequest};
pub use log::{LogPart, ReadLog};
pub use outage::Outage;
pub use plan::PlanUpdate;
pub use ready::Ready;
pub use report::{Failure, Report};
pub use setup::{Assignment, Checkpoint, DeviceSetup, Membership, Resumption};
pub use truth::{EventNews, FailedReport, LostReport, States, Woken, World};
pub use wake::{WakeOutcome, WakeUp};

/// Declares the kinds of message: kind "name": payload, plane, who may send it, whose number goes with it, direction,
/// help; a query has its reply behind `=>`.
macro_rules! messages {
    ($(
        $kind:ident $name:literal: $payload:ty $(=> $reply:ty)?, $plane:ident, $access:ident, $address:ty,
        $direction:literal,
        $about:literal;
    )+) => {
        /// The kinds of message, each with a key of its own.
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

            /// The plane it travels on.
            pub const fn plane(self) -> Plane {
                match self {
                    $(Self::$kind => Plane::$plane,)+
                }
            }

            /// Who may send and hear it.
            pub const fn access(self) -> Access {
                match self {
                    $(Self::$kind => Access::$access,)+
                }
            }

            /// Whose number goes with it.
            pub const fn addressee(self) -> Addressee {
                match self {
                    $(Self::$kind => <$address as Address>::ADDRESSEE,)+
                }
            }

            /// From whom to whom, in words.
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

            /// Shows `visitor` the type of every kind's payload.
            pub fn show_types(visitor: &mut impl TypeVisitor) {
                $(visitor.visit::<$payload>();)+
            }
        }

        $(impl Payload for $payload {
            type Address = $address;
            const KIND: MessageKind = MessageKind::$kind;
        })+

        $($(impl Question for $payload {
            type Reply = $reply;
        })?)+

        /// A decoded message of any kind.
        #[derive(Clone, Debug, PartialEq, Serialize)]
        #[serde(untagged)]
        pub enum Message {
            $(#[doc = $about] $kind($payload),)+
        }

        impl Message {
            /// The message of `kind` in `payload`.
            ///
            /// # Errors
            /// If `payload` is of another version or not exactly one message of this kind.
            pub fn decode(kind: MessageKind, payload: &[u8]) -> Result<Self, CodecError> {
                match kind {
                    $(MessageKind::$kind => codec::decode(payload).map(Self::$kind),)+
                }
            }

            /// The message of `kind` in a text such as JSON that gives fields their names.
            ///
            /// # Errors
            /// If it is no message of this kind.
            pub fn deserialize<'de, D: Deserializer<'de>>(kind: MessageKind, text: D) -> Result<Self, D::Error> {
                match kind {
                    $(MessageKind::$kind => <$payload>::deserialize(text).map(Self::$kind),)+
                }
            }

            /// Its wire form.
            pub fn encode(&self) -> Vec<u8> {
                match self {
                    $(Self::$kind(message) => codec::encode(message),)+
                }
            }

            /// The length of its wire form in bytes, without making it.
            pub fn encoded_len(&self) -> u64 {
                match self {
                    $(Self::$kind(message) => codec::encoded_len(message),)+
                }
            }

            /// Its kind.
            pub const fn kind(&self) -> MessageKind {
                match self {
                    $(Self::$kind(_) => MessageKind::$kind,)+
                }
            }

            /// Whether it is to, from or about `device`; `number` is the one in its key.
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
            /// The reply in `payload` to a query of `kind`; `None` if the kind is no query.
            pub fn decode(kind: MessageKind, payload: &[u8]) -> Option<Result<Self, CodecError>> {
                $($(if kind == MessageKind::$kind {
                    return Some(codec::decode::<$reply>(payload).map(Self::$kind));
                })?)+
                None
            }

            /// Its wire form.
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
        "The plan δ: who senses in which TTI. Sent when it changes and for synchronisation.";
    Wake "wake": WakeUp, Air, Members, DeviceId, "BS → one device",
        "A wake-up for a device's wake-up radio.";
    Report "report": Report, Air, Members, DeviceId, "device → BS",
        "What a device in S3 sends: information and battery.";
    Clock "clock": Clock, Emu, Members, (), "BS → all hosts",
        "The virtual clock: a grant of TTIs with what the world shows in them, or the end of the run.";
    Answer "answer": Answer, Emu, Members, HostId, "host → BS",
        "A host's answer to the clock or to a wake-up: how many reports precede it, who could not transmit, sums.";
    Join "join": JoinRequest => JoinReply, Emu, Anyone, (), "host → BS",
        "A query: a host asks for places in the run.";
    Ready "ready": Ready => bool, Emu, Members, (), "host → BS",
        "A query: a host is subscribed to everything and waits for the first TTI.";
    Control "control": ClockCommand => ClockStatus, Emu, Anyone, (), "operator → BS",
        "A query: pause, step, resume, or where the clock is.";
    Describe "describe": Describe => Description, Emu, Anyone, (), "observer → BS",
        "A query: the scenario of the run, with the files that it names.";
    Log "log": ReadLog => LogPart, Emu, Anyone, (), "observer → BS",
        "A query: a part of the log of what the run depends on besides, outages and decisions from outside.";
    World "world": World, Truth, Members, (), "world → observers",
        "TTIs that the devices go through, and what the world shows in the last of them.";
    Event "event": EventNews, Truth, Members, (), "world → observers",
        "An event starts, or has ended with all that came of it.";
    Failed "failed": FailedReport, Truth, Members, DeviceId, "world → observers",
        "A device has detected an event and could not pay for a report.";
    Woken "woken": Woken, Truth, Members, DeviceId, "world → observers",
        "What came of a wake-up.";
    Belief "belief": Belief, Truth, Members, (), "BS → observers",
        "Where the BS believes the event to be after the reports of a TTI, where its policy has such a belief.";
    Lost "lost": LostReport, Truth, Members, DeviceId, "world → observers",
        "What a device with δ = 1 has sent, and what was lost on its way to the BS.";
    States "states": States, Truth, Members, (), "world → observers",
        "State and battery of all devices at the end of a TTI, where a recording was asked for them.";
    Gone "gone": Outage, Truth, Members, (), "world → observers",
        "Devices that are gone for good, as their process was lost under --on-loss continue.";
}

/// The kinds of message as a table in Markdown, for the page on inspecting.
pub fn markdown() -> String {
    let row = |kind: &MessageKind| {
        let (name, plane, direction, about) = (kind.name(), kind.plane().name(), kind.direction(), kind.about());
        format!("| `{name}` | {plane} | {direction} | {about} |\n")
    };
    let rows: String = MessageKind::ALL.iter().map(row).collect();
    format!("| kind | plane | direction | what |\n|---|---|---|---|\n{rows}")
}

/// The planes: two on the bus, and one that observers see besides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Plane {
    /// What a real deployment would send over the radio.
    Air,
    /// What only the emulation needs.
    Emu,
    /// What happens in the modelled world, ground truth, and what the BS makes of it: nobody sends it.
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

/// Who may send and hear a kind of message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// The BS and hosts that it has given places.
    Members,
    /// Whoever reaches the BS may ask.
    Anyone,
}

/// Whose number goes with a kind's messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Addressee {
    /// Nobody's: the kind has a single key.
    Nobody,
    /// A device's: the receiver of a wake-up, the sender of a report.
    Device,
    /// A host's: the sender of an answer.
    Host,
}

impl Addressee {
    /// What the number is called; empty where there is none.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Nobody => "",
            Self::Device => "device",
            Self::Host => "host",
        }
    }
}

/// Whom a message is to, from or about: a device, a host, or `()` for a kind that has nobody's number.
pub trait Address: Copy {
    /// Whose number it is.
    const ADDRESSEE: Addressee;

    /// The number.
    fn number(self) -> Option<u32>;
}

impl Address for () {
    const ADDRESSEE: Addressee = Addressee::Nobody;

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

/// A payload that knows its kind, so that no key can carry another type than its own.
pub trait Payload: Concerns + fmt::Display + Serialize + DeserializeOwned {
    /// Whose number goes with it.
    type Address: Address;
    /// Its kind.
    const KIND: MessageKind;
}

/// Looks at the types of payloads.
pub trait TypeVisitor {
    /// Looks at one.
    fn visit<P: Payload>(&mut self);
}

/// A query: a payload that is answered.
pub trait Question: Payload {
    /// The answer.
    type Reply: Serialize + DeserializeOwned;
}

/// Whom a message concerns.
pub trait Concerns {
    /// Whether the message is to, from or about `device`; `number` is the one in its key. Most concern none in
    /// particular.
    fn concerns(&self, number: Option<u32>, device: DeviceId) -> bool {
        let _ = (number, device);
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::Tti;
    use crate::pages;
    use crate::units::Energy;

    #[test]
    fn the_page_on_inspecting_has_the_table_of_kinds() {
        pages::assert_table("docs/inspecting.md", "kinds", &markdown());
    }

    #[test]
    fn kinds_have_names_of_their_own_and_help() {
        let mut names: Vec<&str> = MessageKind::ALL.iter().map(|kind| kind.name()).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), MessageKind::ALL.len());
        assert!(
            MessageKind::ALL
                .iter()
                .all(|kind| kind.about().ends_with('.') && kind.direction().contains(" → "))
        );
    }

    #[test]
    fn a_message_of_any_kind_is_decoded_by_its_kind() {
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
        assert_eq!(message.to_string(), "I 0.2500, battery 1.50 left");
        assert!(Message::decode(MessageKind::Wake, &codec::encode(&report)).is_err());
    }

    #[test]
    fn only_queries_have_replies() {
        let yes = codec::encode(&true);
        let with_reply = MessageKind::ALL
            .iter()
            .filter(|&&kind| Reply::decode(kind, &yes).is_some());
        let queries = [
            MessageKind::Join,
            MessageKind::Ready,
            MessageKind::Control,
            MessageKind::Describe,
            MessageKind::Log,
        ];
        assert!(with_reply.eq(&queries));
        let reply = Reply::decode(MessageKind::Ready, &yes)
            .expect("a query")
            .expect("a reply");
        assert_eq!((reply.encode(), reply), (yes, Reply::Ready(true)));
    }
}
