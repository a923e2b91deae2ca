//! Coverage where detection is by chance: the share of each cell that nobody covers.

use reveille_common::geometry::Point;
use reveille_common::sensing::Sensing;

use crate::beliefs::raster::Raster;

/// Cells that are computed side by side.
const LANES: usize = 4;

/// The share of each cell that stays uncovered.
#[derive(Clone, Debug)]
pub(super) struct Shares {
    missed: Vec<f64>,
    /// The rows of device j are `rows[starts[j] .. starts[j + 1]]`.
    starts: Vec<u32>,
    rows: Vec<Stretch>,
    /// p(d) of all cells of all stretches, one after the other.
    detected: Vec<f64>,
}

/// The cells of one row of the raster that a device may detect an event in.
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

impl Shares {
    pub(super) fn new(raster: &Raster, positions: &[Point], sensing: &Sensing) -> Self {
        let (mut starts, mut rows, mut detected) = (vec![0], Vec::new(), Vec::new());
        for &p in positions {
            let [south_to_north, west_to_east] = raster.around(p, sensing.d_max);
            for row in south_to_north {
                let begin = detected.len() as u32;
                let mut first = None;
                // The cells of a row that are near enough are neighbours.
                for column in west_to_east.clone() {
                    let (_, middle) = raster.distances(row, column, p);
                    if middle <= sensing.d_max {
                        first = first.or(Some(column));
                        detected.push(sensing.p(middle));
                    }
                }
                rows.extend(first.map(|column| Stretch {
                    cell: (row * raster.columns + column) as u32,
                    detected: begin,
                    length: detected.len() as u32 - begin,
                }));
            }
            starts.push(rows.len() as u32);
        }
        Self {
            missed: vec![1.0; raster.cells()],
            starts,
            rows,
            detected,
        }
    }

    pub(super) fn clear(&mut self) {
        self.missed.fill(1.0);
    }

    /// Cells, of which a part counts as it is.
    pub(super) fn uncovered(&self) -> f64 {
        self.missed.iter().sum()
    }

    fn rows(&self, j: usize) -> &[Stretch] {
        &self.rows[self.starts[j] as usize..self.starts[j + 1] as usize]
    }

    pub(super) fn cells(&self, j: usize) -> u32 {
        self.rows(j).iter().map(|row| row.length).sum()
    }

    pub(super) fn gain(&self, j: usize) -> f64 {
        let mut lanes = [0.0; LANES];
        let mut rest = 0.0;
        for row in self.rows(j) {
            let (missed, detected) = (&self.missed[row.cells()], &self.detected[row.detected()]);
            let (missed, last_missed) = missed.as_chunks::<LANES>();
            let (detected, last_detected) = detected.as_chunks::<LANES>();
            for (missed, detected) in missed.iter().zip(detected) {
                for lane in 0..LANES {
                    lanes[lane] += missed[lane] * detected[lane];
                }
            }
            for (missed, detected) in last_missed.iter().zip(last_detected) {
                rest += missed * detected;
            }
        }
        lanes.iter().sum::<f64>() + rest
    }

    pub(super) fn add(&mut self, j: usize) {
        let Self {
            missed,
            starts,
            rows,
            detected,
        } = self;
        for row in &rows[starts[j] as usize..starts[j + 1] as usize] {
            for (missed, p) in missed[row.cells()].iter_mut().zip(&detected[row.detected()]) {
                *missed *= 1.0 - p;
            }
        }
    }
}
