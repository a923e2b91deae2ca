//! Ages where detection is probabilistic, or where the radio may lose reports.

use std::ops::Range;

use reveille_common::geometry::Point;

use super::cells::Cells;
use super::index_table::{AgeIndexTable, OLDEST};

/// Cells of one row in which a device may detect an event. Their entries in `ProbabilisticAges::detected` start at
/// `begin`.
#[derive(Clone, Debug)]
struct DetectionSpan {
    cells: Range<usize>,
    begin: usize,
}

/// Mean ages of all cells.
#[derive(Clone, Debug)]
pub(super) struct ProbabilisticAges {
    worths: AgeIndexTable,
    /// The spans of device j are `stretches[starts[j] .. starts[j + 1]]`.
    starts: Vec<u32>,
    stretches: Vec<DetectionSpan>,
    /// p(d) and −ln(1 − p(d)) of the cells of all spans, in order.
    detected: Vec<(f64, u64)>,
    ages: Vec<f64>,
    whole: Vec<f64>,
    /// Sum of −ln(1 − p(d)) over the chosen devices by cell, in [`UNIT`]s. Whole numbers allow exact removal of a
    /// device.
    doubts: Vec<u64>,
    /// Probability by cell that no chosen device detects an event there.
    missed: Vec<f64>,
    cells: Vec<usize>,
}

/// Unit of logarithms of probabilities.
const UNIT: f64 = 1.0 / (1_u64 << 32) as f64;
/// Logarithm that stands for certainty, at distance 0.
const SURE: f64 = 64.0;

impl ProbabilisticAges {
    /// Creates the ages. `heard` is the probability that an event at a distance, at most d_max, is detected and
    /// reported.
    pub(super) fn new(
        cells: &Cells,
        positions: &[Point],
        d_max: f64,
        heard: impl Fn(f64) -> f64,
        worths: AgeIndexTable,
    ) -> Self {
        let (mut starts, mut stretches, mut detected) = (vec![0], Vec::new(), Vec::new());
        for &p in positions {
            for stretch in cells.within(p, d_max) {
                let cell = stretch.row * cells.stride() + stretch.first;
                stretches.push(DetectionSpan {
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
        // Before the first TTI every place has age 1, as after a reported event.
        chance.advance(true);
        chance
    }

    fn stretches(&self, j: usize) -> Range<usize> {
        self.starts[j] as usize..self.starts[j + 1] as usize
    }

    pub(super) fn gain(&self, j: usize) -> f64 {
        let mut sum = 0.0;
        for DetectionSpan { cells, begin } in &self.stretches[self.stretches(j)] {
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
        for DetectionSpan { cells, begin } in &self.stretches[self.stretches(j)] {
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

    pub(super) fn advance(&mut self, is_found: bool) {
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

    /// Returns the worth of an age, by linear interpolation between whole ages.
    fn worth_of(&self, age: f64) -> f64 {
        // The table must also hold the next age.
        let below = (age as usize).min(OLDEST - 1);
        let [low, high] = [below, below + 1].map(|age| f64::from(self.worths[age]));
        low + (age - below as f64) * (high - low)
    }

    pub(super) fn age(&self, cell: usize) -> f64 {
        self.ages[cell]
    }
}
