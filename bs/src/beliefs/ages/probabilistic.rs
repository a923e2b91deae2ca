//! Mean ages where detection is probabilistic, or where the radio may lose reports. [`Ages`](super::Ages) documents the
//! methods and their preconditions. The order of float operations is fixed: the choice of devices, and so digests,
//! depend on the last bit of a gain.

use std::ops::Range;

use reveille_common::geometry::Point;

use super::cells::Cells;
use super::index_table::{MAX_AGE, worth_at_age};

/// Cells of one row in which a device may detect an event. Their entries in `ProbabilisticAges::detections` start
/// at `begin`.
#[derive(Clone, Debug)]
struct DetectionSpan {
    cells: Range<usize>,
    begin: usize,
}

/// Mean ages of all cells.
#[derive(Clone, Debug)]
pub(super) struct ProbabilisticAges {
    /// The spans of device j are `spans[span_starts[j] .. span_starts[j + 1]]`.
    span_starts: Vec<u32>,
    spans: Vec<DetectionSpan>,
    /// By cell of all spans, in order: the probability p that the device detects and reports an event there, and
    /// −ln(1 − p) in [`LOG_UNIT`]s.
    detections: Vec<(f64, u64)>,
    ages: Vec<f64>,
    /// Worth of the age of each cell; 0 outside the area.
    cell_worths: Vec<f64>,
    /// Sum of −ln(1 − p) over the chosen devices by cell, in [`LOG_UNIT`]s. Whole numbers allow exact removal of a
    /// device.
    negative_miss_logs: Vec<u64>,
    /// Probability by cell that no chosen device detects and reports an event there.
    miss_probabilities: Vec<f64>,
    /// Indices of the cells of the area.
    area_cells: Vec<usize>,
}

/// Unit of logarithms of probabilities.
const LOG_UNIT: f64 = 1.0 / (1_u64 << 32) as f64;
/// Logarithm that stands for certainty, at distance 0.
const LOG_CERTAINTY: f64 = 64.0;

impl ProbabilisticAges {
    /// Creates the ages. `report_probability` is the probability that an event at a distance, at most d_max, is
    /// detected and reported.
    pub(super) fn new(cells: &Cells, positions: &[Point], d_max: f64, report_probability: impl Fn(f64) -> f64) -> Self {
        let (mut span_starts, mut spans, mut detections) = (vec![0], Vec::new(), Vec::new());
        for &position in positions {
            for span in cells.within(position, d_max) {
                let cell = span.row * cells.stride() + span.first_column;
                spans.push(DetectionSpan {
                    cells: cell..cell + span.count,
                    begin: detections.len(),
                });
                let columns = span.first_column..span.first_column + span.count;
                detections.extend(columns.map(|column| {
                    let p = report_probability(cells.middle(span.row, column).distance(position));
                    (p, ((-libm::log1p(-p)).min(LOG_CERTAINTY) / LOG_UNIT) as u64)
                }));
            }
            span_starts.push(spans.len() as u32);
        }
        let mut ages = Self {
            span_starts,
            spans,
            detections,
            ages: vec![0.0; cells.len()],
            cell_worths: vec![0.0; cells.len()],
            negative_miss_logs: vec![0; cells.len()],
            miss_probabilities: vec![1.0; cells.len()],
            area_cells: cells.all().collect(),
        };
        // Before the first TTI every place has age 1, as after a reported event.
        ages.advance(true);
        ages
    }

    fn span_range(&self, j: usize) -> Range<usize> {
        self.span_starts[j] as usize..self.span_starts[j + 1] as usize
    }

    pub(super) fn gain(&self, j: usize) -> f64 {
        let mut sum = 0.0;
        for DetectionSpan { cells, begin } in &self.spans[self.span_range(j)] {
            let worths = &self.cell_worths[cells.clone()];
            let miss_probabilities = &self.miss_probabilities[cells.clone()];
            let weights = worths.iter().zip(miss_probabilities);
            for ((worth, miss_probability), (p, _)) in weights.zip(&self.detections[*begin..]) {
                sum += worth * miss_probability * p;
            }
        }
        sum
    }

    pub(super) fn uncovered_worth(&self) -> f64 {
        self.cell_worths
            .iter()
            .zip(&self.miss_probabilities)
            .map(|(worth, miss_probability)| worth * miss_probability)
            .sum()
    }

    pub(super) fn total_worth(&self) -> f64 {
        self.cell_worths.iter().sum()
    }

    pub(super) fn add(&mut self, j: usize) {
        self.update_misses(j, u64::saturating_add);
    }

    pub(super) fn remove(&mut self, j: usize) {
        self.update_misses(j, u64::saturating_sub);
    }

    /// Combines the logarithms of the `j`-th device with the sums, and recomputes the probabilities of a miss.
    fn update_misses(&mut self, j: usize, combine: impl Fn(u64, u64) -> u64) {
        for DetectionSpan { cells, begin } in &self.spans[self.span_range(j)] {
            let log_sums = &mut self.negative_miss_logs[cells.clone()];
            let misses = log_sums.iter_mut().zip(&mut self.miss_probabilities[cells.clone()]);
            for ((log_sum, miss_probability), (_, log)) in misses.zip(&self.detections[*begin..]) {
                *log_sum = combine(*log_sum, *log);
                *miss_probability = libm::exp(-(*log_sum as f64) * LOG_UNIT);
            }
        }
    }

    pub(super) fn clear(&mut self) {
        self.negative_miss_logs.fill(0);
        self.miss_probabilities.fill(1.0);
    }

    pub(super) fn advance(&mut self, is_event_reported: bool) {
        for &cell in &self.area_cells {
            let unseen_age = if is_event_reported {
                0.0
            } else {
                self.ages[cell] * self.miss_probabilities[cell]
            };
            self.ages[cell] = (unseen_age + 1.0).min(f64::from(MAX_AGE));
            self.cell_worths[cell] = worth_of(self.ages[cell]);
        }
        self.clear();
    }

    pub(super) fn age(&self, cell: usize) -> f64 {
        self.ages[cell]
    }
}

/// Returns the worth of `age`, by linear interpolation between whole ages.
fn worth_of(age: f64) -> f64 {
    // The next age must be one that exists too.
    let below = (age as u8).min(MAX_AGE - 1);
    let [low, high] = [below, below + 1].map(|age| f64::from(worth_at_age(age)));
    low + (age - f64::from(below)) * (high - low)
}
