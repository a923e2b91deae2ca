//! Kinds of event processes.
//!
//! A kind is a file here: its fields, its draws. This one has an arm for each, and nothing else tells them apart.

use super::aftershocks::{Aftershocks, Chain};
use super::bursts::{Bursting, Bursts};
use super::hot_spots::{HotSpots, Spots};
use super::steady::Steady;
use super::uniform::Uniform;
use crate::declare::{Reader, ScenarioError, Sink, choice, choices};
use crate::geometry::{Area, Point};
use crate::ids::{EventId, Tti};

choices! {
    /// When and where events come.
    pub enum ProcessKind {
        /// Anywhere, and with the same probability in every TTI: the paper's events.
        Uniform = "uniform",
        /// As `uniform`, but most of them around a few places.
        HotSpots = "hot-spots",
        /// As `uniform`, but many of them near the event before.
        Aftershocks = "aftershocks",
        /// Anywhere, often in busy phases and seldom in quiet ones.
        Bursts = "bursts",
    }
}

crate::declare! {
    /// The event process (paper Sec. II).
    #[derive(Clone, Copy, Debug)]
    pub(super) struct Settings in "events" {
        /// When and where events come.
        pub(super) process: ProcessKind = choice::<ProcessKind>("uniform").source("Sec. II"),
    }
}

/// When and where events come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Process {
    /// See [`ProcessKind::Uniform`].
    Uniform,
    /// See [`ProcessKind::HotSpots`].
    HotSpots(HotSpots),
    /// See [`ProcessKind::Aftershocks`].
    Aftershocks(Aftershocks),
    /// See [`ProcessKind::Bursts`].
    Bursts(Bursts),
}

impl Process {
    /// The process that `reader` has.
    pub(super) fn settle(reader: &Reader<'_>) -> Result<Self, ScenarioError> {
        Ok(match Settings::read(reader)?.process {
            ProcessKind::Uniform => Self::Uniform,
            ProcessKind::HotSpots => Self::HotSpots(HotSpots::read(reader)?),
            ProcessKind::Aftershocks => Self::Aftershocks(Aftershocks::read(reader)?),
            ProcessKind::Bursts => Self::Bursts(Bursts::read(reader)?),
        })
    }

    /// The kind of the process.
    pub const fn kind(&self) -> ProcessKind {
        match self {
            Self::Uniform => ProcessKind::Uniform,
            Self::HotSpots(_) => ProcessKind::HotSpots,
            Self::Aftershocks(_) => ProcessKind::Aftershocks,
            Self::Bursts(_) => ProcessKind::Bursts,
        }
    }

    /// Hands the fields of its own to `sink`.
    pub(super) fn visit(&self, sink: &mut dyn Sink) {
        match self {
            Self::Uniform => {}
            Self::HotSpots(hot_spots) => hot_spots.visit(sink),
            Self::Aftershocks(aftershocks) => aftershocks.visit(sink),
            Self::Bursts(bursts) => bursts.visit(sink),
        }
    }

    /// The long-run mean of the probability that an event starts, of a process that has it change with time.
    pub(super) fn long_run_alpha(&self) -> Option<f64> {
        match self {
            Self::Uniform | Self::HotSpots(_) | Self::Aftershocks(_) => None,
            Self::Bursts(bursts) => Some(bursts.alpha()),
        }
    }

    /// Its mean over the TTIs from `first` to before `end` of a run with `seed`, of the same processes.
    pub(super) fn mean_start_probability(&self, seed: u64, first: Tti, end: Tti) -> Option<f64> {
        match self {
            Self::Uniform | Self::HotSpots(_) | Self::Aftershocks(_) => None,
            Self::Bursts(bursts) => Some(bursts.mean_start_probability(seed, first, end)),
        }
    }

    /// When events start in a run with `seed` that ends before TTI `end`; with probability `alpha` where that does not
    /// change with time.
    pub(super) fn starts(&self, seed: u64, alpha: f64, end: Tti) -> Starts {
        match self {
            Self::Uniform | Self::HotSpots(_) | Self::Aftershocks(_) => Starts::Steady(Steady::new(seed, alpha)),
            Self::Bursts(bursts) => Starts::Bursting(Bursting::new(bursts, seed, end)),
        }
    }

    /// Where events are in a run with `seed` on `area`.
    pub(super) fn epicentres(&self, seed: u64, area: Area) -> Epicentres {
        let uniform = Uniform { seed, area };
        match self {
            Self::Uniform | Self::Bursts(_) => Epicentres::Uniform(uniform),
            Self::HotSpots(hot_spots) => Epicentres::Spots(Spots::new(*hot_spots, uniform)),
            Self::Aftershocks(aftershocks) => Epicentres::Chain(Chain::new(*aftershocks, uniform)),
        }
    }
}

/// When events start.
#[derive(Clone, Debug)]
pub(super) enum Starts {
    Steady(Steady),
    Bursting(Bursting),
}

impl Starts {
    /// The TTI in which `event` starts, which cannot start before `earliest`; [`Tti::NEVER`] for one that does not.
    /// Asked for one event after the other.
    pub(super) fn next(&mut self, event: EventId, earliest: Tti) -> Tti {
        match self {
            Self::Steady(steady) => steady.next(event, earliest),
            Self::Bursting(bursting) => bursting.next(event, earliest),
        }
    }
}

/// Where events are.
#[derive(Clone, Debug)]
pub(super) enum Epicentres {
    Uniform(Uniform),
    Spots(Spots),
    Chain(Chain),
}

impl Epicentres {
    /// The epicentre of `event`. Asked for one event after the other.
    pub(super) fn draw(&mut self, event: EventId) -> Point {
        match self {
            Self::Uniform(uniform) => uniform.draw(event),
            Self::Spots(spots) => spots.draw(event),
            Self::Chain(chain) => chain.draw(event),
        }
    }
}
