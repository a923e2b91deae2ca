//! The kinds of event processes. Their words are part of scenario files and of the scenario hash; doc comments of words
//! and fields appear in `docs/scenario.md`.
//!
//! Each kind has a file with its fields and its draws. This module distinguishes them, with an arm for each: of
//! [`ProcessSettings`], [`Starts`] and [`Epicentres`]. A new kind also needs its section in `EventSettings::SECTIONS`
//! and its rule in `tests/src/reference/events.rs`. The section names its word in `only with`, and `uniform.rs` names
//! there the words with a constant α.

use super::aftershocks::{AftershockEpicentres, Aftershocks};
use super::bursts::{BurstStarts, EventBursts};
use super::hot_spots::{HotSpotEpicentres, HotSpots};
use super::uniform::{SteadyStarts, UniformEpicentres};
use crate::declare::{FieldReader, FieldSink, ScenarioError, Visit, choice, choices};
use crate::geometry::{Area, Point};
use crate::ids::{EventId, Tti};

choices! {
    /// Times and places of events.
    pub enum ProcessKind {
        /// Uniform on the area, with the same start probability in every TTI, as in the paper.
        Uniform = "uniform",
        /// As `uniform`, but most events occur around a few places.
        HotSpots = "hot-spots",
        /// As `uniform`, but many events occur near the previous event.
        Aftershocks = "aftershocks",
        /// Uniform on the area, frequent in busy phases and rare in quiet phases.
        Bursts = "bursts",
    }
}

crate::declare! {
    /// Event process (paper Sec. II).
    #[derive(Clone, Copy, Debug)]
    pub(super) struct ProcessFields in "events" {
        /// Times and places of events.
        pub(super) process: ProcessKind = choice::<ProcessKind>("uniform").source("Sec. II"),
    }
}

/// The times and places of events.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ProcessSettings {
    /// See [`ProcessKind::Uniform`].
    Uniform,
    /// See [`ProcessKind::HotSpots`].
    HotSpots(HotSpots),
    /// See [`ProcessKind::Aftershocks`].
    Aftershocks(Aftershocks),
    /// See [`ProcessKind::Bursts`].
    Bursts(EventBursts),
}

impl ProcessSettings {
    pub(super) fn from_fields(reader: &FieldReader<'_>) -> Result<Self, ScenarioError> {
        Ok(match ProcessFields::read(reader)?.process {
            ProcessKind::Uniform => Self::Uniform,
            ProcessKind::HotSpots => Self::HotSpots(HotSpots::read(reader)?),
            ProcessKind::Aftershocks => Self::Aftershocks(Aftershocks::read(reader)?),
            ProcessKind::Bursts => Self::Bursts(EventBursts::read(reader)?),
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

    pub(super) fn visit(&self, sink: &mut dyn FieldSink) {
        match self {
            Self::Uniform => {}
            Self::HotSpots(hot_spots) => hot_spots.visit(sink),
            Self::Aftershocks(aftershocks) => aftershocks.visit(sink),
            Self::Bursts(bursts) => bursts.visit(sink),
        }
    }

    /// The long-run mean of the probability that an event starts; `None` for a process where it is constant.
    pub(super) fn long_run_alpha(&self) -> Option<f64> {
        match self {
            Self::Uniform | Self::HotSpots(_) | Self::Aftershocks(_) => None,
            Self::Bursts(bursts) => Some(bursts.long_run_alpha()),
        }
    }

    /// The mean start probability over the TTIs from `first` to before `end` of a run with `seed`; `None` as in
    /// [`Self::long_run_alpha`].
    pub(super) fn mean_start_probability(&self, seed: u64, first: Tti, end: Tti) -> Option<f64> {
        match self {
            Self::Uniform | Self::HotSpots(_) | Self::Aftershocks(_) => None,
            Self::Bursts(bursts) => Some(bursts.mean_start_probability(seed, first, end)),
        }
    }

    /// Creates the starts of events in a run with `seed` that ends before TTI `end`; `alpha` applies if the probability
    /// is constant.
    pub(super) fn starts(&self, seed: u64, alpha: f64, end: Tti) -> Starts {
        match self {
            Self::Uniform | Self::HotSpots(_) | Self::Aftershocks(_) => Starts::Steady(SteadyStarts::new(seed, alpha)),
            Self::Bursts(bursts) => Starts::Bursts(BurstStarts::new(bursts, seed, end)),
        }
    }

    /// Creates the epicentres of events in a run with `seed` on `area`.
    pub(super) fn epicentres(&self, seed: u64, area: Area) -> Epicentres {
        let uniform = UniformEpicentres { seed, area };
        match self {
            Self::Uniform | Self::Bursts(_) => Epicentres::Uniform(uniform),
            Self::HotSpots(hot_spots) => Epicentres::HotSpots(HotSpotEpicentres::new(*hot_spots, uniform)),
            Self::Aftershocks(aftershocks) => Epicentres::Aftershocks(AftershockEpicentres::new(*aftershocks, uniform)),
        }
    }
}

/// The starts of the events of a run.
#[derive(Clone, Debug)]
pub(super) enum Starts {
    Steady(SteadyStarts),
    Bursts(BurstStarts),
}

impl Starts {
    /// Changes α, `(0, 1]`, from TTI `from` on. The process `bursts` has no constant α, so it stays as it is.
    pub(super) fn set_alpha(&mut self, from: Tti, alpha: f64) {
        match self {
            Self::Steady(steady) => steady.set_alpha(from, alpha),
            Self::Bursts(_) => {}
        }
    }

    /// The TTI in which `event` starts, not before `earliest`; [`Tti::NEVER`] if it does not start. Call it once per
    /// event, in order.
    pub(super) fn draw_start(&mut self, event: EventId, earliest: Tti) -> Tti {
        match self {
            Self::Steady(steady) => steady.draw_start(event, earliest),
            Self::Bursts(bursts) => bursts.draw_start(event, earliest),
        }
    }
}

/// The epicentres of the events of a run.
#[derive(Clone, Debug)]
pub(super) enum Epicentres {
    Uniform(UniformEpicentres),
    HotSpots(HotSpotEpicentres),
    Aftershocks(AftershockEpicentres),
}

impl Epicentres {
    /// Draws the epicentre of `event`. Call it once per event, in order.
    pub(super) fn draw(&mut self, event: EventId) -> Point {
        match self {
            Self::Uniform(uniform) => uniform.draw(event),
            Self::HotSpots(hot_spots) => hot_spots.draw(event),
            Self::Aftershocks(aftershocks) => aftershocks.draw(event),
        }
    }
}
