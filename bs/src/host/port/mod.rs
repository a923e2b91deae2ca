//! Decisions from outside over the bus, said as in [`wire`](crate::policy::external::wire): those that were kept come
//! first, then a policy process is asked. Virtual time stands until it has answered.
//!
//! ```text
//!            hello answered with the run's key
//!   nobody ───────────────────────────────────► a process ──► answers: the run goes on
//!      ▲                                            │
//!      └────────────────────────────────────────────┘ is gone, or says nothing for a while: the question comes again
//! ```
//! Who has not answered in time, or has answered what decides nothing three times over, has not decided: the run ends,
//! or the plan in force holds on and nobody is woken, as it was told.

pub mod client;

use std::collections::{BTreeSet, VecDeque};
use std::ops::ControlFlow;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use reveille_common::bus::{Bus, BusError, Heard, Replies};
use reveille_common::forms::Form;
use reveille_common::ids::Tti;
use reveille_common::secret::Secret;

use super::drive::{DecisionCounts, Decisions, Patience, Progress, Undecided};
use super::error::BsError;
use super::wall::now;
use crate::policy::external::wire::{Asked, Head, Hello, OLDEST, PROTOCOL, Refused, Reply, Said, Shown, Welcome};
use crate::policy::external::{Answer, Answered, Decision, Question, Stage};

/// How often a wait looks at what else may have happened.
const LOOK: Duration = Duration::from_millis(100);
/// How long a greeting may take to be answered before it is said again.
const GREETING: Duration = Duration::from_secs(2);
/// How long an answer may take before the question is asked again: it can get lost with a link.
const AGAIN: Duration = Duration::from_secs(30);
/// The pause between two tries where nobody is there.
const BETWEEN: Duration = Duration::from_millis(200);
/// How long nobody may decide before it is said.
const SILENT: Duration = Duration::from_secs(5);
/// Answers to one question that decide nothing.
const STRIKES: u32 = 3;
/// Different things that are told of strangers, in a run.
const WONDERS: usize = 20;
/// Characters of one that are shown.
const WONDER: usize = 300;
/// Bytes that an answer can have, and so many for each device.
const ANSWER: (usize, usize) = (4096, 64);
/// How long policy processes have to hear that the run is over.
const FAREWELL: Duration = Duration::from_millis(500);
/// Characters of a name that are shown.
const NAME: usize = 64;

/// Tells policy processes on `bus` that the run is over, so that they leave. Does not wait for long for one that does
/// not listen.
///
/// # Errors
/// If the bus fails.
pub async fn farewell(bus: &Bus) -> Result<(), BusError> {
    let head = Head {
        protocol: PROTOCOL,
        seq: 0,
        tti: 0,
        stage: Said::Bye,
    };
    let payload = (Form::Json.encode(&head), Form::Json);
    let mut replies = bus.ask_policy(payload, 0, FAREWELL).await?;
    while replies.next().await.is_some() {}
    Ok(())
}

/// Who decides.
struct Partner {
    id: String,
    name: String,
    form: Form,
}

/// A question of which nothing is borrowed.
pub(super) struct Pending {
    stage: Stage,
    tti: Tti,
    devices: u32,
    asked: Asked,
    /// What stands for an answer where there comes none.
    hold: Answer,
}

/// Where a question is, once it is posed.
pub(super) enum Posed {
    /// It was answered before.
    Kept(Answer),
    /// A policy process is to be asked.
    Open(Box<Pending>),
}

/// Why a decision is not waited for any more.
enum Cut {
    /// The run is to stop.
    Stop,
    /// Nobody decides in time.
    TimeUp,
}

/// What has come of a try, unless it was cut short.
type Tried<T> = Result<ControlFlow<Cut, T>, BsError>;

/// What has come of asking a policy process.
enum Told {
    /// Its answer.
    Answer(Answer),
    /// An answer, and what is wrong with it.
    Refused(String),
    /// Nothing.
    Silence,
}

/// Where decisions come from.
pub(super) struct Port<'a> {
    bus: &'a Bus,
    key: Option<Secret>,
    run: String,
    kept: VecDeque<Answered>,
    patience: Option<Patience>,
    partner: Option<Partner>,
    /// What is said to who comes, once somebody is asked.
    hello: Option<Hello>,
    /// The number of the next decision.
    seq: u64,
    /// The replies to the last question, of which the first counted, and the id of who was asked.
    spare: Option<(Replies, String)>,
    /// What the run has said last of who decides.
    said: String,
    /// What was said of what anybody may send.
    strange: BTreeSet<String>,
    /// What has come so far.
    counts: DecisionCounts,
}

impl<'a> Port<'a> {
    pub(super) fn new(bus: &'a Bus, key: Option<Secret>, decisions: Decisions) -> Self {
        Self {
            bus,
            key,
            run: bus.keys().run().to_string(),
            kept: decisions.kept.into(),
            patience: decisions.port,
            partner: None,
            hello: None,
            seq: decisions.before,
            spare: None,
            said: String::new(),
            strange: BTreeSet::new(),
            counts: DecisionCounts::default(),
        }
    }

    /// What came of all questions.
    pub(super) fn counts(&self) -> DecisionCounts {
        DecisionCounts {
            left: self.kept.len() as u64,
            ..self.counts
        }
    }

    /// Takes in a question.
    ///
    /// # Errors
    /// Of a log that is all that decides, it has no answer.
    pub(super) fn pose(&mut self, question: &Question<'_>) -> Result<Posed, BsError> {
        let (stage, tti) = (question.stage, question.seen.now);
        let seq = self.seq;
        self.seq += 1;
        if let Some(kept) = self.kept.pop_front() {
            if kept.tti == tti && kept.answer.stage() == stage {
                return Ok(Posed::Kept(kept.answer));
            }
            return Err(BsError::CannotGoOn(format!(
                "a decision was kept for TTI {}, and TTI {tti} asks for another: is it a log of this run?",
                kept.tti
            )));
        }
        if self.patience.is_none() {
            return Err(BsError::CannotGoOn(format!(
                "no decision was kept for TTI {tti}: the run that the log is of ended there"
            )));
        }
        let run = &self.run;
        self.hello
            .get_or_insert_with(|| Hello::new(run.clone(), question.seen.known));
        let to = self.partner.as_ref().map_or("", |partner| &partner.id);
        let plan = question.seen.plan.clone();
        Ok(Posed::Open(Box::new(Pending {
            stage,
            tti,
            devices: question.woken.len() as u32,
            asked: Asked::new(question, seq, to),
            hold: match stage {
                Stage::Plan => Answer::Plan(Decision { plan, next: tti + 1 }),
                Stage::Wake => Answer::Wake(Vec::new()),
            },
        })))
    }

    /// Asks until somebody has decided; nothing if the run is to stop.
    ///
    /// # Errors
    /// The bus fails, or nobody decides and the run is to end then.
    pub(super) async fn settle(&mut self, pending: Pending, progress: &Progress) -> Result<Option<Answer>, BsError> {
        let Pending {
            stage,
            tti,
            devices,
            mut asked,
            hold,
        } = pending;
        self.count_spare();
        let patience = self.patience.unwrap_or_default();
        let mut wait = Wait::new(progress, patience.limit, tti);
        let mut strikes = 0;
        let why = loop {
            wait.whom = self.whom();
            let tried = match &self.partner {
                None => self.greet(asked.head, &mut wait).await?.map_continue(|()| None),
                Some(partner) => {
                    asked.to.clone_from(&partner.id);
                    self.ask(&asked, (stage, tti, devices), &mut wait)
                        .await?
                        .map_continue(Some)
                }
            };
            match tried {
                ControlFlow::Break(Cut::Stop) => return Ok(None),
                ControlFlow::Break(Cut::TimeUp) => break self.whom(),
                ControlFlow::Continue(None) => {}
                ControlFlow::Continue(Some(Told::Answer(answer))) => {
                    self.counts.decided += 1;
                    return Ok(Some(answer));
                }
                ControlFlow::Continue(Some(Told::Silence)) => {
                    let name = self.partner.take().map(|partner| partner.name).unwrap_or_default();
                    let held = "the clock is held until it, or another, does";
                    self.complain(format!("{name} has not answered for TTI {tti}; {held}"));
                    tokio::time::sleep(BETWEEN).await;
                }
                ControlFlow::Continue(Some(Told::Refused(why))) => {
                    self.counts.refused += 1;
                    strikes += 1;
                    tracing::warn!(%tti, "an answer that decides nothing: {why}");
                    if strikes >= STRIKES {
                        break format!("{strikes} answers decided nothing, the last because: {why}");
                    }
                    asked.refused = Some(why);
                }
            }
        };
        match patience.then {
            Undecided::End => Err(BsError::Undecided { tti, why }),
            Undecided::Hold => {
                if self.counts.held == 0 {
                    let held = "the plan in force holds, and nobody is woken";
                    tracing::warn!(%tti, "{why}; {held}. Further ones are only counted");
                }
                self.counts.held += 1;
                Ok(Some(hold))
            }
        }
    }

    /// What is said of a decision that did not come in time.
    fn whom(&self) -> String {
        match &self.partner {
            Some(partner) => format!("{} has not decided", partner.name),
            None => format!("nobody decides at {}", self.bus.keys().policy()),
        }
    }

    /// Looks for somebody who decides.
    async fn greet(&mut self, asked: Head, wait: &mut Wait<'_>) -> Tried<()> {
        let Some(hello) = &mut self.hello else {
            return Ok(ControlFlow::Continue(()));
        };
        hello.head = Head {
            stage: Said::Hello,
            ..asked
        };
        let (head, payload) = (hello.head, Form::Json.encode(hello));
        let mut replies = self.bus.ask_policy((payload, Form::Json), ANSWER.0, GREETING).await?;
        loop {
            let problem = match wait.next(&mut replies).await {
                ControlFlow::Break(cut) => return Ok(ControlFlow::Break(cut)),
                ControlFlow::Continue(None) => break,
                ControlFlow::Continue(Some(Heard::Refusal(why))) => why,
                ControlFlow::Continue(Some(Heard::Answer(bytes, form))) => match self.welcomed(&head, &bytes, form) {
                    Ok(partner) => {
                        tracing::info!(tti = %head.tti, "{} decides", partner.name);
                        if let Some(hello) = &mut self.hello {
                            hello.refused = None;
                        }
                        self.partner = Some(partner);
                        return Ok(ControlFlow::Continue(()));
                    }
                    Err(why) => {
                        let id = form.decode(&bytes).map(|shown: Shown| shown.id);
                        if let (Ok(id), Some(hello)) = (id, &mut self.hello) {
                            let why = why.clone();
                            hello.refused = Some(Refused { id, why });
                        }
                        why
                    }
                },
            };
            self.wonder(&format!("a process at the policy port cannot decide: {problem}"));
        }
        wait.name();
        tokio::time::sleep(BETWEEN).await;
        Ok(ControlFlow::Continue(()))
    }

    fn welcomed(&self, greeting: &Head, bytes: &[u8], form: Form) -> Result<Partner, String> {
        let welcome: Welcome = form.decode(bytes)?;
        let Head { protocol, .. } = welcome.head;
        if !(OLDEST..=PROTOCOL).contains(&protocol) {
            return Err(format!(
                "it speaks protocol {protocol}, this base station {OLDEST} to {PROTOCOL}"
            ));
        }
        let echo = |head: &Head| (head.seq, head.tti, head.stage);
        if echo(&welcome.head) != echo(greeting) {
            return Err("it answers another greeting".to_owned());
        }
        if !self.is_ours(&welcome.key) {
            return Err("it does not show the run's key, which whoever started the run has".to_owned());
        }
        if welcome.id.is_empty() || welcome.id.len() > NAME {
            return Err(format!("its id is to be 1 to {NAME} characters"));
        }
        let name: String = welcome.name.chars().filter(|c| !c.is_control()).take(NAME).collect();
        let name = if name.is_empty() {
            format!("process {}", welcome.id)
        } else {
            name
        };
        Ok(Partner {
            id: welcome.id,
            name,
            form: welcome.form,
        })
    }

    fn is_ours(&self, shown: &str) -> bool {
        self.key.is_none_or(|key| shown.parse() == Ok(key))
    }

    /// Whether an answer is of the process with this id, and of one that has the run's key.
    fn is_from(&self, id: &str, bytes: &[u8], form: Form) -> bool {
        form.decode(bytes)
            .is_ok_and(|shown: Shown| shown.id == id && self.is_ours(&shown.key))
    }

    /// Asks once.
    async fn ask(
        &mut self,
        asked: &Asked,
        (stage, tti, devices): (Stage, Tti, u32),
        wait: &mut Wait<'_>,
    ) -> Tried<Told> {
        let form = self.partner.as_ref().map_or(Form::Json, |partner| partner.form);
        let most = ANSWER.0 + ANSWER.1 * devices as usize;
        let mut replies = self.bus.ask_policy((form.encode(asked), form), most, AGAIN).await?;
        loop {
            match wait.next(&mut replies).await {
                ControlFlow::Break(cut) => return Ok(ControlFlow::Break(cut)),
                ControlFlow::Continue(None) => return Ok(ControlFlow::Continue(Told::Silence)),
                ControlFlow::Continue(Some(Heard::Refusal(why))) => {
                    self.wonder(&format!("a process at the policy port does not answer: {why}"));
                }
                // What cannot be told from a stranger's answer is not held against anybody.
                ControlFlow::Continue(Some(Heard::Answer(bytes, form))) if !self.is_from(&asked.to, &bytes, form) => {
                    let what = "that cannot be read, or does not show the run's key and the id that was asked";
                    self.wonder(&format!("an answer was dropped {what}"));
                }
                ControlFlow::Continue(Some(Heard::Answer(bytes, form))) => {
                    let reply: Result<Reply, String> = form.decode(&bytes);
                    let answer = reply.and_then(|reply| {
                        let echo = (reply.seq, reply.tti, reply.stage);
                        let own = (asked.head.seq, asked.head.tti, Some(asked.head.stage));
                        if echo != own {
                            return Err(format!("it is for {echo:?}, and {own:?} was asked (seq, tti, stage)"));
                        }
                        reply.answer(stage, tti, devices)
                    });
                    let told = match answer {
                        Ok(answer) => {
                            self.spare = Some((replies, asked.to.clone()));
                            Told::Answer(answer)
                        }
                        Err(why) => Told::Refused(why),
                    };
                    return Ok(ControlFlow::Continue(told));
                }
            }
        }
    }

    /// Counts what came of the last question after its answer.
    fn count_spare(&mut self) {
        let Some((replies, id)) = self.spare.take() else { return };
        let is_own = |heard: &Heard| match heard {
            Heard::Answer(bytes, form) => self.is_from(&id, bytes, *form),
            Heard::Refusal(_) => false,
        };
        let more = replies.rest().filter(is_own).count() as u64;
        if more > 0 {
            self.counts.refused += more;
            self.complain("a question was answered twice; the first answer counts".to_owned());
        }
    }

    /// Says what is wrong with who decides, if that was not the last that was said.
    fn complain(&mut self, what: String) {
        if self.said != what {
            tracing::warn!("{what}");
            self.said = what;
        }
    }

    /// Says what is wrong with what anybody may send, if that was not said before: nobody can fill the log or the
    /// memory, or have what the run itself has to say left out.
    fn wonder(&mut self, what: &str) {
        let what: String = what.chars().filter(|c| !c.is_control()).take(WONDER).collect();
        if self.strange.len() == WONDERS || self.strange.contains(&what) {
            return;
        }
        tracing::warn!("{what}");
        self.strange.insert(what);
        if self.strange.len() == WONDERS {
            tracing::warn!("more of what strangers say at the policy port is not told");
        }
    }
}

/// The wait for one decision.
struct Wait<'a> {
    progress: &'a Progress,
    begun: Instant,
    limit: Option<Duration>,
    tti: Tti,
    /// Whom the run waits for, in words.
    whom: String,
    is_named: bool,
}

impl<'a> Wait<'a> {
    fn new(progress: &'a Progress, limit: Option<Duration>, tti: Tti) -> Self {
        Self {
            progress,
            begun: now(),
            limit,
            tti,
            whom: String::new(),
            is_named: false,
        }
    }

    /// What comes next of `replies`; nothing if no more comes.
    async fn next(&mut self, replies: &mut Replies) -> ControlFlow<Cut, Option<Heard>> {
        loop {
            if self.progress.stop.load(Ordering::Relaxed) {
                return ControlFlow::Break(Cut::Stop);
            }
            let waited = self.begun.elapsed();
            if self.limit.is_some_and(|limit| waited >= limit) {
                return ControlFlow::Break(Cut::TimeUp);
            }
            let look = self.limit.map_or(LOOK, |limit| LOOK.min(limit.saturating_sub(waited)));
            match tokio::time::timeout(look, replies.next()).await {
                Ok(heard) => return ControlFlow::Continue(heard),
                Err(_) => self.name(),
            }
        }
    }

    /// Says once whom the run waits for.
    fn name(&mut self) {
        if self.begun.elapsed() >= SILENT && !self.is_named {
            self.is_named = true;
            let (tti, whom) = (self.tti, &self.whom);
            tracing::warn!(%tti, "no decision for {} s: {whom}; the clock is held", SILENT.as_secs());
        }
    }
}
