//! Emulation: the virtual clock.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;
use crate::event::Stimulus;
use crate::ids::Tti;

/// The grant of one or more TTIs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tick {
    /// First granted TTI.
    pub first: Tti,
    /// Last granted TTI. Only in this one can a device have anything to report.
    pub last: Tti,
    /// What the world shows in `last`.
    pub stimulus: Option<Stimulus>,
    /// The last TTI in which it would show that: after it nobody who wakes finds anything.
    pub until: Tti,
    /// Whether the answer carries the sums of the TTIs before `first`.
    pub account: bool,
    /// Whether the answer carries the states and batteries after `last`.
    pub views: bool,
    /// The TTI from which the plan holds that is in force in `last`. A host that has missed that plan does not answer,
    /// and is sent it again.
    pub plan: Tti,
    /// How many plans go with the grant, each of which holds from one of its TTIs on; likewise.
    pub plans: u32,
}

/// What the clock tells: on the emulation plane, from the BS to all hosts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Clock {
    /// TTIs are granted.
    Grant(Tick),
    /// The run has ended before this TTI: hosts answer with their devices' ledgers and leave.
    Finish(Tti),
    /// The BS has received everything: hosts leave.
    Dismiss,
    /// The run has failed, for the reason given: hosts leave.
    Fail(String),
}

impl Concerns for Clock {}

impl fmt::Display for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Grant(tick) => tick.fmt(f),
            Self::Finish(end) => write!(f, "the run ends before TTI {end}"),
            Self::Dismiss => f.write_str("hosts may leave"),
            Self::Fail(why) => write!(f, "the run has failed: {why}"),
        }
    }
}

impl fmt::Display for Tick {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            first,
            last,
            stimulus,
            until: _,
            account,
            views,
            plan: _,
            plans: _,
        } = self;
        if first == last {
            write!(f, "TTI {first}")?;
        } else {
            write!(f, "TTIs {first} to {last}")?;
        }
        if let Some(stimulus) = stimulus {
            write!(f, ", {stimulus}")?;
        }
        f.write_str(if *account { ", sums wanted" } else { "" })?;
        f.write_str(if *views { ", states and batteries wanted" } else { "" })
    }
}
