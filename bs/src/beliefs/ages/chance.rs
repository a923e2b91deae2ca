//! Ages where a device in S1 detects an event by chance, or is heard by chance.

use std::ops::Range;

use reveille_common::geometry::Point;

use super::cells::Cells;
use super::worths::{OLDEST, Worths};

/// Cells of one row that a device may detect an event in: as many of `Chance::detected` from `begin` on as there are in
/// `cells`.
#[derive(Clone, Debug)]
struct Stretch {
    cells: Range<usize>,
    begin: usize,
}

/// Mean ages.
#[derive(Clone, Debug)]
pub(super) struct Chance {
    worths: Worths,
    /// The stretches of device j are `stretches[starts[j] .. starts[j + 1]]`.
    starts: Vec<u32>,
    stretches: Vec<Stretch>,
    /// p(d) of all cells of all stretches, one after the other, and −ln(1 − p(d)).
    detected: Vec<(f64, u64)>,
    ages: Vec<f64>,
    whole: Vec<f64>,
    /// By cell, the sum of −ln(1 − p(d)) of those chosen in [`UNIT`]s: whole numbers, so that one can be taken back.
    doubts: Vec<u64>,
    /// The probability that none of those chosen detects an event in a cell.
    missed: Vec<f64>,
    cells: Vec<usize>,
}

/// Of logarithms of probabilities.
const UNIT: f64 = 1.0 / (1_u64 << 32) as f64;
/// The logarithm that stands for certainty, at distance 0.
const SURE: f64 = 64.0;

impl Chance {
    /// `heard` is the probability that an event at some distance, at most d_max, is detected and heard of.
    pub(super) fn new(
        cells: &Cells,
        positions: &[Point],
        d_max: f64,
        heard: impl Fn(f64) -> f64,
        worths: Worths,
    ) -> Self {
        let (mut starts, mut stretches, mut detected) = (vec![0], Vec::new(), Vec::new());
        for &p in positions {
            for stretch in cells.within(p, d_max) {
                let cell = stretch.row * cells.stride() + stretch.first;
                stretches.push(Stretch {
                    cells: cell..cell + stretch.count,
                    begin: detected.len(),
                });
                let columns = stretch.first..stretch.first + stretch.count;
                detected.extend(columns.map(|column| {
                    let p = heard(cells.middle(stretch.row, column).distance(p));
                    (p, ((-libm::log1p(-p)).min(SURE) / UNIT) as u64)
                }));
            }
            starts.push(stretches.len() as u32);
        }
        let mut chance = Self {
            worths,
            starts,
            stretches,
            detected,
            ages: vec![0.0; cells.len()],
            whole: vec![0.0; cells.len()],
            doubts: vec![0; cells.len()],
            missed: vec![1.0; cells.len()],
            cells: cells.all().collect(),
        };
        chance.pass(true);
        chance
    }

    fn stretches(&self, j: usize) -> Range<usize> {
        self.starts[j] as usize..self.starts[j + 1] as usize
    }

    pub(super) fn worth(&self, j: usize) -> f64 {
        let mut sum = 0.0;
        for Stretch { cells, begin } in &self.stretches[self.stretches(j)] {
            let (whole, missed) = (&self.whole[cells.clone()], &self.missed[cells.clone()]);
            for ((whole, missed), (p, _)) in whole.iter().zip(missed).zip(&self.detected[*begin..]) {
                sum += whole * missed * p;
            }
        }
        sum
    }

    pub(super) fn left(&self) -> f64 {
        self.whole
            .iter()
            .zip(&self.missed)
            .map(|(whole, missed)| whole * missed)
            .sum()
    }

    pub(super) fn all(&self) -> f64 {
        self.whole.iter().sum()
    }

    pub(super) fn add(&mut self, j: usize) {
        self.change(j, u64::saturating_add);
    }

    pub(super) fn remove(&mut self, j: usize) {
        self.change(j, u64::saturating_sub);
    }

    fn change(&mut self, j: usize, by: impl Fn(u64, u64) -> u64) {
        for Stretch { cells, begin } in &self.stretches[self.stretches(j)] {
            let (doubts, missed) = (&mut self.doubts[cells.clone()], &mut self.missed[cells.clone()]);
            for ((doubt, missed), (_, one)) in doubts.iter_mut().zip(missed).zip(&self.detected[*begin..]) {
                *doubt = by(*doubt, *one);
                *missed = libm::exp(-(*doubt as f64) * UNIT);
            }
        }
    }

    pub(super) fn clear(&mut self) {
        self.doubts.fill(0);
        self.missed.fill(1.0);
    }

    pub(super) fn pass(&mut self, is_found: bool) {
        for &cell in &self.cells {
            let old = if is_found {
                0.0
            } else {
                self.ages[cell] * self.missed[cell]
            };
            self.ages[cell] = (old + 1.0).min(OLDEST as f64);
            self.whole[cell] = self.worth_of(self.ages[cell]);
        }
        self.clear();
    }

    /// Between whole ages the worth rises evenly.
    fn worth_of(&self, age: f64) -> f64 {
        let below = (age as usize).min(OLDEST - 1);
        let [low, high] = [below, below + 1].map(|age| f64::from(self.worths[age]));
        low + (age - below as f64) * (high - low)
    }

    pub(super) fn age(&self, cell: usize) -> f64 {
        self.ages[cell]
    }
}
