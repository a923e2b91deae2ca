//! Coverage where detection is probabilistic: the uncovered share of each cell.

use reveille_common::geometry::Point;
use reveille_common::sensing::Sensing;

use crate::beliefs::grid::Raster;

/// Cells computed in parallel.
const LANES: usize = 8;

/// A whole cell, in shares of 1/65535. Whole numbers make the covered shares add up exactly.
pub(super) const CELL: u16 = u16::MAX;

/// The uncovered share of each cell.
#[derive(Clone, Debug)]
pub(super) struct UncoveredShares {
    /// Shares of all cells, row by row, followed by padding for the last spans.
    missed: Vec<u16>,
    cells: usize,
    /// The rows of device j are `rows[starts[j] .. starts[j + 1]]`.
    starts: Vec<u32>,
    rows: Vec<ShareSpan>,
    /// p(d) of the cells of all spans, in order, in 65536ths.
    detected: Vec<u16>,
}

/// Cells of one grid row in which a device may detect an event, padded to a multiple of [`LANES`] with cells of p(d) =
/// 0.
#[derive(Clone, Copy, Debug)]
struct ShareSpan {
    /// Index of the first cell, and of its p(d).
    cell: u32,
    detected: u32,
    length: u32,
}

impl ShareSpan {
    fn cells(self) -> std::ops::Range<usize> {
        self.cell as usize..(self.cell + self.length) as usize
    }

    fn detected(self) -> std::ops::Range<usize> {
        self.detected as usize..(self.detected + self.length) as usize
    }
}

/// Returns the part of the share `missed` that a device with detection probability `detected` covers, rounded down.
#[inline]
const fn covered(missed: u16, detected: u16) -> u16 {
    ((missed as u32 * detected as u32) >> 16) as u16
}

impl UncoveredShares {
    pub(super) fn new(raster: &Raster, positions: &[Point], sensing: &Sensing) -> Self {
        let (mut starts, mut rows, mut detected) = (vec![0], Vec::new(), Vec::new());
        for &p in positions {
            let [south_to_north, west_to_east] = raster.around(p, sensing.d_max);
            for row in south_to_north {
                let begin = detected.len();
                let mut first = None;
                // The cells of a row that are near enough are adjacent.
                for column in west_to_east.clone() {
                    let (_, middle) = raster.distances(row, column, p);
                    if middle <= sensing.d_max {
                        first = first.or(Some(column));
                        // p = 1 would be 65536, which does not fit.
                        detected.push((sensing.p(middle) * 65536.0).round().min(f64::from(u16::MAX)) as u16);
                    }
                }
                let length = (detected.len() - begin).next_multiple_of(LANES);
                detected.resize(begin + length, 0);
                rows.extend(first.map(|column| ShareSpan {
                    cell: (row * raster.columns + column) as u32,
                    detected: begin as u32,
                    length: length as u32,
                }));
            }
            starts.push(rows.len() as u32);
        }
        Self {
            missed: vec![CELL; raster.cells() + LANES],
            cells: raster.cells(),
            starts,
            rows,
            detected,
        }
    }

    pub(super) fn clear(&mut self) {
        self.missed.fill(CELL);
    }

    /// Returns the uncovered area, in 65535ths of a cell.
    pub(super) fn uncovered(&self) -> u64 {
        self.missed[..self.cells].iter().map(|&missed| u64::from(missed)).sum()
    }

    /// Returns the area that the `j`-th device would newly cover, in 65535ths of a cell.
    pub(super) fn gain(&self, j: usize) -> u64 {
        let mut lanes = [0; LANES];
        for row in &self.rows[self.starts[j] as usize..self.starts[j + 1] as usize] {
            let (missed, _) = self.missed[row.cells()].as_chunks::<LANES>();
            let (detected, _) = self.detected[row.detected()].as_chunks::<LANES>();
            for (missed, detected) in missed.iter().zip(detected) {
                for lane in 0..LANES {
                    lanes[lane] += u32::from(covered(missed[lane], detected[lane]));
                }
            }
        }
        lanes.into_iter().map(u64::from).sum()
    }

    pub(super) fn add(&mut self, j: usize) {
        for row in &self.rows[self.starts[j] as usize..self.starts[j + 1] as usize] {
            let missed = &mut self.missed[row.cells()];
            for (missed, &detected) in missed.iter_mut().zip(&self.detected[row.detected()]) {
                // No underflow: `detected` is below 2¹⁶, so the product shifted by 16 bits is at most `missed`.
                *missed -= covered(*missed, detected);
            }
        }
    }
}
