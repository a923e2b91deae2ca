//! A run that is joined late, from its first TTI on.
//!
//! The same scenario and seed are the same run: what happened before somebody looked is worked out in memory, and what
//! goes on is heard.
//!
//! ```text
//!   TTI 0 ──── worked out ────► a grant that is heard ──── worked out ────► the next grant ──── heard ────► the end
//!                               (its plan may not be, so neither is it handed on)
//! ```
//! Of a policy that is asked for elsewhere, a TTI is worked out once it is over: what is decided in it is known no
//! sooner.

use anyhow::{Context, bail};
use reveille_bs::observe::frames::Framed;
use reveille_bs::policy::outside;
use reveille_common::ids::Tti;
use reveille_common::message::{ClockStatus, Frame, Message};
use reveille_common::scenario::Scenario;
use reveille_lab::inputs::{Input, Inputs, Parser};
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Options, Run};

/// What is said of a log that cannot be read.
const LOG: &str = "the log of what the run depends on";

/// Puts what has happened before in front of what is heard.
pub struct Past {
    scenario: Scenario,
    /// The log of what it depends on besides, as far as it was read.
    log: Parser,
    /// Bytes of it.
    read: u64,
    /// The run in memory, once it is needed.
    run: Option<Run>,
    /// The TTIs before this one have been told.
    told: Tti,
    /// Whether the grant that was heard first goes on: what is heard of it may not be all, and is not handed on.
    is_within: bool,
    is_over: bool,
}

impl Past {
    /// The past of a run of `scenario`, of which nothing is told yet.
    pub fn new(scenario: Scenario) -> Self {
        Self {
            scenario,
            log: Parser::default(),
            read: 0,
            run: None,
            told: Tti::ZERO,
            is_within: false,
            is_over: false,
        }
    }

    /// Whether what is told goes by decisions from outside, which come as the run goes on.
    pub fn depends_on_more(&self) -> bool {
        !self.is_over && outside::is_external(&self.scenario.policy)
    }

    /// The first byte of the run's log of inputs that is not known.
    pub const fn read(&self) -> u64 {
        self.read
    }

    /// Takes in what follows in the log of inputs, up to its last whole line. False if there is none.
    ///
    /// # Errors
    /// It is no log of this run.
    pub fn learn(&mut self, more: &[u8]) -> anyhow::Result<bool> {
        let known = self.log.inputs();
        let (outages, decisions) = (known.outages.len(), known.decisions.len());
        let whole = more.iter().rposition(|byte| *byte == b'\n').map_or(0, |last| last + 1);
        let text = std::str::from_utf8(&more[..whole]).context(LOG)?;
        let length = self.log.read(text, &self.scenario).context(LOG)?;
        self.read += length as u64;
        if let Some(run) = &mut self.run {
            let Inputs {
                outages: all,
                decisions: made,
            } = self.log.inputs();
            all[outages..]
                .iter()
                .for_each(|outage| run.expect(Input::Outage(*outage)));
            let new = made[decisions..].iter().cloned();
            new.for_each(|decision| run.expect(Input::Decision(decision)));
        }
        Ok(length > 0)
    }

    /// The TTIs before this one have been told, until what is heard is handed on.
    pub const fn told(&self) -> Tti {
        self.told
    }

    /// Tells of what was over when the clock had this `status`.
    ///
    /// # Errors
    /// As of [`Self::tell`].
    pub fn catch_up(&mut self, status: &ClockStatus, take: impl FnMut(Frame)) -> anyhow::Result<()> {
        let decided = self.log.inputs().decisions.last().map_or(Tti::ZERO, |last| last.tti);
        let is_certain = status.paused || !self.depends_on_more();
        // The TTI before that of the clock may still be in work; what is before a decision is not.
        let over = if is_certain {
            status.tti
        } else {
            status.tti.min(decided)
        };
        self.tell(over, take)
    }

    /// Tells of all TTIs before `end` that are not told yet.
    ///
    /// # Errors
    /// What was decided in one of them is not known.
    fn tell(&mut self, end: Tti, mut take: impl FnMut(Frame)) -> anyhow::Result<()> {
        if end <= self.told {
            return Ok(());
        }
        let run = self.run.get_or_insert_with(|| {
            let options = Options {
                lookahead: false,
                ..Options::default()
            };
            let mut run = Run::new(&prepare(&self.scenario), options);
            run.expect_all(self.log.inputs());
            run
        });
        let mut framed = Framed::new(0, &mut take);
        while run.cycle().next_tti() < end {
            run.grant(&mut framed);
            if let Some(tti) = run.undecided() {
                bail!("the run has not told what was decided in TTI {tti}");
            }
        }
        self.told = end;
        Ok(())
    }

    /// Takes in a frame that is heard, with all that was before it.
    ///
    /// # Errors
    /// As of [`Self::tell`].
    pub fn hear(&mut self, frame: Frame, mut take: impl FnMut(Frame)) -> anyhow::Result<()> {
        if self.is_over {
            take(frame);
            return Ok(());
        }
        let (first, end) = match frame.message() {
            Ok(Message::Plan(update)) => (update.from, None),
            Ok(Message::World(world)) => (world.first, Some(world.last + 1)),
            Ok(_) | Err(_) => return Ok(()),
        };
        // A plan comes before the grant from which on it holds: nothing of that has been missed.
        if self.is_within || (end.is_none() && first == self.told) {
            self.tell(first, &mut take)?;
            (self.is_over, self.run) = (true, None);
            take(frame);
        } else if let Some(end) = end.filter(|end| *end > self.told) {
            // Its plan may have been sent unheard.
            self.tell(if self.depends_on_more() { first } else { end }, take)?;
            self.is_within = true;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use reveille_bs::policy::external::{Answer, Answered, Decision, Stage};
    use reveille_common::ids::DeviceId;
    use reveille_common::io::Disk;
    use reveille_common::message::{MessageKind, Pace};
    use reveille_common::plan::Plan;
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::scenario::{Override, load};
    use reveille_lab::inputs::{first_line, line};
    use reveille_lab::stepping::Stepping;
    use reveille_view::replay::Replay;

    use super::*;

    fn all(scenario: &Scenario, lookahead: bool) -> Vec<Frame> {
        let mut frames = Vec::new();
        let options = Options {
            lookahead,
            ..Options::default()
        };
        Run::new(&prepare(scenario), options).finish(&mut Framed::new(0, |frame| frames.push(frame)));
        frames
    }

    fn scenario(policy: &str) -> Scenario {
        let set = [
            "devices=20",
            "ttis=240",
            "bs.sync_interval=7",
            &format!("policy.name={policy}"),
        ];
        let set = set.map(|set| Override::parse(set).expect("an override"));
        load("paper", &set, &outside::kinds(), &Disk).expect("a scenario")
    }

    #[test]
    fn a_run_is_whole_from_wherever_it_is_joined() {
        for policy in ["knn", "age-index"] {
            let scenario = scenario(policy);
            let whole = Replay::new(&scenario);
            let result = |frames: &[Frame]| {
                let mut replay = whole.clone();
                for frame in frames {
                    replay.take(frame).expect("it fits");
                }
                replay.finish().digest.to_string()
            };
            let mut joined = 0;
            for lookahead in [true, false] {
                let frames = all(&scenario, lookahead);
                let digest = result(&frames);
                for at in (0..frames.len()).step_by(23).chain(0..12) {
                    // The clock says of late joiners where it stands, or stood a moment before.
                    for before in [0, 3] {
                        let mut told = Vec::new();
                        let mut past = Past::new(scenario.clone());
                        let closed = Tti(frames[at].tti.0.saturating_sub(before));
                        past.tell(closed, |frame| told.push(frame)).expect("all is known");
                        for frame in &frames[at..] {
                            past.hear(frame.clone(), |frame| told.push(frame))
                                .expect("all is known");
                        }
                        // Who joins in the last grant hears of no other.
                        if past.is_over {
                            assert_eq!(result(&told), digest, "{policy}, joined at frame {at}");
                            joined += 1;
                        }
                    }
                }
            }
            assert!(joined > 40, "{joined}");
        }
    }

    /// The frames of a run that is decided for, and its decisions with the number of frames before each.
    fn decided(scenario: &Scenario, hold: u64) -> (Vec<Frame>, Vec<(usize, Answered)>) {
        let frames = RefCell::new(Vec::new());
        let mut stepping = Stepping::new(scenario, Framed::new(0, |frame| frames.borrow_mut().push(frame)));
        let (mut stream, mut all) = (Stream::new(3, Purpose::Training, 0), Vec::new());
        while let Some(question) = stepping.question() {
            let (tti, n) = (question.seen.now, question.seen.known.n() as u64);
            let answer = match question.stage {
                Stage::Plan => Answer::Plan(Decision {
                    plan: Plan::from_bits((0..n).map(|_| stream.below(4) == 0)),
                    next: tti + hold,
                }),
                Stage::Wake => Answer::Wake((0..stream.below(2)).map(|_| DeviceId(stream.below(n) as u32)).collect()),
            };
            all.push((
                frames.borrow().len(),
                Answered {
                    tti,
                    answer: answer.clone(),
                },
            ));
            match answer {
                Answer::Plan(decision) => stepping.decide(decision),
                Answer::Wake(devices) => stepping.wake(&devices),
            }
        }
        stepping.finish();
        (frames.into_inner(), all)
    }

    /// The log of the run never has more than what was decided when what was heard last was sent.
    #[test]
    fn a_run_that_is_decided_for_is_whole_from_wherever_it_is_joined() {
        for hold in [1, 30] {
            let scenario = scenario("external");
            let (frames, decisions) = decided(&scenario, hold);
            let lines = decisions
                .iter()
                .map(|(_, answered)| line(&Input::Decision(answered.clone())));
            let mut ends = vec![first_line(&scenario).len()];
            let mut log = first_line(&scenario);
            for line in lines {
                log += &line;
                ends.push(log.len());
            }
            // With some bytes of a line that is being written.
            let known = |sent: usize| {
                let made = decisions.partition_point(|(before, _)| *before < sent);
                &log.as_bytes()[..log.len().min(ends[made] + 9)]
            };
            let mut happened = frames.clone();
            happened.retain(|frame| frame.kind != MessageKind::World);
            let mut joined = 0;
            for at in (0..frames.len()).step_by(3) {
                let granted = frames[..at].iter().rev().find_map(|frame| match frame.message() {
                    Ok(Message::World(world)) => Some(world.last + 1),
                    Ok(_) | Err(_) => None,
                });
                let status = ClockStatus {
                    tti: granted.unwrap_or_default(),
                    ttis: scenario.ttis,
                    paused: false,
                    until: Tti(scenario.ttis),
                    pace: Pace::Max,
                    begun: true,
                    devices: scenario.devices,
                    lost: Vec::new(),
                };
                let mut told = Vec::new();
                let mut past = Past::new(scenario.clone());
                past.learn(known(at)).expect("a log");
                past.catch_up(&status, |frame| told.push(frame)).expect("it is over");
                for (number, frame) in (at..).zip(&frames[at..]) {
                    past.learn(&known(number + 1)[past.read() as usize..]).expect("a log");
                    past.hear(frame.clone(), |frame| told.push(frame)).expect("it is over");
                }
                if past.is_over {
                    // How TTIs were granted changes nothing.
                    told.retain(|frame| frame.kind != MessageKind::World);
                    assert!(told == happened, "hold {hold}, joined at frame {at}");
                    joined += 1;
                }
            }
            assert!(joined > 40, "{joined}");
        }
    }
}
