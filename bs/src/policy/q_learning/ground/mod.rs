//! What there is to look at, and who is chosen to: the area to be covered within a window, or places that have ages.

mod ages;
mod choice;
mod contract;
mod window;

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::Sensing;

use self::ages::Aged;
pub(super) use self::contract::{Gain, Ground};
use self::window::Windowed;
use super::learned::Lookback;

/// The ground of devices at `positions` of `area`. With probability `lost` nothing is heard of one that has found
/// something.
pub(super) fn new(
    lookback: Lookback,
    lost: f64,
    positions: &[Point],
    area: Area,
    sensing: &Sensing,
) -> Box<dyn Ground> {
    match lookback {
        Lookback::Window(window) => Box::new(Windowed::new(window, positions, area, sensing)),
        Lookback::Ages => Box::new(Aged::new(lost, positions, area, sensing)),
    }
}
