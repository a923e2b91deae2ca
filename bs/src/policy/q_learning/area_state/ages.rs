//! Area state in which places have ages and count by them.

use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::sensing::Sensing;

use super::traits::{AreaState, CHARGES, Gain, discs};
use crate::beliefs::ages::selector::DeviceSelector;
use crate::beliefs::ages::{Ages, FREE, worths};
use crate::policy::q_learning::learned::{ABLE, AREAS, BATTERIES, Lookback};

/// Area state in which a device's gain is the sum of the age indices of its newly covered places. Devices are chosen as
/// by `age-index`, at learned prices. The price of a battery bucket is the least gain for which sensing has an
/// advantage with such a battery or a lower one.
pub(super) struct AgedArea {
    ages: Ages,
    choice: DeviceSelector,
    /// Cells of the area.
    cells: f64,
    /// Surface of the area, in sensing discs.
    discs: f64,
    /// Learned prices by battery bucket, in the unit of [`Ages::gain`]; infinite where sensing never has an advantage.
    learned: [f64; BATTERIES],
    /// Prices by device in this TTI.
    prices: Vec<f64>,
    /// The battery bucket of each device.
    batteries: Vec<u8>,
    /// Whether a TTI has passed.
    has_begun: bool,
    is_found: bool,
}

impl AgedArea {
    pub(super) fn new(lost: f64, positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let ages = Ages::with_loss(lost, positions, area, sensing, worths());
        Self {
            choice: DeviceSelector::new(positions, area, sensing.d_max),
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

impl AreaState for AgedArea {
    fn set_advantages(&mut self, advantages: &[[f64; AREAS]; BATTERIES]) {
        // A fuller battery is never dearer: without a price, or with a higher one, a bucket takes the least lower
        // price.
        let mut least = f64::INFINITY;
        for (battery, row) in advantages.iter().enumerate().skip(usize::from(ABLE)) {
            if let Some(begin) = Lookback::Ages.begin(row) {
                least = least.min((begin / self.discs * self.cells).max(FREE));
            }
            self.learned[battery] = least;
        }
    }

    fn begin(&mut self, batteries: &[u8]) {
        // The initial ages are already valid in the first TTI.
        if std::mem::replace(&mut self.has_begun, true) {
            self.ages.advance(std::mem::take(&mut self.is_found));
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
            // `DeviceSelector` keeps no state between calls, so the second pass must exclude devices chosen in the
            // first.
            for device in &chosen {
                self.prices[device.index()] = f64::INFINITY;
            }
            chosen.extend(self.choice.choose(&mut self.ages, &self.prices));
        }
        chosen
    }

    fn gains(&mut self, chosen: &[DeviceId]) -> Vec<Gain> {
        // In the order of choice: each device gains only the places that no earlier one covers.
        self.ages.clear();
        let mut gain = |device: &DeviceId| {
            let gain = self.gain(device.index());
            self.ages.add(device.index());
            gain
        };
        chosen.iter().map(&mut gain).collect()
    }

    fn gain(&self, j: usize) -> Gain {
        let share = self.ages.gain(j) / self.cells;
        Gain {
            share,
            bucket: Lookback::Ages.bucket(share * self.discs) as u8,
        }
    }

    fn left(&self) -> f64 {
        self.ages.remaining() / self.cells
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

    /// Does nothing: the ages hold the choice and advance when the next TTI begins.
    fn remember(&mut self, _: &[DeviceId]) {}

    fn found(&mut self) {
        self.is_found = true;
    }

    fn prior(&self, at: Point) -> f64 {
        self.ages.age_at(at)
    }
}
