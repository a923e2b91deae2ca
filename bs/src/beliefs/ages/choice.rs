//! Who looks: the devices whose looks are worth more than they cost.

use std::cmp::Ordering;
use std::collections::BinaryHeap;
use std::collections::binary_heap::PeekMut;

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::DeviceId;

use super::Ages;

/// How often each chosen device is held against others that might take its place. The first time brings most of what
/// can be had, from the third on hardly anything.
const ROUNDS: usize = 2;

/// Chooses who looks in one TTI after another.
#[derive(Clone, Debug)]
pub struct Choice {
    positions: Vec<Point>,
    buckets: Buckets,
    d_max: f64,
    /// Candidates by [`key`].
    heap: BinaryHeap<u64>,
    /// By device, what it would look at if nobody was chosen.
    alone: Vec<f64>,
    is_chosen: Vec<bool>,
    /// In the order of choice; nobody in the place of one that was taken out.
    chosen: Vec<Option<u32>>,
}

impl Choice {
    /// Among devices at `positions` of `area` that sense as far as `d_max`.
    pub fn new(positions: &[Point], area: Area, d_max: f64) -> Self {
        Self {
            buckets: Buckets::new(positions, area, d_max),
            d_max,
            positions: positions.to_vec(),
            heap: BinaryHeap::new(),
            alone: vec![0.0; positions.len()],
            is_chosen: vec![false; positions.len()],
            chosen: Vec::new(),
        }
    }

    /// Chooses devices so that the worth of what they look at, less what they cost, is large, and adds them to `ages`,
    /// beside those who are chosen there already. `prices` are in the unit of [`Ages::worth`], above 0, infinite for
    /// devices that may not be chosen. Gives them in the order of choice.
    ///
    /// First the device with the most worth for its price is chosen, then the next given the first, and so on while one
    /// is worth more than it costs. Then each is taken out in turn, `ROUNDS` times: of itself and of the others
    /// within d_max, the one that is worth most beyond its price takes the place, or nobody if all cost more than they
    /// are worth.
    pub fn choose(&mut self, ages: &mut Ages, prices: &[f64]) -> Vec<DeviceId> {
        self.is_chosen.fill(false);
        self.chosen.clear();
        self.greedily(ages, prices);
        self.improve(ages, prices);
        self.chosen.iter().flatten().map(|&j| DeviceId(j)).collect()
    }

    /// A worth never rises while others are chosen, so a candidate whose worth is still what it was is the best of all,
    /// and few have to be looked at twice.
    fn greedily(&mut self, ages: &mut Ages, prices: &[f64]) {
        let mut keys = std::mem::take(&mut self.heap).into_vec();
        keys.clear();
        for ((alone, &price), j) in self.alone.iter_mut().zip(prices).zip(0..) {
            *alone = ages.worth(j as usize);
            keys.extend(key(*alone, price, j));
        }
        self.heap = BinaryHeap::from(keys);
        while let Some(mut best) = self.heap.peek_mut() {
            let j = u32::MAX - *best as u32;
            match key(ages.worth(j as usize), prices[j as usize], j) {
                Some(now) if now == *best => {
                    PeekMut::pop(best);
                    ages.add(j as usize);
                    self.is_chosen[j as usize] = true;
                    self.chosen.push(Some(j));
                }
                Some(now) => *best = now,
                None => {
                    PeekMut::pop(best);
                }
            }
        }
    }

    fn improve(&mut self, ages: &mut Ages, prices: &[f64]) {
        let places = self.chosen.len();
        let mut unchanged = 0;
        for turn in 0..ROUNDS * places {
            if unchanged == places {
                // All have been tried since the last change: another time would change nothing.
                break;
            }
            unchanged += 1;
            let place = turn % places;
            let Some(j) = self.chosen[place] else { continue };
            ages.remove(j as usize);
            self.is_chosen[j as usize] = false;
            let best = self.best_around(ages, prices, j as usize);
            if let Some(best) = best {
                ages.add(best as usize);
                self.is_chosen[best as usize] = true;
            }
            if best != Some(j) {
                unchanged = 0;
            }
            self.chosen[place] = best;
        }
    }

    /// Of device `j`, which was just taken out, and the others within d_max, the one that is worth most beyond its
    /// price, if one is worth that. Among equals it is j, or else the lowest number.
    fn best_around(&self, ages: &Ages, prices: &[f64], j: usize) -> Option<u32> {
        let own = ages.worth(j) - prices[j];
        let (mut most, mut best) = if own > 0.0 { (own, Some(j as u32)) } else { (0.0, None) };
        let first = best;
        self.buckets.within(self.positions[j], self.d_max, |i, _| {
            if i == j || self.is_chosen[i] || self.alone[i] - prices[i] < most {
                return;
            }
            let net = ages.worth(i) - prices[i];
            let is_better = match net.total_cmp(&most) {
                Ordering::Greater => true,
                Ordering::Equal => best != first && best.is_some_and(|best| (i as u32) < best),
                Ordering::Less => false,
            };
            if is_better {
                (most, best) = (net, Some(i as u32));
            }
        });
        best
    }
}

/// The worth for the price in single precision, and the number counted down: the largest key has the most worth for its
/// price, and among those the lowest number. Nothing where the price is not less than the worth.
#[inline]
fn key(worth: f64, price: f64, j: u32) -> Option<u64> {
    (worth > price).then(|| {
        let ratio = (worth / price) as f32;
        // The bits of floating-point numbers that are not negative rise with them.
        u64::from(ratio.to_bits()) << 32 | u64::from(u32::MAX - j)
    })
}

#[cfg(test)]
#[path = "choice_tests.rs"]
mod tests;
