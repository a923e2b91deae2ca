//! Fuzzes answers at the policy port in both encodings: each is decoded or refused with an error, and a decision
//! encodes to an equal answer.

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

const DEVICES: u32 = 11;

/// Checks that a decoded value survives encoding and decoding unchanged.
fn again<T: DeserializeOwned + Serialize + PartialEq + std::fmt::Debug>(form: Encoding, bytes: &[u8]) {
    match form.decode::<T>(bytes) {
        Ok(read) => {
            let written = form.encode(&read);
            let decoded: T = form.decode(&written).expect("encoded text decodes");
            // Compares the encoded form, since NaN differs from itself.
            assert_eq!(form.encode(&decoded), written);
        }
        Err(why) => assert!(!why.trim().is_empty()),
    }
}

fn answer(form: Encoding, bytes: &[u8]) {
    let Ok(reply) = form.decode::<DecisionReply>(bytes) else {
        return;
    };
    let tti = Tti(reply.tti.min(u64::MAX / 2));
    for stage in [DecisionStage::Plan, DecisionStage::Wake] {
        let answer = match reply.decision(stage, tti, DEVICES) {
            Ok(answer) => answer,
            Err(why) => {
                assert!(!why.trim().is_empty());
                continue;
            }
        };
        match &answer {
            Decision::Plan(PlanDecision { plan, next }) => {
                assert!(*next > tti);
                let _any: u32 = (0..DEVICES).map(|j| plan.duty_cycle(DeviceId(j)).t_on).sum();
            }
            Decision::Wake(devices) => assert!(devices.iter().all(|device| device.0 < DEVICES)),
        }
        let head = WireHeader {
            protocol: 1,
            seq: reply.seq,
            tti: tti.0,
            stage: RequestKind::from(stage),
        };
        let said = DecisionReply::for_request(&head, &reply.id, &reply.key).with_decision(&answer);
        let heard: DecisionReply = form.decode(&form.encode(&said)).expect("an answer");
        assert_eq!(heard.decision(stage, tti, DEVICES), Ok(answer));
    }
}

fuzz_target!(|data: &[u8]| {
    for form in [Encoding::Json, Encoding::Cbor] {
        answer(form, data);
        again::<DecisionReply>(form, data);
        again::<HelloReply>(form, data);
        again::<Hello>(form, data);
        again::<DecisionRequest>(form, data);
        let _shown = form.decode::<ReplyCredentials>(data);
    }
});
