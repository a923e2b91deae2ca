//! Ages where looks are told once they are made: nobody is chosen ahead, and nothing is taken back.
//!
//! An environment keeps them for each of its runs and looks at all devices in each step, so there is little of it:
//! three bytes a cell and 36 a device.

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::{DetectionKind, Sensing};

use super::Ages;
use super::cells::{Cells, SIDE};
use super::worths::{self, worths};

/// How much more a look is worth than right after another, for each device and for the whole area.
#[derive(Clone, Debug)]
pub struct Staleness {
    looks: Looks,
    /// By device, what it looks at where every place was looked at in the last TTI.
    fresh: Vec<f64>,
    all_fresh: f64,
}

#[derive(Clone, Debug)]
enum Looks {
    Sure(Sure),
    Chance(Box<Ages>),
}

impl Staleness {
    /// Before the first TTI, as [`Ages::losing`].
    pub fn losing(lost: f64, positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let looks = match sensing.kind {
            DetectionKind::Range if lost <= 0.0 => Looks::Sure(Sure::new(area, positions, sensing.d_max)),
            DetectionKind::Range | DetectionKind::Probabilistic => {
                Looks::Chance(Box::new(Ages::losing(lost, positions, area, sensing, worths())))
            }
        };
        let mut staleness = Self {
            looks,
            fresh: Vec::new(),
            all_fresh: 0.0,
        };
        staleness.fresh = (0..positions.len()).map(|j| staleness.worth(j)).collect();
        staleness.all_fresh = staleness.all();
        staleness
    }

    /// The `j`-th device looks in the TTI that passes next, once.
    #[inline]
    pub fn look(&mut self, j: usize) {
        match &mut self.looks {
            Looks::Sure(sure) => sure.look(j),
            Looks::Chance(ages) => ages.add(j),
        }
    }

    /// A TTI passes. `is_found`: an event was reported.
    pub fn pass(&mut self, is_found: bool) {
        match &mut self.looks {
            Looks::Sure(sure) => sure.pass(is_found),
            Looks::Chance(ages) => ages.pass(is_found),
        }
    }

    /// How many times as much as right after a look it is worth to look at what the `j`-th device covers, ≥ 1; 1 where
    /// it covers nothing.
    #[inline]
    pub fn of(&self, j: usize) -> f64 {
        let fresh = self.fresh[j];
        if fresh > 0.0 { self.worth(j) / fresh } else { 1.0 }
    }

    /// The same of the whole area.
    pub fn of_all(&self) -> f64 {
        self.all() / self.all_fresh
    }

    #[inline]
    fn worth(&self, j: usize) -> f64 {
        match &self.looks {
            Looks::Sure(sure) => f64::from(sure.worth(j)),
            Looks::Chance(ages) => ages.worth(j),
        }
    }

    fn all(&self) -> f64 {
        match &self.looks {
            Looks::Sure(sure) => sure.all as f64,
            Looks::Chance(ages) => ages.all(),
        }
    }
}

/// The cells that a device looks at: of row i of the square from `corner` on, those from `rows[i].0` on, `rows[i].1` of
/// them.
#[derive(Clone, Debug)]
struct Disc {
    corner: u32,
    rows: [(u8, u8); SIDE],
}

impl Disc {
    /// Where the cells of each row begin and end.
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

/// Ages in whole TTIs, row by row. Where the area has fewer rows or columns than a square, there are cells of nobody
/// beyond its last.
#[derive(Clone, Debug)]
struct Sure {
    stride: usize,
    columns: usize,
    rows: usize,
    discs: Vec<Disc>,
    /// 0 in the TTI in which somebody looks.
    ages: Vec<u8>,
    /// The sum of the worths of all cells before each, and at last of all, in the numbers from 0 to 2¹⁶ − 1: the
    /// difference of two is right where it is less than that.
    before: Vec<u16>,
    /// The sum of the worths of the area.
    all: u64,
}

impl Sure {
    fn new(area: Area, positions: &[Point], d_max: f64) -> Self {
        let cells = Cells::new(area, d_max);
        let [rows, columns] = cells.shape();
        let (stride, height) = (columns.max(SIDE), rows.max(SIDE));
        let disc = |&p: &Point| {
            let stretches = cells.within(p, d_max);
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
            // A byte each, the first the lowest.
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
            // First what can be done side by side.
            let mut worths = [0_u8; LANES];
            for (age, worth) in ages.iter_mut().zip(&mut worths) {
                *age = age.saturating_add(1);
                *worth = worths::of(*age);
            }
            for (before, worth) in before.iter_mut().zip(worths) {
                sum += u64::from(worth);
                *before = sum as u16;
            }
        }
        self.all = sum - self.beyond();
    }

    /// The sum of the worths of the cells beyond the last of the area, mostly none.
    fn beyond(&self) -> u64 {
        if self.ages.len() == self.rows * self.columns {
            return 0;
        }
        let rows = self.ages.chunks_exact(self.stride).enumerate();
        let beyond = rows.flat_map(|(row, ages)| &ages[if row < self.rows { self.columns } else { 0 }..]);
        beyond.map(|age| u64::from(worths::of(*age))).sum()
    }

    /// At most 16 · 16 · 255.
    #[inline]
    fn worth(&self, j: usize) -> u32 {
        let rows = self.discs[j].rows(self.stride);
        rows.map(|(first, end)| u32::from(self.before[end].wrapping_sub(self.before[first])))
            .sum()
    }
}

/// Cells that are computed side by side.
const LANES: usize = 64;

const ROOM: &str = "a square is within the cells";

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Layout, place};
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::Fusion;

    use super::*;

    /// Looks by chance, in areas of fewer cells than a square and of many.
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
                let mut ages = Ages::losing(lost, &positions, area, &sensing, worths());
                let mut staleness = Staleness::losing(lost, &positions, area, &sensing);
                let fresh: Vec<f64> = (0..25).map(|j| ages.worth(j)).collect();
                let all_fresh = ages.all();
                for _ in 0..300 {
                    for (j, fresh) in fresh.iter().enumerate() {
                        let expected = if *fresh > 0.0 { ages.worth(j) / fresh } else { 1.0 };
                        assert_eq!(staleness.of(j).to_bits(), expected.to_bits(), "{kind:?} {width} {j}");
                    }
                    assert_eq!(staleness.of_all().to_bits(), (ages.all() / all_fresh).to_bits());
                    for j in (0..25).filter(|_| stream.unit() < 0.06) {
                        ages.add(j);
                        staleness.look(j);
                    }
                    let is_found = stream.unit() < 0.02;
                    ages.pass(is_found);
                    staleness.pass(is_found);
                }
            }
        }
    }
}
