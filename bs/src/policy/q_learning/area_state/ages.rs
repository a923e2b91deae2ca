//! Area state in which places have ages and count by them, for `policy.q-learning.ages`. Digests depend on the
//! choice, which `tests/src/reference/q_learning.rs` repeats; the training learns from gains and credits.

use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::sensing::Sensing;

use super::traits::{AreaState, Gain, PASS_MIN_BUCKETS, area_in_discs};
use crate::beliefs::ages::selector::DeviceSelector;
use crate::beliefs::ages::{Ages, MIN_PRICE};
use crate::policy::q_learning::learned::{AREA_BUCKETS, BATTERY_BUCKETS, FIRST_ABLE_BUCKET, Lookback};

/// Area state in which a device's gain is the sum of the age indices of its newly covered places. Devices are chosen as
/// by `age-index`, at learned prices. The price of a battery bucket is the least gain for which sensing has an
/// advantage with such a battery or a lower one.
pub(super) struct AgedArea {
    ages: Ages,
    selector: DeviceSelector,
    cell_count: f64,
    /// Surface of the area, in sensing discs.
    area_in_discs: f64,
    /// Learned prices by battery bucket, in the unit of [`Ages::gain`]; infinite where sensing never has an advantage,
    /// and below [`FIRST_ABLE_BUCKET`].
    bucket_prices: [f64; BATTERY_BUCKETS],
    /// By device, its price in the current pass of the choice; infinite if it may not be chosen.
    prices: Vec<f64>,
    battery_buckets: Vec<u8>,
    /// Whether the first TTI has begun.
    has_begun: bool,
    /// Whether an event was reported in the TTI of the last decision.
    is_event_reported: bool,
}

impl AgedArea {
    pub(super) fn new(loss_probability: f64, positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let ages = Ages::with_loss(loss_probability, positions, area, sensing);
        Self {
            selector: DeviceSelector::new(positions, area, sensing.d_max),
            cell_count: area.surface() / ages.cell_surface(),
            area_in_discs: area_in_discs(area, sensing),
            ages,
            bucket_prices: [f64::INFINITY; BATTERY_BUCKETS],
            prices: vec![f64::INFINITY; positions.len()],
            battery_buckets: vec![0; positions.len()],
            has_begun: false,
            is_event_reported: false,
        }
    }
}

impl AreaState for AgedArea {
    fn set_advantages(&mut self, advantages: &[[f64; AREA_BUCKETS]; BATTERY_BUCKETS]) {
        // A fuller battery is never dearer: without a price, or with a higher one, a bucket takes the least price of
        // the lower buckets.
        let mut lowest_price = f64::INFINITY;
        for (battery, row) in advantages.iter().enumerate().skip(usize::from(FIRST_ABLE_BUCKET)) {
            if let Some(start) = Lookback::Ages.advantage_start(row) {
                lowest_price = lowest_price.min((start / self.area_in_discs * self.cell_count).max(MIN_PRICE));
            }
            self.bucket_prices[battery] = lowest_price;
        }
    }

    fn begin_tti(&mut self, battery_buckets: &[u8]) {
        // The initial ages are already valid in the first TTI.
        if std::mem::replace(&mut self.has_begun, true) {
            self.ages.advance(std::mem::take(&mut self.is_event_reported));
        }
        self.battery_buckets.copy_from_slice(battery_buckets);
    }

    fn add(&mut self, j: usize) {
        self.ages.add(j);
    }

    /// Chooses with the prices of [`AreaState::set_advantages`]. Devices of [`AreaState::add`] must not be free.
    fn choose_devices(&mut self, is_free: &dyn Fn(usize) -> bool) -> Vec<DeviceId> {
        let mut chosen: Vec<DeviceId> = Vec::new();
        for min_bucket in PASS_MIN_BUCKETS {
            for (j, (price, &battery)) in self.prices.iter_mut().zip(&self.battery_buckets).enumerate() {
                let may_choose = battery >= min_bucket && is_free(j);
                *price = if may_choose {
                    self.bucket_prices[usize::from(battery)]
                } else {
                    f64::INFINITY
                };
            }
            // `DeviceSelector` keeps no state between calls, so the second pass must exclude devices chosen in the
            // first.
            for device in &chosen {
                self.prices[device.index()] = f64::INFINITY;
            }
            chosen.extend(self.selector.choose(&mut self.ages, &self.prices));
        }
        chosen
    }

    fn gains(&mut self, chosen: &[DeviceId]) -> Vec<Gain> {
        // In the order of choice: each device gains only the places that no earlier one covers.
        self.ages.clear();
        let gain_then_add = |device: &DeviceId| {
            let newly_covered = self.gain(device.index());
            self.ages.add(device.index());
            newly_covered
        };
        chosen.iter().map(gain_then_add).collect()
    }

    fn gain(&self, j: usize) -> Gain {
        let share = self.ages.gain(j) / self.cell_count;
        Gain {
            share,
            bucket: Lookback::Ages.bucket(share * self.area_in_discs) as u8,
        }
    }

    /// Returns the worth of the places that no chosen device covers, as a mean over the cells of the area.
    fn uncovered_gain(&self) -> f64 {
        self.ages.uncovered_worth() / self.cell_count
    }

    fn credits(&mut self, chosen: &[DeviceId], gains: &[Gain]) -> Vec<f64> {
        let mut credits = vec![0.0; self.battery_buckets.len()];
        for (device, gain) in chosen.iter().zip(gains) {
            credits[device.index()] = gain.share;
        }
        credits
    }

    /// Returns the worth of all places, as a mean over the cells of the area.
    fn coverable_gain(&self) -> f64 {
        self.ages.total_worth() / self.cell_count
    }

    /// Does nothing: the ages hold the choice and advance when the next TTI begins.
    fn end_tti(&mut self, _chosen: &[DeviceId]) {}

    fn record_event(&mut self) {
        self.is_event_reported = true;
    }

    fn prior(&self, place: Point) -> f64 {
        self.ages.age_at(place)
    }
}
