//! Sequential choice of the sensing devices.

use reveille_common::ids::DeviceId;

use super::traits::{CHARGES, Gain};
use crate::beliefs::coverage::{CellPosition, Coverage};
use crate::policy::q_learning::learned::{ABLE, AREAS, BATTERIES, area_bucket};

/// Largest device id within a key.
const NUMBERS: u32 = (1 << 24) - 1;
/// Sequential choice among the devices for which sensing has an advantage.
///
/// Open places are processed in the order of [`Coverage::blocks`]. For each, the devices that reach it with an
/// advantage are compared. The one with the largest product of newly covered area and charge is chosen; its newly
/// covered places are no longer open. The first pass considers devices at least half charged, the second all devices,
/// after which none has an advantage. Earlier choices that later ones made superfluous are removed.
///
/// Charge counts because advantages hardly differ between batteries in dense deployments. By area alone the same few
/// devices would be chosen until they are empty, and then they could not be woken.
#[derive(Clone, Debug)]
pub(super) struct SequentialSelector {
    coverage: Coverage,
    /// Surface of the area, in sensing discs.
    discs: f64,
    /// By battery and area bucket, whether sensing is worth more than sleep.
    is_worth_it: [[bool; AREAS]; BATTERIES],
    /// Area bucket by number of newly covered parts.
    areas: Vec<u8>,
    /// By device, the parts that it covers if no other device senses.
    own: Vec<u32>,
    /// The battery bucket of each device.
    batteries: Vec<u8>,
    /// By device, an upper bound of its key. Gains never rise while others are added, so neither does a key.
    bounds: Vec<u64>,
    /// Devices that can cover a place of the current block and can still be chosen, in the order of ids.
    near: Vec<u32>,
}

impl SequentialSelector {
    /// Creates a selector for the devices of `coverage`, none added yet, on an area of `discs` sensing discs.
    pub(super) fn new(coverage: Coverage, discs: f64, devices: usize) -> Self {
        let own: Vec<u32> = (0..devices).map(|j| coverage.parts(j)).collect();
        let (most, all) = (own.iter().copied().max().unwrap_or(0), coverage.all_parts());
        Self {
            discs,
            is_worth_it: [[false; AREAS]; BATTERIES],
            areas: (0..=most)
                .map(|parts| area_bucket(f64::from(parts) / all * discs) as u8)
                .collect(),
            own,
            batteries: vec![0; devices],
            bounds: vec![0; devices],
            near: Vec::with_capacity(devices),
            coverage,
        }
    }

    /// Sets the advantages for the choices that follow.
    pub(super) fn set_advantages(&mut self, advantages: &[[f64; AREAS]; BATTERIES]) {
        self.is_worth_it = advantages.map(|row| row.map(|advantage| advantage > 0.0));
    }

    /// Begins a TTI with these battery buckets, in which only the devices in `covering` cover places.
    pub(super) fn begin(&mut self, batteries: &[u8], covering: impl Iterator<Item = DeviceId>) {
        self.batteries.copy_from_slice(batteries);
        self.cover(covering);
    }

    /// Resets the coverage to the devices in `covering`.
    pub(super) fn cover(&mut self, covering: impl Iterator<Item = DeviceId>) {
        self.coverage.clear();
        for device in covering {
            self.coverage.add(device.index());
        }
    }

    /// Adds device `j` to the covering devices.
    pub(super) fn add(&mut self, j: usize) {
        self.coverage.add(j);
    }

    /// Returns the gain of device `j` if it were added.
    pub(super) fn gain(&self, j: usize) -> Gain {
        let share = self.coverage.gain(j);
        Gain {
            share,
            bucket: area_bucket(share * self.discs) as u8,
        }
    }

    /// Returns the uncovered share of the area.
    pub(super) fn uncovered(&self) -> f64 {
        self.coverage.uncovered()
    }

    /// Chooses among the devices that satisfy `is_free` and do not cover places yet. Adds the chosen devices and
    /// returns them in the order of choice.
    pub(super) fn choose(&mut self, is_free: impl Fn(usize) -> bool) -> Vec<DeviceId> {
        let mut chosen = Vec::new();
        for least in CHARGES {
            for j in 0..self.bounds.len() {
                let may = is_free(j) && self.batteries[j] >= least && !self.coverage.has(j);
                self.bounds[j] = if may { self.key(j, self.own[j]) } else { 0 };
            }
            self.look_after_all(&mut chosen);
        }
        chosen
    }

    /// Adds devices to `chosen` until no candidate is left for any open place.
    fn look_after_all(&mut self, chosen: &mut Vec<DeviceId>) {
        for block in 0..self.coverage.blocks() {
            if !self.coverage.has_open(block) {
                continue;
            }
            self.near.clear();
            let may_be_chosen = |j: &&u32| self.bounds[**j as usize] > 0;
            self.near.extend(self.coverage.near(block).iter().filter(may_be_chosen));
            if self.near.is_empty() {
                continue;
            }
            for i in 0..self.coverage.spots(block).len() {
                let spot = self.coverage.spots(block)[i];
                while self.coverage.is_open(spot)
                    && let Some(j) = self.best(spot)
                {
                    self.coverage.add(j as usize);
                    self.bounds[j as usize] = 0;
                    chosen.push(DeviceId(j));
                }
            }
        }
    }

    /// Returns the best device that reaches a place, if any has an advantage.
    fn best(&mut self, spot: CellPosition) -> Option<u32> {
        // The device with the highest bound is evaluated first, which rules out most others without evaluation.
        let mut first = (0, 0);
        for &j in &self.near {
            let bound = self.bounds[j as usize];
            if bound > first.0 && self.coverage.reaches(j as usize, spot) {
                first = (bound, j);
            }
        }
        if first.0 == 0 {
            return None;
        }
        let (mut most, mut best) = (self.look(first.1), first.1);
        for i in 0..self.near.len() {
            let j = self.near[i];
            if self.bounds[j as usize] > most && self.coverage.reaches(j as usize, spot) {
                let key = self.look(j);
                if key > most {
                    (most, best) = (key, j);
                }
            }
        }
        (most > 0).then_some(best)
    }

    /// Recomputes the key of device `j`.
    fn look(&mut self, j: u32) -> u64 {
        let key = self.key(j as usize, self.coverage.parts(j as usize));
        self.bounds[j as usize] = key;
        key
    }

    /// Removes superfluous devices from `chosen`, first the one whose removal loses the least coverage. Ties go to the
    /// device chosen last. `covering` returns the other devices that cover places.
    pub(super) fn spare<I: Iterator<Item = DeviceId>>(&mut self, chosen: &mut Vec<DeviceId>, covering: impl Fn() -> I) {
        loop {
            let lost = |j: DeviceId| self.coverage.lost(j.index());
            let is_spare = |j: DeviceId, parts: u32| self.key(j.index(), parts) == 0;
            let of = |(turn, &j): (usize, &DeviceId)| lost(j).filter(|&parts| is_spare(j, parts)).map(|p| (p, turn));
            // `min_by_key` takes the first of equals, which in reverse order is the device chosen last.
            let spare = chosen
                .iter()
                .enumerate()
                .rev()
                .filter_map(of)
                .min_by_key(|(parts, _)| *parts);
            let Some((_, turn)) = spare else { return };
            chosen.remove(turn);
            // Without that device others cover more places alone, so all losses are recomputed.
            self.cover(covering().chain(chosen.iter().copied()));
        }
    }

    /// Returns the key: the newly covered parts times the charge in sixths, followed by the inverted id. The largest
    /// key has the largest product, and among equal products the lowest id. The key is 0 for a device that cannot
    /// report, covers no new parts or has no advantage.
    #[inline]
    fn key(&self, j: usize, parts: u32) -> u64 {
        let battery = self.batteries[j];
        let is_worth_it = self.is_worth_it[usize::from(battery)][usize::from(self.areas[parts as usize])];
        if battery < ABLE || !is_worth_it || parts == 0 {
            return 0;
        }
        let charge = u64::from(battery - ABLE + 1);
        (u64::from(parts) * charge) << 24 | u64::from(NUMBERS - j as u32)
    }
}
