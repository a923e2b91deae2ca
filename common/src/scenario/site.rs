//! [`Site`]: the facts about its devices and their area that the base station knows before a run. A policy checks and
//! completes its settings with them. [`Scenario::site`](super::Scenario::site) builds it. The doc tests below keep
//! ground truth out; `compile_fail` also passes for a path that does not exist, so rename types there too.
//! `tests/tests/knowledge_wall.rs` reads its `Debug` text.

use super::run::BsSettings;
use crate::energy::EnergyModel;
use crate::geometry::{Area, Layout};
use crate::sensing::Sensing;
use crate::units::Energy;

/// The base station's knowledge of a device class.
#[derive(Clone, Debug, PartialEq)]
pub struct ClassKnowledge<'s> {
    /// The name of the class.
    pub name: &'s str,
    /// The share of all N devices, `[0, 1]`; 0 for a class without devices.
    pub share: f64,
    /// Battery and costs.
    pub energy: EnergyModel,
    /// The mean harvest in a TTI, see [`Harvest::mean`](crate::harvest::Harvest::mean).
    pub mean_harvest: Energy,
}

/// The base station's knowledge of its site: the part of a scenario without ground truth.
///
/// The settings of a policy cannot depend on the seed:
/// ```compile_fail
/// fn peek(site: &reveille_common::scenario::Site<'_>) -> u64 {
///     site.seed
/// }
/// ```
/// They cannot depend on the duration of events or, except for α, on their process:
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
/// fn peek(site: &reveille_common::scenario::Site<'_>) -> reveille_common::event::ProcessSettings {
///     site.events.process
/// }
/// ```
/// ```compile_fail
/// fn peek(site: &reveille_common::scenario::Site<'_>) -> reveille_common::event::DurationKind {
///     site.events.duration_kind
/// }
/// ```
/// They cannot depend on the future harvest of a class:
/// ```compile_fail
/// fn peek(site: &reveille_common::scenario::Site<'_>) {
///     let _ = &site.classes[0].harvest;
/// }
/// ```
/// The site has only these fields; a new field must be added here:
/// ```
/// use reveille_common::scenario::Site;
///
/// fn all(site: Site<'_>) {
///     let Site { devices: _, area: _, layout: _, sensing: _, alpha: _, bs: _, classes: _ } = site;
/// }
/// ```
/// A permitted use:
/// ```
/// fn known(site: &reveille_common::scenario::Site<'_>) -> f64 {
///     site.alpha + site.classes[0].mean_harvest.units()
/// }
/// ```
#[derive(Clone, Debug)]
pub struct Site<'s> {
    /// Number of devices N, `1 ..= `[`MAX_DEVICES`](crate::ids::MAX_DEVICES).
    pub devices: u32,
    /// The served area ξ.
    pub area: Area,
    /// The layout of the devices. It holds positions only if they come from a file.
    pub layout: &'s Layout,
    /// The sensing model.
    pub sensing: &'s Sensing,
    /// Probability α that an event starts in a TTI in which none is active, `(0, 1]`; its long-run mean if it changes
    /// with time.
    pub alpha: f64,
    /// The settings of the base station.
    pub bs: BsSettings,
    /// The device classes, at least one.
    pub classes: Vec<ClassKnowledge<'s>>,
}
