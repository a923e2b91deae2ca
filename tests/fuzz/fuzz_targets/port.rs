//! Whatever comes at the policy port, in either form: it is an answer or is refused in words, and what an answer
//! decides is said again as the same.

#![no_main]

use libfuzzer_sys::fuzz_target;
use reveille_bs::policy::external::wire::{Asked, Head, Hello, Reply, Said, Shown, Welcome};
use reveille_bs::policy::external::{Answer, Decision, Stage};
use reveille_common::forms::Form;
use reveille_common::ids::{DeviceId, Tti};
use serde::Serialize;
use serde::de::DeserializeOwned;

const DEVICES: u32 = 11;

/// What is read is written and read again as the same.
fn again<T: DeserializeOwned + Serialize + PartialEq + std::fmt::Debug>(form: Form, bytes: &[u8]) {
    match form.decode::<T>(bytes) {
        Ok(read) => {
            let written = form.encode(&read);
            let once_more: T = form.decode(&written).expect("what was written");
            // Not a number is no number, not even itself.
            assert_eq!(form.encode(&once_more), written);
        }
        Err(why) => assert!(!why.trim().is_empty()),
    }
}

fn answer(form: Form, bytes: &[u8]) {
    let Ok(reply) = form.decode::<Reply>(bytes) else { return };
    let tti = Tti(reply.tti.min(u64::MAX / 2));
    for stage in [Stage::Plan, Stage::Wake] {
        let answer = match reply.answer(stage, tti, DEVICES) {
            Ok(answer) => answer,
            Err(why) => {
                assert!(!why.trim().is_empty());
                continue;
            }
        };
        match &answer {
            Answer::Plan(Decision { plan, next }) => {
                assert!(*next > tti);
                let _any: u32 = (0..DEVICES).map(|j| plan.duty_cycle(DeviceId(j)).t_on).sum();
            }
            Answer::Wake(devices) => assert!(devices.iter().all(|device| device.0 < DEVICES)),
        }
        let head = Head {
            protocol: 1,
            seq: reply.seq,
            tti: tti.0,
            stage: Said::from(stage),
        };
        let said = Reply::to(&head, &reply.id, &reply.key).with(&answer);
        let heard: Reply = form.decode(&form.encode(&said)).expect("an answer");
        assert_eq!(heard.answer(stage, tti, DEVICES), Ok(answer));
    }
}

fuzz_target!(|data: &[u8]| {
    for form in [Form::Json, Form::Cbor] {
        answer(form, data);
        again::<Reply>(form, data);
        again::<Welcome>(form, data);
        again::<Hello>(form, data);
        again::<Asked>(form, data);
        let _shown = form.decode::<Shown>(data);
    }
});
