//! The part of the area that a set of devices covers. Rewards need only this, in less memory than
//! [`Coverage`](super::Coverage), which serves the selection of devices. Both must give the same bits, which a test
//! below checks; trajectories and environments report them.

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::{DetectionKind, Sensing};

use super::bits::{BitDisc, DISC_SIDE};
use super::shares::{QUANTA_PER_CELL, UncoveredShares};
use super::{Raster, cells_per_range};

/// The area that a set of devices covers, in the cells of `Coverage`.
#[derive(Clone, Debug)]
pub struct CoverageUnion {
    cell_count: f64,
    model: UnionModel,
}

#[derive(Clone, Debug)]
enum UnionModel {
    Range(UnionTiles),
    Probabilistic(UncoveredShares),
}

impl CoverageUnion {
    /// Creates the model for devices at `positions`.
    pub fn new(positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let raster = Raster::new(area, sensing.d_max, cells_per_range(sensing.kind));
        let model = match sensing.kind {
            DetectionKind::Range => UnionModel::Range(UnionTiles::new(&raster, positions, sensing.d_max)),
            DetectionKind::Probabilistic => {
                UnionModel::Probabilistic(UncoveredShares::new(&raster, positions, sensing))
            }
        };
        Self {
            cell_count: raster.cell_count() as f64,
            model,
        }
    }

    /// Returns the share of the area, `[0, 1]`, that none of `devices` covers. Each device appears once in `devices`.
    /// With probabilistic detection their order affects the rounding.
    pub fn uncovered(&mut self, devices: impl Iterator<Item = usize>) -> f64 {
        match &mut self.model {
            UnionModel::Range(tiles) => {
                tiles.covered.fill(0);
                let covered: u32 = devices.map(|j| tiles.add(j)).sum();
                (self.cell_count - f64::from(covered)) / self.cell_count
            }
            UnionModel::Probabilistic(shares) => {
                shares.clear();
                devices.for_each(|j| shares.add(j));
                shares.uncovered_quanta() as f64 / f64::from(QUANTA_PER_CELL) / self.cell_count
            }
        }
    }
}

/// One bit per cell. Columns lie in tiles of 64, and a tile has a word for each row, with [`DISC_SIDE`] empty words
/// above. An extra tile in the east makes bounds tests unnecessary.
#[derive(Clone, Debug)]
struct UnionTiles {
    /// Words per tile.
    stride: usize,
    covered: Vec<u64>,
    discs: Vec<BitDisc>,
}

impl UnionTiles {
    fn new(raster: &Raster, positions: &[Point], d_max: f64) -> Self {
        let stride = raster.rows + DISC_SIDE;
        // The stride of a disc locates it in the tiles of `CoverageBits`, which do not exist here.
        let disc_stride = 0;
        Self {
            stride,
            covered: vec![0; (raster.columns.div_ceil(64) + 1) * stride],
            discs: positions
                .iter()
                .map(|&position| BitDisc::new(raster, disc_stride, position, d_max))
                .collect(),
        }
    }

    /// Adds the `j`-th device and returns the number of cells that it newly covers.
    fn add(&mut self, j: usize) -> u32 {
        let BitDisc { first_cell, rows, .. } = &self.discs[j];
        let (row, column) = (first_cell.0 as usize, first_cell.1 as usize);
        let (begin, shift) = (column / 64 * self.stride + row, column % 64);
        let (west, east) = self.covered.split_at_mut(begin + self.stride);
        let west = west[begin..].first_chunk_mut::<DISC_SIDE>().expect(TILES_FIT);
        let east = east.first_chunk_mut::<DISC_SIDE>().expect(TILES_FIT);
        let mut newly_covered = 0;
        for i in 0..DISC_SIDE {
            let cells = u64::from(rows[i]);
            // A shift by 64 − `shift` would overflow for 0, so it is split into two.
            let already_covered = west[i] >> shift | east[i] << 1 << (63 - shift);
            newly_covered += (cells & !already_covered).count_ones();
            west[i] |= cells << shift;
            east[i] |= cells >> 1 >> (63 - shift);
        }
        newly_covered
    }
}

const TILES_FIT: &str = "there are empty rows above, and a tile in the east";

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Layout, place_devices};
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::Fusion;

    use super::super::Coverage;
    use super::*;

    #[test]
    fn the_union_equals_coverage_bit_by_bit() {
        for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
            for (width, height) in [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (70.0, 12.0), (5.0, 60.0)] {
                let sensing = Sensing {
                    kind,
                    d_max: 4.0,
                    eta: 1.0,
                    psi: 1.0,
                    g: Fusion::Max,
                };
                let area = Area { width, height };
                let positions = place_devices(&Layout::Uniform, area, 60, 11);
                let mut stream = Stream::new(2, Purpose::Epicentre, 0);
                let mut union = CoverageUnion::new(&positions, area, &sensing);
                let mut coverage = Coverage::new(&positions, area, &sensing);
                for device_share in [0.0, 0.02, 0.1, 0.5, 1.0] {
                    let devices: Vec<usize> = (0..60).filter(|_| stream.unit() < device_share).collect();
                    coverage.clear();
                    for &j in &devices {
                        coverage.add(j);
                    }
                    let uncovered = union.uncovered(devices.into_iter());
                    assert_eq!(
                        uncovered.to_bits(),
                        coverage.uncovered().to_bits(),
                        "{kind:?}, {width} m wide, {device_share} of the devices"
                    );
                }
            }
        }
    }
}
