//! Figures: the paper's, drawn from result tables, and pictures of a deployment and of its devices' batteries.
//!
//! ```text
//! tables ─► study ─► chart ┐
//! analysis::harvest ─► chart ├─► scene ─► svg, png
//! run ─► witness ─► deployment, timeline ┘
//! ```
//! A [`scene::Scene`] is all that a picture is; [`svg`] and [`png`] only write it down. The same input gives the same bytes.

pub mod chart;
pub mod deployment;
pub mod energy;
mod error;
pub mod font;
mod map;
pub mod path;
pub mod png;
pub mod results;
pub mod scale;
pub mod scene;
pub mod study;
pub mod style;
pub mod svg;
pub mod timeline;
pub mod witness;

#[cfg(test)]
mod tests;
pub use error::FigureError;
