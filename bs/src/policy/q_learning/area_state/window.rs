//! Area state for covering the area once within a window.

use std::collections::VecDeque;

use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::sensing::Sensing;

use super::selector::SequentialSelector;
use super::traits::{AreaState, Gain, discs};
use crate::beliefs::coverage::Coverage;
use crate::policy::q_learning::learned::{AREAS, BATTERIES};

/// Area state in which a place covered within the window need not be covered again.
pub(super) struct WindowedArea {
    choice: SequentialSelector,
    devices: usize,
    /// Window within which the area must be covered once, TTIs, ≥ 1.
    window: usize,
    /// Devices that sensed in each of the last `window` − 1 TTIs, the latest at the end.
    recent: VecDeque<Vec<DeviceId>>,
    /// Devices added in this TTI.
    added: Vec<DeviceId>,
    /// Number of TTIs over which the choice must still be spread.
    spread: usize,
}

impl WindowedArea {
    pub(super) fn new(window: u32, positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let (coverage, window) = (Coverage::new(positions, area, sensing), window as usize);
        Self {
            choice: SequentialSelector::new(coverage, discs(area, sensing), positions.len()),
            devices: positions.len(),
            window,
            recent: VecDeque::from(vec![Vec::new(); window - 1]),
            added: Vec::new(),
            spread: window,
        }
    }
}

impl AreaState for WindowedArea {
    fn set_advantages(&mut self, advantages: &[[f64; AREAS]; BATTERIES]) {
        self.choice.set_advantages(advantages);
    }

    fn begin(&mut self, batteries: &[u8]) {
        self.added.clear();
        self.choice.begin(batteries, self.recent.iter().flatten().copied());
    }

    fn add(&mut self, j: usize) {
        self.added.push(DeviceId(j as u32));
        self.choice.add(j);
    }

    fn choose(&mut self, is_free: &dyn Fn(usize) -> bool) -> Vec<DeviceId> {
        let mut chosen = self.choice.choose(is_free);
        let covering = || self.recent.iter().flatten().chain(&self.added).copied();
        self.choice.spare(&mut chosen, covering);
        // All places covered in one TTI are due again together, a window later. The first window is therefore spread:
        // every n-th device in the order of choice, since these are far apart.
        if self.spread > 1 {
            chosen = chosen.into_iter().step_by(self.spread).collect();
        }
        chosen
    }

    fn gains(&mut self, chosen: &[DeviceId]) -> Vec<Gain> {
        self.choice.cover(self.recent.iter().flatten().copied());
        let mut gain = |device: &DeviceId| {
            let gain = self.choice.gain(device.index());
            self.choice.add(device.index());
            gain
        };
        chosen.iter().map(&mut gain).collect()
    }

    fn gain(&self, j: usize) -> Gain {
        self.choice.gain(j)
    }

    fn left(&self) -> f64 {
        self.choice.uncovered()
    }

    /// Credits each place to the device that covered it first in the window, of which `chosen` is the last TTI.
    fn credits(&mut self, chosen: &[DeviceId], _: &[Gain]) -> Vec<f64> {
        let mut credits = vec![0.0; self.devices];
        self.choice.cover(std::iter::empty());
        for device in self.recent.iter().flatten().chain(chosen) {
            let j = device.index();
            credits[j] += self.choice.gain(j).share;
            self.choice.add(j);
        }
        credits
    }

    fn all(&self) -> f64 {
        1.0
    }

    fn remember(&mut self, chosen: &[DeviceId]) {
        if self.window > 1 {
            self.recent.pop_front();
            self.recent.push_back(chosen.to_vec());
        }
        self.spread = self.spread.saturating_sub(1);
    }

    fn found(&mut self) {}

    fn prior(&self, _: Point) -> f64 {
        1.0
    }
}
