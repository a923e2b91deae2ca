//! Choice of sensing devices under `q-learning`, from the rule in docs/q-learning.md: table values, batteries and plain
//! geometry. The edges of buckets are the edges in `bs/src/policy/q_learning/learned/tables.rs`, and the numbers of
//! cells are the numbers in `bs/src/beliefs/coverage/`. `tests/tests/q_learning.rs` compares both.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use std::f64::consts::PI;

use reveille_bs::policy::q_learning::learned::{AREA_BUCKETS, BATTERY_BUCKETS, DutyTable};
use reveille_common::geometry::{Area, Point};
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::{DetectionKind, Sensing};
use reveille_common::units::Energy;

use super::age_index::ReferenceAgeIndex;
use super::clusters::distance;

/// Cells along the side of a block.
const BLOCK_SIDE: usize = 4;
/// First battery bucket in which a device can pay for a TTI in S1 and a report.
const FIRST_ABLE_BUCKET: usize = 2;
/// Least battery bucket of a sensing device in each round of the choice: at least half charged, then any able device.
const MIN_BATTERY_BUCKETS: [usize; 2] = [5, FIRST_ABLE_BUCKET];

/// Second implementation of the choice with a look-back window. Devices have equal batteries and costs.
pub struct ReferenceDutySelector {
    sensing: Sensing,
    energy: EnergyModel,
    /// Rows and columns of cells.
    cell_counts: (usize, usize),
    /// Share of a cell that a device covers, by cell (row by row) and device.
    shares: Vec<Vec<f64>>,
    /// Cells in the order in which they are covered.
    cover_order: Vec<usize>,
    /// Size of the area in sensing discs.
    area_in_discs: f64,
    /// Number of TTIs in which the devices must cover the area once.
    window: usize,
    /// Devices that sensed in each TTI so far, in order of choice.
    past_choices: Vec<Vec<usize>>,
}

impl ReferenceDutySelector {
    /// Creates the selector for devices with the battery and costs of `energy` at `positions` of `area`. `window` is at
    /// least 1.
    pub fn new(positions: &[Point], area: Area, sensing: &Sensing, energy: EnergyModel, window: usize) -> Self {
        let is_certain = sensing.kind == DetectionKind::Range;
        let cells_per_d_max = if is_certain { 15.0 } else { 10.0 };
        let cell_count = |length: f64| (cells_per_d_max * length / sensing.d_max).ceil().max(1.0) as usize;
        let cell_counts = (cell_count(area.height), cell_count(area.width));
        let (height, width) = (area.height / cell_counts.0 as f64, area.width / cell_counts.1 as f64);
        let share_in_range = |cell: usize, device: Point| {
            let (row, column) = ((cell / cell_counts.1) as f64, (cell % cell_counts.1) as f64);
            let point_in_cell = |up: f64, right: f64| Point::new((column + right) * width, (row + up) * height);
            if is_certain {
                let corners =
                    [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)].map(|(up, right)| point_in_cell(up, right));
                let is_in_range = |corner: &Point| distance(*corner, device) <= sensing.d_max;
                return f64::from(u8::from(corners.iter().all(is_in_range)));
            }
            match distance(point_in_cell(0.5, 0.5), device) {
                d if d <= sensing.d_max => libm::exp(-sensing.eta * d),
                _ => 0.0,
            }
        };
        let cells = cell_counts.0 * cell_counts.1;
        let d_max_in_cells = (sensing.d_max / width.max(height)).floor() as usize;
        Self {
            shares: (0..cells)
                .map(|cell| positions.iter().map(|&p| share_in_range(cell, p)).collect())
                .collect(),
            cover_order: cover_order(cell_counts, d_max_in_cells),
            sensing: sensing.clone(),
            energy,
            cell_counts,
            area_in_discs: area.width * area.height / (PI * sensing.d_max * sensing.d_max),
            window,
            past_choices: Vec::new(),
        }
    }

    /// Whether a device detects every event within d_max.
    fn is_certain(&self) -> bool {
        self.sensing.kind == DetectionKind::Range
    }

    /// Returns the cells that `device` covers and `others` do not; 64ths of a cell with probabilistic detection.
    fn newly_covered(&self, others: &[usize], device: usize) -> u32 {
        if others.contains(&device) {
            return 0;
        }
        if self.is_certain() {
            let is_new = |cell: &&Vec<f64>| cell[device] > 0.0 && others.iter().all(|&j| cell[j] <= 0.0);
            return self.shares.iter().filter(is_new).count() as u32;
        }
        // A cell has 65535 units. Each device takes its part of the remaining units, in 65536ths and rounded down.
        let part = |share: f64| (share * 65536.0).round().min(65535.0) as u64;
        let newly_covered = |cell: &Vec<f64>| {
            let remaining = others
                .iter()
                .fold(65535, |remaining, &j| remaining - remaining * part(cell[j]) / 65536);
            remaining * part(cell[device]) / 65536
        };
        let sum: u64 = self.shares.iter().map(newly_covered).sum();
        // 1024 of 65536 units are a 64th of a cell.
        (sum / 1024) as u32
    }

    /// Whether sensing has a higher value than sleep for a device in this battery bucket with this newly covered area,
    /// in the unit of [`Self::newly_covered`].
    fn is_worth_sensing(&self, advantages: &[Vec<f64>], battery: usize, newly_covered: u32) -> bool {
        let whole_area = (self.cell_counts.0 * self.cell_counts.1) as f64 * if self.is_certain() { 1.0 } else { 64.0 };
        let discs = f64::from(newly_covered) / whole_area * self.area_in_discs;
        let upper_edge = |bucket: u32| match bucket {
            0 => 0.0002,
            _ => 0.005 * 1.45_f64.powi(bucket.cast_signed() - 1),
        };
        let bucket = (0..AREA_BUCKETS as u32 - 1)
            .filter(|&bucket| discs >= upper_edge(bucket))
            .count();
        newly_covered > 0 && battery >= FIRST_ABLE_BUCKET && advantages[battery][bucket] > 0.0
    }

    /// Chooses the sensing devices of the next TTI, in the order of numbers. Call once for each TTI, in order.
    pub fn choose(&mut self, table: &DutyTable, levels: &[Energy]) -> Vec<usize> {
        let advantages = monotone_advantages(table);
        let batteries: Vec<usize> = levels
            .iter()
            .map(|&level| battery_bucket(&self.energy, level))
            .collect();
        let window_start = self.past_choices.len().saturating_sub(self.window - 1);
        // Shares are rounded, so the order of devices matters; a device counts once.
        let mut sensed_before: Vec<usize> = Vec::new();
        for &j in self.past_choices[window_start..].iter().flatten() {
            if !sensed_before.contains(&j) {
                sensed_before.push(j);
            }
        }
        let mut chosen: Vec<usize> = Vec::new();
        for min_bucket in MIN_BATTERY_BUCKETS {
            for &cell in &self.cover_order {
                loop {
                    let covering = [&sensed_before[..], &chosen].concat();
                    let is_covered = covering.iter().any(|&j| self.shares[cell][j] > 0.0);
                    if is_covered && self.is_certain() {
                        break;
                    }
                    let mut best: Option<(u64, usize)> = None;
                    for (j, &battery) in batteries.iter().enumerate() {
                        let covers_cell = !self.is_certain() || self.shares[cell][j] > 0.0;
                        if battery < min_bucket || !covers_cell {
                            continue;
                        }
                        let newly_covered = self.newly_covered(&covering, j);
                        let weight = u64::from(newly_covered) * (battery as u64 - 1);
                        let is_better = best.is_none_or(|(largest, _)| weight > largest);
                        if self.is_worth_sensing(&advantages, battery, newly_covered) && is_better {
                            best = Some((weight, j));
                        }
                    }
                    let Some((_, j)) = best else { break };
                    chosen.push(j);
                }
                if !self.is_certain() {
                    // With probabilistic detection all cells form one group.
                    break;
                }
            }
        }
        self.remove_superfluous(&advantages, &batteries, &sensed_before, &mut chosen);
        // In its first TTIs the run fills the window gradually.
        let missing_ttis = self.window.saturating_sub(self.past_choices.len()).max(1);
        let mut plan: Vec<usize> = chosen.iter().copied().step_by(missing_ttis).collect();
        self.past_choices.push(plan.clone());
        plan.sort_unstable();
        plan
    }

    /// Removes devices that are not worth sensing given all others, the least useful first. With probabilistic
    /// detection none is removed.
    fn remove_superfluous(
        &self,
        advantages: &[Vec<f64>],
        batteries: &[usize],
        sensed_before: &[usize],
        chosen: &mut Vec<usize>,
    ) {
        while self.is_certain() {
            let mut least_useful: Option<(u32, usize)> = None;
            for (rank, &j) in chosen.iter().enumerate() {
                let others_chosen = chosen.iter().copied().filter(|&other| other != j);
                let others: Vec<usize> = sensed_before.iter().copied().chain(others_chosen).collect();
                let newly_covered = self.newly_covered(&others, j);
                let is_less_useful = least_useful.is_none_or(|(least, _)| newly_covered <= least);
                if !self.is_worth_sensing(advantages, batteries[j], newly_covered) && is_less_useful {
                    least_useful = Some((newly_covered, rank));
                }
            }
            let Some((_, rank)) = least_useful else { return };
            chosen.remove(rank);
        }
    }
}

/// Returns the battery bucket: two buckets for levels too low to sense and report, then sixths.
fn battery_bucket(energy: &EnergyModel, level: Energy) -> usize {
    let EnergyModel {
        e_max, e_idle, e_tx, ..
    } = *energy;
    let needed = e_idle.micro() + e_tx.micro();
    if level.micro() < needed {
        return usize::from(level >= e_idle);
    }
    let sixths = (level.micro() - needed) * 6 / (e_max.micro() - needed);
    FIRST_ABLE_BUCKET + sixths.min(5) as usize
}

/// Chooses the sensing devices by the ages of `places`, in order of number; `None` if too close to call. A device's
/// price is the lower edge of the first area bucket in which sensing has an advantage at its battery level; the price
/// of `places` has no effect. The caller advances `places` afterwards.
pub fn choose_by_ages(
    places: &ReferenceAgeIndex,
    table: &DutyTable,
    energy: &EnergyModel,
    levels: &[Energy],
) -> Option<Vec<usize>> {
    let advantages = monotone_advantages(table);
    let first_bucket =
        |battery: usize| (0..AREA_BUCKETS as u32).find(|&bucket| advantages[battery][bucket as usize] > 0.0);
    let lower_edge = |battery: usize| match first_bucket(battery) {
        // Stands for a price of 0, like `MIN_PRICE` in `age_index.rs`.
        Some(0) => 1e-30,
        Some(1) => 0.0002 * places.places_per_disc(),
        Some(bucket) => 0.2 * 1.6_f64.powi(bucket.cast_signed() - 2) * places.places_per_disc(),
        None => f64::INFINITY,
    };
    // A fuller battery never has a higher price.
    let price = |battery: usize| {
        (FIRST_ABLE_BUCKET..=battery)
            .map(lower_edge)
            .fold(f64::INFINITY, f64::min)
    };
    let batteries: Vec<usize> = levels.iter().map(|&level| battery_bucket(energy, level)).collect();
    let mut chosen = Vec::new();
    for min_bucket in MIN_BATTERY_BUCKETS {
        let price_of = |(j, &battery): (usize, &usize)| {
            let may_sense = battery >= min_bucket && !chosen.contains(&j);
            if may_sense { price(battery) } else { f64::INFINITY }
        };
        let prices: Vec<f64> = batteries.iter().enumerate().map(price_of).collect();
        let additional = places.choose_at_prices(&prices, &chosen)?;
        chosen.extend(additional);
    }
    chosen.sort_unstable();
    Some(chosen)
}

/// Returns all cells in the order in which they are covered: square blocks of cells in ascending order of the room of
/// their middle cells, and the cells of a block in ascending order of their own room. The room of a cell is the part of
/// a square of side 2·d_max around it that lies in the area.
fn cover_order((rows, columns): (usize, usize), d_max_in_cells: usize) -> Vec<usize> {
    let room_along = |index: usize, count: usize| d_max_in_cells + d_max_in_cells.min(index).min(count - 1 - index);
    let room = |row: usize, column: usize| room_along(row, rows) * room_along(column, columns);
    let block_middle = |index: usize, count: usize| (index / BLOCK_SIDE * BLOCK_SIDE + BLOCK_SIDE / 2).min(count - 1);
    let rank = |cell: &usize| {
        let (row, column) = (cell / columns, cell % columns);
        let block_room = room(block_middle(row, rows), block_middle(column, columns));
        (
            block_room,
            row / BLOCK_SIDE,
            column / BLOCK_SIDE,
            room(row, column),
            row,
            column,
        )
    };
    let mut cells: Vec<usize> = (0..rows * columns).collect();
    cells.sort_by_key(rank);
    cells
}

/// Returns Q(s, 1) − Q(s, 0) by battery and area bucket, made non-decreasing in the area with the max-min formula of
/// isotonic regression. Weights are 1 + the visits of the less tried action.
fn monotone_advantages(table: &DutyTable) -> Vec<Vec<f64>> {
    let advantages_at = |battery: usize| {
        let advantage_and_weight = |bucket: usize| {
            let [on, off] = [true, false].map(|delta| table.at(battery, bucket, delta));
            (on.value - off.value, 1.0 + f64::from(on.visits.min(off.visits)))
        };
        let raw: Vec<(f64, f64)> = (0..AREA_BUCKETS).map(advantage_and_weight).collect();
        let mean = |from: usize, to: usize| {
            let weight: f64 = raw[from..=to].iter().map(|(_, weight)| weight).sum();
            raw[from..=to].iter().map(|(value, weight)| value * weight).sum::<f64>() / weight
        };
        let least_mean = |from: usize, bucket: usize| {
            let means = (bucket..AREA_BUCKETS).map(|to| mean(from, to));
            means.fold(f64::MAX, f64::min)
        };
        let max_min = |bucket: usize| {
            let minima = (0..=bucket).map(|from| least_mean(from, bucket));
            minima.fold(f64::MIN, f64::max)
        };
        (0..AREA_BUCKETS).map(max_min).collect()
    };
    (0..BATTERY_BUCKETS).map(advantages_at).collect()
}
