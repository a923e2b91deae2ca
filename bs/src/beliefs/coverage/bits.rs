//! Coverage where detection is certain within d_max: one bit per cell.

use reveille_common::geometry::Point;

use crate::beliefs::grid::Raster;

/// Exclusive limit on the rows, and columns, of cells that a device covers. With c = ⌈15 w/d_max⌉ cells along a width
/// w, either c ≤ 30, or 2·d_max is at most 30·c/(c − 1) ≤ 31 cells long and holds no more whole cells.
pub(super) const SIDE: usize = 32;

/// The cells covered by at least one device, and those covered by at least two.
///
/// Columns lie in tiles of 64 bits that overlap by half. So all cells of a device lie in one tile, and its rows are
/// consecutive words. An extra tile at either end and [`SIDE`] empty rows above each tile make bounds tests
/// unnecessary.
#[derive(Clone, Debug)]
pub(super) struct Bits {
    /// Words per tile.
    stride: usize,
    covered: Vec<u64>,
    twice: Vec<u64>,
    discs: Vec<BitDisc>,
    /// Number of covered cells.
    count: u32,
}

/// Cells that a device covers: bit `b` of `rows[i]` is the cell in row `first.0 + i` and column `first.1 + b`.
#[derive(Clone, Debug)]
pub(super) struct BitDisc {
    pub(super) first: (u32, u32),
    /// Word of the first row, and bit of the first column in it, less than 32.
    word: u32,
    shift: u32,
    pub(super) rows: [u32; SIDE],
}

impl BitDisc {
    pub(super) fn new(raster: &Raster, stride: usize, p: Point, d_max: f64) -> Self {
        let [south_to_north, west_to_east] = raster.around(p, d_max);
        // The cells of a row are adjacent: distances fall towards `p` and rise beyond it, however they are rounded.
        let stretch = |row: usize| {
            let is_inside = |column: &usize| raster.distances(row, *column, p).0 <= d_max;
            let first = west_to_east.clone().find(is_inside)?;
            let last = west_to_east.clone().rfind(is_inside)?;
            Some((row, first, last))
        };
        let stretches: Vec<(usize, usize, usize)> = south_to_north.filter_map(stretch).collect();
        let row = stretches.first().map_or(0, |stretch| stretch.0);
        let column = stretches.iter().map(|stretch| stretch.1).min().unwrap_or(0);
        let mut rows = [0; SIDE];
        for (at, first, last) in stretches {
            // At most 31 columns, see `SIDE`, so the shifts lose no bit.
            rows[at - row] = u32::MAX >> (31 - (last - first)) << (first - column);
        }
        Self {
            first: (row as u32, column as u32),
            word: ((1 + column / 32) * stride + row) as u32,
            shift: (column % 32) as u32,
            rows,
        }
    }
}

impl Bits {
    pub(super) fn new(raster: &Raster, positions: &[Point], d_max: f64) -> Self {
        let stride = raster.rows + SIDE;
        let words = (raster.columns.div_ceil(32) + 2) * stride;
        Self {
            stride,
            covered: vec![0; words],
            twice: vec![0; words],
            discs: positions
                .iter()
                .map(|&p| BitDisc::new(raster, stride, p, d_max))
                .collect(),
            count: 0,
        }
    }

    pub(super) fn clear(&mut self) {
        self.covered.fill(0);
        self.twice.fill(0);
        self.count = 0;
    }

    /// Returns the number of cells of the `j`-th device that no device covers.
    #[inline]
    pub(super) fn gain(&self, j: usize) -> u32 {
        outside(&self.covered, &self.discs[j])
    }

    /// Returns the number of cells that only the `j`-th device covers, if it was added.
    pub(super) fn lost(&self, j: usize) -> u32 {
        outside(&self.twice, &self.discs[j])
    }

    /// Adds a device that was not added before.
    pub(super) fn add(&mut self, j: usize) {
        let Self {
            stride,
            covered,
            twice,
            discs,
            count,
        } = self;
        let disc = &discs[j];
        *count += outside(covered, disc);
        let (word, shift) = (disc.word as usize, disc.shift);
        // Tiles overlap by half, so the same cells also appear in the tile to the west and in the tile to the east.
        for (begin, to_east, to_west) in [(word - *stride, 32, 0), (word, 0, 0), (word + *stride, 0, 32)] {
            let covered = covered[begin..].first_chunk_mut::<SIDE>().expect(ROOM);
            let twice = twice[begin..].first_chunk_mut::<SIDE>().expect(ROOM);
            for i in 0..SIDE {
                let cells = u64::from(disc.rows[i]) << shift << to_east >> to_west;
                twice[i] |= covered[i] & cells;
                covered[i] |= cells;
            }
        }
    }

    pub(super) const fn covered(&self) -> u32 {
        self.count
    }

    /// Returns whether the `j`-th device covers the cell.
    #[inline]
    pub(super) fn reaches(&self, j: usize, row: u32, column: u32) -> bool {
        let BitDisc { first, rows, .. } = &self.discs[j];
        let (row, column) = (row.wrapping_sub(first.0) as usize, column.wrapping_sub(first.1));
        row < SIDE && column < 32 && rows[row] >> column & 1 == 1
    }

    /// Returns the uncovered cells of `row` from `column` on as bits. The first cell is the lowest bit, and at least 33
    /// bits are valid.
    #[inline]
    pub(super) fn open(&self, row: u32, column: u32) -> u64 {
        !self.covered[(1 + column as usize / 32) * self.stride + row as usize] >> (column % 32)
    }
}

const ROOM: &str = "there are empty rows above";

/// Returns the number of cells of `disc` that are not in `words`.
#[inline]
fn outside(words: &[u64], disc: &BitDisc) -> u32 {
    let words = words[disc.word as usize..].first_chunk::<SIDE>().expect(ROOM);
    let rows = words.iter().zip(&disc.rows);
    rows.map(|(word, cells)| (!((word >> disc.shift) as u32) & cells).count_ones())
        .sum()
}
