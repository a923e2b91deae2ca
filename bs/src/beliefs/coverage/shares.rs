//! Coverage where detection is probabilistic: the uncovered share of each cell. [`Coverage`](super::Coverage) and
//! [`CoverageUnion`](super::CoverageUnion) both use it. Each device rounds down, so the order of additions is part of
//! the result, and so of digests, rewards and learned tables.

use reveille_common::geometry::Point;
use reveille_common::sensing::Sensing;

use crate::beliefs::grid::Raster;

/// Cells computed in parallel.
const LANES: usize = 8;

/// Number of quanta, equal small parts, in a cell. Covered and uncovered shares are whole numbers of quanta, so they
/// add up exactly.
pub(super) const QUANTA_PER_CELL: u16 = u16::MAX;

/// The uncovered share of each cell.
#[derive(Clone, Debug)]
pub(super) struct UncoveredShares {
    /// Uncovered quanta of each cell, row by row, followed by padding for the last spans.
    quanta_by_cell: Vec<u16>,
    cell_count: usize,
    /// The spans of device j are `spans[span_starts[j] .. span_starts[j + 1]]`.
    span_starts: Vec<u32>,
    spans: Vec<PaddedSpan>,
    /// p(d) of the cells of all spans, in order, in 65536ths.
    probabilities: Vec<u16>,
}

/// Cells of one grid row in which a device may detect an event, padded to a multiple of [`LANES`] with cells of p(d) =
/// 0.
#[derive(Clone, Copy, Debug)]
struct PaddedSpan {
    /// Index of the first cell.
    first_cell: u32,
    /// Index of its p(d) in `UncoveredShares::probabilities`.
    first_probability: u32,
    length: u32,
}

impl PaddedSpan {
    fn cells(self) -> std::ops::Range<usize> {
        self.first_cell as usize..(self.first_cell + self.length) as usize
    }

    fn probabilities(self) -> std::ops::Range<usize> {
        self.first_probability as usize..(self.first_probability + self.length) as usize
    }
}

/// Returns the quanta that a device newly covers in a cell with `uncovered` quanta, rounded down. The device detects an
/// event in the cell with probability `probability`/65536.
#[inline]
const fn newly_covered(uncovered: u16, probability: u16) -> u16 {
    ((uncovered as u32 * probability as u32) >> 16) as u16
}

impl UncoveredShares {
    pub(super) fn new(raster: &Raster, positions: &[Point], sensing: &Sensing) -> Self {
        let (mut span_starts, mut spans, mut probabilities) = (vec![0], Vec::new(), Vec::new());
        for &position in positions {
            let [south_to_north, west_to_east] = raster.disc_bounds(position, sensing.d_max);
            for row in south_to_north {
                let begin = probabilities.len();
                let mut first = None;
                // The cells of a row that are near enough are adjacent.
                for column in west_to_east.clone() {
                    let (_, distance) = raster.cell_distances(row, column, position);
                    if distance <= sensing.d_max {
                        first = first.or(Some(column));
                        // p(0) = 1 would be 65536, which does not fit.
                        probabilities.push((sensing.p(distance) * 65536.0).round().min(f64::from(u16::MAX)) as u16);
                    }
                }
                let length = (probabilities.len() - begin).next_multiple_of(LANES);
                probabilities.resize(begin + length, 0);
                spans.extend(first.map(|column| PaddedSpan {
                    first_cell: (row * raster.columns + column) as u32,
                    first_probability: begin as u32,
                    length: length as u32,
                }));
            }
            span_starts.push(spans.len() as u32);
        }
        Self {
            quanta_by_cell: vec![QUANTA_PER_CELL; raster.cell_count() + LANES],
            cell_count: raster.cell_count(),
            span_starts,
            spans,
            probabilities,
        }
    }

    pub(super) fn clear(&mut self) {
        self.quanta_by_cell.fill(QUANTA_PER_CELL);
    }

    /// Returns the uncovered area in quanta.
    pub(super) fn uncovered_quanta(&self) -> u64 {
        self.quanta_by_cell[..self.cell_count]
            .iter()
            .map(|&quanta| u64::from(quanta))
            .sum()
    }

    fn span_range(&self, j: usize) -> std::ops::Range<usize> {
        self.span_starts[j] as usize..self.span_starts[j + 1] as usize
    }

    /// Returns the area that the `j`-th device would newly cover, in quanta.
    pub(super) fn gain(&self, j: usize) -> u64 {
        let mut sums = [0; LANES];
        for span in &self.spans[self.span_range(j)] {
            let (quanta_chunks, _) = self.quanta_by_cell[span.cells()].as_chunks::<LANES>();
            let (probability_chunks, _) = self.probabilities[span.probabilities()].as_chunks::<LANES>();
            for (quanta, probabilities) in quanta_chunks.iter().zip(probability_chunks) {
                for lane in 0..LANES {
                    sums[lane] += u32::from(newly_covered(quanta[lane], probabilities[lane]));
                }
            }
        }
        sums.into_iter().map(u64::from).sum()
    }

    /// Adds a device that was not added before.
    pub(super) fn add(&mut self, j: usize) {
        for span in &self.spans[self.span_range(j)] {
            let cells = self.quanta_by_cell[span.cells()].iter_mut();
            for (uncovered, &probability) in cells.zip(&self.probabilities[span.probabilities()]) {
                // No underflow: `probability` is below 2¹⁶, so the product shifted by 16 bits is at most `uncovered`.
                *uncovered -= newly_covered(*uncovered, probability);
            }
        }
    }
}
