//! Places have ages, and what is looked at counts by them.

use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::sensing::Sensing;

use super::contract::{CHARGES, Gain, Ground, discs};
use crate::beliefs::ages::choice::Choice;
use crate::beliefs::ages::{Ages, FREE, worths};
use crate::policy::q_learning::learned::{ABLE, AREAS, BATTERIES, Lookback};

/// What is looked at is worth the sum over its places of their ages' index. Devices are chosen as `age-index` does, at
/// prices that were learned: what a device with such a battery, or with less, must look at so that sensing has an
/// advantage.
pub(super) struct Aged {
    ages: Ages,
    choice: Choice,
    /// Cells of the area.
    cells: f64,
    /// Sensing discs that make up the area.
    discs: f64,
    /// By battery bucket, in the unit of [`Ages::worth`]; infinite where sensing never has an advantage.
    learned: [f64; BATTERIES],
    /// By device, in this TTI.
    prices: Vec<f64>,
    /// The battery bucket of each device.
    batteries: Vec<u8>,
    /// Whether a TTI has passed.
    has_begun: bool,
    is_found: bool,
}

impl Aged {
    pub(super) fn new(lost: f64, positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let ages = Ages::losing(lost, positions, area, sensing, worths());
        Self {
            choice: Choice::new(positions, area, sensing.d_max),
            cells: area.surface() / ages.cell_surface(),
            discs: discs(area, sensing),
            ages,
            learned: [f64::INFINITY; BATTERIES],
            prices: vec![f64::INFINITY; positions.len()],
            batteries: vec![0; positions.len()],
            has_begun: false,
            is_found: false,
        }
    }
}

impl Ground for Aged {
    fn set_advantages(&mut self, advantages: &[[f64; AREAS]; BATTERIES]) {
        // What a battery lacks for a price of its own, one that is less full has: nobody is dearer for being fuller.
        let mut least = f64::INFINITY;
        for (battery, row) in advantages.iter().enumerate().skip(usize::from(ABLE)) {
            if let Some(begin) = Lookback::Ages.begin(row) {
                least = least.min((begin / self.discs * self.cells).max(FREE));
            }
            self.learned[battery] = least;
        }
    }

    fn begin(&mut self, batteries: &[u8]) {
        if std::mem::replace(&mut self.has_begun, true) {
            self.ages.pass(std::mem::take(&mut self.is_found));
        }
        self.batteries.copy_from_slice(batteries);
    }

    fn add(&mut self, j: usize) {
        self.ages.add(j);
    }

    fn choose(&mut self, is_free: &dyn Fn(usize) -> bool) -> Vec<DeviceId> {
        let mut chosen: Vec<DeviceId> = Vec::new();
        for least in CHARGES {
            for (j, (price, &battery)) in self.prices.iter_mut().zip(&self.batteries).enumerate() {
                let may = battery >= least && is_free(j);
                *price = if may {
                    self.learned[usize::from(battery)]
                } else {
                    f64::INFINITY
                };
            }
            for device in &chosen {
                self.prices[device.index()] = f64::INFINITY;
            }
            chosen.extend(self.choice.choose(&mut self.ages, &self.prices));
        }
        chosen
    }

    fn gains(&mut self, chosen: &[DeviceId]) -> Vec<Gain> {
        self.ages.clear();
        let mut gain = |device: &DeviceId| {
            let gain = self.gain(device.index());
            self.ages.add(device.index());
            gain
        };
        chosen.iter().map(&mut gain).collect()
    }

    fn gain(&self, j: usize) -> Gain {
        let share = self.ages.worth(j) / self.cells;
        Gain {
            share,
            bucket: Lookback::Ages.bucket(share * self.discs) as u8,
        }
    }

    fn left(&self) -> f64 {
        self.ages.left() / self.cells
    }

    fn credits(&mut self, chosen: &[DeviceId], gains: &[Gain]) -> Vec<f64> {
        let mut credits = vec![0.0; self.batteries.len()];
        for (device, gain) in chosen.iter().zip(gains) {
            credits[device.index()] = gain.share;
        }
        credits
    }

    fn all(&self) -> f64 {
        self.ages.all() / self.cells
    }

    /// They are chosen in the ages, which pass when the next TTI begins.
    fn remember(&mut self, _: &[DeviceId]) {}

    fn found(&mut self) {
        self.is_found = true;
    }

    fn prior(&self, at: Point) -> f64 {
        self.ages.at(at)
    }
}
