//! What a base station knows of its site before a run, by which a policy checks and completes its settings.

use super::bs::BsSettings;
use crate::energy::EnergyModel;
use crate::geometry::{Area, Layout};
use crate::sensing::Sensing;
use crate::units::Energy;

/// What is known of the devices of a class.
#[derive(Clone, Debug, PartialEq)]
pub struct ClassKnowledge<'s> {
    /// Its name.
    pub name: &'s str,
    /// Its share of the devices, `(0, 1]`.
    pub share: f64,
    /// Battery and costs.
    pub energy: EnergyModel,
    /// Its mean harvest in a TTI.
    pub mean_harvest: Energy,
}

/// What a base station knows of its site: the part of a scenario that is no ground truth.
///
/// No policy can be set from the seed,
/// ```compile_fail
/// fn peek(site: &reveille_common::scenario::Site<'_>) -> u64 {
///     site.seed
/// }
/// ```
/// from how long events last or from their process beyond α,
/// ```compile_fail
/// fn peek(site: &reveille_common::scenario::Site<'_>) -> u64 {
///     site.events.duration
/// }
/// ```
/// ```compile_fail
/// fn peek(site: &reveille_common::scenario::Site<'_>) -> f64 {
///     site.events.alpha
/// }
/// ```
/// ```compile_fail
/// fn peek(site: &reveille_common::scenario::Site<'_>) -> reveille_common::event::Process {
///     site.events.process
/// }
/// ```
/// ```compile_fail
/// fn peek(site: &reveille_common::scenario::Site<'_>) -> reveille_common::event::DurationKind {
///     site.events.duration_kind
/// }
/// ```
/// or from what a class will harvest:
/// ```compile_fail
/// fn peek(site: &reveille_common::scenario::Site<'_>) {
///     let _ = &site.classes[0].harvest;
/// }
/// ```
/// This is all that there is, so that whoever adds to it passes by here,
/// ```
/// use reveille_common::scenario::Site;
///
/// fn all(site: Site<'_>) {
///     let Site { devices: _, area: _, layout: _, sensing: _, alpha: _, bs: _, classes: _ } = site;
/// }
/// ```
/// and what it can do:
/// ```
/// fn known(site: &reveille_common::scenario::Site<'_>) -> f64 {
///     site.alpha + site.classes[0].mean_harvest.units()
/// }
/// ```
#[derive(Clone, Debug)]
pub struct Site<'s> {
    /// Number of devices N, `1 ..= 1 000 000`.
    pub devices: u32,
    /// The served area ξ.
    pub area: Area,
    /// Where the devices stand.
    pub layout: &'s Layout,
    /// The sensing model.
    pub sensing: &'s Sensing,
    /// Probability α that an event starts in a TTI in which none is active, `(0, 1]`; its long-run mean where it
    /// changes with time.
    pub alpha: f64,
    /// The settings of the base station.
    pub bs: BsSettings,
    /// The device classes, at least one.
    pub classes: Vec<ClassKnowledge<'s>>,
}
