//! A run in memory beside a run over the bus: what devices are lost with their process, and whether all that was heard
//! is true, follows from the scenario and the seed alone.

use std::collections::VecDeque;
use std::fmt;

use reveille_bs::observe::frames::Frames;
use reveille_bs::observe::{Happening, Observer};
use reveille_bs::outcome::Outcome;
use reveille_bs::prepared::Prepared;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Checkpoint, Frame, Message, States};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::Ledger;
use reveille_common::units::Energy;

use crate::inputs::{Input, Inputs};
use crate::run::{Options, Run};

/// Makes frames of what a digest covers: what is sent on the air, and what comes of it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Noting(Frames);

impl Noting {
    /// The `batteries` that a policy is told before it decides of TTI `tti`. No digest covers them, but what it
    /// decides: a host that lies in them is found here, and who it is.
    pub fn told(tti: Tti, batteries: &[Energy]) -> Frame {
        let view = |battery: &Energy| DeviceView {
            state: DeviceState::Sleep { powered: true },
            battery: *battery,
        };
        let views = batteries.iter().map(view).collect();
        Frame::of(tti, (), &States { views })
    }

    /// Hands to `take` what `happening` is in messages, if a digest covers it.
    pub fn of(&mut self, happening: &Happening<'_>, take: impl FnMut(Frame)) {
        match happening {
            // How TTIs are granted, and who looks on, changes nothing.
            Happening::Granted(_) | Happening::Closed(_) | Happening::Believed { .. } | Happening::States(_) => {}
            Happening::Plan { .. }
            | Happening::EventStarted(_)
            | Happening::Reported(_)
            | Happening::Lost(_)
            | Happening::Gone(_)
            | Happening::Failed { .. }
            | Happening::WakeUp { .. }
            | Happening::Woken { .. }
            | Happening::EventEnded(_) => self.0.of(happening, take),
        }
    }
}

/// Where a run and its shadow part.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// The TTI.
    pub tti: Tti,
    /// The device that it is about, if it is about one.
    pub device: Option<DeviceId>,
    /// What the run had and what the replay has, in words.
    pub what: String,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "TTI {}: {}", self.tti, self.what)
    }
}

/// A run in memory that follows another.
pub struct Shadow {
    prepared: Prepared,
    run: Run,
    /// The TTI from which on the run is compared.
    from: Tti,
    compared: Tti,
    inputs: Inputs,
    ahead: Ahead,
}

/// What a shadow has noted.
#[derive(Default)]
struct Ahead {
    noting: Noting,
    /// That of which the run has not told yet.
    frames: VecDeque<Frame>,
    /// Frames that were the same in both.
    same: u64,
    /// Of those, how many are noted once more, since the shadow has gone back.
    again: u64,
}

impl Ahead {
    fn take(&mut self, frame: Frame) {
        if self.again > 0 {
            self.again -= 1;
        } else {
            self.frames.push_back(frame);
        }
    }
}

impl Observer for Ahead {
    fn see(&mut self, happening: &Happening<'_>) {
        let mut noting = self.noting;
        noting.of(happening, |frame| self.take(frame));
        self.noting = noting;
    }

    fn told(&mut self, tti: Tti, batteries: &[Energy]) {
        self.take(Noting::told(tti, batteries));
    }
}

impl Shadow {
    /// The shadow, before TTI 0, of the run that is `prepared`, has had these `inputs`, and is compared from TTI
    /// `from` on.
    pub fn new(prepared: &Prepared, inputs: &Inputs, from: Tti) -> Self {
        Self {
            run: begin(prepared, inputs),
            prepared: prepared.clone(),
            from,
            compared: from,
            inputs: inputs.clone(),
            ahead: Ahead::default(),
        }
    }

    /// What the run depends on besides has come, in a TTI of which it has told nothing yet.
    pub fn hear(&mut self, input: Input) {
        let tti = match &input {
            Input::Outage(outage) => outage.tti,
            Input::Decision(decision) => decision.tti,
        };
        self.inputs.add(input.clone());
        if self.next_tti() > tti {
            self.begin_anew();
        } else {
            self.run.expect(input);
        }
    }

    /// The next TTI.
    pub const fn next_tti(&self) -> Tti {
        self.run.cycle().next_tti()
    }

    /// Goes to TTI `k`, and back before it if it is past.
    fn reach(&mut self, k: Tti) {
        if self.next_tti() > k {
            self.begin_anew();
        }
        self.run.advance(k.min(self.from), &mut ());
        self.run.advance(k, &mut self.ahead);
        assert!(
            self.run.undecided().is_none(),
            "a decision is told before the run goes on from it"
        );
    }

    fn begin_anew(&mut self) -> Run {
        self.ahead.frames.clear();
        self.ahead.again = self.ahead.same;
        std::mem::replace(&mut self.run, begin(&self.prepared, &self.inputs))
    }

    /// The run is not compared any more.
    pub fn forget(&mut self) {
        self.from = Tti::NEVER;
        self.ahead = Ahead::default();
    }

    /// The TTI before which all was the same.
    pub const fn compared(&self) -> Tti {
        self.compared
    }

    /// The devices from `first` on, `count` of them, as they are before TTI `k`.
    pub fn devices(&mut self, k: Tti, first: DeviceId, count: u32) -> Vec<Checkpoint> {
        self.reach(k);
        self.run.checkpoints(first, count)
    }

    /// The books of the devices from `first` on, `count` of them, before TTI `k`.
    pub fn ledgers(&mut self, k: Tti, first: DeviceId, count: u32) -> Vec<Ledger> {
        self.reach(k);
        self.run.ledgers(first, count)
    }

    /// What the run has come to before TTI `k`; a shadow after that begins anew.
    pub fn outcome(&mut self, k: Tti) -> Outcome {
        self.reach(k);
        self.begin_anew().cut_short()
    }

    /// Compares what the run has noted since the last comparison, all of it in TTIs before `k`.
    ///
    /// # Errors
    /// The first difference.
    pub fn compare(&mut self, k: Tti, live: &[Frame]) -> Result<(), Difference> {
        self.reach(k.max(self.next_tti()));
        for frame in live {
            match self.ahead.frames.pop_front() {
                Some(own) if own == *frame => self.ahead.same += 1,
                own => return Err(difference(Some(frame), own.as_ref())),
            }
        }
        self.compared = k;
        Ok(())
    }

    /// Compares what the run came to, of which all that it noted has been compared.
    ///
    /// # Errors
    /// The first difference.
    pub fn conclude(&mut self, live: &Outcome) -> Result<(), Difference> {
        self.reach(Tti(live.ttis_done));
        if let Some(own) = self.ahead.frames.pop_front() {
            return Err(difference(None, Some(&own)));
        }
        same_outcome(live, &self.outcome(Tti(live.ttis_done)))
    }
}

/// A run before TTI 0.
fn begin(prepared: &Prepared, inputs: &Inputs) -> Run {
    let mut run = Run::new(prepared, Options::default());
    run.expect_all(inputs);
    run
}

/// What the run `had` instead of what a replay `has`.
fn difference(had: Option<&Frame>, has: Option<&Frame>) -> Difference {
    if let (Some(had), Some(has)) = (had, has)
        && let Some(lie) = lie(had, has)
    {
        return lie;
    }
    let ttis = had.iter().chain(&has).map(|frame| frame.tti);
    let say = |frame: Option<&Frame>| match frame {
        None => "nothing more".to_owned(),
        Some(frame) => {
            let number = frame.number.map_or_else(String::new, |number| format!(" {number}"));
            let text = frame
                .message()
                .map_or_else(|error| error.to_string(), |m| m.to_string());
            format!("{}{number} ({text})", frame.kind.name())
        }
    };
    Difference {
        tti: ttis.min().unwrap_or_default(),
        device: had.and_then(Frame::device).or_else(|| has.and_then(Frame::device)),
        what: format!("the run had {}, a replay has {}", say(had), say(has)),
    }
}

/// The first battery that a run was told wrongly, where that is the difference.
fn lie(had: &Frame, has: &Frame) -> Option<Difference> {
    let (Ok(Message::States(had)), Ok(Message::States(own))) = (had.message(), has.message()) else {
        return None;
    };
    let pairs = had.views.iter().zip(&own.views).zip((0..).map(DeviceId));
    let ((said, held), device) = pairs.into_iter().find(|((said, held), _)| said != held)?;
    let (said, held) = (said.battery.units(), held.battery.units());
    Some(Difference {
        tti: has.tti,
        device: Some(device),
        what: format!("device {device} was said to hold {said:.2} units before it, and held {held:.2}"),
    })
}

/// Whether a run came to what its replay comes to.
///
/// # Errors
/// The first thing that differs.
fn same_outcome(live: &Outcome, replayed: &Outcome) -> Result<(), Difference> {
    let tti = Tti(live.ttis_done);
    let differing = live.devices.iter().zip(&replayed.devices).find(|(a, b)| a != b);
    if let Some((device, _)) = differing {
        return Err(Difference {
            tti,
            device: Some(device.device),
            what: format!("the ledger of device {} is not that of a replay", device.device),
        });
    }
    if live.digest == replayed.digest {
        return Ok(());
    }
    Err(Difference {
        tti,
        device: None,
        what: format!("the digest is {}, that of a replay {}", live.digest, replayed.digest),
    })
}
