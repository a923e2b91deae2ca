//! State of the area and choice of the sensing devices, for coverage within a window (`window`, with `selector`) or for
//! places with ages (`ages`). The duty cycling sees both through [`AreaState`]; nothing else uses them.

mod ages;
mod selector;
mod traits;
mod window;

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::Sensing;

use self::ages::AgedArea;
pub(super) use self::traits::{AreaState, Gain};
use self::window::WindowedArea;
use super::learned::Lookback;

/// Creates the state for devices at `positions` of `area`. `loss_probability` is the probability that no report arrives
/// from a device that has detected an event; only ages depend on it.
pub(super) fn new(
    lookback: Lookback,
    loss_probability: f64,
    positions: &[Point],
    area: Area,
    sensing: &Sensing,
) -> Box<dyn AreaState> {
    match lookback {
        Lookback::Window(window) => Box::new(WindowedArea::new(window, positions, area, sensing)),
        Lookback::Ages => Box::new(AgedArea::new(loss_probability, positions, area, sensing)),
    }
}
