//! Coverage where detection is probabilistic: the uncovered share of each cell. [`Coverage`](super::Coverage) and
//! [`CoverageUnion`](super::CoverageUnion) both use it. Each device rounds down, so the order of additions is part of
//! the result.

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
    uncovered: Vec<u16>,
    cell_count: usize,
    /// The rows of device j are `rows[row_starts[j] .. row_starts[j + 1]]`.
    row_starts: Vec<u32>,
    rows: Vec<CellSpan>,
    /// p(d) of the cells of all spans, in order, in 65536ths.
    detected: Vec<u16>,
}

/// Cells of one grid row in which a device may detect an event, padded to a multiple of [`LANES`] with cells of p(d) =
/// 0.
#[derive(Clone, Copy, Debug)]
struct CellSpan {
    /// Index of the first cell.
    first_cell: u32,
    /// Index of its p(d) in `UncoveredShares::detected`.
    first_detected: u32,
    length: u32,
}

impl CellSpan {
    fn cells(self) -> std::ops::Range<usize> {
        self.first_cell as usize..(self.first_cell + self.length) as usize
    }

    fn detected(self) -> std::ops::Range<usize> {
        self.first_detected as usize..(self.first_detected + self.length) as usize
    }
}

/// Returns the quanta that a device newly covers in a cell with `uncovered` quanta, rounded down. The device detects an
/// event in the cell with probability `detected`/65536.
#[inline]
const fn newly_covered(uncovered: u16, detected: u16) -> u16 {
    ((uncovered as u32 * detected as u32) >> 16) as u16
}

impl UncoveredShares {
    pub(super) fn new(raster: &Raster, positions: &[Point], sensing: &Sensing) -> Self {
        let (mut row_starts, mut rows, mut detected) = (vec![0], Vec::new(), Vec::new());
        for &p in positions {
            let [south_to_north, west_to_east] = raster.disc_bounds(p, sensing.d_max);
            for row in south_to_north {
                let begin = detected.len();
                let mut first = None;
                // The cells of a row that are near enough are adjacent.
                for column in west_to_east.clone() {
                    let (_, distance) = raster.cell_distances(row, column, p);
                    if distance <= sensing.d_max {
                        first = first.or(Some(column));
                        // p = 1 would be 65536, which does not fit.
                        detected.push((sensing.p(distance) * 65536.0).round().min(f64::from(u16::MAX)) as u16);
                    }
                }
                let length = (detected.len() - begin).next_multiple_of(LANES);
                detected.resize(begin + length, 0);
                rows.extend(first.map(|column| CellSpan {
                    first_cell: (row * raster.columns + column) as u32,
                    first_detected: begin as u32,
                    length: length as u32,
                }));
            }
            row_starts.push(rows.len() as u32);
        }
        Self {
            uncovered: vec![QUANTA_PER_CELL; raster.cell_count() + LANES],
            cell_count: raster.cell_count(),
            row_starts,
            rows,
            detected,
        }
    }

    pub(super) fn clear(&mut self) {
        self.uncovered.fill(QUANTA_PER_CELL);
    }

    /// Returns the uncovered area in quanta.
    pub(super) fn uncovered(&self) -> u64 {
        self.uncovered[..self.cell_count]
            .iter()
            .map(|&quanta| u64::from(quanta))
            .sum()
    }

    /// Returns the area that the `j`-th device would newly cover, in quanta.
    pub(super) fn gain(&self, j: usize) -> u64 {
        let mut lanes = [0; LANES];
        for row in &self.rows[self.row_starts[j] as usize..self.row_starts[j + 1] as usize] {
            let (uncovered, _) = self.uncovered[row.cells()].as_chunks::<LANES>();
            let (detected, _) = self.detected[row.detected()].as_chunks::<LANES>();
            for (uncovered, detected) in uncovered.iter().zip(detected) {
                for lane in 0..LANES {
                    lanes[lane] += u32::from(newly_covered(uncovered[lane], detected[lane]));
                }
            }
        }
        lanes.into_iter().map(u64::from).sum()
    }

    /// Adds a device that was not added before.
    pub(super) fn add(&mut self, j: usize) {
        for row in &self.rows[self.row_starts[j] as usize..self.row_starts[j + 1] as usize] {
            let uncovered = &mut self.uncovered[row.cells()];
            for (uncovered, &detected) in uncovered.iter_mut().zip(&self.detected[row.detected()]) {
                // No underflow: `detected` is below 2¹⁶, so the product shifted by 16 bits is at most `uncovered`.
                *uncovered -= newly_covered(*uncovered, detected);
            }
        }
    }
}
