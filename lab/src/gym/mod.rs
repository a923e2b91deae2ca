//! Environments to train policies in: runs whose decisions come from outside, one step for each, with observations as
//! numbers and the rewards of Sec. V-B.
//!
//! A step answers one question. At stage 0 the action is δ(k), a bit for each device; at stage 1 it is whom to wake,
//! and nobody ends the wake-ups of the TTI. Devices of one action are woken in the order of ids. An action cannot be
//! wrong: what cannot be done is dropped ([`reveille_bs::policy::external`]).

mod batch;
mod environment;
mod stream;
#[cfg(test)]
mod tests;

pub use batch::{Batch, PARTS, Views};
pub use environment::{Environment, Ground, Step, Weights};
pub use stream::{Actions, record};
