//! Fuzzes the messages of the policy port in both encodings: each is decoded or refused with an error, and a decoded
//! message or decision is equal after encoding and decoding. The whole input is read as each type of message, without a
//! byte that selects one; the seeds of the corpus are JSON. tests/fuzz/README.md shows how to run the target.

#![no_main]

use libfuzzer_sys::fuzz_target;
use reveille_bs::policy::external::wire::{
    DecisionReply, DecisionRequest, Hello, HelloReply, ReplyCredentials, RequestKind, WireHeader,
};
use reveille_bs::policy::external::{Decision, DecisionStage, PlanDecision};
use reveille_common::encoding::Encoding;
use reveille_common::ids::{DeviceId, Tti};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Number of devices for which decisions are checked.
const DEVICES: u32 = 11;
/// A version from `OLDEST_PROTOCOL` to `PROTOCOL_VERSION` in `bs/src/policy/external/wire.rs`: others are refused.
const PROTOCOL: u32 = 1;

/// Checks that a decodable value survives encoding and decoding unchanged, and that others are refused with a reason.
fn check_round_trip<T: DeserializeOwned + Serialize>(encoding: Encoding, bytes: &[u8]) {
    match encoding.decode::<T>(bytes) {
        Ok(read) => {
            let written = encoding.encode(&read);
            let decoded: T = encoding.decode(&written).expect("an encoded message decodes");
            // Compares the encoded form, since NaN differs from itself.
            assert_eq!(encoding.encode(&decoded), written);
        }
        Err(reason) => assert!(!reason.trim().is_empty()),
    }
}

/// Checks that a decision in a reply is valid, and equal after encoding and decoding.
fn check_decision(encoding: Encoding, bytes: &[u8]) {
    let Ok(reply) = encoding.decode::<DecisionReply>(bytes) else {
        return;
    };
    // A plan names the TTI of the next plan, so that a later TTI must exist.
    let tti = Tti(reply.tti.min(u64::MAX / 2));
    for stage in [DecisionStage::Plan, DecisionStage::Wake] {
        let decision = match reply.decision(stage, tti, DEVICES) {
            Ok(decision) => decision,
            Err(reason) => {
                assert!(!reason.trim().is_empty());
                continue;
            }
        };
        match &decision {
            Decision::Plan(PlanDecision { plan, next }) => {
                assert!(*next > tti);
                // Devices of the scenario can be looked up in the plan without a panic.
                let _any: u32 = (0..DEVICES).map(|j| plan.duty_cycle(DeviceId(j)).t_on).sum();
            }
            Decision::Wake(devices) => assert!(devices.iter().all(|device| device.0 < DEVICES)),
        }
        let header = WireHeader {
            protocol: PROTOCOL,
            seq: reply.seq,
            tti: tti.0,
            stage: RequestKind::from(stage),
        };
        let sent = DecisionReply::for_request(&header, &reply.id, &reply.key).with_decision(&decision);
        let received: DecisionReply = encoding
            .decode(&encoding.encode(&sent))
            .expect("an encoded reply decodes");
        assert_eq!(received.decision(stage, tti, DEVICES), Ok(decision));
    }
}

fuzz_target!(|data: &[u8]| {
    for encoding in [Encoding::Json, Encoding::Cbor] {
        check_decision(encoding, data);
        check_round_trip::<DecisionReply>(encoding, data);
        check_round_trip::<HelloReply>(encoding, data);
        check_round_trip::<Hello>(encoding, data);
        check_round_trip::<DecisionRequest>(encoding, data);
        // Credentials have no encoder.
        let _result = encoding.decode::<ReplyCredentials>(data);
    }
});
