//! A run in memory beside a run over the bus: what devices are lost with their process, and whether all that was heard
//! is true, follows from the scenario and the seed alone.

use std::collections::VecDeque;
use std::fmt;

use reveille_bs::observe::frames::Frames;
use reveille_bs::observe::{Happening, Observer};
use reveille_bs::outcome::Outcome;
use reveille_bs::prepared::Prepared;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Checkpoint, Frame, Outage};
use reveille_common::totals::Ledger;

use crate::run::{Options, Run};

/// Makes frames of what a digest covers: what is sent on the air, and what comes of it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Noting(Frames);

impl Noting {
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
    outages: Vec<Outage>,
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

impl Observer for Ahead {
    fn see(&mut self, happening: &Happening<'_>) {
        let Self {
            noting, frames, again, ..
        } = self;
        noting.of(happening, |frame| {
            if *again > 0 {
                *again -= 1;
            } else {
                frames.push_back(frame);
            }
        });
    }
}

impl Shadow {
    /// The shadow, before TTI 0, of the run that is `prepared`, has had these `outages`, and is compared from TTI
    /// `from` on.
    pub fn new(prepared: &Prepared, outages: &[Outage], from: Tti) -> Self {
        Self {
            run: begin(prepared, outages),
            prepared: prepared.clone(),
            from,
            outages: outages.to_vec(),
            ahead: Ahead::default(),
        }
    }

    /// Devices have gone from the run, in a TTI of which it has told nothing yet.
    pub fn lose(&mut self, outage: Outage) {
        self.outages.push(outage);
        if self.next_tti() > outage.tti {
            self.begin_anew();
        } else {
            self.run.lose(outage);
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
    }

    fn begin_anew(&mut self) -> Run {
        self.ahead.frames.clear();
        self.ahead.again = self.ahead.same;
        std::mem::replace(&mut self.run, begin(&self.prepared, &self.outages))
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
fn begin(prepared: &Prepared, outages: &[Outage]) -> Run {
    let mut run = Run::new(prepared, Options::default());
    run.lose_all(outages);
    run
}

/// What the run `had` instead of what a replay `has`.
fn difference(had: Option<&Frame>, has: Option<&Frame>) -> Difference {
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
