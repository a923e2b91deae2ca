//! Client side of the policy port, for a Rust process that decides for a run. On the bus the base station asks and this
//! process replies, so the "client" serves. [`serve_decisions`] runs it; tests and policies in Rust call it.
//! `python/reveille/policy_client.py` is the same client in Python, and docs/policy-port.md describes the protocol and
//! `MAX_BS_ABSENCE`: a change concerns all three.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, PortRequest, draw_nonce};
use reveille_common::encoding::Encoding;
use reveille_common::secret::Secret;

use crate::policy::external::Decision;
use crate::policy::external::wire::{
    DecisionReply, DecisionRequest, Hello, HelloReply, OLDEST_PROTOCOL, PROTOCOL_VERSION, RequestKind, WireHeader,
};
use crate::server::state::now;

/// Interval between checks of whether the base station is alive.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);
/// Longest absence of a base station that has not ended the run. Meanwhile this process may have been stopped, its link
/// re-established, or the run resumed at the same address.
const MAX_BS_ABSENCE: Duration = Duration::from_secs(30);

/// A rule that decides for a run; a closure from request to decision is one.
pub trait PolicyClient {
    /// Receives the hello of the base station, before the first request and after every interruption.
    fn hello_received(&mut self, _hello: &Hello) {}

    /// Returns the decision for `request`. A repeated request comes here again only if its decision was refused
    /// ([`DecisionRequest::refused`]).
    fn decide(&mut self, request: &DecisionRequest) -> Decision;
}

impl<F: FnMut(&DecisionRequest) -> Decision> PolicyClient for F {
    fn decide(&mut self, request: &DecisionRequest) -> Decision {
        self(request)
    }
}

/// Identity of a policy process at the port.
#[derive(Clone, Debug)]
pub struct ClientIdentity {
    /// Its name, for logs and the terminal.
    pub name: String,
    /// The run's key, if the run has one.
    pub run_key: Option<Secret>,
    /// Encoding in which it wants its requests.
    pub encoding: Encoding,
}

/// Replies to the decision requests of the run on `bus` until the run ends or its base station is absent for 30 s.
/// Returns the number of decisions, refused ones included.
///
/// # Errors
/// If the bus fails, the base station refuses this process, or it is absent for 30 s before the first decision.
pub async fn serve_decisions(
    bus: &Bus,
    identity: &ClientIdentity,
    policy: &mut impl PolicyClient,
) -> Result<u64, BusError> {
    let is_bs_alive = Arc::new(AtomicBool::new(false));
    let bs_alive_writer = Arc::clone(&is_bs_alive);
    let _watched = bus.watch_alive(bus.key_exprs().bs_liveliness(), move |_, is_alive| {
        bs_alive_writer.store(is_alive, Ordering::Relaxed);
    })?;
    let requests = bus.serve_policy_port()?;
    let mut client = ClientState {
        id: format!("{:016x}", draw_nonce()?),
        identity,
        last_reply: None,
        decision_count: 0,
        is_over: false,
    };
    // The base station may start later than this process, so its absence counts from here.
    let mut last_seen = now();
    while !client.is_over {
        if is_bs_alive.load(Ordering::Relaxed) {
            last_seen = now();
        } else if last_seen.elapsed() >= MAX_BS_ABSENCE {
            return if client.last_reply.is_some() {
                Ok(client.decision_count)
            } else {
                Err(bus.no_run_error().await)
            };
        }
        match tokio::time::timeout(CHECK_INTERVAL, requests.next()).await {
            Ok(Some(request)) => client.handle_request(&request, policy)?,
            // The bus is closed.
            Ok(None) => break,
            // No request within the interval: the base station is checked again.
            Err(_) => {}
        }
    }
    Ok(client.decision_count)
}

/// State of a policy process between requests.
struct ClientState<'a> {
    /// Random id of this process, to which the base station addresses its decision requests.
    id: String,
    identity: &'a ClientIdentity,
    /// Header of the last decision request, and the reply.
    last_reply: Option<(WireHeader, DecisionReply)>,
    /// Decisions of the policy, including refused ones.
    decision_count: u64,
    /// Whether the run has ended.
    is_over: bool,
}

impl ClientState<'_> {
    fn handle_request(&mut self, request: &PortRequest, policy: &mut impl PolicyClient) -> Result<(), BusError> {
        let encoding = request.encoding;
        let invalid = |why: String| request.reply_error(&format!("invalid request: {why}"));
        let header: WireHeader = match encoding.decode(&request.payload) {
            Ok(header) => header,
            Err(why) => return invalid(why),
        };
        match header.stage {
            RequestKind::Bye => {
                self.is_over = true;
                Ok(())
            }
            RequestKind::Hello => match encoding.decode(&request.payload) {
                Ok(hello) => self.reply_to_hello(request, &hello, policy),
                Err(why) => invalid(why),
            },
            RequestKind::Plan | RequestKind::Wake => match self.decide(&request.payload, encoding, policy) {
                Ok(Some(reply)) => request.reply(reply, encoding),
                Ok(None) => Ok(()),
                Err(why) => invalid(why),
            },
        }
    }

    /// Returns the reply to the decision request in `payload`, in the same encoding; `None` if the request is for
    /// another policy process.
    ///
    /// # Errors
    /// Describes the error in `payload`.
    fn decide(
        &mut self,
        payload: &[u8],
        encoding: Encoding,
        policy: &mut impl PolicyClient,
    ) -> Result<Option<Vec<u8>>, String> {
        let request: DecisionRequest = encoding.decode(payload)?;
        // All processes at the port receive every request.
        if request.to != self.id {
            return Ok(None);
        }
        // The base station repeats a request whose reply was lost or late. The policy may have internal state, so it
        // decides a request again only if its decision was refused.
        let is_repetition = self.last_reply.as_ref().is_some_and(|(head, _)| *head == request.head);
        if !is_repetition || request.refused.is_some() {
            let reply = DecisionReply::for_request(&request.head, &self.id, &self.run_key_text())
                .with_decision(&policy.decide(&request));
            self.last_reply = Some((request.head, reply));
            self.decision_count += 1;
        }
        Ok(self.last_reply.as_ref().map(|(_, reply)| encoding.encode(reply)))
    }

    /// The secret key of the run as text, shown in every reply; empty if the run has none.
    fn run_key_text(&self) -> String {
        self.identity.run_key.map_or_else(String::new, |key| key.to_string())
    }

    fn reply_to_hello(
        &self,
        request: &PortRequest,
        hello: &Hello,
        policy: &mut impl PolicyClient,
    ) -> Result<(), BusError> {
        if hello.min > PROTOCOL_VERSION || hello.max < OLDEST_PROTOCOL {
            let (min, max) = (hello.min, hello.max);
            return request.reply_error(&format!(
                "it speaks protocol {OLDEST_PROTOCOL} to {PROTOCOL_VERSION}, the base station {min} to {max}"
            ));
        }
        // The base station names the refused process in its next hello, since it cannot reply to a reply.
        if let Some(refused) = hello.refused.as_ref().filter(|refused| refused.id == self.id) {
            return Err(BusError::Refused(refused.why.clone()));
        }
        policy.hello_received(hello);
        let reply = HelloReply {
            head: WireHeader {
                protocol: PROTOCOL_VERSION.min(hello.max),
                ..hello.head
            },
            id: self.id.clone(),
            name: self.identity.name.clone(),
            key: self.run_key_text(),
            form: self.identity.encoding,
        };
        request.reply(request.encoding.encode(&reply), request.encoding)
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::encoding::{FloatRows, Octets};
    use reveille_common::ids::DeviceId;

    use super::*;

    #[test]
    fn a_repeated_request_gets_the_first_reply_in_the_encoding_of_the_repetition() {
        let identity = ClientIdentity {
            name: "a test".to_owned(),
            run_key: None,
            encoding: Encoding::Cbor,
        };
        let mut client = ClientState {
            id: "a".to_owned(),
            identity: &identity,
            last_reply: None,
            decision_count: 0,
            is_over: false,
        };
        let no_rows = || FloatRows {
            width: 1,
            values: Vec::new(),
        };
        let mut request = DecisionRequest {
            head: WireHeader {
                protocol: PROTOCOL_VERSION,
                seq: 3,
                tti: 7,
                stage: RequestKind::Wake,
            },
            to: "a".to_owned(),
            device: no_rows(),
            globals: no_rows(),
            action_mask: Octets::default(),
            heard: Vec::new(),
            refused: None,
        };
        // Every decision differs, so the replies show how often the policy decided.
        let mut decisions = (0..).map(|device| Decision::Wake(vec![DeviceId(device)]));
        let mut policy = |_: &DecisionRequest| decisions.next().expect("endless");
        let mut woken = |request: &DecisionRequest, encoding: Encoding| {
            let reply = client.decide(&encoding.encode(request), encoding, &mut policy);
            let reply: Option<DecisionReply> = reply
                .expect("a valid request")
                .map(|bytes| encoding.decode(&bytes).expect("a reply in this encoding"));
            reply.and_then(|reply| reply.wake)
        };
        assert_eq!(woken(&request, Encoding::Cbor), Some(vec![0]));
        assert_eq!(woken(&request, Encoding::Cbor), Some(vec![0]));
        assert_eq!(woken(&request, Encoding::Json), Some(vec![0]));
        request.refused = Some("no device 0".to_owned());
        assert_eq!(woken(&request, Encoding::Json), Some(vec![1]));
        request.to = "b".to_owned();
        assert_eq!(woken(&request, Encoding::Json), None);
    }
}
