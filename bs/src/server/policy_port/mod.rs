//! Decisions of a policy process over the bus, in the form of [`wire`](crate::policy::external::wire). The virtual
//! clock waits until the process has answered.
//!
//! ```text
//!               hello answered with the run's key
//!   no process ───────────────────────────────────► a process ──► answers: the run continues
//!       ▲                                               │
//!       └───────────────────────────────────────────────┘ leaves, or does not answer: the request is sent again
//! ```
//! A process that does not answer in time, or gives three invalid answers to a request, has not decided. Then the run
//! ends, or it keeps the current plan and wakes no device ([`OnUndecided`]).

pub mod client;

use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use reveille_common::bus::{Bus, BusError, PortReply, Replies};
use reveille_common::encoding::Encoding;
use reveille_common::ids::Tti;
use reveille_common::secret::Secret;

use super::config::{DecisionCounts, DecisionTimeout, OnUndecided, RunProgress};
use super::error::BsError;
use super::state::now;
use crate::policy::external::wire::{
    DecisionReply, DecisionRequest, Hello, HelloReply, OLDEST, PROTOCOL, Rejection, ReplyCredentials, RequestKind,
    WireHeader,
};
use crate::policy::external::{Decision, DecisionContext, DecisionStage, PlanDecision};

/// Interval between checks of the stop flag and the time limit during a wait.
const LOOK: Duration = Duration::from_millis(100);
/// Time to answer a greeting before it is sent again.
const GREETING: Duration = Duration::from_secs(2);
/// Time to answer a request before it is sent again, since an answer can get lost with a link.
const AGAIN: Duration = Duration::from_secs(30);
/// Pause between two greetings while no process answers.
const BETWEEN: Duration = Duration::from_millis(200);
/// Time without a decision after which a warning is logged.
const SILENT: Duration = Duration::from_secs(5);
/// Invalid answers to one request after which it counts as undecided.
const STRIKES: u32 = 3;
/// Largest number of different warnings about other processes in a run.
const WONDERS: usize = 20;
/// Characters of such a warning that are logged.
const WONDER: usize = 300;
/// Largest size of an answer: bytes for the whole, and additional bytes per device.
const ANSWER: (usize, usize) = (4096, 64);
/// Time for policy processes to receive the end of the run.
const FAREWELL: Duration = Duration::from_millis(500);
/// Largest length of an id, and characters of a name that are shown.
const NAME: usize = 64;

/// Notifies the policy processes on `bus` that the run has ended, so that they exit. Waits at most 0.5 s for their
/// replies.
///
/// # Errors
/// If the bus fails.
pub async fn send_bye(bus: &Bus) -> Result<(), BusError> {
    let head = WireHeader {
        protocol: PROTOCOL,
        seq: 0,
        tti: 0,
        stage: RequestKind::Bye,
    };
    let payload = (Encoding::Json.encode(&head), Encoding::Json);
    let mut replies = bus.query_policy(payload, 0, FAREWELL).await?;
    while replies.next().await.is_some() {}
    Ok(())
}

/// The policy process that decides.
struct PolicyPeer {
    id: String,
    name: String,
    form: Encoding,
}

/// A decision request that borrows nothing from the session.
pub(super) struct Pending {
    stage: DecisionStage,
    tti: Tti,
    devices: u32,
    asked: DecisionRequest,
    /// The decision that applies if none arrives in time.
    hold: Decision,
}

/// Reason to end the wait for a decision.
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
    /// No answer.
    Timeout,
}

/// The policy port of a run, from which decisions come.
pub(super) struct Port<'a> {
    bus: &'a Bus,
    key: Option<Secret>,
    run: String,
    patience: Option<DecisionTimeout>,
    partner: Option<PolicyPeer>,
    /// The greeting for policy processes, built at the first decision request.
    hello: Option<Hello>,
    /// Further replies to the last request, whose first valid reply counted, and the id of the process asked.
    extra_replies: Option<(Replies, String)>,
    /// The last warning about the policy process.
    last_replies: String,
    /// Warnings about other processes at the port.
    unexpected: BTreeSet<String>,
    /// Counts of decisions so far.
    counts: DecisionCounts,
}

impl<'a> Port<'a> {
    pub(super) fn new(bus: &'a Bus, key: Option<Secret>, patience: Option<DecisionTimeout>) -> Self {
        Self {
            bus,
            key,
            run: bus.keys().run().to_string(),
            patience,
            partner: None,
            hello: None,
            extra_replies: None,
            last_replies: String::new(),
            unexpected: BTreeSet::new(),
            counts: DecisionCounts::default(),
        }
    }

    /// The counts of all decision requests.
    pub(super) const fn counts(&self) -> DecisionCounts {
        self.counts
    }

    /// Builds the request for decision number `seq` of the run.
    ///
    /// # Errors
    /// If decisions come from the input log alone, and it has none for this request.
    pub(super) fn lookup(&mut self, question: &DecisionContext<'_>, seq: u64) -> Result<Pending, BsError> {
        let (stage, tti) = (question.stage, question.seen.now);
        if self.patience.is_none() {
            return Err(BsError::CannotContinue(format!(
                "inputs.log has no decision for TTI {tti}: the logged run ended there"
            )));
        }
        let run = &self.run;
        // The greeting describes the deployment, which does not change during a run.
        self.hello
            .get_or_insert_with(|| Hello::new(run.clone(), question.seen.known));
        let to = self.partner.as_ref().map_or("", |partner| &partner.id);
        let plan = question.seen.plan.clone();
        Ok(Pending {
            stage,
            tti,
            devices: question.woken.len() as u32,
            asked: DecisionRequest::new(question, seq, to),
            hold: match stage {
                DecisionStage::Plan => Decision::Plan(PlanDecision { plan, next: tti + 1 }),
                DecisionStage::Wake => Decision::Wake(Vec::new()),
            },
        })
    }

    /// Sends the request until a decision arrives; `None` if the run is to stop.
    ///
    /// # Errors
    /// If the bus fails, or no decision arrives in time under [`OnUndecided::End`].
    pub(super) async fn resolve(
        &mut self,
        pending: Pending,
        progress: &RunProgress,
    ) -> Result<Option<Decision>, BsError> {
        let Pending {
            stage,
            tti,
            devices,
            mut asked,
            hold,
        } = pending;
        // Second answers to the last request have had time to arrive since the first one counted.
        self.count_spare();
        let patience = self.patience.unwrap_or_default();
        let mut wait = Wait::new(progress, patience.limit, tti);
        let mut strikes = 0;
        let why = loop {
            wait.peer_status = self.peer_status();
            let tried = match &self.partner {
                None => self.handshake(asked.head, &mut wait).await?.map_continue(|()| None),
                Some(partner) => {
                    asked.to.clone_from(&partner.id);
                    self.ask(&asked, (stage, tti, devices), &mut wait)
                        .await?
                        .map_continue(Some)
                }
            };
            match tried {
                ControlFlow::Break(WaitEnd::Stop) => return Ok(None),
                ControlFlow::Break(WaitEnd::TimeUp) => break self.peer_status(),
                ControlFlow::Continue(None) => {}
                ControlFlow::Continue(Some(PeerReply::Decision(answer))) => {
                    self.counts.decided += 1;
                    return Ok(Some(answer));
                }
                ControlFlow::Continue(Some(PeerReply::Timeout)) => {
                    // An unresponsive process may have exited, so the next attempt greets again and another process can
                    // take its place.
                    let name = self.partner.take().map(|partner| partner.name).unwrap_or_default();
                    let held = "the run is waiting until a policy process answers";
                    self.complain(format!("{name} has not answered for TTI {tti}; {held}"));
                    tokio::time::sleep(BETWEEN).await;
                }
                ControlFlow::Continue(Some(PeerReply::Invalid(why))) => {
                    self.counts.refused += 1;
                    strikes += 1;
                    tracing::warn!(%tti, "invalid answer: {why}");
                    if strikes >= STRIKES {
                        break format!("{strikes} invalid answers, the last one because: {why}");
                    }
                    asked.refused = Some(why);
                }
            }
        };
        match patience.on_timeout {
            OnUndecided::End => Err(BsError::Undecided { tti, why }),
            OnUndecided::Hold => {
                // One warning in a run: without a policy process every decision would add another.
                if self.counts.held == 0 {
                    let held = "the current plan stays, and no device is woken";
                    tracing::warn!(%tti, "{why}; {held}; further cases are only counted");
                }
                self.counts.held += 1;
                Ok(Some(hold))
            }
        }
    }

    /// The reason to report for a decision that did not arrive in time.
    fn peer_status(&self) -> String {
        match &self.partner {
            Some(partner) => format!("{} has not decided", partner.name),
            None => format!("no policy process answers at {}", self.bus.keys().policy()),
        }
    }

    /// Sends a greeting and selects the first process that answers it correctly.
    async fn handshake(&mut self, asked: WireHeader, wait: &mut Wait<'_>) -> WaitResult<()> {
        let Some(hello) = &mut self.hello else {
            return Ok(ControlFlow::Continue(()));
        };
        // The greeting repeats the number and TTI of the request, so a late reply to an older greeting is recognised.
        hello.head = WireHeader {
            stage: RequestKind::Hello,
            ..asked
        };
        let (head, payload) = (hello.head, Encoding::Json.encode(hello));
        let mut replies = self
            .bus
            .query_policy((payload, Encoding::Json), ANSWER.0, GREETING)
            .await?;
        loop {
            let problem = match wait.next(&mut replies).await {
                ControlFlow::Break(cut) => return Ok(ControlFlow::Break(cut)),
                ControlFlow::Continue(None) => break,
                ControlFlow::Continue(Some(PortReply::Refusal(why))) => why,
                ControlFlow::Continue(Some(PortReply::Answer(bytes, form))) => match self.welcomed(&head, &bytes, form)
                {
                    Ok(partner) => {
                        tracing::info!(tti = %head.tti, "{} decides", partner.name);
                        if let Some(hello) = &mut self.hello {
                            hello.refused = None;
                        }
                        self.partner = Some(partner);
                        return Ok(ControlFlow::Continue(()));
                    }
                    Err(why) => {
                        // The reason goes into the next greeting, which needs an id to name the refused process.
                        let id = form.decode(&bytes).map(|shown: ReplyCredentials| shown.id);
                        if let (Ok(id), Some(hello)) = (id, &mut self.hello) {
                            let why = why.clone();
                            hello.refused = Some(Rejection { id, why });
                        }
                        why
                    }
                },
            };
            self.wonder(&format!("refused a process at the policy port: {problem}"));
        }
        wait.name();
        // With no process at the port the replies can end immediately; without a pause this loop would spin.
        tokio::time::sleep(BETWEEN).await;
        Ok(ControlFlow::Continue(()))
    }

    fn welcomed(&self, greeting: &WireHeader, bytes: &[u8], form: Encoding) -> Result<PolicyPeer, String> {
        let welcome: HelloReply = form.decode(bytes)?;
        let WireHeader { protocol, .. } = welcome.head;
        if !(OLDEST..=PROTOCOL).contains(&protocol) {
            return Err(format!(
                "it speaks protocol {protocol}, this base station {OLDEST} to {PROTOCOL}"
            ));
        }
        // A reply to an earlier greeting may arrive late, and its process may have exited.
        let echo = |head: &WireHeader| (head.seq, head.tti, head.stage);
        if echo(&welcome.head) != echo(greeting) {
            return Err("it answers another greeting".to_owned());
        }
        if !self.is_ours(&welcome.key) {
            return Err("it does not show the run's key; use the key of the process that started the run".to_owned());
        }
        if welcome.id.is_empty() || welcome.id.len() > NAME {
            return Err(format!("its id must have 1 to {NAME} characters"));
        }
        // The name appears in logs and on the terminal, so another process must not control either.
        let name: String = welcome.name.chars().filter(|c| !c.is_control()).take(NAME).collect();
        let name = if name.is_empty() {
            format!("process {}", welcome.id)
        } else {
            name
        };
        Ok(PolicyPeer {
            id: welcome.id,
            name,
            form: welcome.form,
        })
    }

    fn is_ours(&self, shown: &str) -> bool {
        self.key.is_none_or(|key| shown.parse() == Ok(key))
    }

    /// Whether an answer shows this process id and the run's key.
    fn is_from(&self, id: &str, bytes: &[u8], form: Encoding) -> bool {
        form.decode(bytes)
            .is_ok_and(|shown: ReplyCredentials| shown.id == id && self.is_ours(&shown.key))
    }

    /// Sends the request once.
    async fn ask(
        &mut self,
        asked: &DecisionRequest,
        (stage, tti, devices): (DecisionStage, Tti, u32),
        wait: &mut Wait<'_>,
    ) -> WaitResult<PeerReply> {
        let form = self.partner.as_ref().map_or(Encoding::Json, |partner| partner.form);
        // The bound follows from the largest valid answer, so a hostile process cannot fill the memory.
        let most = ANSWER.0 + ANSWER.1 * devices as usize;
        let mut replies = self.bus.query_policy((form.encode(asked), form), most, AGAIN).await?;
        loop {
            match wait.next(&mut replies).await {
                ControlFlow::Break(cut) => return Ok(ControlFlow::Break(cut)),
                ControlFlow::Continue(None) => return Ok(ControlFlow::Continue(PeerReply::Timeout)),
                ControlFlow::Continue(Some(PortReply::Refusal(why))) => {
                    self.wonder(&format!("a process at the policy port returned an error: {why}"));
                }
                // A reply without key and id can come from any client, so it does not count against the policy process.
                ControlFlow::Continue(Some(PortReply::Answer(bytes, form)))
                    if !self.is_from(&asked.to, &bytes, form) =>
                {
                    let what = "that cannot be decoded, or does not show the run's key and the requested id";
                    self.wonder(&format!("dropped an answer {what}"));
                }
                ControlFlow::Continue(Some(PortReply::Answer(bytes, form))) => {
                    let reply: Result<DecisionReply, String> = form.decode(&bytes);
                    let answer = reply.and_then(|reply| {
                        let echo = (reply.seq, reply.tti, reply.stage);
                        let own = (asked.head.seq, asked.head.tti, Some(asked.head.stage));
                        if echo != own {
                            return Err(format!("it is for {echo:?}, not for {own:?} (seq, tti, stage)"));
                        }
                        reply.answer(stage, tti, devices)
                    });
                    let told = match answer {
                        Ok(answer) => {
                            // The replies stay open, so a second answer to this request can be counted before the next
                            // request.
                            self.extra_replies = Some((replies, asked.to.clone()));
                            PeerReply::Decision(answer)
                        }
                        Err(why) => PeerReply::Invalid(why),
                    };
                    return Ok(ControlFlow::Continue(told));
                }
            }
        }
    }

    /// Counts further answers to the last request.
    fn count_spare(&mut self) {
        let Some((replies, id)) = self.extra_replies.take() else {
            return;
        };
        let is_own = |heard: &PortReply| match heard {
            PortReply::Answer(bytes, form) => self.is_from(&id, bytes, *form),
            PortReply::Refusal(_) => false,
        };
        let more = replies.drain().filter(is_own).count() as u64;
        if more > 0 {
            self.counts.refused += more;
            self.complain("a decision request was answered twice; the first answer counts".to_owned());
        }
    }

    /// Logs a warning about the policy process, unless it repeats the last one.
    fn complain(&mut self, what: String) {
        if self.last_replies != what {
            tracing::warn!("{what}");
            self.last_replies = what;
        }
    }

    /// Logs a warning about another process at the port, once per text. Such processes can neither fill the log or the
    /// memory nor suppress the warnings of the run itself.
    fn wonder(&mut self, what: &str) {
        let what: String = what.chars().filter(|c| !c.is_control()).take(WONDER).collect();
        // The set is bounded as well as the text, since a process can send new texts for ever.
        if self.unexpected.len() == WONDERS || self.unexpected.contains(&what) {
            return;
        }
        tracing::warn!("{what}");
        self.unexpected.insert(what);
        if self.unexpected.len() == WONDERS {
            tracing::warn!("further errors of other processes at the policy port are not logged");
        }
    }
}

/// The wait for one decision.
struct Wait<'a> {
    progress: &'a RunProgress,
    begun: Instant,
    limit: Option<Duration>,
    tti: Tti,
    /// Description of the missing decision, for the warning.
    peer_status: String,
    is_named: bool,
}

impl<'a> Wait<'a> {
    fn new(progress: &'a RunProgress, limit: Option<Duration>, tti: Tti) -> Self {
        Self {
            progress,
            begun: now(),
            limit,
            tti,
            peer_status: String::new(),
            is_named: false,
        }
    }

    /// Returns the next of `replies`; `None` if no more follow.
    async fn next(&mut self, replies: &mut Replies) -> ControlFlow<WaitEnd, Option<PortReply>> {
        loop {
            if self.progress.stop.load(Ordering::Relaxed) {
                return ControlFlow::Break(WaitEnd::Stop);
            }
            let waited = self.begun.elapsed();
            if self.limit.is_some_and(|limit| waited >= limit) {
                return ControlFlow::Break(WaitEnd::TimeUp);
            }
            // The last check comes earlier, so that the wait does not exceed its limit by a whole interval.
            let look = self.limit.map_or(LOOK, |limit| LOOK.min(limit.saturating_sub(waited)));
            match tokio::time::timeout(look, replies.next()).await {
                Ok(heard) => return ControlFlow::Continue(heard),
                Err(_) => self.name(),
            }
        }
    }

    /// Logs one warning if the wait is long.
    fn name(&mut self) {
        if self.begun.elapsed() >= SILENT && !self.is_named {
            self.is_named = true;
            let (tti, peer_status) = (self.tti, &self.peer_status);
            tracing::warn!(%tti, "no decision for {} s: {peer_status}; the run is waiting", SILENT.as_secs());
        }
    }
}
