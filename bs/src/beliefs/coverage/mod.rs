//! The part of the area that a set of devices covers, counted on a grid.
//!
//! `Coverage` answers gain and loss of single devices, from which `q-learning` with a window chooses those that sense;
//! its digests and learned tables depend on the counts. [`CoverageUnion`] gives only the total, for rewards, in less
//! memory. Both give bit-equal results. `tests/src/reference/q_learning.rs` and a test of the training repeat the cell
//! sizes.

mod bits;
mod blocks;
mod shares;
mod union;

use std::ops::Range;

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::{DetectionKind, Sensing};

use self::bits::CoverageBits;
use self::blocks::CellBlocks;
pub use self::blocks::CellPosition;
use self::shares::{QUANTA_PER_CELL, UncoveredShares};
pub use self::union::CoverageUnion;
use super::grid::{self, Raster};

/// Returns the number of grid cells along d_max. With certain detection, a device covers only cells that lie fully
/// within its range, so larger cells lose more of each disc, and smaller ones do not fit `DISC_SIDE`. With
/// probabilistic detection, cells are covered in part and nothing is lost.
const fn cells_per_range(kind: DetectionKind) -> f64 {
    match kind {
        DetectionKind::Range => 15.0,
        DetectionKind::Probabilistic => 10.0,
    }
}

/// Returns the number of grid cells on which the covered part of `area` is counted: a whole number, but possibly too
/// large for an integer type.
pub fn count_cells(area: Area, sensing: &Sensing) -> f64 {
    grid::count_cells(area, sensing.d_max, cells_per_range(sensing.kind))
}

/// Units per cell if detection is probabilistic, since cells are then covered in part; otherwise a unit is a cell.
/// Gains and losses are compared in units.
const UNITS_PER_PARTIAL_CELL: u32 = 64;

/// Quanta per unit if detection is probabilistic. A cell has 64 · `QUANTA_PER_UNIT` − 1 quanta, the maximum of a `u16`.
const QUANTA_PER_UNIT: u64 = (QUANTA_PER_CELL as u64 + 1) / UNITS_PER_PARTIAL_CELL as u64;

/// Approximate cost of a removal among few devices, in additions.
const ADDITIONS_PER_REMOVAL: usize = 3;
/// Approximate number of devices that a removal can rule out in the time of an addition.
const CHECKS_PER_ADDITION: usize = 32;

/// The part of the area covered by the devices added so far.
///
/// With certain detection, a device covers the cells that lie fully within d_max, and coverage counts whole cells. With
/// probabilistic detection, each device leaves the share 1 − p(d) of a cell uncovered.
#[derive(Clone, Debug)]
pub(crate) struct Coverage {
    raster: Raster,
    model: CoverageModel,
    cell_blocks: CellBlocks,
    /// Devices already added. A device counts once: for one event it detects always or never.
    is_added: Vec<bool>,
    /// List of the added devices.
    added_devices: Vec<u32>,
    /// Scratch space of [`Self::replace`]: by device, whether it is wanted.
    is_wanted: Vec<bool>,
}

#[derive(Clone, Debug)]
enum CoverageModel {
    Range(CoverageBits),
    Probabilistic(UncoveredShares),
}

impl Coverage {
    /// Creates the coverage for devices at `positions`, none of them added yet.
    pub(crate) fn new(positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let raster = Raster::new(area, sensing.d_max, cells_per_range(sensing.kind));
        let (model, cell_blocks) = match sensing.kind {
            DetectionKind::Range => {
                let bits = CoverageBits::new(&raster, positions, sensing.d_max);
                let reaches = |j: usize, row: u32, column: u32| bits.reaches(j, row, column);
                let place = |row: u32, column: u32| CoverageBits::place(bits.stride(), row, column);
                let cell_blocks = CellBlocks::new(&raster, positions, sensing.d_max, reaches, place);
                (CoverageModel::Range(bits), cell_blocks)
            }
            // No cell is ever fully covered, so cells have no order.
            DetectionKind::Probabilistic => (
                CoverageModel::Probabilistic(UncoveredShares::new(&raster, positions, sensing)),
                CellBlocks::single(positions.len()),
            ),
        };
        Self {
            raster,
            model,
            cell_blocks,
            is_added: vec![false; positions.len()],
            added_devices: Vec::new(),
            is_wanted: vec![false; positions.len()],
        }
    }

    /// Removes all devices.
    #[inline(always)]
    pub(crate) fn clear(&mut self) {
        match &mut self.model {
            CoverageModel::Range(bits) => bits.clear(),
            CoverageModel::Probabilistic(shares) => shares.clear(),
        }
        for j in self.added_devices.drain(..) {
            self.is_added[j as usize] = false;
        }
    }

    /// Returns the share of the area, `[0, 1]`, that the `j`-th device would newly cover.
    pub(crate) fn gain(&self, j: usize) -> f64 {
        if self.is_added[j] {
            return 0.0;
        }
        let cells = match &self.model {
            CoverageModel::Range(bits) => f64::from(bits.gain(j)),
            CoverageModel::Probabilistic(shares) => shares.gain(j) as f64 / f64::from(QUANTA_PER_CELL),
        };
        cells / self.raster.cell_count() as f64
    }

    /// Returns the gain in units, rounded down, for comparisons.
    #[inline(always)]
    pub(crate) fn gain_in_units(&self, j: usize) -> u32 {
        if self.is_added[j] {
            return 0;
        }
        match &self.model {
            CoverageModel::Range(bits) => bits.gain(j),
            CoverageModel::Probabilistic(shares) => (shares.gain(j) / QUANTA_PER_UNIT) as u32,
        }
    }

    /// Returns the number of units that would be uncovered without the `j`-th device, which was added. `None` if
    /// detection is probabilistic, since all devices then cover cells in part and no device alone covers a cell.
    #[inline(always)]
    pub(crate) fn loss_in_units(&self, j: usize) -> Option<u32> {
        match &self.model {
            CoverageModel::Range(bits) => Some(bits.loss(j)),
            CoverageModel::Probabilistic(_) => None,
        }
    }

    /// Number of units in the area.
    pub(crate) fn total_units(&self) -> f64 {
        let units_per_cell = match &self.model {
            CoverageModel::Range(_) => 1,
            CoverageModel::Probabilistic(_) => UNITS_PER_PARTIAL_CELL,
        };
        self.raster.cell_count() as f64 * f64::from(units_per_cell)
    }

    /// Adds the `j`-th device. Without effect if it was added before.
    #[inline(always)]
    pub(crate) fn add(&mut self, j: usize) {
        if std::mem::replace(&mut self.is_added[j], true) {
            return;
        }
        self.added_devices.push(j as u32);
        match &mut self.model {
            CoverageModel::Range(bits) => bits.add(j),
            CoverageModel::Probabilistic(shares) => shares.add(j),
        }
    }

    /// Removes the `j`-th device, which was added.
    #[inline(always)]
    pub(crate) fn remove(&mut self, j: usize) {
        self.is_added[j] = false;
        self.added_devices.retain(|device| *device as usize != j);
        match &mut self.model {
            CoverageModel::Range(bits) => bits.remove(j, &self.added_devices),
            CoverageModel::Probabilistic(shares) => {
                shares.clear();
                self.added_devices
                    .iter()
                    .for_each(|device| shares.add(*device as usize));
            }
        }
    }

    /// Adds and removes devices until exactly those in `devices` are added, as if they were added in this order.
    #[inline(always)]
    pub(crate) fn replace(&mut self, devices: impl Iterator<Item = usize> + Clone) {
        let mut is_wanted = std::mem::take(&mut self.is_wanted);
        is_wanted.fill(false);
        let mut wanted_count = 0;
        for j in devices.clone() {
            wanted_count += usize::from(!std::mem::replace(&mut is_wanted[j], true));
        }
        let mut unwanted = self.added_devices.clone();
        unwanted.retain(|device| !is_wanted[*device as usize]);
        // A removal costs as much as some additions, and looks at all added devices. Shares are rounded, so there the
        // order of additions counts.
        let has_order = matches!(self.model, CoverageModel::Probabilistic(_));
        let additions_per_removal = ADDITIONS_PER_REMOVAL + self.added_devices.len() / CHECKS_PER_ADDITION;
        if has_order || additions_per_removal * unwanted.len() > wanted_count {
            self.clear();
        } else {
            for device in unwanted {
                self.remove(device as usize);
            }
        }
        devices.for_each(|j| self.add(j));
        self.is_wanted = is_wanted;
    }

    /// Whether one of two devices can change the gain or loss of the other.
    pub(crate) fn may_overlap(&self, a: usize, b: usize) -> bool {
        match &self.model {
            CoverageModel::Range(bits) => bits.may_overlap(a, b),
            CoverageModel::Probabilistic(_) => true,
        }
    }

    /// Whether the `j`-th device was added.
    pub(crate) fn contains(&self, j: usize) -> bool {
        self.is_added[j]
    }

    /// Share of the area that is not covered, `[0, 1]`.
    pub(crate) fn uncovered(&self) -> f64 {
        let cells = self.raster.cell_count() as f64;
        match &self.model {
            CoverageModel::Range(bits) => (cells - f64::from(bits.covered_count())) / cells,
            CoverageModel::Probabilistic(shares) => {
                shares.uncovered_quanta() as f64 / f64::from(QUANTA_PER_CELL) / cells
            }
        }
    }

    /// Number of blocks of neighbouring cells. Blocks are in the order in which a choice of devices should cover them:
    /// corners and borders of the area first.
    pub(crate) const fn block_count(&self) -> usize {
        self.cell_blocks.blocks.len()
    }

    /// Returns the cells of `block` that devices can cover and no added device fully covers, by the bits of
    /// [`CellPosition::block_bit`]. All of them if detection is probabilistic.
    #[inline(always)]
    pub(crate) fn uncovered_in(&self, block: usize) -> u16 {
        let block = &self.cell_blocks.blocks[block];
        match &self.model {
            CoverageModel::Range(bits) => bits.uncovered_in(block),
            CoverageModel::Probabilistic(_) => block.cell_bits,
        }
    }

    /// Returns the indices of the cells of a block that devices can cover, in the order in which they should be
    /// covered.
    #[inline(always)]
    pub(crate) fn cells_in(&self, block: usize) -> Range<usize> {
        let (first, end) = self.cell_blocks.blocks[block].cells;
        first as usize..end as usize
    }

    /// Returns the cell with this index, see [`Self::cells_in`].
    #[inline(always)]
    pub(crate) fn cell(&self, index: usize) -> CellPosition {
        self.cell_blocks.cells[index]
    }

    /// Returns the devices that can cover at least one cell of `block`, in ascending order.
    pub(crate) fn devices_covering_block(&self, block: usize) -> &[u32] {
        let (first, end) = self.cell_blocks.blocks[block].devices;
        &self.cell_blocks.devices[first as usize..end as usize]
    }

    /// Returns whether the `j`-th device covers `cell`; always true if detection is probabilistic, since the one cell
    /// of `CellBlocks::single` is the whole area.
    #[inline(always)]
    pub(crate) fn reaches(&self, j: usize, cell: CellPosition) -> bool {
        match &self.model {
            CoverageModel::Range(bits) => bits.reaches(j, cell.row, cell.column),
            CoverageModel::Probabilistic(_) => true,
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Layout, place_devices};
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
    fn gains_add_up_to_the_covered_share() {
        for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
            for (width, height) in AREAS {
                let area = Area { width, height };
                let positions = place_devices(&Layout::Uniform, area, 40, 5);
                let mut coverage = Coverage::new(&positions, area, &sensing(kind));
                let mut covered = 0.0;
                assert!((coverage.uncovered() - 1.0).abs() < 1e-12);
                for j in 0..40 {
                    covered += coverage.gain(j);
                    coverage.add(j);
                    assert!(
                        (coverage.uncovered() - (1.0 - covered)).abs() < 1e-9,
                        "{kind:?}, {width} m wide, device {j}: covered {covered}"
                    );
                    let repeated_gain = coverage.gain(j);
                    assert!(repeated_gain == 0.0, "device {j} gains {repeated_gain} twice");
                }
                coverage.clear();
                assert!((coverage.uncovered() - 1.0).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn removed_devices_leave_no_trace() {
        for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
            for (width, height) in AREAS {
                let area = Area { width, height };
                let positions = place_devices(&Layout::Uniform, area, 40, 5);
                let new_coverage = || Coverage::new(&positions, area, &sensing(kind));
                let (mut coverage, mut stream) = (new_coverage(), Stream::new(2, Purpose::Training, 0));
                for step in 0..60 {
                    let device_count = stream.below(25);
                    let wanted: Vec<usize> = (0..device_count).map(|_| stream.below(40) as usize).collect();
                    let mut expected = new_coverage();
                    // Half of the sets differ from the one before by a single device.
                    let expected_devices = if step % 2 == 0 {
                        coverage.replace(wanted.iter().copied());
                        wanted
                    } else if let Some(&first) = coverage.added_devices.first() {
                        coverage.remove(first as usize);
                        coverage.added_devices.iter().map(|j| *j as usize).collect()
                    } else {
                        Vec::new()
                    };
                    for j in expected_devices {
                        expected.add(j);
                    }
                    let state = |coverage: &Coverage| -> Vec<_> {
                        let by_device = |j| {
                            (
                                coverage.contains(j),
                                coverage.gain_in_units(j),
                                coverage.loss_in_units(j),
                            )
                        };
                        (0..40).map(by_device).collect()
                    };
                    assert_eq!(
                        state(&coverage),
                        state(&expected),
                        "{kind:?}, {width} m wide, step {step}"
                    );
                    assert!(coverage.uncovered().to_bits() == expected.uncovered().to_bits());
                }
            }
        }
    }

    #[test]
    fn uncovered_cells_of_a_block_are_those_that_no_added_device_reaches() {
        for (width, height) in AREAS {
            let area = Area { width, height };
            let positions = place_devices(&Layout::Uniform, area, 40, 3);
            let mut coverage = Coverage::new(&positions, area, &sensing(DetectionKind::Range));
            let mut stream = Stream::new(4, Purpose::Epicentre, 0);
            for _ in 0..20 {
                let added: Vec<usize> = (0..40).filter(|_| stream.unit() < 0.1).collect();
                coverage.replace(added.iter().copied());
                for block in 0..coverage.block_count() {
                    let cells = coverage.cells_in(block).map(|index| coverage.cell(index));
                    let is_covered = |cell: &CellPosition| added.iter().any(|&j| coverage.reaches(j, *cell));
                    let expected = cells
                        .filter(|cell| !is_covered(cell))
                        .fold(0, |bits, cell| bits | cell.block_bit());
                    assert_eq!(coverage.uncovered_in(block), expected, "{width} m wide, block {block}");
                }
            }
        }
    }

    #[test]
    fn covered_cells_are_in_range_and_cover_most_of_it() {
        for (width, height) in AREAS {
            let area = Area { width, height };
            let positions = place_devices(&Layout::Uniform, area, 8, 7);
            let mut coverage = Coverage::new(&positions, area, &sensing(DetectionKind::Range));
            (0..8).for_each(|j| coverage.add(j));
            let mut stream = Stream::new(1, Purpose::Epicentre, 0);
            let (draws, mut in_range, mut covered) = (40_000, 0, 0);
            let CoverageModel::Range(bits) = &coverage.model else {
                panic!("certain detection needs the range model")
            };
            let is_in_any_disc = |row: u32, column: u32| (0..8).any(|j| bits.reaches(j, row, column));
            for _ in 0..draws {
                let place = Point::new(stream.unit() * width, stream.unit() * height);
                let raster = &coverage.raster;
                let (row, column) = (
                    (place.y / raster.cell_height) as usize,
                    (place.x / raster.cell_width) as usize,
                );
                let is_covered = !bits.is_uncovered(row as u32, column as u32);
                assert_eq!(is_covered, is_in_any_disc(row as u32, column as u32));
                let is_in_range = positions.iter().any(|device| device.distance(place) <= 4.0);
                assert!(
                    is_in_range || !is_covered,
                    "{place:?} is covered, and no device is within d_max"
                );
                in_range += u32::from(is_in_range);
                covered += u32::from(is_covered);
            }
            // A disc loses the cells that its border cuts, about 8 % of its area; the limit leaves a margin.
            assert!(
                f64::from(covered) > 0.87 * f64::from(in_range),
                "{width} m wide: {covered} of {in_range} places in range are covered"
            );
            let covered_share = f64::from(covered) / f64::from(draws);
            assert!(
                (1.0 - coverage.uncovered() - covered_share).abs() < 0.02,
                "{width} m wide: {covered_share} of the places, not {}",
                1.0 - coverage.uncovered()
            );
        }
    }
}
