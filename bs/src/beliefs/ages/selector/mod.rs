//! Selection of the devices to put in S1, whose looks are worth more than they cost. `age-index`, `dt` and `q-learning`
//! with ages plan by it. Ties and the order of evaluations are part of the result, and so of digests. docs/age-index.md
//! states the rule; `tests/src/reference/age_index.rs` repeats it, with `IMPROVEMENT_ROUNDS`.

use std::cmp::Ordering;
use std::collections::BinaryHeap;
use std::collections::binary_heap::PeekMut;
use std::sync::Arc;

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::DeviceId;

use super::Ages;

/// Number of rounds of replacing chosen devices. The first round brings most of the improvement, rounds after the
/// second hardly any.
const IMPROVEMENT_ROUNDS: usize = 2;

/// Selects the sensing devices of one TTI at a time.
#[derive(Clone, Debug)]
pub struct DeviceSelector {
    positions: Vec<Point>,
    buckets: Buckets,
    d_max: f64,
    /// Candidates by [`ratio_key`].
    heap: BinaryHeap<u64>,
    /// Gain by device at the start of a choice, before it adds a device.
    gains_alone: Vec<f64>,
    /// Gain at the start less the price by device; negative infinity for a chosen device.
    nets_alone: Vec<f64>,
    /// `None` if the lists would be too long: each query then searches the neighbours.
    neighbours: Option<Arc<NeighbourLists>>,
    /// Chosen devices in order; `None` for a device removed without a replacement.
    chosen: Vec<Option<u32>>,
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
            gains_alone: vec![0.0; positions.len()],
            nets_alone: vec![0.0; positions.len()],
            chosen: Vec::new(),
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
        self.chosen.clear();
        self.choose_greedily(ages, prices);
        self.replace_chosen(ages, prices);
        self.chosen.iter().flatten().map(|&j| DeviceId(j)).collect()
    }

    /// Chooses devices by the ratio of worth to price. A worth never grows as others are chosen, so a candidate whose
    /// worth is unchanged is the best, and few candidates are evaluated twice.
    fn choose_greedily(&mut self, ages: &mut Ages, prices: &[f64]) {
        // Reuses the memory of the heap. Building it from all keys takes linear time; pushing them one by one does not.
        let mut keys = std::mem::take(&mut self.heap).into_vec();
        keys.clear();
        let alone = self.gains_alone.iter_mut().zip(&mut self.nets_alone);
        for (((gain_alone, net_alone), &price), j) in alone.zip(prices).zip(0..) {
            *gain_alone = ages.gain(j as usize);
            *net_alone = *gain_alone - price;
            keys.extend(ratio_key(*gain_alone, price, j));
        }
        self.heap = BinaryHeap::from(keys);
        while let Some(mut best) = self.heap.peek_mut() {
            // The low half of a key is the inverted device number.
            let j = u32::MAX - *best as u32;
            match ratio_key(ages.gain(j as usize), prices[j as usize], j) {
                Some(key) if key == *best => {
                    PeekMut::pop(best);
                    ages.add(j as usize);
                    self.nets_alone[j as usize] = f64::NEG_INFINITY;
                    self.chosen.push(Some(j));
                }
                Some(key) => *best = key,
                None => {
                    PeekMut::pop(best);
                }
            }
        }
    }

    /// Replaces each chosen device in turn by the best device around it.
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
    fn best_around(&self, ages: &Ages, prices: &[f64], j: usize) -> Option<u32> {
        let net_of_j = ages.gain(j) - prices[j];
        let (mut best_net, mut best) = if net_of_j > 0.0 {
            (net_of_j, Some(j as u32))
        } else {
            (0.0, None)
        };
        let initial_best = best;
        let mut try_device = |i: u32| {
            // A device is never worth more than alone, so the bound spares most candidates an evaluation.
            if self.nets_alone[i as usize] < best_net {
                return;
            }
            let net = ages.gain(i as usize) - prices[i as usize];
            let is_better = match net.total_cmp(&best_net) {
                Ordering::Greater => true,
                Ordering::Equal => best != initial_best && best.is_some_and(|best| i < best),
                Ordering::Less => false,
            };
            if is_better {
                (best_net, best) = (net, Some(i));
            }
        };
        match &self.neighbours {
            Some(lists) => lists.of(j).iter().copied().for_each(try_device),
            None => self
                .buckets
                .within(self.positions[j], self.d_max, |i, _| try_device(i as u32)),
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
#[inline]
fn ratio_key(worth: f64, price: f64, j: u32) -> Option<u64> {
    (worth > price).then(|| {
        let ratio = (worth / price) as f32;
        // The bits of non-negative floating-point numbers have the order of the numbers.
        u64::from(ratio.to_bits()) << 32 | u64::from(u32::MAX - j)
    })
}

#[cfg(test)]
mod tests;
