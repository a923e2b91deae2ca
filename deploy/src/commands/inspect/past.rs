//! A run that is joined late, from its first TTI on.
//!
//! The same scenario and seed are the same run: what happened before somebody looked is worked out in memory, and what
//! goes on is heard.

use anyhow::Context;
use reveille_bs::observe::frames::Framed;
use reveille_bs::policy::outside;
use reveille_common::ids::Tti;
use reveille_common::message::{Frame, Message};
use reveille_common::scenario::Scenario;
use reveille_lab::inputs::{self, Input, Inputs};
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Options, Run};
use reveille_view::recording::Bundle;

use crate::input_log::INPUTS;

/// Puts what has happened before in front of what is heard.
pub(super) struct Past {
    scenario: Scenario,
    inputs: Inputs,
    /// The run in memory, once it is needed.
    run: Option<Run>,
    /// The TTIs before this one have been told.
    told: Tti,
    /// Whether the grant that was heard first is told already: what is heard of it may not be all.
    is_within: bool,
    is_over: bool,
}

impl Past {
    /// The past of a run of `scenario` that has had these `inputs`, of which nothing is told yet.
    const fn new(scenario: Scenario, inputs: Inputs) -> Self {
        Self {
            scenario,
            inputs,
            run: None,
            told: Tti::ZERO,
            is_within: false,
            is_over: false,
        }
    }

    /// The past of the run that `bundle` describes, of which nothing is told yet.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn of(bundle: &Bundle) -> anyhow::Result<Self> {
        let scenario = bundle.load()?;
        let inputs = log(bundle, &scenario)?;
        Ok(Self::new(scenario, inputs))
    }

    /// Whether what is told goes by decisions from outside, which come as the run goes on.
    pub fn depends_on_more(&self) -> bool {
        !self.is_over && outside::is_external(&self.scenario.policy)
    }

    /// Takes in what the run that `bundle` describes has come to depend on besides.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn learn(&mut self, bundle: &Bundle) -> anyhow::Result<()> {
        let inputs = log(bundle, &self.scenario)?;
        for decision in inputs.decisions.into_iter().skip(self.inputs.decisions.len()) {
            let decision = Input::Decision(decision);
            if let Some(run) = &mut self.run {
                run.expect(decision.clone());
            }
            self.inputs.add(decision);
        }
        Ok(())
    }

    /// The TTIs before this one have been told, until what is heard is handed on.
    pub const fn told(&self) -> Tti {
        self.told
    }

    /// Tells of all TTIs before `end` that are not told yet.
    pub fn tell(&mut self, end: Tti, mut take: impl FnMut(Frame)) {
        if end <= self.told {
            return;
        }
        let run = self.run.get_or_insert_with(|| {
            let options = Options {
                lookahead: false,
                ..Options::default()
            };
            let mut run = Run::new(&prepare(&self.scenario), options);
            run.expect_all(&self.inputs);
            run
        });
        let mut framed = Framed::new(0, &mut take);
        while run.cycle().next_tti() < end && run.undecided().is_none() {
            run.grant(&mut framed);
        }
        self.told = end;
    }

    /// Takes in a frame that is heard, with all that was before it.
    pub fn hear(&mut self, frame: Frame, mut take: impl FnMut(Frame)) {
        if self.is_over {
            take(frame);
            return;
        }
        let message = frame.message();
        let (is_whole, next) = match message {
            // It comes before the grant from which on it holds: nothing of that has been missed.
            Ok(Message::Plan(update)) => (self.is_within || update.from == self.told, None),
            Ok(Message::World(world)) => (self.is_within, Some(world.last + 1)),
            Ok(_) | Err(_) => return,
        };
        if is_whole {
            (self.is_over, self.run) = (true, None);
            take(frame);
        } else if let Some(next) = next.filter(|next| *next > self.told) {
            // Its plan may have been sent unheard.
            self.tell(next, take);
            self.is_within = true;
        }
    }
}

/// What a run depends on besides, as `bundle` has it.
fn log(bundle: &Bundle, scenario: &Scenario) -> anyhow::Result<Inputs> {
    let log = bundle.files.iter().find(|(name, _)| name == INPUTS);
    let inputs = log.map_or(Ok(Inputs::default()), |(_, bytes)| {
        inputs::parse(&String::from_utf8_lossy(bytes), scenario)
    });
    inputs.context("what the run depends on")
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};
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
        load("paper", &set).expect("a scenario")
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
                        let mut past = Past::new(scenario.clone(), Inputs::default());
                        let closed = Tti(frames[at].tti.0.saturating_sub(before));
                        past.tell(closed, |frame| told.push(frame));
                        for frame in &frames[at..] {
                            past.hear(frame.clone(), |frame| told.push(frame));
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
}
