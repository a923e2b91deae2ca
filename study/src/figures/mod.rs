//! Figures: the paper's, drawn from result tables, pictures of a deployment and of its devices' batteries, of what
//! `q-learning` has learned, and of a tuning of its weights.
//!
//! ```text
//! tables ─► study, sweep, pareto, front ─► chart ┐
//! analysis::harvest ─► chart ├─► scene ─► svg, png
//! run ─► witness ─► deployment, timeline ┤
//! runs ─► robustness ─► chart ┤
//! run ─► trajectories ─► attention ┤
//! Learned ─► learning, q_table ┤
//! tuning::History ─► tuning (contour) ┘
//! ```
//! A [`scene::Scene`] is all that a picture is; [`svg`] and [`png`] only write it down. The same input gives the same
//! bytes.

pub mod attention;
pub mod chart;
mod contour;
pub mod deployment;
pub mod energy;
mod error;
pub mod floor;
pub mod font;
pub mod front;
pub mod ground;
pub mod heat;
pub mod layout;
pub mod learning;
mod map;
pub mod name;
pub mod note;
pub mod pareto;
pub mod path;
pub mod png;
pub mod q_table;
pub mod results;
pub mod robustness;
pub mod scale;
pub mod scene;
mod stated;
pub mod study;
pub mod style;
pub mod svg;
pub mod sweep;
pub mod timeline;
pub mod tuning;
pub mod witness;

#[cfg(test)]
mod tests;

pub use error::FigureError;
