//! Coverage where detection is by chance: the share of each cell that nobody covers.

use reveille_common::geometry::Point;
use reveille_common::sensing::Sensing;

use crate::beliefs::raster::Raster;

/// Cells that are computed side by side.
const LANES: usize = 8;

/// A whole cell: shares are counted in 65535ths of it. In whole numbers, what devices cover adds up exactly.
pub(super) const CELL: u16 = u16::MAX;

/// The share of each cell that stays uncovered.
#[derive(Clone, Debug)]
pub(super) struct Shares {
    /// Of all cells, row by row, and of some beyond the last that are none: the rows of a device end there.
    missed: Vec<u16>,
    cells: usize,
    /// The rows of device j are `rows[starts[j] .. starts[j + 1]]`.
    starts: Vec<u32>,
    rows: Vec<Stretch>,
    /// p(d), in 65536ths, of all cells of all stretches, one after the other.
    detected: Vec<u16>,
}

/// Cells of one row of the raster that a device may detect an event in, and after them as many that it detects nothing
/// in as make a multiple of [`LANES`].
#[derive(Clone, Copy, Debug)]
struct Stretch {
    /// The first of them, and the first of their p(d).
    cell: u32,
    detected: u32,
    length: u32,
}

impl Stretch {
    fn cells(self) -> std::ops::Range<usize> {
        self.cell as usize..(self.cell + self.length) as usize
    }

    fn detected(self) -> std::ops::Range<usize> {
        self.detected as usize..(self.detected + self.length) as usize
    }
}

/// What a device that detects with probability `detected` covers of the share that is `missed`, rounded down.
#[inline]
const fn covered(missed: u16, detected: u16) -> u16 {
    ((missed as u32 * detected as u32) >> 16) as u16
}

impl Shares {
    pub(super) fn new(raster: &Raster, positions: &[Point], sensing: &Sensing) -> Self {
        let (mut starts, mut rows, mut detected) = (vec![0], Vec::new(), Vec::new());
        for &p in positions {
            let [south_to_north, west_to_east] = raster.around(p, sensing.d_max);
            for row in south_to_north {
                let begin = detected.len();
                let mut first = None;
                // The cells of a row that are near enough are neighbours.
                for column in west_to_east.clone() {
                    let (_, middle) = raster.distances(row, column, p);
                    if middle <= sensing.d_max {
                        first = first.or(Some(column));
                        detected.push((sensing.p(middle) * 65536.0).round().min(f64::from(u16::MAX)) as u16);
                    }
                }
                let length = (detected.len() - begin).next_multiple_of(LANES);
                detected.resize(begin + length, 0);
                rows.extend(first.map(|column| Stretch {
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

    /// In 65535ths of a cell.
    pub(super) fn uncovered(&self) -> u64 {
        self.missed[..self.cells].iter().map(|&missed| u64::from(missed)).sum()
    }

    /// What the `j`-th device would newly cover, in 65535ths of a cell.
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
                *missed -= covered(*missed, detected);
            }
        }
    }
}
