//! Who senses, and whom to wake.
//!
//! A policy answers with a δ plan and says when it next wants to decide; when a report has come it names one sleeping
//! device after another to be woken ([`contract`]). A policy is a folder: its settings, its algorithm, and what it
//! tells of itself ([`kind`]). To add one: a folder here and a line in [`registry::POLICIES`].
//! [`external`] is none: it asks somebody outside, and comes with those who can answer ([`outside`]).

pub mod adjusted;
pub mod age_index;
pub mod contract;
pub mod dt;
pub mod external;
pub mod genie;
pub mod kind;
pub mod knn;
pub mod mind;
pub mod outside;
pub mod pilots;
pub mod q_learning;
pub mod random;
pub mod registry;
mod tally;
