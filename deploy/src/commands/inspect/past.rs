//! A run that is joined late, from its first TTI on.
//!
//! The same scenario and seed are the same run: what happened before somebody looked is worked out in memory, and what
//! goes on is heard.
//!
//! ```text
//!   TTI 0 ──── worked out ────► a grant that is heard ──── worked out ────► the next grant ──── heard ────► the end
//!                               (its plan may not be, so neither is it handed on)
//! ```
//! The last TTI of a grant is worked out once the next begins, or the run is over: devices that go in it, and what is
//! decided in it elsewhere, are in the log of inputs no sooner.

use anyhow::{Context, bail};
use reveille_bs::observe::frames::Framed;
use reveille_common::ids::Tti;
use reveille_common::message::{Clock, ClockStatus, Frame, Message};
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

    /// Whether it is told, and what is heard handed on.
    pub const fn is_over(&self) -> bool {
        self.is_over
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
        let in_work = u64::from(!status.paused);
        self.tell(Tti(status.tti.0.saturating_sub(in_work)), take)
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
        // All before this TTI is over, and nothing of it and what follows was missed.
        let whole_from = match frame.message() {
            // It comes before the grant from which on it holds.
            Ok(Message::Plan(update)) if self.is_within || update.from == self.told => update.from,
            Ok(Message::World(world)) if self.is_within => world.first,
            Ok(Message::World(world)) => {
                if world.last >= self.told {
                    self.tell(world.last, take)?;
                    self.is_within = true;
                }
                return Ok(());
            }
            Ok(Message::Clock(Clock::Finish(end))) => end,
            Ok(_) | Err(_) => return Ok(()),
        };
        self.tell(whole_from, &mut take)?;
        (self.is_over, self.run) = (true, None);
        take(frame);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use reveille_bs::policy::external::{Answer, Answered, Decision, Stage};
    use reveille_bs::policy::outside;
    use reveille_common::ids::DeviceId;
    use reveille_common::io::Disk;
    use reveille_common::message::{MessageKind, Outage, Pace};
    use reveille_common::plan::Plan;
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::scenario::{Override, load};
    use reveille_lab::inputs::{first_line, line};
    use reveille_lab::stepping::Stepping;

    use super::*;

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

    /// A run as it is heard, and what it depends on besides with the number of frames before each such input.
    #[derive(Default)]
    struct Heard {
        frames: Vec<Frame>,
        inputs: Vec<(usize, Input)>,
    }

    impl Heard {
        fn of(scenario: &Scenario, outages: &[Outage], lookahead: bool) -> Self {
            let mut frames = Vec::new();
            let options = Options {
                lookahead,
                ..Options::default()
            };
            let mut run = Run::new(&prepare(scenario), options);
            run.expect_all(&Inputs::of_outages(outages));
            run.finish(&mut Framed::new(0, |frame| frames.push(frame)));
            let gone = frames.iter().enumerate();
            let gone = gone.filter(|(_, frame)| frame.kind == MessageKind::Gone);
            let inputs = gone
                .map(|(at, _)| at)
                .zip(outages.iter().copied().map(Input::Outage))
                .collect();
            Self { frames, inputs }
        }

        /// Of a run that is decided for at random, and asks for a plan every `hold` TTIs.
        fn decided(scenario: &Scenario, hold: u64) -> Self {
            let frames = RefCell::new(Vec::new());
            let mut stepping = Stepping::new(scenario, Framed::new(0, |frame| frames.borrow_mut().push(frame)));
            let (mut stream, mut inputs) = (Stream::new(3, Purpose::Training, 0), Vec::new());
            while let Some(question) = stepping.question() {
                let (tti, n) = (question.seen.now, question.seen.known.n() as u64);
                let mut any = || DeviceId(stream.below(n) as u32);
                let answer = match question.stage {
                    Stage::Plan => Answer::Plan(Decision {
                        plan: Plan::from_chosen(n as usize, &[any(), any(), any(), any()]),
                        next: tti + hold,
                    }),
                    Stage::Wake if any().0 % 2 == 0 => Answer::Wake(vec![any()]),
                    Stage::Wake => Answer::Wake(Vec::new()),
                };
                let decision = Answered {
                    tti,
                    answer: answer.clone(),
                };
                inputs.push((frames.borrow().len(), Input::Decision(decision)));
                match answer {
                    Answer::Plan(decision) => stepping.decide(decision),
                    Answer::Wake(devices) => stepping.wake(&devices),
                }
            }
            stepping.finish();
            let frames = frames.into_inner();
            Self { frames, inputs }
        }

        /// Whoever joins, wherever that is, is told of all of it. The log of inputs never has more than was in it when
        /// what was heard last was sent.
        fn assert_whole_from_everywhere(mut self, scenario: &Scenario) {
            let end = Tti(scenario.ttis);
            self.frames.push(Frame::of(end, (), &Clock::Finish(end)));
            // How TTIs were granted changes nothing.
            let happened = |frames: &[Frame]| {
                let mut frames = frames.to_vec();
                frames.retain(|frame| frame.kind != MessageKind::World);
                frames
            };
            let (all, mut ends) = (happened(&self.frames), vec![first_line(scenario).len()]);
            let mut log = first_line(scenario);
            for (_, input) in &self.inputs {
                log += &line(input);
                ends.push(log.len());
            }
            // With some bytes of a line that is being written.
            let known = |sent: usize| {
                let made = self.inputs.partition_point(|(before, _)| *before < sent);
                &log.as_bytes()[..log.len().min(ends[made] + 9)]
            };
            for at in (0..self.frames.len()).step_by(5).chain(0..12) {
                let granted = self.frames[..at].iter().rev().find_map(|frame| match frame.message() {
                    Ok(Message::World(world)) => Some(world.last + 1),
                    Ok(_) | Err(_) => None,
                });
                let stands = matches!(self.frames[at].kind, MessageKind::Plan | MessageKind::Clock);
                for paused in [false, true] {
                    if paused && !stands {
                        continue;
                    }
                    let status = ClockStatus {
                        tti: granted.unwrap_or_default(),
                        ttis: scenario.ttis,
                        paused,
                        until: end,
                        pace: Pace::Max,
                        begun: true,
                        devices: scenario.devices,
                        lost: Vec::new(),
                    };
                    let (mut told, mut past) = (Vec::new(), Past::new(scenario.clone()));
                    past.learn(known(at)).expect("a log");
                    past.catch_up(&status, |frame| told.push(frame)).expect("it is over");
                    for (number, frame) in (at..).zip(&self.frames[at..]) {
                        past.learn(&known(number + 1)[past.read() as usize..]).expect("a log");
                        past.hear(frame.clone(), |frame| told.push(frame)).expect("it is over");
                    }
                    assert!(happened(&told) == all, "joined at frame {at}, paused: {paused}");
                }
            }
        }
    }

    #[test]
    fn a_run_is_whole_from_wherever_it_is_joined() {
        for policy in ["knn", "age-index"] {
            let scenario = scenario(policy);
            for lookahead in [true, false] {
                Heard::of(&scenario, &[], lookahead).assert_whole_from_everywhere(&scenario);
            }
        }
    }

    #[test]
    fn so_is_one_that_devices_go_from() {
        let scenario = scenario("knn");
        let gone = |first, tti, wake_ups| Outage {
            first: DeviceId(first),
            count: 5,
            tti: Tti(tti),
            wake_ups,
        };
        let outages = [gone(0, 40, None), gone(10, 41, None), gone(5, 180, None)];
        for lookahead in [true, false] {
            let heard = Heard::of(&scenario, &outages, lookahead);
            assert_eq!(heard.inputs.len(), outages.len());
            heard.assert_whole_from_everywhere(&scenario);
        }
    }

    #[test]
    fn so_is_one_that_is_decided_for() {
        let scenario = scenario("external");
        for hold in [1, 30, 500] {
            Heard::decided(&scenario, hold).assert_whole_from_everywhere(&scenario);
        }
    }
}
