//! What a policy tells of itself: its settings, how it is built, and what others ask of it.

use std::fmt::Debug;

use reveille_common::scenario::{PolicyChoice, PolicyKind, PolicySettings};

use super::contract::Opaque;
use super::mind::Mind;
use super::pilots::Pilots;
use crate::knowledge::Knowledge;

/// Facts about a policy, for those who list, draw and compare policies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(clippy::struct_excessive_bools, reason = "facts that do not depend on each other")]
pub struct Profile {
    /// Whether it can learn, so that it has tables to train.
    pub learns: bool,
    /// Whether it wakes devices.
    pub wakes: bool,
    /// Whether it ranks wake-up candidates as `bs.ranking` says.
    pub heeds_ranking: bool,
    /// Whether it is told where events are: a bound on what others reach, that no base station could run.
    pub is_bound: bool,
    /// Its place in the palette of figures.
    pub series: usize,
    /// How the paper says that the time of a decision grows with N; "–" where it says nothing.
    pub runtime: &'static str,
}

impl Profile {
    /// A policy that only follows a plan. `series` is its place in the palette.
    pub const fn plain(series: usize) -> Self {
        Self {
            learns: false,
            wakes: false,
            heeds_ranking: false,
            is_bound: false,
            series,
            runtime: "–",
        }
    }
}

/// A policy of this program.
pub trait Registered: PolicyKind + Debug {
    /// The properties of the policy that other parts of the program ask for.
    fn profile(&self) -> Profile;

    /// The pilot runs that it asks for with the settings of `choice`, which are its own.
    fn pilots(&self, _choice: &PolicyChoice) -> Option<Box<dyn Pilots>> {
        None
    }

    /// The policy with the settings of `choice`, which are its own, for a base station that knows `known`. `findings`
    /// are those of the pilot runs that it has asked for.
    fn build(&self, choice: &PolicyChoice, known: &Knowledge, findings: Option<&Opaque>) -> Mind;
}

/// The settings of `choice`.
///
/// # Panics
/// If they are another policy's.
pub fn own<T: PolicySettings>(choice: &PolicyChoice) -> &T {
    choice.settings().expect("a policy is built from its own settings")
}
