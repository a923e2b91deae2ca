//! Which part of the area is covered, counted on a raster.

mod bits;
mod places;
mod shares;
mod union;

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::{DetectionKind, Sensing};

use self::bits::Bits;
pub use self::places::Spot;
use self::places::{Block, Places};
use self::shares::{CELL, Shares};
pub use self::union::Union;
use super::raster::{self, Raster};

/// Cells of the raster along d_max. A cell counts as covered by a device that has all of it in range, so the larger the
/// cells the more of each disc is given away; where cells are covered in part, nothing is.
const fn per_range(kind: DetectionKind) -> f64 {
    match kind {
        DetectionKind::Range => 15.0,
        DetectionKind::Probabilistic => 10.0,
    }
}

/// Cells of the raster on which the covered part of `area` is counted.
pub fn cells(area: Area, sensing: &Sensing) -> f64 {
    raster::cells(area, sensing.d_max, per_range(sensing.kind))
}

/// Parts of a cell, where it can be covered in part.
const PARTS: u32 = 64;

/// Shares that make up a part; a whole cell lacks one of being 64 of them.
const SHARES: u64 = (CELL as u64 + 1) / PARTS as u64;

/// How much of the area is covered by the devices added so far.
///
/// With detection in range a cell is covered by a device that has all of it within d_max, and coverage counts whole
/// cells; with detection by chance each device leaves the share 1 − p(d) of a cell uncovered.
#[derive(Clone, Debug)]
pub struct Coverage {
    raster: Raster,
    cover: Cover,
    places: Places,
    /// A device counts once: for one event it detects always or never.
    is_added: Vec<bool>,
    added: Vec<u32>,
}

#[derive(Clone, Debug)]
enum Cover {
    Range(Bits),
    Chance(Shares),
}

impl Coverage {
    /// The coverage by devices at `positions`, none of them added yet.
    pub fn new(positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let raster = Raster::new(area, sensing.d_max, per_range(sensing.kind));
        let (cover, places) = match sensing.kind {
            DetectionKind::Range => {
                let bits = Bits::new(&raster, positions, sensing.d_max);
                let reaches = |j: usize, row: u32, column: u32| bits.reaches(j, row, column);
                let places = Places::new(&raster, positions, sensing.d_max, reaches);
                (Cover::Range(bits), places)
            }
            // No place is ever covered for good, so none comes before another.
            DetectionKind::Probabilistic => (
                Cover::Chance(Shares::new(&raster, positions, sensing)),
                Places::one(positions.len()),
            ),
        };
        Self {
            raster,
            cover,
            places,
            is_added: vec![false; positions.len()],
            added: Vec::new(),
        }
    }

    /// Forgets all devices.
    pub fn clear(&mut self) {
        match &mut self.cover {
            Cover::Range(bits) => bits.clear(),
            Cover::Chance(shares) => shares.clear(),
        }
        for j in self.added.drain(..) {
            self.is_added[j as usize] = false;
        }
    }

    /// The share of the area, `[0, 1]`, that the `j`-th device would newly cover.
    pub fn gain(&self, j: usize) -> f64 {
        if self.is_added[j] {
            return 0.0;
        }
        let cells = match &self.cover {
            Cover::Range(bits) => f64::from(bits.gain(j)),
            Cover::Chance(shares) => shares.gain(j) as f64 / f64::from(CELL),
        };
        cells / self.raster.cells() as f64
    }

    /// The gain in whole parts, rounded down, for comparisons: cells, or with detection by chance 64ths of a cell.
    #[inline]
    pub fn parts(&self, j: usize) -> u32 {
        if self.is_added[j] {
            return 0;
        }
        match &self.cover {
            Cover::Range(bits) => bits.gain(j),
            Cover::Chance(shares) => (shares.gain(j) / SHARES) as u32,
        }
    }

    /// The parts that would be uncovered without the `j`-th device, which was added. `None` with detection by chance:
    /// there each device makes up for others in part, and nobody's place is taken altogether.
    pub fn lost(&self, j: usize) -> Option<u32> {
        match &self.cover {
            Cover::Range(bits) => Some(bits.lost(j)),
            Cover::Chance(_) => None,
        }
    }

    /// How many parts make up the area.
    pub fn all_parts(&self) -> f64 {
        let each = match &self.cover {
            Cover::Range(_) => 1,
            Cover::Chance(_) => PARTS,
        };
        self.raster.cells() as f64 * f64::from(each)
    }

    /// Adds the `j`-th device.
    pub fn add(&mut self, j: usize) {
        if std::mem::replace(&mut self.is_added[j], true) {
            return;
        }
        self.added.push(j as u32);
        match &mut self.cover {
            Cover::Range(bits) => bits.add(j),
            Cover::Chance(shares) => shares.add(j),
        }
    }

    /// Whether the `j`-th device was added.
    pub fn has(&self, j: usize) -> bool {
        self.is_added[j]
    }

    /// The share of the area, `[0, 1]`, that is not covered.
    pub fn uncovered(&self) -> f64 {
        let cells = self.raster.cells() as f64;
        match &self.cover {
            Cover::Range(bits) => (cells - f64::from(bits.covered())) / cells,
            Cover::Chance(shares) => shares.uncovered() as f64 / f64::from(CELL) / cells,
        }
    }

    /// Blocks of neighbouring places, in the order in which they are to be looked after.
    pub const fn blocks(&self) -> usize {
        self.places.blocks.len()
    }

    /// Whether some cell of a block is open.
    #[inline]
    pub fn has_open(&self, block: usize) -> bool {
        let Cover::Range(bits) = &self.cover else { return true };
        let Block {
            row,
            column,
            rows,
            columns,
            ..
        } = self.places.blocks[block];
        let open = (row..row + rows).fold(0, |open, row| open | bits.open(row, column));
        open & ((1 << columns) - 1) != 0
    }

    /// The places of a block that somebody can cover, in their order.
    pub fn spots(&self, block: usize) -> &[Spot] {
        let (first, end) = self.places.blocks[block].spots;
        &self.places.spots[first as usize..end as usize]
    }

    /// Who may cover a place of a block, by rising number.
    pub fn near(&self, block: usize) -> &[u32] {
        let (first, end) = self.places.blocks[block].devices;
        &self.places.devices[first as usize..end as usize]
    }

    /// Whether nobody covers a place. With detection by chance nobody ever does altogether.
    #[inline]
    pub fn is_open(&self, spot: Spot) -> bool {
        match &self.cover {
            Cover::Range(bits) => bits.open(spot.row, spot.column) & 1 == 1,
            Cover::Chance(_) => true,
        }
    }

    /// Whether the `j`-th device covers a place, at least in part.
    #[inline]
    pub fn reaches(&self, j: usize, spot: Spot) -> bool {
        match &self.cover {
            Cover::Range(bits) => bits.reaches(j, spot.row, spot.column),
            Cover::Chance(_) => true,
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Layout, place};
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::Fusion;

    use super::*;

    fn sensing(kind: DetectionKind) -> Sensing {
        Sensing {
            kind,
            d_max: 4.0,
            eta: 1.0,
            psi: 1.0,
            g: Fusion::Max,
        }
    }

    const AREAS: [(f64, f64); 4] = [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (70.0, 12.0)];

    #[test]
    fn gains_add_up_to_what_is_covered() {
        for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
            for (width, height) in AREAS {
                let area = Area { width, height };
                let points = place(&Layout::Uniform, area, 40, 5);
                let mut coverage = Coverage::new(&points, area, &sensing(kind));
                let mut sum = 0.0;
                assert!((coverage.uncovered() - 1.0).abs() < 1e-12);
                for j in 0..40 {
                    sum += coverage.gain(j);
                    coverage.add(j);
                    assert!((coverage.uncovered() - (1.0 - sum)).abs() < 1e-9, "{kind:?} {width}");
                    let again = coverage.gain(j);
                    assert!(again == 0.0, "{again}");
                }
                coverage.clear();
                assert!((coverage.uncovered() - 1.0).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn what_counts_as_covered_is_in_range_and_little_more_is_left_out() {
        for (width, height) in AREAS {
            let area = Area { width, height };
            let points = place(&Layout::Uniform, area, 8, 7);
            let mut coverage = Coverage::new(&points, area, &sensing(DetectionKind::Range));
            (0..8).for_each(|j| coverage.add(j));
            let mut stream = Stream::new(1, Purpose::Epicentre, 0);
            let (draws, mut reached, mut counted) = (40_000, 0, 0);
            let Cover::Range(bits) = &coverage.cover else {
                panic!("range")
            };
            let counts = |row: u32, column: u32| (0..8).any(|j| bits.reaches(j, row, column));
            for _ in 0..draws {
                let p = Point::new(stream.unit() * width, stream.unit() * height);
                let raster = &coverage.raster;
                let (row, column) = ((p.y / raster.height) as usize, (p.x / raster.width) as usize);
                let is_counted = bits.open(row as u32, column as u32) & 1 == 0;
                assert_eq!(is_counted, counts(row as u32, column as u32));
                let is_reached = points.iter().any(|q| q.distance(p) <= 4.0);
                assert!(is_reached || !is_counted, "{p:?} counts as covered");
                reached += u32::from(is_reached);
                counted += u32::from(is_counted);
            }
            assert!(
                f64::from(counted) > 0.87 * f64::from(reached),
                "{counted} of {reached}, {width} m"
            );
            let share = f64::from(counted) / f64::from(draws);
            assert!((1.0 - coverage.uncovered() - share).abs() < 0.02, "{share}");
        }
    }
}
