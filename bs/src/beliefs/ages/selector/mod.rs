//! Selection of the devices to put in S1, whose looks are worth more than they cost. `age-index`, `dt` and `q-learning`
//! with ages plan by it. Ties and the order of evaluations are part of the result, and so of digests. docs/age-index.md
//! states the rule; `tests/src/reference/age_index.rs` repeats it, with `IMPROVEMENT_ROUNDS`.

use std::cmp::Ordering;
use std::collections::BinaryHeap;
use std::collections::binary_heap::PeekMut;
use std::sync::Arc;

use pulp::NullaryFnOnce;
use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::DeviceId;

use super::Ages;
use crate::vector_width::VectorWidth;

/// Number of rounds of replacing chosen devices. The first round brings most of the improvement, rounds after the
/// second hardly any.
const IMPROVEMENT_ROUNDS: usize = 2;

/// Number of chosen devices before the first review of all candidates, for an area of this many d_max². The time of a
/// choice depends on it, not the result: by then the choice covers much of the area, and most candidates are worth
/// less than their price.
const REVIEWS_PER_AREA: f64 = 1.0 / 6.0;

/// Selects the sensing devices of one TTI at a time.
#[derive(Clone, Debug)]
pub struct DeviceSelector {
    positions: Vec<Point>,
    buckets: Buckets,
    d_max: f64,
    /// Candidates by [`ratio_key`].
    heap: BinaryHeap<u64>,
    /// Number of chosen devices at the first review; it doubles with each further one.
    first_review: usize,
    /// Gain by device at the start of a choice, before it adds a device.
    gains_alone: Vec<f64>,
    /// Gain at the start less the price by device; negative infinity for a chosen device.
    nets_alone: Vec<f64>,
    /// `None` if the lists would be too long: each query then searches the neighbours.
    neighbours: Option<Arc<NeighbourLists>>,
    /// Chosen devices in order; `None` for a device removed without a replacement.
    chosen: Vec<Option<u32>>,
    /// Scratch space of [`Self::best_around`].
    rivals: Vec<u32>,
    vector_width: VectorWidth,
}

/// A call of [`DeviceSelector::choose`].
struct Choice<'s> {
    selector: &'s mut DeviceSelector,
    ages: &'s mut Ages,
    prices: &'s [f64],
    /// `None` to compute them.
    gains_alone: Option<&'s [f64]>,
}

impl NullaryFnOnce for Choice<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self {
            selector,
            ages,
            prices,
            gains_alone,
        } = self;
        match gains_alone {
            None => ages.fill_gains(&mut selector.gains_alone),
            Some(gains) => selector.gains_alone.copy_from_slice(gains),
        }
        selector.choose_greedily(ages, prices);
        selector.replace_chosen(ages, prices);
    }
}

impl DeviceSelector {
    /// Creates a selector for devices at `positions` of `area` with sensing range `d_max`.
    pub fn new(positions: &[Point], area: Area, d_max: f64) -> Self {
        let buckets = Buckets::new(positions, area, d_max);
        Self {
            neighbours: NeighbourLists::new(positions, &buckets, d_max, MAX_LIST_ENTRIES).map(Arc::new),
            buckets,
            d_max,
            positions: positions.to_vec(),
            heap: BinaryHeap::new(),
            first_review: ((area.surface() / (d_max * d_max) * REVIEWS_PER_AREA) as usize).max(1),
            gains_alone: vec![0.0; positions.len()],
            nets_alone: vec![0.0; positions.len()],
            chosen: Vec::new(),
            rivals: Vec::new(),
            vector_width: VectorWidth::fastest(),
        }
    }

    /// Adds devices to `ages` so that their total worth less their total price is large, and returns them in the order
    /// in which they were chosen. `ages` has the positions and the area of this selector. `prices`, one per device, are
    /// in the unit of [`Ages::gain`], above 0, and infinite for devices that may not be chosen. Devices already chosen
    /// in `ages` stay; their prices must be infinite, since the selector may choose them again.
    ///
    /// A greedy pass first adds the device with the highest ratio of worth to price, as long as its worth exceeds its
    /// price. Then each chosen device is removed in turn, `IMPROVEMENT_ROUNDS` times. Of this device and the others
    /// within d_max, the one with the largest positive worth less price takes its slot. Otherwise the slot stays empty.
    pub fn choose(&mut self, ages: &mut Ages, prices: &[f64]) -> Vec<DeviceId> {
        self.choose_by(ages, prices, None)
    }

    /// Chooses like [`Self::choose`]. `gains` are the [`Ages::gain`] of all devices, which it would compute first.
    pub(crate) fn choose_with_gains(&mut self, ages: &mut Ages, prices: &[f64], gains: &[f64]) -> Vec<DeviceId> {
        debug_assert!(
            (0..gains.len()).all(|j| gains[j].to_bits() == ages.gain(j).to_bits()),
            "current gains"
        );
        self.choose_by(ages, prices, Some(gains))
    }

    fn choose_by(&mut self, ages: &mut Ages, prices: &[f64], gains_alone: Option<&[f64]>) -> Vec<DeviceId> {
        self.chosen.clear();
        self.vector_width.run(Choice {
            selector: self,
            ages,
            prices,
            gains_alone,
        });
        self.chosen.iter().flatten().map(|&j| DeviceId(j)).collect()
    }

    /// Chooses devices by the ratio of worth to price. A worth never grows as others are chosen, so a candidate whose
    /// worth is unchanged is the best, and few candidates are evaluated twice.
    #[inline(always)]
    fn choose_greedily(&mut self, ages: &mut Ages, prices: &[f64]) {
        // Reuses the memory of the heap. Building it from all keys takes linear time; pushing them one by one does not.
        let mut keys = std::mem::take(&mut self.heap).into_vec();
        keys.clear();
        let alone = self.gains_alone.iter().zip(&mut self.nets_alone);
        for (((&gain_alone, net_alone), &price), j) in alone.zip(prices).zip(0..) {
            *net_alone = gain_alone - price;
            if let Some(key) = ratio_key(gain_alone, price, j) {
                keys.push(key);
            }
        }
        self.heap = BinaryHeap::from(keys);
        let mut next_review = self.first_review;
        while self.choose_next(ages, prices) {
            if self.chosen.len() == next_review {
                next_review *= 2;
                self.review_candidates(ages, prices);
            }
        }
    }

    /// Chooses the device with the highest ratio of worth to price. Returns whether its worth exceeds its price.
    #[inline(always)]
    fn choose_next(&mut self, ages: &mut Ages, prices: &[f64]) -> bool {
        while let Some(mut best) = self.heap.peek_mut() {
            let j = device_of_key(*best);
            match ratio_key(ages.inlined_gain(j as usize), prices[j as usize], j) {
                Some(key) if key == *best => {
                    PeekMut::pop(best);
                    ages.add(j as usize);
                    self.nets_alone[j as usize] = f64::NEG_INFINITY;
                    self.chosen.push(Some(j));
                    return true;
                }
                Some(key) => *best = key,
                None => {
                    PeekMut::pop(best);
                }
            }
        }
        false
    }

    /// Updates the keys of all candidates, and drops those whose worth no longer exceeds their price. That is faster
    /// than to find each of them at the top of the heap. The choice stays the same, since every key is an upper bound.
    #[inline(always)]
    fn review_candidates(&mut self, ages: &Ages, prices: &[f64]) {
        let mut keys = std::mem::take(&mut self.heap).into_vec();
        // Not `retain_mut`, whose closure would not be inlined.
        let mut kept_count = 0;
        for index in 0..keys.len() {
            let j = device_of_key(keys[index]);
            if let Some(key) = ratio_key(ages.inlined_gain(j as usize), prices[j as usize], j) {
                keys[kept_count] = key;
                kept_count += 1;
            }
        }
        keys.truncate(kept_count);
        self.heap = BinaryHeap::from(keys);
    }

    /// Replaces each chosen device in turn by the best device around it.
    #[inline(always)]
    fn replace_chosen(&mut self, ages: &mut Ages, prices: &[f64]) {
        let slot_count = self.chosen.len();
        let mut unchanged_slots = 0;
        for turn in 0..IMPROVEMENT_ROUNDS * slot_count {
            if unchanged_slots == slot_count {
                // Each has been tried since the last change, so another round would change nothing.
                break;
            }
            unchanged_slots += 1;
            let slot = turn % slot_count;
            let Some(j) = self.chosen[slot] else { continue };
            ages.remove(j as usize);
            let best = self.best_around(ages, prices, j as usize);
            self.nets_alone[j as usize] = self.gains_alone[j as usize] - prices[j as usize];
            if let Some(best) = best {
                ages.add(best as usize);
                self.nets_alone[best as usize] = f64::NEG_INFINITY;
            }
            if best != Some(j) {
                unchanged_slots = 0;
            }
            self.chosen[slot] = best;
        }
    }

    /// Returns the device with the largest positive worth less price among device `j`, which was just removed, and the
    /// others within d_max. Ties go to j, then to the lowest number. `nets_alone[j]` is still negative infinity,
    /// so j is no candidate among them.
    #[inline(always)]
    fn best_around(&mut self, ages: &Ages, prices: &[f64], j: usize) -> Option<u32> {
        let net_of_j = ages.inlined_gain(j) - prices[j];
        let (mut best_net, mut best) = if net_of_j > 0.0 {
            (net_of_j, Some(j as u32))
        } else {
            (0.0, None)
        };
        let initial_best = best;
        let rivals = if let Some(lists) = &self.neighbours {
            lists.of(j)
        } else {
            let rivals = &mut self.rivals;
            rivals.clear();
            self.buckets
                .within(self.positions[j], self.d_max, |i, _| rivals.push(i as u32));
            rivals
        };
        for &i in rivals {
            // A device is never worth more than alone, so the bound spares most candidates an evaluation.
            if self.nets_alone[i as usize] < best_net {
                continue;
            }
            let net = ages.inlined_gain(i as usize) - prices[i as usize];
            let is_better = match net.total_cmp(&best_net) {
                Ordering::Greater => true,
                Ordering::Equal => best != initial_best && best.is_some_and(|best| i < best),
                Ordering::Less => false,
            };
            if is_better {
                (best_net, best) = (net, Some(i));
            }
        }
        best
    }
}

/// Most entries of [`NeighbourLists`], 16 MiB.
const MAX_LIST_ENTRIES: usize = 1 << 22;

/// The devices within d_max of each device, itself included.
#[derive(Clone, Debug)]
struct NeighbourLists {
    /// The neighbours of device j are `devices[starts[j] .. starts[j + 1]]`.
    starts: Vec<u32>,
    devices: Vec<u32>,
}

impl NeighbourLists {
    /// Creates the lists; `None` if they have more than `max_entries`.
    fn new(positions: &[Point], buckets: &Buckets, d_max: f64, max_entries: usize) -> Option<Self> {
        let (mut starts, mut devices) = (vec![0], Vec::new());
        for &position in positions {
            buckets.within(position, d_max, |i, _| devices.push(i as u32));
            if devices.len() > max_entries {
                return None;
            }
            starts.push(devices.len() as u32);
        }
        devices.shrink_to_fit();
        Some(Self { starts, devices })
    }

    fn of(&self, j: usize) -> &[u32] {
        &self.devices[self.starts[j] as usize..self.starts[j + 1] as usize]
    }
}

/// Returns a key from the ratio of worth to price, in single precision, and the inverted device number. The largest key
/// has the highest ratio, and among equal ratios the lowest number. `None` if the worth does not exceed the price.
#[inline(always)]
fn ratio_key(worth: f64, price: f64, j: u32) -> Option<u64> {
    (worth > price).then(|| {
        let ratio = (worth / price) as f32;
        // The bits of non-negative floating-point numbers have the order of the numbers.
        u64::from(ratio.to_bits()) << 32 | u64::from(u32::MAX - j)
    })
}

/// Returns the device number in a key of [`ratio_key`].
#[inline(always)]
const fn device_of_key(key: u64) -> u32 {
    u32::MAX - key as u32
}

#[cfg(test)]
mod tests;
