//! The covered part of the area, counted on a grid.

mod bits;
mod blocks;
mod shares;
mod union;

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::{DetectionKind, Sensing};

use self::bits::Bits;
pub use self::blocks::CellPosition;
use self::blocks::{Block, CellBlocks};
use self::shares::{CELL, UncoveredShares};
pub use self::union::Union;
use super::grid::{self, Raster};

/// Returns the number of grid cells along d_max. With certain detection, a device covers only cells that lie fully
/// within its range, so larger cells lose more of each disc. With probabilistic detection, cells are covered in part
/// and nothing is lost.
const fn per_range(kind: DetectionKind) -> f64 {
    match kind {
        DetectionKind::Range => 15.0,
        DetectionKind::Probabilistic => 10.0,
    }
}

/// Returns the number of grid cells on which the covered part of `area` is counted.
pub fn cells(area: Area, sensing: &Sensing) -> f64 {
    grid::cells(area, sensing.d_max, per_range(sensing.kind))
}

/// Parts of a cell, where it can be covered in part.
const PARTS: u32 = 64;

/// Shares per part. A whole cell is one share short of 64 parts.
const SHARES: u64 = (CELL as u64 + 1) / PARTS as u64;

/// The part of the area covered by the devices added so far.
///
/// With certain detection, a device covers the cells that lie fully within d_max, and coverage counts whole cells. With
/// probabilistic detection, each device leaves the share 1 − p(d) of a cell uncovered.
#[derive(Clone, Debug)]
pub(crate) struct Coverage {
    raster: Raster,
    cover: CoverageModel,
    places: CellBlocks,
    /// Devices already added. A device counts once: for one event it detects always or never.
    is_added: Vec<bool>,
    added: Vec<u32>,
}

#[derive(Clone, Debug)]
enum CoverageModel {
    Range(Bits),
    Chance(UncoveredShares),
}

impl Coverage {
    /// Creates the coverage for devices at `positions`, none of them added yet.
    pub(crate) fn new(positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let raster = Raster::new(area, sensing.d_max, per_range(sensing.kind));
        let (cover, places) = match sensing.kind {
            DetectionKind::Range => {
                let bits = Bits::new(&raster, positions, sensing.d_max);
                let reaches = |j: usize, row: u32, column: u32| bits.reaches(j, row, column);
                let places = CellBlocks::new(&raster, positions, sensing.d_max, reaches);
                (CoverageModel::Range(bits), places)
            }
            // No place is ever fully covered, so places have no order.
            DetectionKind::Probabilistic => (
                CoverageModel::Chance(UncoveredShares::new(&raster, positions, sensing)),
                CellBlocks::one(positions.len()),
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

    /// Removes all devices.
    pub(crate) fn clear(&mut self) {
        match &mut self.cover {
            CoverageModel::Range(bits) => bits.clear(),
            CoverageModel::Chance(shares) => shares.clear(),
        }
        for j in self.added.drain(..) {
            self.is_added[j as usize] = false;
        }
    }

    /// Returns the share of the area, `[0, 1]`, that the `j`-th device would newly cover.
    pub(crate) fn gain(&self, j: usize) -> f64 {
        if self.is_added[j] {
            return 0.0;
        }
        let cells = match &self.cover {
            CoverageModel::Range(bits) => f64::from(bits.gain(j)),
            CoverageModel::Chance(shares) => shares.gain(j) as f64 / f64::from(CELL),
        };
        cells / self.raster.cells() as f64
    }

    /// Returns the gain in whole parts, rounded down, for comparisons: cells, or 64ths of a cell if detection is
    /// probabilistic.
    #[inline]
    pub(crate) fn parts(&self, j: usize) -> u32 {
        if self.is_added[j] {
            return 0;
        }
        match &self.cover {
            CoverageModel::Range(bits) => bits.gain(j),
            CoverageModel::Chance(shares) => (shares.gain(j) / SHARES) as u32,
        }
    }

    /// Returns the number of parts that would be uncovered without the `j`-th device, which was added. `None` if
    /// detection is probabilistic, since all devices then cover cells in part and no device alone covers a place.
    pub(crate) fn lost(&self, j: usize) -> Option<u32> {
        match &self.cover {
            CoverageModel::Range(bits) => Some(bits.lost(j)),
            CoverageModel::Chance(_) => None,
        }
    }

    /// Number of parts in the area.
    pub(crate) fn all_parts(&self) -> f64 {
        let each = match &self.cover {
            CoverageModel::Range(_) => 1,
            CoverageModel::Chance(_) => PARTS,
        };
        self.raster.cells() as f64 * f64::from(each)
    }

    /// Adds the `j`-th device.
    pub(crate) fn add(&mut self, j: usize) {
        if std::mem::replace(&mut self.is_added[j], true) {
            return;
        }
        self.added.push(j as u32);
        match &mut self.cover {
            CoverageModel::Range(bits) => bits.add(j),
            CoverageModel::Chance(shares) => shares.add(j),
        }
    }

    /// Returns whether the `j`-th device was added.
    pub(crate) fn has(&self, j: usize) -> bool {
        self.is_added[j]
    }

    /// Share of the area that is not covered, `[0, 1]`.
    pub(crate) fn uncovered(&self) -> f64 {
        let cells = self.raster.cells() as f64;
        match &self.cover {
            CoverageModel::Range(bits) => (cells - f64::from(bits.covered())) / cells,
            CoverageModel::Chance(shares) => shares.uncovered() as f64 / f64::from(CELL) / cells,
        }
    }

    /// Number of blocks of neighbouring places. Blocks are in the order in which they should be covered.
    pub(crate) const fn blocks(&self) -> usize {
        self.places.blocks.len()
    }

    /// Returns whether a block has an uncovered cell.
    #[inline]
    pub(crate) fn has_open(&self, block: usize) -> bool {
        let CoverageModel::Range(bits) = &self.cover else {
            return true;
        };
        let Block {
            row,
            column,
            rows,
            columns,
            ..
        } = self.places.blocks[block];
        let open = (row..row + rows).fold(0, |open, row| open | bits.open(row, column));
        // The word also holds columns beyond the block.
        open & ((1 << columns) - 1) != 0
    }

    /// Returns the places of a block that devices can cover, in order.
    pub(crate) fn spots(&self, block: usize) -> &[CellPosition] {
        let (first, end) = self.places.blocks[block].spots;
        &self.places.spots[first as usize..end as usize]
    }

    /// Returns the devices that can cover a place of a block, in ascending order.
    pub(crate) fn near(&self, block: usize) -> &[u32] {
        let (first, end) = self.places.blocks[block].devices;
        &self.places.devices[first as usize..end as usize]
    }

    /// Returns whether no device covers a place. With probabilistic detection no place is ever fully covered.
    #[inline]
    pub(crate) fn is_open(&self, spot: CellPosition) -> bool {
        match &self.cover {
            CoverageModel::Range(bits) => bits.open(spot.row, spot.column) & 1 == 1,
            CoverageModel::Chance(_) => true,
        }
    }

    /// Returns whether the `j`-th device covers a place, at least in part.
    #[inline]
    pub(crate) fn reaches(&self, j: usize, spot: CellPosition) -> bool {
        match &self.cover {
            CoverageModel::Range(bits) => bits.reaches(j, spot.row, spot.column),
            CoverageModel::Chance(_) => true,
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
            let CoverageModel::Range(bits) = &coverage.cover else {
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
