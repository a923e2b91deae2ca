//! Client side of the policy port, for a Rust process that decides for a run. `python/reveille/policy_client.py` is the
//! same client in Python: a change of the protocol concerns both.

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

/// A rule that answers the decision requests of a run.
pub trait PolicyClient {
    /// Receives the base station's greeting, before the first decision request of a run and after a lost connection.
    /// Does nothing by default.
    fn hello_received(&mut self, _hello: &Hello) {}

    /// Decides. A repeated request is not passed on again, unless its answer was refused.
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

/// Decides for the run on `bus` until the run ends or its base station is absent for 30 s. Returns the number of
/// decisions.
///
/// # Errors
/// If the bus fails, no base station is found, or the base station refuses this process.
pub async fn decide(bus: &Bus, identity: &ClientIdentity, policy: &mut impl PolicyClient) -> Result<u64, BusError> {
    let is_bs_alive = Arc::new(AtomicBool::new(false));
    let bs_alive = Arc::clone(&is_bs_alive);
    let _watched = bus.watch_alive(bus.keys().bs_liveliness(), move |_, alive| {
        bs_alive.store(alive, Ordering::Relaxed);
    })?;
    let port_requests = bus.serve_policy_port()?;
    let mut session = ClientSession {
        id: format!("{:016x}", draw_nonce()?),
        identity,
        last: None,
        decided: 0,
        is_over: false,
    };
    let mut last_seen = now();
    while !session.is_over {
        if is_bs_alive.load(Ordering::Relaxed) {
            last_seen = now();
        } else if last_seen.elapsed() >= MAX_BS_ABSENCE {
            return if session.last.is_some() {
                Ok(session.decided)
            } else {
                Err(bus.no_run_error().await)
            };
        }
        match tokio::time::timeout(CHECK_INTERVAL, port_requests.next()).await {
            Ok(Some(port_request)) => session.answer_request(&port_request, policy)?,
            Ok(None) => break,
            Err(_) => {}
        }
    }
    Ok(session.decided)
}

/// Returns the error for a request that cannot be decoded.
fn unreadable(request: &str, why: &impl std::fmt::Display) -> String {
    format!("the {request} cannot be decoded: {why}; use a policy client of the base station's version")
}

/// State of a policy process between requests.
struct ClientSession<'a> {
    id: String,
    identity: &'a ClientIdentity,
    /// The header of the last request, and the answer in the encoding of that request.
    last: Option<(WireHeader, Vec<u8>)>,
    decided: u64,
    /// Whether the run has ended.
    is_over: bool,
}

impl ClientSession<'_> {
    fn answer_request(&mut self, port_request: &PortRequest, policy: &mut impl PolicyClient) -> Result<(), BusError> {
        let encoding = port_request.encoding;
        let header: WireHeader = match encoding.decode(&port_request.payload) {
            Ok(header) => header,
            Err(why) => return port_request.reply_error(&unreadable("decision request", &why)),
        };
        if header.stage == RequestKind::Bye {
            self.is_over = true;
            return Ok(());
        }
        if header.stage == RequestKind::Hello {
            return match encoding.decode::<Hello>(&port_request.payload) {
                Ok(hello) => self.answer_hello(port_request, &hello, policy),
                Err(why) => port_request.reply_error(&unreadable("greeting", &why)),
            };
        }
        let request: DecisionRequest = match encoding.decode(&port_request.payload) {
            Ok(request) => request,
            Err(why) => return port_request.reply_error(&unreadable("decision request", &why)),
        };
        if request.to != self.id {
            // The request is for another policy process.
            return Ok(());
        }
        match &self.last {
            // The request was repeated, since its answer was lost or late. A refused answer is decided again.
            Some((last, answer)) if *last == header && request.refused.is_none() => {
                port_request.answer(answer.clone(), encoding)
            }
            _ => {
                let reply = DecisionReply::for_request(&header, &self.id, &self.run_key())
                    .with_decision(&policy.decide(&request));
                let answer = encoding.encode(&reply);
                // Kept before sending, so that a repetition of the request gets the same bytes.
                self.last = Some((header, answer.clone()));
                self.decided += 1;
                port_request.answer(answer, encoding)
            }
        }
    }

    fn run_key(&self) -> String {
        self.identity.run_key.map_or_else(String::new, |key| key.to_string())
    }

    fn answer_hello(
        &self,
        port_request: &PortRequest,
        hello: &Hello,
        policy: &mut impl PolicyClient,
    ) -> Result<(), BusError> {
        if hello.min > PROTOCOL_VERSION || hello.max < OLDEST_PROTOCOL {
            let (min, max) = (hello.min, hello.max);
            return port_request.reply_error(&format!(
                "it speaks protocol {OLDEST_PROTOCOL} to {PROTOCOL_VERSION}, the base station {min} to {max}"
            ));
        }
        // The base station names the refused process in its next greeting, since it cannot reply to a reply.
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
            key: self.run_key(),
            form: self.identity.encoding,
        };
        port_request.answer(port_request.encoding.encode(&reply), port_request.encoding)
    }
}
