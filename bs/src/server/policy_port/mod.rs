//! Decisions of a policy process over the bus, in the form of [`wire`](crate::policy::external::wire) and as described
//! in docs/policy-port.md. [`client`] and `python/reveille/policy_client.py` are the other side.
//!
//! ```text
//!               hello answered with the run's key
//!   no process ───────────────────────────────────► a process ──► answers: the run continues
//!       ▲                                               │
//!       └───────────────────────────────────────────────┘ leaves, or does not answer: the request is sent again
//! ```
//! After an invalid answer the process receives the request again, with the reason. A process that gives three invalid
//! answers to a request, or none in time, has not decided. Then the run ends, or it keeps the current plan and wakes no
//! device ([`OnUndecided`]). docs/policy-port.md states these rules and some of the limits below.

pub mod client;

use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::time::{Duration, Instant};

use reveille_common::bus::{Bus, BusError, PortReply, Replies};
use reveille_common::encoding::Encoding;
use reveille_common::ids::Tti;
use reveille_common::secret::Secret;

use super::config::{DecisionCounts, DecisionTimeout, OnUndecided, RunProgress};
use super::error::BsError;
use super::state::now;
use crate::policy::external::wire::{
    DecisionReply, DecisionRequest, Hello, HelloReply, OLDEST_PROTOCOL, PROTOCOL_VERSION, RefusedProcess,
    ReplyCredentials, RequestKind, WireHeader,
};
use crate::policy::external::{Decision, DecisionContext, DecisionStage, PlanDecision};

/// Interval between checks of the stop flag and the time limit during a wait.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);
/// Time to answer a hello before it is sent again.
const HELLO_TIMEOUT: Duration = Duration::from_secs(2);
/// Time to answer a request before it is sent again, since an answer can get lost with a link.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(30);
/// Pause between two hellos while no process answers.
const HELLO_PAUSE: Duration = Duration::from_millis(200);
/// Time without a decision after which a warning is logged.
const WARN_AFTER: Duration = Duration::from_secs(5);
/// Invalid answers to one request after which it counts as undecided.
const MAX_INVALID_ANSWERS: u32 = 3;
/// Largest number of different warnings about other processes in a run.
const MAX_WARNINGS: usize = 20;
/// Characters of such a warning that are logged.
const MAX_WARNING_CHARS: usize = 300;
/// Largest size of an answer without its devices.
const MAX_ANSWER_BASE_BYTES: usize = 4096;
/// Additional size of an answer for each device.
const MAX_ANSWER_BYTES_PER_DEVICE: usize = 64;
/// Time for policy processes to receive the end of the run.
const BYE_TIMEOUT: Duration = Duration::from_millis(500);
/// Largest length of an id, and number of characters of a name that are shown.
const MAX_NAME_CHARS: usize = 64;

/// Notifies the policy processes on `bus` that the run has ended, so that they exit. Waits at most 0.5 s for their
/// replies.
///
/// # Errors
/// If the bus fails.
pub async fn send_bye(bus: &Bus) -> Result<(), BusError> {
    let header = WireHeader {
        protocol: PROTOCOL_VERSION,
        seq: 0,
        tti: 0,
        stage: RequestKind::Bye,
    };
    let payload = (Encoding::Json.encode(&header), Encoding::Json);
    // The content of a reply does not matter.
    let max_reply_bytes = 0;
    let mut replies = bus.query_policy(payload, max_reply_bytes, BYE_TIMEOUT).await?;
    while replies.next().await.is_some() {}
    Ok(())
}

/// The policy process that decides.
struct PolicyPeer {
    id: String,
    name: String,
    encoding: Encoding,
}

/// A decision request that borrows nothing from the session.
pub(super) struct PendingDecision {
    stage: DecisionStage,
    tti: Tti,
    devices: u32,
    request: DecisionRequest,
    /// The decision that applies if none arrives in time.
    fallback: Decision,
}

/// Reason why a wait ended without a reply.
enum WaitEnd {
    /// The run is to stop.
    Stop,
    /// No decision has arrived in time.
    TimeUp,
}

/// Result of an attempt, unless the wait ended first.
type WaitResult<T> = Result<ControlFlow<WaitEnd, T>, BsError>;

/// Result of a decision request.
enum PeerReply {
    /// A valid answer.
    Decision(Decision),
    /// An invalid answer, with the reason.
    Invalid(String),
    /// No answer. Also within milliseconds: zenoh ends a query without a reply if it knows no route to the process,
    /// which may have ended, or have connected a moment ago (zenoh issue 2767).
    Timeout,
}

/// The policy port of a run, from which decisions come.
pub(super) struct PolicyPort<'a> {
    bus: &'a Bus,
    run_key: Option<Secret>,
    /// Name of the run, for the hello.
    run: String,
    /// The time limit of each decision; `None` if all decisions come from the input log.
    timeout: Option<DecisionTimeout>,
    peer: Option<PolicyPeer>,
    /// The hello to policy processes, built at the first decision request.
    hello: Option<Hello>,
    /// Further replies to the last request, whose first valid reply counted, and the id of the process asked.
    extra_replies: Option<(Replies, String)>,
    last_warning: String,
    /// Warnings about other processes at the port.
    other_warnings: BTreeSet<String>,
    counts: DecisionCounts,
}

impl<'a> PolicyPort<'a> {
    pub(super) fn new(bus: &'a Bus, run_key: Option<Secret>, timeout: Option<DecisionTimeout>) -> Self {
        Self {
            bus,
            run_key,
            run: bus.key_exprs().run().to_string(),
            timeout,
            peer: None,
            hello: None,
            extra_replies: None,
            last_warning: String::new(),
            other_warnings: BTreeSet::new(),
            counts: DecisionCounts::default(),
        }
    }

    pub(super) const fn counts(&self) -> DecisionCounts {
        self.counts
    }

    /// Builds the request for decision number `seq` of the run.
    ///
    /// # Errors
    /// If decisions come from the input log alone, and it has none for this request.
    pub(super) fn prepare_request(
        &mut self,
        context: &DecisionContext<'_>,
        seq: u64,
    ) -> Result<PendingDecision, BsError> {
        let (stage, tti) = (context.stage, context.observation.now);
        if self.timeout.is_none() {
            return Err(BsError::CannotContinue(format!(
                "inputs.log has no decision for TTI {tti}: the logged run ended there"
            )));
        }
        let run = &self.run;
        // The hello describes the deployment, which does not change during a run.
        self.hello
            .get_or_insert_with(|| Hello::new(run.clone(), context.observation.known));
        let peer_id = self.peer.as_ref().map_or("", |peer| &peer.id);
        let plan = context.observation.plan.clone();
        Ok(PendingDecision {
            stage,
            tti,
            devices: context.device_count() as u32,
            request: DecisionRequest::new(context, seq, peer_id),
            fallback: match stage {
                DecisionStage::Plan => Decision::Plan(PlanDecision { plan, next: tti + 1 }),
                DecisionStage::Wake => Decision::Wake(Vec::new()),
            },
        })
    }

    /// Sends the request until a decision arrives; `None` if the run is to stop.
    ///
    /// # Errors
    /// If the bus fails, or no decision arrives in time under [`OnUndecided::End`].
    pub(super) async fn obtain_decision(
        &mut self,
        pending: PendingDecision,
        progress: &RunProgress,
    ) -> Result<Option<Decision>, BsError> {
        let PendingDecision {
            stage,
            tti,
            devices,
            mut request,
            fallback,
        } = pending;
        // Second answers to the last request have had time to arrive since the first one counted.
        self.count_extra_answers();
        let timeout = self.timeout.unwrap_or_default();
        let mut wait = DecisionWait::new(progress, timeout.limit, tti);
        let mut invalid_answers = 0;
        let why = loop {
            wait.peer_status = self.peer_status();
            let attempt = match &self.peer {
                None => self.handshake(request.head, &mut wait).await?.map_continue(|()| None),
                Some(peer) => {
                    request.to.clone_from(&peer.id);
                    self.send_request(&request, (stage, tti, devices), &mut wait)
                        .await?
                        .map_continue(Some)
                }
            };
            match attempt {
                ControlFlow::Break(WaitEnd::Stop) => return Ok(None),
                ControlFlow::Break(WaitEnd::TimeUp) => break self.peer_status(),
                ControlFlow::Continue(None) => {}
                ControlFlow::Continue(Some(PeerReply::Decision(answer))) => {
                    self.counts.decided += 1;
                    return Ok(Some(answer));
                }
                ControlFlow::Continue(Some(PeerReply::Timeout)) => {
                    // An unresponsive process may have exited, so the next attempt sends a hello again and another
                    // process can take its place.
                    let name = self.peer.take().map(|peer| peer.name).unwrap_or_default();
                    // A process that the program started may have crashed: its end then stops the run with its own
                    // error, which names the cause.
                    tokio::time::sleep(HELLO_PAUSE).await;
                    if !progress.is_stop_requested() {
                        let effect =
                            "the run is waiting until a policy process answers; --decision-timeout limits the wait";
                        self.warn_about_peer(format!("{name} has not answered for TTI {tti}; {effect}"));
                    }
                }
                ControlFlow::Continue(Some(PeerReply::Invalid(why))) => {
                    self.counts.refused_answers += 1;
                    invalid_answers += 1;
                    tracing::warn!(%tti, "invalid answer: {why}");
                    if invalid_answers >= MAX_INVALID_ANSWERS {
                        break format!("{invalid_answers} invalid answers, the last one because: {why}");
                    }
                    request.refused = Some(why);
                }
            }
        };
        match timeout.on_timeout {
            OnUndecided::End => Err(BsError::Undecided { tti, why }),
            OnUndecided::Hold => {
                // One warning in a run: without a policy process every decision would add another.
                if self.counts.held == 0 {
                    let effect = "the current plan stays, and no device is woken";
                    tracing::warn!(%tti, "{why}; {effect}; further cases are only counted");
                }
                self.counts.held += 1;
                Ok(Some(fallback))
            }
        }
    }

    /// The reason to report for a decision that did not arrive in time.
    fn peer_status(&self) -> String {
        match &self.peer {
            Some(peer) => format!("{} has not decided", peer.name),
            None => format!(
                "no policy process answers at {}; start one that connects there, or use --policy-command",
                self.bus.key_exprs().policy_port()
            ),
        }
    }

    /// Sends a hello and selects the first process that answers it correctly.
    async fn handshake(&mut self, request_header: WireHeader, wait: &mut DecisionWait<'_>) -> WaitResult<()> {
        let Some(hello) = &mut self.hello else {
            return Ok(ControlFlow::Continue(()));
        };
        // The hello repeats the number and TTI of the request, so a late reply to an older hello is recognised.
        hello.head = WireHeader {
            stage: RequestKind::Hello,
            ..request_header
        };
        let (header, payload) = (hello.head, Encoding::Json.encode(hello));
        let mut replies = self
            .bus
            .query_policy((payload, Encoding::Json), MAX_ANSWER_BASE_BYTES, HELLO_TIMEOUT)
            .await?;
        loop {
            let problem = match wait.next(&mut replies).await {
                ControlFlow::Break(end) => return Ok(ControlFlow::Break(end)),
                ControlFlow::Continue(None) => break,
                ControlFlow::Continue(Some(PortReply::Refusal(why))) => why,
                ControlFlow::Continue(Some(PortReply::Answer(bytes, encoding))) => {
                    match self.check_hello_reply(&header, &bytes, encoding) {
                        Ok(peer) => {
                            tracing::info!(tti = %header.tti, "{} decides", peer.name);
                            if let Some(hello) = &mut self.hello {
                                hello.refused = None;
                            }
                            self.peer = Some(peer);
                            return Ok(ControlFlow::Continue(()));
                        }
                        Err(why) => {
                            // The reason goes into the next hello, which needs an id to name the refused process.
                            let id = encoding.decode(&bytes).map(|shown: ReplyCredentials| shown.id);
                            if let (Ok(id), Some(hello)) = (id, &mut self.hello) {
                                let why = why.clone();
                                hello.refused = Some(RefusedProcess { id, why });
                            }
                            why
                        }
                    }
                }
            };
            self.warn_about_other(&format!("refused a process at the policy port: {problem}"));
        }
        wait.warn_if_long();
        // With no process at the port the replies can end immediately; without a pause this loop would spin.
        tokio::time::sleep(HELLO_PAUSE).await;
        Ok(ControlFlow::Continue(()))
    }

    fn check_hello_reply(
        &self,
        hello_head: &WireHeader,
        bytes: &[u8],
        encoding: Encoding,
    ) -> Result<PolicyPeer, String> {
        let reply: HelloReply = encoding.decode(bytes)?;
        let WireHeader { protocol, .. } = reply.head;
        if !(OLDEST_PROTOCOL..=PROTOCOL_VERSION).contains(&protocol) {
            return Err(format!(
                "it speaks protocol {protocol}, this base station {OLDEST_PROTOCOL} to {PROTOCOL_VERSION}"
            ));
        }
        // A reply to an earlier hello may arrive late, and its process may have exited.
        let echo = |head: &WireHeader| (head.seq, head.tti, head.stage);
        if echo(&reply.head) != echo(hello_head) {
            return Err("it answers another greeting".to_owned());
        }
        if !self.shows_run_key(&reply.key) {
            return Err("it does not show the run's key; use the key of the process that started the run".to_owned());
        }
        if reply.id.is_empty() || reply.id.chars().count() > MAX_NAME_CHARS {
            return Err(format!("its id must have 1 to {MAX_NAME_CHARS} characters"));
        }
        // The name appears in logs and on the terminal, so another process must not control either.
        let name: String = reply
            .name
            .chars()
            .filter(|c| !c.is_control())
            .take(MAX_NAME_CHARS)
            .collect();
        let name = if name.is_empty() {
            format!("process {}", reply.id)
        } else {
            name
        };
        Ok(PolicyPeer {
            id: reply.id,
            name,
            encoding: reply.form,
        })
    }

    fn shows_run_key(&self, shown: &str) -> bool {
        self.run_key.is_none_or(|key| shown.parse() == Ok(key))
    }

    /// Whether an answer shows this process id and the run's key.
    fn is_from_peer(&self, id: &str, bytes: &[u8], encoding: Encoding) -> bool {
        encoding
            .decode(bytes)
            .is_ok_and(|shown: ReplyCredentials| shown.id == id && self.shows_run_key(&shown.key))
    }

    /// Sends the request once.
    async fn send_request(
        &mut self,
        request: &DecisionRequest,
        (stage, tti, devices): (DecisionStage, Tti, u32),
        wait: &mut DecisionWait<'_>,
    ) -> WaitResult<PeerReply> {
        let request_encoding = self.peer.as_ref().map_or(Encoding::Json, |peer| peer.encoding);
        // The bound follows from the largest valid answer, so a hostile process cannot fill the memory.
        let max_bytes = MAX_ANSWER_BASE_BYTES + MAX_ANSWER_BYTES_PER_DEVICE * devices as usize;
        let mut replies = self
            .bus
            .query_policy(
                (request_encoding.encode(request), request_encoding),
                max_bytes,
                REQUEST_TIMEOUT,
            )
            .await?;
        loop {
            match wait.next(&mut replies).await {
                ControlFlow::Break(end) => return Ok(ControlFlow::Break(end)),
                ControlFlow::Continue(None) => return Ok(ControlFlow::Continue(PeerReply::Timeout)),
                ControlFlow::Continue(Some(PortReply::Refusal(why))) => {
                    self.warn_about_other(&format!("a process at the policy port returned an error: {why}"));
                }
                // A reply without key and id can come from any client, so it does not count against the policy process.
                ControlFlow::Continue(Some(PortReply::Answer(bytes, encoding)))
                    if !self.is_from_peer(&request.to, &bytes, encoding) =>
                {
                    let defect = "that cannot be decoded, or does not show the run's key and the requested id";
                    self.warn_about_other(&format!("dropped an answer {defect}"));
                }
                ControlFlow::Continue(Some(PortReply::Answer(bytes, encoding))) => {
                    let reply: Result<DecisionReply, String> = encoding.decode(&bytes);
                    let answer = reply.and_then(|reply| {
                        let echo = (reply.seq, reply.tti, reply.stage);
                        let expected = (request.head.seq, request.head.tti, Some(request.head.stage));
                        if echo != expected {
                            return Err(format!("it is for {echo:?}, not for {expected:?} (seq, tti, stage)"));
                        }
                        reply.decision(stage, tti, devices)
                    });
                    let peer_reply = match answer {
                        Ok(answer) => {
                            // The replies stay open, so a second answer to this request can be counted before the next
                            // request.
                            self.extra_replies = Some((replies, request.to.clone()));
                            PeerReply::Decision(answer)
                        }
                        Err(why) => PeerReply::Invalid(why),
                    };
                    return Ok(ControlFlow::Continue(peer_reply));
                }
            }
        }
    }

    fn count_extra_answers(&mut self) {
        let Some((replies, id)) = self.extra_replies.take() else {
            return;
        };
        let is_from_same_peer = |reply: &PortReply| match reply {
            PortReply::Answer(bytes, encoding) => self.is_from_peer(&id, bytes, *encoding),
            PortReply::Refusal(_) => false,
        };
        let extra_answers = replies.drain().filter(is_from_same_peer).count() as u64;
        if extra_answers > 0 {
            self.counts.refused_answers += extra_answers;
            self.warn_about_peer("a decision request was answered twice; the first answer counts".to_owned());
        }
    }

    /// Logs a warning about the policy process, unless it repeats the last one.
    fn warn_about_peer(&mut self, warning: String) {
        if self.last_warning != warning {
            tracing::warn!("{warning}");
            self.last_warning = warning;
        }
    }

    /// Logs a warning about another process at the port, once per text. Such processes can neither fill the log or the
    /// memory nor suppress the warnings of the run itself.
    fn warn_about_other(&mut self, warning: &str) {
        let warning: String = warning
            .chars()
            .filter(|c| !c.is_control())
            .take(MAX_WARNING_CHARS)
            .collect();
        // The set is bounded as well as the text, since a process can send new texts for ever.
        if self.other_warnings.len() == MAX_WARNINGS || self.other_warnings.contains(&warning) {
            return;
        }
        tracing::warn!("{warning}");
        self.other_warnings.insert(warning);
        if self.other_warnings.len() == MAX_WARNINGS {
            tracing::warn!("further errors of other processes at the policy port are not logged");
        }
    }
}

/// The wait for one decision, over all attempts.
struct DecisionWait<'a> {
    progress: &'a RunProgress,
    started: Instant,
    limit: Option<Duration>,
    tti: Tti,
    /// Description of the missing decision, for the warning.
    peer_status: String,
    has_warned: bool,
}

impl<'a> DecisionWait<'a> {
    fn new(progress: &'a RunProgress, limit: Option<Duration>, tti: Tti) -> Self {
        Self {
            progress,
            started: now(),
            limit,
            tti,
            peer_status: String::new(),
            has_warned: false,
        }
    }

    /// Returns the next of `replies`; `None` if no more follow.
    async fn next(&mut self, replies: &mut Replies) -> ControlFlow<WaitEnd, Option<PortReply>> {
        loop {
            if self.progress.is_stop_requested() {
                return ControlFlow::Break(WaitEnd::Stop);
            }
            let waited = self.started.elapsed();
            if self.limit.is_some_and(|limit| waited >= limit) {
                return ControlFlow::Break(WaitEnd::TimeUp);
            }
            // The last check comes earlier, so that the wait does not exceed its limit by a whole interval.
            let interval = self
                .limit
                .map_or(CHECK_INTERVAL, |limit| CHECK_INTERVAL.min(limit.saturating_sub(waited)));
            match tokio::time::timeout(interval, replies.next()).await {
                Ok(reply) => return ControlFlow::Continue(reply),
                Err(_) => self.warn_if_long(),
            }
        }
    }

    fn warn_if_long(&mut self) {
        if self.started.elapsed() >= WARN_AFTER && !self.has_warned {
            self.has_warned = true;
            let (tti, peer_status) = (self.tti, &self.peer_status);
            tracing::warn!(%tti, "no decision for {} s: {peer_status}; the run is waiting", WARN_AFTER.as_secs());
        }
    }
}
