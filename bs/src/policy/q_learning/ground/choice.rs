//! Who is chosen, one device after the other.

use reveille_common::ids::DeviceId;

use super::contract::{CHARGES, Gain};
use crate::beliefs::coverage::{Coverage, Spot};
use crate::policy::q_learning::learned::{ABLE, AREAS, BATTERIES, area_bucket};

/// The largest number of a device within a key.
const NUMBERS: u32 = (1 << 24) - 1;
/// Sequential choice among those for whom sensing has an advantage.
///
/// Places are looked after in the order of [`Coverage::blocks`]. If one is open, then of those that reach it with an
/// advantage the device is chosen whose newly covered area times its charge is the largest; what it newly covers is no
/// longer open. That is done with those at least half charged, and then with all, after which nobody has an advantage.
/// Those who were chosen early may have been made superfluous by those who came later, and are left out again.
///
/// Why charge counts: where devices stand densely, advantages hardly differ between batteries. By area alone the same
/// few devices would be chosen until they are empty, and then nobody could wake them.
#[derive(Clone, Debug)]
pub struct Choice {
    coverage: Coverage,
    /// Sensing discs that make up the area.
    discs: f64,
    /// By battery and area bucket, whether sensing is worth more than sleep.
    is_worth_it: [[bool; AREAS]; BATTERIES],
    /// The area bucket of newly covered parts of the area.
    areas: Vec<u8>,
    /// By device, the parts that it covers alone.
    own: Vec<u32>,
    /// The battery bucket of each device.
    batteries: Vec<u8>,
    /// What the key of a device is at most: gains never rise while others are added, so neither does a key.
    bounds: Vec<u64>,
    /// Of those who may cover a place of the block that is looked after, who may still be chosen, by rising number.
    near: Vec<u32>,
}

impl Choice {
    /// Of the devices of `coverage`, none of them added yet and `discs` of whose discs make up the area.
    pub fn new(coverage: Coverage, discs: f64, devices: usize) -> Self {
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

    /// Chooses by these advantages from now on.
    pub fn set_advantages(&mut self, advantages: &[[f64; AREAS]; BATTERIES]) {
        self.is_worth_it = advantages.map(|row| row.map(|advantage| advantage > 0.0));
    }

    /// Begins a TTI with these battery buckets, in which so far those of `covering` cover something.
    pub fn begin(&mut self, batteries: &[u8], covering: impl Iterator<Item = DeviceId>) {
        self.batteries.copy_from_slice(batteries);
        self.cover(covering);
    }

    /// Covers what those of `covering` do, and nothing else.
    pub fn cover(&mut self, covering: impl Iterator<Item = DeviceId>) {
        self.coverage.clear();
        for device in covering {
            self.coverage.add(device.index());
        }
    }

    /// The `j`-th device covers something from now on.
    pub fn add(&mut self, j: usize) {
        self.coverage.add(j);
    }

    /// What the `j`-th device would newly cover.
    pub fn gain(&self, j: usize) -> Gain {
        let share = self.coverage.gain(j);
        Gain {
            share,
            bucket: area_bucket(share * self.discs) as u8,
        }
    }

    /// The share of the area that nobody covers.
    pub fn uncovered(&self) -> f64 {
        self.coverage.uncovered()
    }

    /// Chooses among those for whom `is_free` holds, beside those who cover something already. Gives them in the order
    /// in which they were chosen; they are added.
    pub fn choose(&mut self, is_free: impl Fn(usize) -> bool) -> Vec<DeviceId> {
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

    /// Adds to those `chosen` until for no open place somebody is left.
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

    /// The best of those who reach a place, if one of them has an advantage.
    fn best(&mut self, spot: Spot) -> Option<u32> {
        // Whoever was the best when last looked at comes first: most others are then known to be worse.
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

    /// The key of the `j`-th device, looked at anew.
    fn look(&mut self, j: u32) -> u64 {
        let key = self.key(j as usize, self.coverage.parts(j as usize));
        self.bounds[j as usize] = key;
        key
    }

    /// Leaves out those of `chosen` who are superfluous, first those without whom least is lost, and of several the one
    /// who was chosen last. `covering` gives the others who cover something.
    pub fn spare<I: Iterator<Item = DeviceId>>(&mut self, chosen: &mut Vec<DeviceId>, covering: impl Fn() -> I) {
        loop {
            let lost = |j: DeviceId| self.coverage.lost(j.index());
            let is_spare = |j: DeviceId, parts: u32| self.key(j.index(), parts) == 0;
            let of = |(turn, &j): (usize, &DeviceId)| lost(j).filter(|&parts| is_spare(j, parts)).map(|p| (p, turn));
            let spare = chosen
                .iter()
                .enumerate()
                .rev()
                .filter_map(of)
                .min_by_key(|(parts, _)| *parts);
            let Some((_, turn)) = spare else { return };
            chosen.remove(turn);
            self.cover(covering().chain(chosen.iter().copied()));
        }
    }

    /// What is newly covered times the charge in sixths, and below it the number counted down: the largest key has the
    /// largest product, and among those the lowest number. 0 for a device that cannot report, covers nothing or has no
    /// advantage.
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
