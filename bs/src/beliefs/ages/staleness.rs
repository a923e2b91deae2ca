//! Ages for devices that only record looks, without choosing devices ahead or removing them.
//!
//! An environment keeps these ages for each of its runs and reads all devices in each step. So they are small: three
//! bytes per cell and 36 per device.

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::{DetectionKind, Sensing};

use super::Ages;
use super::cells::{Cells, SIDE};
use super::index_table::{self, worths};

/// Worth of a look relative to a look right after another, for each device and for the whole area.
#[derive(Clone, Debug)]
pub(crate) struct Staleness {
    looks: StalenessModel,
    /// Worth of a look by device, if every place was covered in the last TTI.
    fresh: Vec<f64>,
    all_fresh: f64,
}

#[derive(Clone, Debug)]
enum StalenessModel {
    Sure(CertainStaleness),
    Chance(Box<Ages>),
}

impl Staleness {
    /// Creates the state before the first TTI; arguments as in [`Ages::with_loss`].
    pub(crate) fn with_loss(lost: f64, positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let looks = match sensing.kind {
            DetectionKind::Range if lost <= 0.0 => {
                StalenessModel::Sure(CertainStaleness::new(area, positions, sensing.d_max))
            }
            DetectionKind::Range | DetectionKind::Probabilistic => {
                StalenessModel::Chance(Box::new(Ages::with_loss(lost, positions, area, sensing, worths())))
            }
        };
        let mut staleness = Self {
            looks,
            fresh: Vec::new(),
            all_fresh: 0.0,
        };
        // All ages are 1 here, so these are the worths right after a look.
        staleness.fresh = (0..positions.len()).map(|j| staleness.worth(j)).collect();
        staleness.all_fresh = staleness.all();
        staleness
    }

    /// Lets the `j`-th device sense in the next TTI; at most one call per TTI.
    #[inline]
    pub(crate) fn look(&mut self, j: usize) {
        match &mut self.looks {
            StalenessModel::Sure(sure) => sure.look(j),
            StalenessModel::Chance(ages) => ages.add(j),
        }
    }

    /// Passes a TTI. `is_found`: an event was reported.
    pub(crate) fn advance(&mut self, is_found: bool) {
        match &mut self.looks {
            StalenessModel::Sure(sure) => sure.pass(is_found),
            StalenessModel::Chance(ages) => ages.advance(is_found),
        }
    }

    /// Returns the worth of a look of the `j`-th device, ≥ 1, relative to its worth right after a look. A device
    /// without cells has worth 1.
    #[inline]
    pub(crate) fn staleness(&self, j: usize) -> f64 {
        let fresh = self.fresh[j];
        if fresh > 0.0 { self.worth(j) / fresh } else { 1.0 }
    }

    /// Returns the ratio for the whole area.
    pub(crate) fn of_all(&self) -> f64 {
        self.all() / self.all_fresh
    }

    #[inline]
    fn worth(&self, j: usize) -> f64 {
        match &self.looks {
            StalenessModel::Sure(sure) => f64::from(sure.worth(j)),
            StalenessModel::Chance(ages) => ages.gain(j),
        }
    }

    fn all(&self) -> f64 {
        match &self.looks {
            StalenessModel::Sure(sure) => sure.all as f64,
            StalenessModel::Chance(ages) => ages.all(),
        }
    }
}

/// Cells that a device covers. In row i of the square at `corner`, these are `rows[i].1` cells starting at `rows[i].0`.
#[derive(Clone, Debug)]
struct Disc {
    corner: u32,
    rows: [(u8, u8); SIDE],
}

impl Disc {
    /// Returns the first cell and the end of each row.
    #[inline]
    fn rows(&self, stride: usize) -> impl Iterator<Item = (usize, usize)> {
        let begins = (0..).map(move |i| self.corner as usize + i * stride);
        let rows = begins.zip(&self.rows);
        rows.map(|(begin, (first, count))| {
            let first = begin + usize::from(*first);
            (first, first + usize::from(*count))
        })
    }
}

/// Ages in whole TTIs, row by row. If the area has fewer rows or columns than a square, the rest are cells outside it.
#[derive(Clone, Debug)]
struct CertainStaleness {
    stride: usize,
    columns: usize,
    rows: usize,
    discs: Vec<Disc>,
    /// Age of each cell; 0 in a TTI in which a device covers it.
    ages: Vec<u8>,
    /// Prefix sums of the worths, modulo 2¹⁶, with the sum of all cells last. A difference below 2¹⁶ is exact.
    before: Vec<u16>,
    /// Sum of the worths of the area.
    all: u64,
}

impl CertainStaleness {
    fn new(area: Area, positions: &[Point], d_max: f64) -> Self {
        let cells = Cells::new(area, d_max);
        let [rows, columns] = cells.shape();
        let (stride, height) = (columns.max(SIDE), rows.max(SIDE));
        let disc = |&p: &Point| {
            let stretches = cells.within(p, d_max);
            // Rows of a square are read in full, so the square moves inwards at the border.
            let south = stretches.first().map_or(0, |stretch| stretch.row).min(height - SIDE);
            let west = stretches.iter().map(|stretch| stretch.first).min().unwrap_or(0);
            let west = west.min(stride - SIDE);
            let mut rows = [(0, 0); SIDE];
            for stretch in &stretches {
                rows[stretch.row - south] = ((stretch.first - west) as u8, stretch.count as u8);
            }
            Disc {
                corner: (south * stride + west) as u32,
                rows,
            }
        };
        let mut sure = Self {
            stride,
            columns,
            rows,
            discs: positions.iter().map(disc).collect(),
            ages: vec![0; stride * height],
            before: vec![0; stride * height + 1],
            all: 0,
        };
        sure.pass(true);
        sure
    }

    #[inline]
    fn look(&mut self, j: usize) {
        let disc = &self.discs[j];
        let mut begin = disc.corner as usize;
        for (first, count) in &disc.rows {
            let ages = self.ages[begin..].first_chunk_mut::<SIDE>().expect(ROOM);
            begin += self.stride;
            // One byte per cell, the first cell in the lowest byte.
            let cells = match count {
                0 => continue,
                count => u128::MAX >> (128 - 8 * u32::from(*count)) << (8 * u32::from(*first)),
            };
            *ages = (u128::from_le_bytes(*ages) & !cells).to_le_bytes();
        }
    }

    fn pass(&mut self, is_found: bool) {
        if is_found {
            self.ages.fill(0);
        }
        let mut sum = 0_u64;
        for (ages, before) in self.ages.chunks_mut(LANES).zip(self.before[1..].chunks_mut(LANES)) {
            // Ages and worths first: without the running sum, cells do not depend on each other and are computed in
            // parallel.
            let mut worths = [0_u8; LANES];
            for (age, worth) in ages.iter_mut().zip(&mut worths) {
                *age = age.saturating_add(1);
                *worth = index_table::index(*age);
            }
            for (before, worth) in before.iter_mut().zip(worths) {
                sum += u64::from(worth);
                // Wraps on purpose: only differences over one row are used, at most 16 · 255.
                *before = sum as u16;
            }
        }
        self.all = sum - self.beyond();
    }

    /// Returns the sum of the worths of the cells outside the area, usually none.
    fn beyond(&self) -> u64 {
        if self.ages.len() == self.rows * self.columns {
            return 0;
        }
        let rows = self.ages.chunks_exact(self.stride).enumerate();
        let beyond = rows.flat_map(|(row, ages)| &ages[if row < self.rows { self.columns } else { 0 }..]);
        beyond.map(|age| u64::from(index_table::index(*age))).sum()
    }

    /// Returns the worth of a look, at most 16 · 16 · 255.
    #[inline]
    fn worth(&self, j: usize) -> u32 {
        let rows = self.discs[j].rows(self.stride);
        rows.map(|(first, end)| u32::from(self.before[end].wrapping_sub(self.before[first])))
            .sum()
    }
}

/// Cells computed in parallel.
const LANES: usize = 64;

const ROOM: &str = "a square is within the cells";

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Layout, place};
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::Fusion;

    use super::*;

    /// Random looks, in areas of fewer cells than a square and of many.
    #[test]
    fn it_is_what_ages_say_after_the_same_looks() {
        for (kind, lost) in [
            (DetectionKind::Range, 0.0),
            (DetectionKind::Range, 0.3),
            (DetectionKind::Probabilistic, 0.0),
        ] {
            for (width, height) in [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (70.0, 12.0), (5.0, 60.0)] {
                let sensing = Sensing {
                    kind,
                    d_max: 4.0,
                    eta: 1.0,
                    psi: 1.0,
                    g: Fusion::Max,
                };
                let area = Area { width, height };
                let positions = place(&Layout::Uniform, area, 25, 3);
                let mut stream = Stream::new(9, Purpose::Epicentre, 0);
                let mut ages = Ages::with_loss(lost, &positions, area, &sensing, worths());
                let mut staleness = Staleness::with_loss(lost, &positions, area, &sensing);
                let fresh: Vec<f64> = (0..25).map(|j| ages.gain(j)).collect();
                let all_fresh = ages.all();
                for _ in 0..300 {
                    for (j, fresh) in fresh.iter().enumerate() {
                        let expected = if *fresh > 0.0 { ages.gain(j) / fresh } else { 1.0 };
                        assert_eq!(
                            staleness.staleness(j).to_bits(),
                            expected.to_bits(),
                            "{kind:?} {width} {j}"
                        );
                    }
                    assert_eq!(staleness.of_all().to_bits(), (ages.all() / all_fresh).to_bits());
                    for j in (0..25).filter(|_| stream.unit() < 0.06) {
                        ages.add(j);
                        staleness.look(j);
                    }
                    let is_found = stream.unit() < 0.02;
                    ages.advance(is_found);
                    staleness.advance(is_found);
                }
            }
        }
    }
}
