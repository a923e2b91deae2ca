//! Sequential choice of the sensing devices of `q-learning`, for coverage within a window ([`super::window`]). All
//! comparisons are of whole numbers, so the choice is the same on every machine; digests depend on it.
//! `tests/src/reference/q_learning.rs` repeats it for comparison.

use pulp::NullaryFnOnce;
use reveille_common::ids::DeviceId;

use super::traits::{Gain, PASS_MIN_BUCKETS};
use crate::beliefs::coverage::{CellPosition, Coverage};
use crate::policy::q_learning::learned::{AREA_BUCKETS, BATTERY_BUCKETS, FIRST_ABLE_BUCKET, area_bucket};
use crate::vector_width::VectorWidth;

/// A call of [`SequentialSelector::choose`].
struct Choice<'s, F> {
    selector: &'s mut SequentialSelector,
    is_free: F,
}

impl<F: Fn(usize) -> bool> NullaryFnOnce for Choice<'_, F> {
    type Output = Vec<DeviceId>;

    #[inline(always)]
    fn call(self) -> Self::Output {
        let mut chosen = self.selector.choose_all(self.is_free);
        self.selector.remove_superfluous(&mut chosen);
        chosen
    }
}

/// Low bits of a key that hold the inverted device id, enough for `MAX_DEVICES`.
const ID_BITS: u32 = 24;
const MAX_ID: u32 = (1 << ID_BITS) - 1;

/// Sequential choice among the devices for which sensing has an advantage.
///
/// Uncovered cells are processed block by block, in the order of [`Coverage::cells_in`]. For each, the devices that
/// reach it with an advantage are compared. The one with the largest product of newly covered area and charge is
/// chosen; its newly covered cells need no further device. The first pass considers devices at least half charged, the
/// second all devices, after which none has an advantage. Earlier choices that later ones made superfluous are removed.
///
/// Charge counts because advantages hardly differ between batteries in dense deployments. By area alone the same few
/// devices would be chosen until they are empty, and then they could not be woken.
#[derive(Clone, Debug)]
pub(super) struct SequentialSelector {
    coverage: Coverage,
    /// Surface of the area, in sensing discs.
    area_in_discs: f64,
    /// By battery and area bucket, whether sensing is worth more than sleep.
    has_advantage: [[bool; AREA_BUCKETS]; BATTERY_BUCKETS],
    /// Area bucket by number of newly covered units.
    bucket_by_units: Vec<u8>,
    /// By device, the units that it covers if no other device senses.
    own_units: Vec<u32>,
    battery_buckets: Vec<u8>,
    /// By device, an upper bound of its key. Gains never rise while others are added, so neither does a key.
    key_bounds: Vec<u64>,
    /// Devices that can cover a cell of the current block and can still be chosen, in the order of ids.
    block_devices: Vec<u32>,
    /// Blocks that may have uncovered cells, in their order.
    uncovered_blocks: Vec<usize>,
    vector_width: VectorWidth,
}

impl SequentialSelector {
    /// Creates a selector for the `device_count` devices of `coverage`, none added yet, on an area of `area_in_discs`
    /// sensing discs.
    pub(super) fn new(coverage: Coverage, area_in_discs: f64, device_count: usize) -> Self {
        let own_units: Vec<u32> = (0..device_count).map(|j| coverage.gain_in_units(j)).collect();
        let (max_units, total_units) = (own_units.iter().copied().max().unwrap_or(0), coverage.total_units());
        Self {
            area_in_discs,
            has_advantage: [[false; AREA_BUCKETS]; BATTERY_BUCKETS],
            bucket_by_units: (0..=max_units)
                .map(|units| area_bucket(f64::from(units) / total_units * area_in_discs) as u8)
                .collect(),
            own_units,
            battery_buckets: vec![0; device_count],
            key_bounds: vec![0; device_count],
            block_devices: Vec::with_capacity(device_count),
            uncovered_blocks: Vec::new(),
            vector_width: VectorWidth::fastest(),
            coverage,
        }
    }

    pub(super) fn set_advantages(&mut self, advantages: &[[f64; AREA_BUCKETS]; BATTERY_BUCKETS]) {
        self.has_advantage = advantages.map(|row| row.map(|advantage| advantage > 0.0));
    }

    /// Begins a TTI with these battery buckets, in which only the devices in `covering` cover places.
    pub(super) fn begin(&mut self, battery_buckets: &[u8], covering: impl Iterator<Item = DeviceId> + Clone) {
        self.battery_buckets.copy_from_slice(battery_buckets);
        self.set_covering(covering);
    }

    /// Makes the devices in `covering` the only ones that cover places.
    pub(super) fn set_covering(&mut self, covering: impl Iterator<Item = DeviceId> + Clone) {
        self.vector_width
            .run(|| self.coverage.replace(covering.map(DeviceId::index)));
    }

    pub(super) fn add(&mut self, j: usize) {
        self.coverage.add(j);
    }

    pub(super) fn gain(&self, j: usize) -> Gain {
        let share = self.coverage.gain(j);
        Gain {
            share,
            bucket: area_bucket(share * self.area_in_discs) as u8,
        }
    }

    /// Returns the uncovered share of the area.
    pub(super) fn uncovered(&self) -> f64 {
        self.coverage.uncovered()
    }

    /// Chooses among the devices that satisfy `is_free` and do not cover places yet, without those that later choices
    /// made superfluous. Adds the chosen devices and returns them in the order of choice.
    pub(super) fn choose(&mut self, is_free: impl Fn(usize) -> bool) -> Vec<DeviceId> {
        let selector = self;
        selector.vector_width.run(Choice { selector, is_free })
    }

    #[inline(always)]
    fn choose_all(&mut self, is_free: impl Fn(usize) -> bool) -> Vec<DeviceId> {
        let mut chosen = Vec::new();
        self.uncovered_blocks.clear();
        self.uncovered_blocks.extend(0..self.coverage.block_count());
        let mut passed_bucket = u8::MAX;
        for min_bucket in PASS_MIN_BUCKETS {
            for j in 0..self.key_bounds.len() {
                let battery = self.battery_buckets[j];
                // The bounds of the last pass remain valid.
                if battery < passed_bucket {
                    let may_choose = battery >= min_bucket && is_free(j) && !self.coverage.contains(j);
                    self.key_bounds[j] = if may_choose { self.key(j, self.own_units[j]) } else { 0 };
                }
            }
            passed_bucket = min_bucket;
            self.cover_cells(&mut chosen);
        }
        chosen
    }

    /// Adds devices to `chosen` until no candidate is left for any uncovered cell. Requires current `key_bounds`,
    /// and removes covered blocks from `uncovered_blocks`.
    #[inline(always)]
    fn cover_cells(&mut self, chosen: &mut Vec<DeviceId>) {
        // Not `retain`, whose closure would not be inlined.
        let mut kept_count = 0;
        for index in 0..self.uncovered_blocks.len() {
            let block = self.uncovered_blocks[index];
            let mut uncovered = self.coverage.uncovered_in(block);
            if uncovered == 0 {
                continue;
            }
            self.uncovered_blocks[kept_count] = block;
            kept_count += 1;
            self.block_devices.clear();
            let may_be_chosen = |j: &&u32| self.key_bounds[**j as usize] > 0;
            self.block_devices
                .extend(self.coverage.devices_covering_block(block).iter().filter(may_be_chosen));
            if self.block_devices.is_empty() {
                continue;
            }
            for cell_index in self.coverage.cells_in(block) {
                let cell = self.coverage.cell(cell_index);
                while uncovered & cell.block_bit() > 0
                    && let Some(j) = self.choose_best(cell)
                {
                    self.coverage.add(j as usize);
                    self.key_bounds[j as usize] = 0;
                    chosen.push(DeviceId(j));
                    uncovered = self.coverage.uncovered_in(block);
                }
            }
        }
        self.uncovered_blocks.truncate(kept_count);
    }

    /// Returns the device with the largest key that reaches `cell`, if any has an advantage.
    #[inline(always)]
    fn choose_best(&mut self, cell: CellPosition) -> Option<u32> {
        // The device with the highest bound is evaluated first, which rules out most others without evaluation.
        let (mut max_bound, mut best) = (0, 0);
        for &j in &self.block_devices {
            let bound = self.key_bounds[j as usize];
            if bound > max_bound && self.coverage.reaches(j as usize, cell) {
                (max_bound, best) = (bound, j);
            }
        }
        if max_bound == 0 {
            return None;
        }
        let mut best_key = self.update_key(best);
        for i in 0..self.block_devices.len() {
            let j = self.block_devices[i];
            if self.key_bounds[j as usize] > best_key && self.coverage.reaches(j as usize, cell) {
                let key = self.update_key(j);
                if key > best_key {
                    (best_key, best) = (key, j);
                }
            }
        }
        (best_key > 0).then_some(best)
    }

    /// Computes the key of device `j` and makes it its bound.
    #[inline(always)]
    fn update_key(&mut self, j: u32) -> u64 {
        let key = self.key(j as usize, self.coverage.gain_in_units(j as usize));
        self.key_bounds[j as usize] = key;
        key
    }

    /// Removes superfluous devices from `chosen`, which were added, first the one whose removal loses the least
    /// coverage. Ties go to the device chosen last.
    #[inline(always)]
    fn remove_superfluous(&mut self, chosen: &mut Vec<DeviceId>) {
        let mut losses: Vec<Option<u32>> = chosen.iter().map(|j| self.superfluous_loss(*j)).collect();
        loop {
            // `min_by_key` takes the first of equals, which in reverse order is the device chosen last.
            let superfluous = losses.iter().enumerate().rev();
            let least_useful = superfluous
                .filter_map(|(index, units)| Some(((*units)?, index)))
                .min_by_key(|(units, _)| *units);
            let Some((_, index)) = least_useful else { return };
            let removed = chosen.remove(index).index();
            losses.remove(index);
            self.coverage.remove(removed);
            // Without that device, devices near it cover more places alone.
            for (j, loss) in chosen.iter().zip(&mut losses) {
                if self.coverage.may_overlap(j.index(), removed) {
                    *loss = self.superfluous_loss(*j);
                }
            }
        }
    }

    /// Returns the units that would be uncovered without device `j`, which was added, if it is superfluous.
    #[inline(always)]
    fn superfluous_loss(&self, j: DeviceId) -> Option<u32> {
        let units = self.coverage.loss_in_units(j.index())?;
        (self.key(j.index(), units) == 0).then_some(units)
    }

    /// Returns the key: the newly covered units times the charge in sixths, followed by the inverted id. The largest
    /// key has the largest product, and among equal products the lowest id. The key is 0 for a device that cannot
    /// report, covers no new units or has no advantage.
    #[inline(always)]
    fn key(&self, j: usize, units: u32) -> u64 {
        let battery = self.battery_buckets[j];
        let area = self.bucket_by_units[units as usize];
        let is_worth_it = self.has_advantage[usize::from(battery)][usize::from(area)];
        if battery < FIRST_ABLE_BUCKET || !is_worth_it || units == 0 {
            return 0;
        }
        let charge = u64::from(battery - FIRST_ABLE_BUCKET + 1);
        (u64::from(units) * charge) << ID_BITS | u64::from(MAX_ID - j as u32)
    }
}
