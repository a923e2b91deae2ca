//! Interface between the duty cycling ([`DutyLearner`](crate::policy::q_learning::duty::DutyLearner)) and the state of
//! the area: [`AreaState`], with an implementation for windows and one for ages. Callers must keep the order of
//! calls that the trait states.

use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::sensing::Sensing;

use crate::policy::q_learning::learned::{AREA_BUCKETS, BATTERY_BUCKETS, FIRST_ABLE_BUCKET};

/// Least battery bucket of each pass of the choice: first at least half charged, then all able devices. The 5 follows
/// from [`BATTERY_BUCKETS`]. `tests/src/reference/q_learning.rs` repeats both.
pub(super) const PASS_MIN_BUCKETS: [u8; 2] = [5, FIRST_ABLE_BUCKET];

/// State of the area and of the devices, carried from TTI to TTI.
///
/// Calls in each TTI: [`AreaState::begin_tti`], optionally [`AreaState::add`], then [`AreaState::choose_devices`].
/// While learning, [`AreaState::gains`], [`AreaState::gain`], [`AreaState::uncovered_gain`] and [`AreaState::credits`]
/// follow, in this order. [`AreaState::end_tti`] comes last; [`AreaState::record_event`] and [`AreaState::prior`] refer
/// to the ended TTI. After the choice, `chosen` includes the devices of [`AreaState::add`].
pub(crate) trait AreaState: Send {
    /// Sets the advantages of sensing, by battery and area bucket (`DutyTable::advantages`).
    fn set_advantages(&mut self, advantages: &[[f64; AREA_BUCKETS]; BATTERY_BUCKETS]);

    /// Begins a TTI with the battery bucket of each device and no chosen device.
    fn begin_tti(&mut self, battery_buckets: &[u8]);

    /// Adds device `j`, which is not free, to the chosen devices.
    fn add(&mut self, j: usize);

    /// Chooses further devices to sense, among the devices j with `is_free(j)`. Returns only these, in the order of
    /// choice.
    fn choose_devices(&mut self, is_free: &dyn Fn(usize) -> bool) -> Vec<DeviceId>;

    /// Returns the gain of each device in `chosen`, in this order. Afterwards exactly these devices are chosen.
    fn gains(&mut self, chosen: &[DeviceId]) -> Vec<Gain>;

    /// Returns the gain of device `j`, which is not chosen, in addition to the chosen devices.
    fn gain(&self, j: usize) -> Gain;

    /// Returns the gain that the chosen devices leave to others, in the unit of [`Gain::share`].
    fn uncovered_gain(&self) -> f64;

    /// Returns, by device, the coverage credited to it, for `chosen` devices with `gains` in this order. The credits
    /// and [`AreaState::uncovered_gain`] add up to [`AreaState::coverable_gain`].
    fn credits(&mut self, chosen: &[DeviceId], gains: &[Gain]) -> Vec<f64>;

    /// Returns the gain of covering the whole area in this TTI, places beyond every device included, in the unit of
    /// [`Gain::share`].
    fn coverable_gain(&self) -> f64;

    /// Ends the TTI, in which the `chosen` devices sense.
    fn end_tti(&mut self, chosen: &[DeviceId]);

    /// Records that an event was reported in the TTI of the last decision.
    fn record_event(&mut self);

    /// Returns the relative likelihood that a reported event is at a place.
    fn prior(&self, place: Point) -> f64;
}

/// Part of the area that a device newly covers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Gain {
    /// Share of the area; with ages, times the worth of its places.
    pub share: f64,
    /// Bucket of the share, by `Lookback::bucket`.
    pub bucket: u8,
}

/// Returns the surface of an area in sensing discs.
pub(super) fn area_in_discs(area: Area, sensing: &Sensing) -> f64 {
    area.surface() / (std::f64::consts::PI * sensing.d_max * sensing.d_max)
}
