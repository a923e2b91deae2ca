//! Choice of sensing devices under `q-learning`, from the rule in docs/q-learning.md: table values, batteries and plain
//! geometry.

use std::f64::consts::PI;

use reveille_bs::policy::q_learning::learned::{AREA_BUCKETS, BATTERY_BUCKETS, DutyTable};
use reveille_common::geometry::{Area, Point};
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::{DetectionKind, Sensing};
use reveille_common::units::Energy;

use super::age_index::ReferenceAgeIndex;
use super::clusters::distance;

/// Cells along the side of a block.
const BLOCK: usize = 4;

/// Deployment whose devices are chosen sequentially.
pub struct Sequential {
    sensing: Sensing,
    energy: EnergyModel,
    /// Rows and columns of cells.
    size: (usize, usize),
    /// Share of a cell that a device covers, by cell (row by row) and device.
    shares: Vec<Vec<f64>>,
    /// Cells in the order in which they are covered.
    order: Vec<usize>,
    /// Size of the area in sensing discs.
    discs: f64,
    window: usize,
    /// Devices that sensed in each TTI so far.
    past: Vec<Vec<usize>>,
}

impl Sequential {
    /// Creates the deployment of devices with the battery and costs of `energy` at `positions` of `area`. The
    /// devices must cover the area once in `window` TTIs.
    pub fn new(positions: &[Point], area: Area, sensing: &Sensing, energy: EnergyModel, window: usize) -> Self {
        let is_sure = sensing.kind == DetectionKind::Range;
        let fine = if is_sure { 15.0 } else { 10.0 };
        let count = |length: f64| (fine * length / sensing.d_max).ceil().max(1.0) as usize;
        let size = (count(area.height), count(area.width));
        let (height, width) = (area.height / size.0 as f64, area.width / size.1 as f64);
        let share = |cell: usize, p: Point| {
            let (row, column) = ((cell / size.1) as f64, (cell % size.1) as f64);
            let at = |up: f64, right: f64| Point::new((column + right) * width, (row + up) * height);
            if is_sure {
                let corners = [at(0.0, 0.0), at(0.0, 1.0), at(1.0, 0.0), at(1.0, 1.0)];
                let within = |corner: &Point| distance(*corner, p) <= sensing.d_max;
                return f64::from(u8::from(corners.iter().all(within)));
            }
            match distance(at(0.5, 0.5), p) {
                d if d <= sensing.d_max => libm::exp(-sensing.eta * d),
                _ => 0.0,
            }
        };
        let cells = size.0 * size.1;
        let reach = (sensing.d_max / width.max(height)).floor() as usize;
        Self {
            shares: (0..cells)
                .map(|cell| positions.iter().map(|&p| share(cell, p)).collect())
                .collect(),
            order: in_order(size, reach),
            sensing: sensing.clone(),
            energy,
            size,
            discs: area.width * area.height / (PI * sensing.d_max * sensing.d_max),
            window,
            past: Vec::new(),
        }
    }

    fn is_sure(&self) -> bool {
        self.sensing.kind == DetectionKind::Range
    }

    /// Returns the cells that `device` covers and `others` do not; 64ths of a cell with probabilistic detection.
    fn newly(&self, others: &[usize], device: usize) -> u32 {
        if others.contains(&device) {
            return 0;
        }
        if self.is_sure() {
            let is_new = |of: &&Vec<f64>| of[device] > 0.0 && others.iter().all(|&j| of[j] <= 0.0);
            return self.shares.iter().filter(is_new).count() as u32;
        }
        // A cell has 65535 shares. Each device takes its part of the remaining shares, in 65536ths and rounded down.
        let part = |share: f64| (share * 65536.0).round().min(65535.0) as u64;
        let newly = |of: &Vec<f64>| {
            let left = others.iter().fold(65535, |left, &j| left - left * part(of[j]) / 65536);
            left * part(of[device]) / 65536
        };
        let sum: u64 = self.shares.iter().map(newly).sum();
        (sum / 1024) as u32
    }

    /// Whether sensing has a higher value than sleep for a device with this charge and this newly covered area.
    fn is_worth_it(&self, advantages: &[Vec<f64>], battery: usize, parts: u32) -> bool {
        let all = (self.size.0 * self.size.1) as f64 * if self.is_sure() { 1.0 } else { 64.0 };
        let share = f64::from(parts) / all * self.discs;
        let edge = |bucket: u32| match bucket {
            0 => 0.0002,
            _ => 0.005 * 1.45_f64.powi(bucket.cast_signed() - 1),
        };
        let bucket = (0..AREA_BUCKETS as u32 - 1)
            .filter(|&bucket| share >= edge(bucket))
            .count();
        parts > 0 && battery >= 2 && advantages[battery][bucket] > 0.0
    }

    /// Chooses the sensing devices of the next TTI, in the order of numbers.
    pub fn choose(&mut self, table: &DutyTable, levels: &[Energy]) -> Vec<usize> {
        let advantages = advantages(table);
        let batteries: Vec<usize> = levels.iter().map(|&level| battery(&self.energy, level)).collect();
        let from = self.past.len().saturating_sub(self.window - 1);
        // Shares are rounded, so the order of devices matters; a device counts once.
        let mut before: Vec<usize> = Vec::new();
        for &j in self.past[from..].iter().flatten() {
            if !before.contains(&j) {
                before.push(j);
            }
        }
        let mut chosen: Vec<usize> = Vec::new();
        for least in [5, 2] {
            for &place in &self.order {
                loop {
                    let covering = [&before[..], &chosen].concat();
                    let is_covered = covering.iter().any(|&j| self.shares[place][j] > 0.0);
                    if is_covered && self.is_sure() {
                        break;
                    }
                    let mut best: Option<(u64, usize)> = None;
                    for (j, &battery) in batteries.iter().enumerate() {
                        let reaches = !self.is_sure() || self.shares[place][j] > 0.0;
                        if battery < least || !reaches {
                            continue;
                        }
                        let parts = self.newly(&covering, j);
                        let weighed = u64::from(parts) * (battery as u64 - 1);
                        let is_better = best.is_none_or(|(most, _)| weighed > most);
                        if self.is_worth_it(&advantages, battery, parts) && is_better {
                            best = Some((weighed, j));
                        }
                    }
                    let Some((_, j)) = best else { break };
                    chosen.push(j);
                }
                if !self.is_sure() {
                    // With probabilistic detection all places form one group.
                    break;
                }
            }
        }
        self.spare(&advantages, &batteries, &before, &mut chosen);
        let left = self.window.saturating_sub(self.past.len()).max(1);
        let mut plan: Vec<usize> = (0..chosen.len()).step_by(left).map(|turn| chosen[turn]).collect();
        self.past.push(plan.clone());
        plan.sort_unstable();
        plan
    }

    /// Removes devices that are not worth sensing given all others, the least useful first.
    fn spare(&self, advantages: &[Vec<f64>], batteries: &[usize], before: &[usize], chosen: &mut Vec<usize>) {
        while self.is_sure() {
            let mut least: Option<(u32, usize)> = None;
            for (turn, &j) in chosen.iter().enumerate() {
                let others_chosen = chosen.iter().copied().filter(|&other| other != j);
                let others: Vec<usize> = before.iter().copied().chain(others_chosen).collect();
                let parts = self.newly(&others, j);
                if !self.is_worth_it(advantages, batteries[j], parts) && least.is_none_or(|(few, _)| parts <= few) {
                    least = Some((parts, turn));
                }
            }
            let Some((_, turn)) = least else { return };
            chosen.remove(turn);
        }
    }
}

/// Returns the battery bucket: two buckets for levels too low to sense and report, then sixths.
fn battery(energy: &EnergyModel, level: Energy) -> usize {
    let EnergyModel {
        e_max, e_idle, e_tx, ..
    } = *energy;
    let needed = e_idle.micro() + e_tx.micro();
    if level.micro() < needed {
        return usize::from(level >= e_idle);
    }
    let sixths = (level.micro() - needed) * 6 / (e_max.micro() - needed);
    2 + sixths.min(5) as usize
}

/// Chooses the sensing devices by the ages of `places`, in order of number; `None` if too close to call. A device's
/// price is the lower edge of the first area bucket in which sensing has an advantage at its battery level.
pub fn choose_by_ages(
    places: &ReferenceAgeIndex,
    table: &DutyTable,
    energy: &EnergyModel,
    levels: &[Energy],
) -> Option<Vec<usize>> {
    let advantages = advantages(table);
    let first = |battery: usize| (0..AREA_BUCKETS as u32).find(|&bucket| advantages[battery][bucket as usize] > 0.0);
    let own = |battery: usize| match first(battery) {
        Some(0) => 1e-30,
        Some(1) => 0.0002 * places.disc(),
        Some(bucket) => 0.2 * 1.6_f64.powi(bucket.cast_signed() - 2) * places.disc(),
        None => f64::INFINITY,
    };
    let price = |battery: usize| (2..=battery).map(own).fold(f64::INFINITY, f64::min);
    let batteries: Vec<usize> = levels.iter().map(|&level| battery(energy, level)).collect();
    let mut chosen = Vec::new();
    for least in [5, 2] {
        let of = |(j, &battery): (usize, &usize)| {
            let may = battery >= least && !chosen.contains(&j);
            if may { price(battery) } else { f64::INFINITY }
        };
        let prices: Vec<f64> = batteries.iter().enumerate().map(of).collect();
        let more = places.choose_at(&prices, &chosen)?;
        chosen.extend(more);
    }
    chosen.sort_unstable();
    Some(chosen)
}

/// Returns the cells by block and, within a block, in ascending order of room. Room is the part in the area of the
/// square of side 2·d_max around a cell. The room of a block is the room of its middle cell. `reach` is d_max in cells.
fn in_order((rows, columns): (usize, usize), reach: usize) -> Vec<usize> {
    let side = |at: usize, count: usize| reach + reach.min(at).min(count - 1 - at);
    let room = |row: usize, column: usize| side(row, rows) * side(column, columns);
    let middle = |at: usize, count: usize| (at / BLOCK * BLOCK + BLOCK / 2).min(count - 1);
    let rank = |cell: &usize| {
        let (row, column) = (cell / columns, cell % columns);
        let of_block = room(middle(row, rows), middle(column, columns));
        (of_block, row / BLOCK, column / BLOCK, room(row, column), row, column)
    };
    let mut cells: Vec<usize> = (0..rows * columns).collect();
    cells.sort_by_key(rank);
    cells
}

/// Returns Q(s, 1) − Q(s, 0) by battery and area, made non-decreasing in the area with the max-min formula of isotonic
/// regression. Weights are 1 + the visits of the less tried action.
fn advantages(table: &DutyTable) -> Vec<Vec<f64>> {
    let of_battery = |battery: usize| {
        let of = |area: usize| {
            let [on, off] = [true, false].map(|delta| table.at(battery, area, delta));
            (on.value - off.value, 1.0 + f64::from(on.visits.min(off.visits)))
        };
        let raw: Vec<(f64, f64)> = (0..AREA_BUCKETS).map(of).collect();
        let mean = |from: usize, to: usize| {
            let weight: f64 = raw[from..=to].iter().map(|(_, weight)| weight).sum();
            raw[from..=to].iter().map(|(value, weight)| value * weight).sum::<f64>() / weight
        };
        let least_from =
            |from: usize, area: usize| (area..AREA_BUCKETS).map(|to| mean(from, to)).fold(f64::MAX, f64::min);
        let at = |area: usize| (0..=area).map(|from| least_from(from, area)).fold(f64::MIN, f64::max);
        (0..AREA_BUCKETS).map(at).collect()
    };
    (0..BATTERY_BUCKETS).map(of_battery).collect()
}
