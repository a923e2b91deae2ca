//! What the duty cycling asks of a ground.

use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::sensing::Sensing;

use crate::policy::q_learning::learned::{ABLE, AREAS, BATTERIES};

/// First those at least half charged are chosen from, then all who are able.
pub const CHARGES: [u8; 2] = [5, ABLE];

/// The state of the area and of the devices, from one TTI to the next.
///
/// In each TTI: [`Ground::begin`], then perhaps [`Ground::add`], then [`Ground::choose`], then, for what is to be
/// learned from, [`Ground::gains`], [`Ground::gain`], [`Ground::left`] and at last [`Ground::credits`]; and in the end
/// [`Ground::remember`].
pub trait Ground: Send {
    /// Chooses by these advantages from now on.
    fn set_advantages(&mut self, advantages: &[[f64; AREAS]; BATTERIES]);

    /// Begins a TTI with these battery buckets, in which nobody is chosen yet.
    fn begin(&mut self, batteries: &[u8]);

    /// Chooses the `j`-th device.
    fn add(&mut self, j: usize);

    /// Chooses, among those for whom `is_free` holds, beside those who are chosen already. Gives them in the order in
    /// which they were chosen.
    fn choose(&mut self, is_free: &dyn Fn(usize) -> bool) -> Vec<DeviceId>;

    /// What each of `chosen` newly looks at, in this order; in the end they, and nobody else, are chosen.
    fn gains(&mut self, chosen: &[DeviceId]) -> Vec<Gain>;

    /// What the `j`-th device, which is not chosen, would newly look at beside those chosen.
    fn gain(&self, j: usize) -> Gain;

    /// What nobody looks at, as [`Gain::share`].
    fn left(&self) -> f64;

    /// By device, what is looked at thanks to it, with those of `chosen` in this order, who newly look at `gains`.
    /// Together with [`Ground::left`] that is everything there is.
    fn credits(&mut self, chosen: &[DeviceId], gains: &[Gain]) -> Vec<f64>;

    /// Everything there is to look at in this TTI, as [`Gain::share`].
    fn all(&self) -> f64;

    /// Those of `chosen` look, and the TTI passes.
    fn remember(&mut self, chosen: &[DeviceId]);

    /// An event was reported in the TTI that was decided on last.
    fn found(&mut self);

    /// How likely an event that was reported is to be at a place, up to a factor.
    fn prior(&self, at: Point) -> f64;
}

/// What a device newly looks at.
#[derive(Clone, Copy, Debug)]
pub struct Gain {
    /// The share of the area, and with ages times what they are worth.
    pub share: f64,
    /// Its bucket.
    pub bucket: u8,
}

/// Sensing discs that make up an area.
pub fn discs(area: Area, sensing: &Sensing) -> f64 {
    area.surface() / (std::f64::consts::PI * sensing.d_max * sensing.d_max)
}
