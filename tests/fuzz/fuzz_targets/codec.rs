//! Whatever arrives on the bus: no payload makes the codec panic, and what it reads it writes again unchanged.
//!
//! The first byte chooses the type of message, the rest is the payload.

#![no_main]

use libfuzzer_sys::fuzz_target;
use reveille_common::codec;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{
    Answer, Clock, ClockCommand, ClockStatus, JoinReply, JoinRequest, PlanUpdate, Ready, Report, TapBatch, WakeUp,
};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Decodes `payload` as a `T`. What comes of it must come back from its own wire form, which has the stated length.
///
/// Wire forms are compared, not values: a NaN is not equal to itself, its bits are.
fn round_trip<T: Serialize + DeserializeOwned>(payload: &[u8]) -> Option<T> {
    let message: T = codec::decode(payload).ok()?;
    let wire = codec::encode(&message);
    assert_eq!(codec::encoded_len(&message), wire.len() as u64, "the stated length");
    let again: T = codec::decode(&wire).expect("what was encoded decodes");
    assert_eq!(codec::encode(&again), wire, "the same wire form");
    Some(message)
}

/// A plan from outside answers for any device and any TTI.
fn use_plan(update: &PlanUpdate) {
    for device in [0, 1, 7, 8, 1_000, u32::MAX].map(DeviceId) {
        let duty = update.plan.duty_cycle(device);
        assert!(duty.is_valid(), "{duty:?}");
        let next = duty.next_on(update.from);
        assert!(next == Tti::NEVER || duty.is_on(next), "{duty:?} at {next}");
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((&kind, payload)) = data.split_first() else {
        return;
    };
    match kind % 11 {
        0 => {
            if let Some(update) = round_trip::<PlanUpdate>(payload) {
                use_plan(&update);
            }
        }
        1 => drop(round_trip::<WakeUp>(payload)),
        2 => drop(round_trip::<Report>(payload)),
        3 => drop(round_trip::<Clock>(payload)),
        4 => drop(round_trip::<Answer>(payload)),
        5 => drop(round_trip::<JoinRequest>(payload)),
        6 => drop(round_trip::<JoinReply>(payload)),
        7 => drop(round_trip::<Ready>(payload)),
        8 => drop(round_trip::<ClockCommand>(payload)),
        9 => drop(round_trip::<ClockStatus>(payload)),
        _ => drop(round_trip::<TapBatch>(payload)),
    }
});
