//! Fuzzes the codec of bus messages: no payload panics, and a decoded value has the same wire form after encoding and
//! decoding.
//!
//! The first byte selects, with `K` kinds in `MessageKind::ALL`: below `K` a message of this kind, below `2 K` a reply
//! to this kind, otherwise a batch for observers. The rest is the payload. Each file `seed-I` of the corpus begins with
//! the byte `I`, so a kind added before the end of the list shifts the meaning of seeds. tests/fuzz/README.md shows how
//! to run the target.

#![no_main]

use libfuzzer_sys::fuzz_target;
use reveille_common::codec;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{FrameBatch, Message, MessageKind, PlanUpdate, Reply};

/// Checks that a message decodes from its own wire form, has the stated length and can be printed.
///
/// Compares wire forms, not values: a NaN differs from itself, but its bits do not.
fn check_message(message: &Message) {
    let wire = message.encode();
    assert_eq!(message.encoded_len(), wire.len() as u64, "the stated length");
    let decoded = Message::decode(message.kind(), &wire).expect("an encoded message decodes");
    assert_eq!(decoded.encode(), wire, "the same wire form");
    assert!(!message.to_string().is_empty());
    // Any answer is right, but no message may panic. The arguments are any number and device.
    message.concerns(Some(1), DeviceId(1));
}

/// Checks that a decoded plan gives valid duty cycles and correct next TTIs in S1, also for devices that it omits.
fn check_plan(update: &PlanUpdate) {
    for device in [0, 1, 7, 8, 1_000, u32::MAX].map(DeviceId) {
        let duty = update.plan.duty_cycle(device);
        assert!(duty.is_valid(), "{duty:?}");
        let next = duty.next_on(update.from);
        assert!(next == Tti::NEVER || duty.is_on(next), "{duty:?} at {next}");
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((&selector, payload)) = data.split_first() else {
        return;
    };
    let (selector, kinds) = (usize::from(selector), MessageKind::ALL);
    let kind = kinds[selector % kinds.len()];
    match selector / kinds.len() {
        0 => {
            let message = Message::decode(kind, payload);
            if let Ok(message) = &message {
                check_message(message);
            }
            if let Ok(Message::Plan(update)) = &message {
                check_plan(update);
            }
        }
        1 => {
            if let Some(Ok(reply)) = Reply::decode(kind, payload) {
                let wire = reply.encode();
                let decoded = Reply::decode(kind, &wire)
                    .expect("a query")
                    .expect("an encoded reply decodes");
                assert_eq!(decoded.encode(), wire, "the same wire form");
            }
        }
        _ => {
            if let Ok(batch) = codec::decode::<FrameBatch>(payload) {
                let wire = codec::encode(&batch);
                let decoded: FrameBatch = codec::decode(&wire).expect("an encoded batch decodes");
                assert_eq!(decoded, batch);
            }
        }
    }
});
