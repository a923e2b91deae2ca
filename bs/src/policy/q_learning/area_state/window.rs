//! Area state for covering the area once within a window, `policy.q-learning.window`. Digests depend on the choice,
//! which `tests/src/reference/q_learning.rs` repeats; the training learns from gains and credits.

use std::collections::VecDeque;

use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::sensing::Sensing;

use super::selector::SequentialSelector;
use super::traits::{AreaState, Gain, area_in_discs};
use crate::beliefs::coverage::Coverage;
use crate::policy::q_learning::learned::{AREA_BUCKETS, BATTERY_BUCKETS};

/// Area state in which a place covered within the window need not be covered again.
pub(super) struct WindowedArea {
    selector: SequentialSelector,
    device_count: usize,
    /// Window within which the area must be covered once, TTIs, ≥ 1.
    window: usize,
    /// Devices that sensed in each of the last `window` − 1 TTIs, the latest at the end.
    recent_sensing: VecDeque<Vec<DeviceId>>,
    /// Number of TTIs over which the choice must still be spread, from `window` down to 0.
    spread_ttis: usize,
}

impl WindowedArea {
    pub(super) fn new(window: u32, positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let (coverage, window) = (Coverage::new(positions, area, sensing), window as usize);
        Self {
            selector: SequentialSelector::new(coverage, area_in_discs(area, sensing), positions.len()),
            device_count: positions.len(),
            window,
            recent_sensing: VecDeque::from(vec![Vec::new(); window - 1]),
            spread_ttis: window,
        }
    }
}

impl AreaState for WindowedArea {
    fn set_advantages(&mut self, advantages: &[[f64; AREA_BUCKETS]; BATTERY_BUCKETS]) {
        self.selector.set_advantages(advantages);
    }

    fn begin_tti(&mut self, battery_buckets: &[u8]) {
        self.selector
            .begin(battery_buckets, self.recent_sensing.iter().flatten().copied());
    }

    fn add(&mut self, j: usize) {
        self.selector.add(j);
    }

    fn choose_devices(&mut self, is_free: &dyn Fn(usize) -> bool) -> Vec<DeviceId> {
        let mut chosen = self.selector.choose(is_free);
        // All places covered in one TTI are due again together, a window later. The first window is therefore spread:
        // every n-th device in the order of choice, since these are far apart.
        if self.spread_ttis > 1 {
            chosen = chosen.into_iter().step_by(self.spread_ttis).collect();
        }
        chosen
    }

    fn gains(&mut self, chosen: &[DeviceId]) -> Vec<Gain> {
        self.selector
            .set_covering(self.recent_sensing.iter().flatten().copied());
        let gain_then_add = |device: &DeviceId| {
            let newly_covered = self.selector.gain(device.index());
            self.selector.add(device.index());
            newly_covered
        };
        chosen.iter().map(gain_then_add).collect()
    }

    fn gain(&self, j: usize) -> Gain {
        self.selector.gain(j)
    }

    fn uncovered_gain(&self) -> f64 {
        self.selector.uncovered()
    }

    /// Credits each place to the device that covered it first in the window, of which `chosen` is the last TTI. Changes
    /// the covering devices, so no gain can be read until the next TTI.
    fn credits(&mut self, chosen: &[DeviceId], _gains: &[Gain]) -> Vec<f64> {
        let mut credits = vec![0.0; self.device_count];
        self.selector.set_covering(std::iter::empty());
        for device in self.recent_sensing.iter().flatten().chain(chosen) {
            let j = device.index();
            credits[j] += self.selector.gain(j).share;
            self.selector.add(j);
        }
        credits
    }

    fn coverable_gain(&self) -> f64 {
        1.0
    }

    fn end_tti(&mut self, chosen: &[DeviceId]) {
        if self.window > 1 {
            self.recent_sensing.pop_front();
            self.recent_sensing.push_back(chosen.to_vec());
        }
        self.spread_ttis = self.spread_ttis.saturating_sub(1);
    }

    fn record_event(&mut self) {}

    fn prior(&self, _place: Point) -> f64 {
        1.0
    }
}
