//! Coverage where detection is certain within d_max: one bit per cell. `CoverageBits` serves
//! [`Coverage`](super::Coverage); `BitDisc` also serves [`CoverageUnion`](super::CoverageUnion). Digests, rewards and
//! learned tables depend on which cells a device covers.

use reveille_common::geometry::Point;

use super::blocks::{BLOCK_SIDE, Block};
use crate::beliefs::grid::Raster;

/// Exclusive limit on the rows, and columns, of cells that a device covers: the bits of a row fit a `u32`. With c =
/// ⌈15 w/d_max⌉ cells along a width w (`cells_per_range`), either c ≤ 30, or 2·d_max is at most 30·c/(c − 1) ≤ 31 cells
/// long and holds no more whole cells.
pub(super) const DISC_SIDE: usize = 32;

/// The cells covered by at least one device, and those covered by at least two.
///
/// Columns lie in tiles of 64 bits that overlap by half. So all cells of a device lie in one tile, and its rows are
/// consecutive words. An extra tile at either end and [`DISC_SIDE`] empty rows above each tile make bounds tests
/// unnecessary.
#[derive(Clone, Debug)]
pub(super) struct CoverageBits {
    /// Words per tile.
    stride: usize,
    covered: Vec<u64>,
    /// Cells that at least two added devices cover.
    covered_twice: Vec<u64>,
    discs: Vec<BitDisc>,
}

/// Cells that a device covers: bit `b` of `rows[i]` is the cell in row `first_cell.0 + i`, column `first_cell.1 + b`.
#[derive(Clone, Debug)]
pub(super) struct BitDisc {
    pub(super) first_cell: (u32, u32),
    /// Word of the first row in the tiles of [`CoverageBits`], and bit of the first column in it, less than 32.
    word: u32,
    shift: u32,
    pub(super) rows: [u32; DISC_SIDE],
}

impl BitDisc {
    /// Creates the disc of a device at `position`. `stride` is the number of words per tile of [`CoverageBits`].
    pub(super) fn new(raster: &Raster, stride: usize, position: Point, d_max: f64) -> Self {
        let [south_to_north, west_to_east] = raster.disc_bounds(position, d_max);
        // The cells of a row are adjacent: distances fall towards the device and rise beyond it, however they are
        // rounded.
        let row_span = |row: usize| {
            let is_inside = |column: &usize| raster.cell_distances(row, *column, position).0 <= d_max;
            let first = west_to_east.clone().find(is_inside)?;
            let last = west_to_east.clone().rfind(is_inside)?;
            Some((row, first, last))
        };
        let row_spans: Vec<(usize, usize, usize)> = south_to_north.filter_map(row_span).collect();
        let row = row_spans.first().map_or(0, |row_span| row_span.0);
        let column = row_spans.iter().map(|row_span| row_span.1).min().unwrap_or(0);
        let mut rows = [0; DISC_SIDE];
        for (row_index, first, last) in row_spans {
            // At most 31 columns, see `DISC_SIDE`, so the shifts lose no bit.
            rows[row_index - row] = u32::MAX >> (31 - (last - first)) << (first - column);
        }
        let (word, shift) = CoverageBits::place(stride, row as u32, column as u32);
        Self {
            first_cell: (row as u32, column as u32),
            word,
            shift: shift.into(),
            rows,
        }
    }

    /// The first words of the rows in the three tiles that have these cells, and the shifts to the east and to the west
    /// there: tiles overlap by half, so the same cells also appear in the tile to the west and in the tile to the east.
    const fn tiles(&self, stride: usize) -> [(usize, u32, u32); 3] {
        let word = self.word as usize;
        [(word - stride, 32, 0), (word, 0, 0), (word + stride, 0, 32)]
    }

    /// The rows and columns from the first cell of `other` to the first cell of this disc; `None` if they are so far
    /// apart that the discs have no common cell.
    fn offset_in(&self, other: &Self) -> Option<(i32, i32)> {
        let limit = DISC_SIDE as u32;
        let distance = |own: u32, other: u32| own.cast_signed() - other.cast_signed();
        let rows = distance(self.first_cell.0, other.first_cell.0);
        let columns = distance(self.first_cell.1, other.first_cell.1);
        (rows.unsigned_abs() < limit && columns.unsigned_abs() < limit).then_some((rows, columns))
    }

    /// Calls `take` for each row of `other` that this disc can reach, with the index of the row and the cells of this
    /// disc in it. Bit 0 is the first column of `other`.
    #[inline(always)]
    fn for_each_row_in(&self, other: &Self, mut take: impl FnMut(usize, u32)) {
        let Some((rows, columns)) = self.offset_in(other) else {
            return;
        };
        let (first, own_first) = (rows.max(0) as usize, (-rows).max(0) as usize);
        for i in first..DISC_SIDE - own_first {
            let cells = self.rows[i - first + own_first];
            take(i, cells << columns.max(0) >> (-columns).max(0));
        }
    }
}

impl CoverageBits {
    pub(super) fn new(raster: &Raster, positions: &[Point], d_max: f64) -> Self {
        let stride = raster.rows + DISC_SIDE;
        let words = (raster.columns.div_ceil(32) + 2) * stride;
        Self {
            stride,
            covered: vec![0; words],
            covered_twice: vec![0; words],
            discs: positions
                .iter()
                .map(|&position| BitDisc::new(raster, stride, position, d_max))
                .collect(),
        }
    }

    #[inline(always)]
    pub(super) fn clear(&mut self) {
        self.covered.fill(0);
        self.covered_twice.fill(0);
    }

    /// Returns the number of cells of the `j`-th device that no device covers.
    #[inline(always)]
    pub(super) fn gain(&self, j: usize) -> u32 {
        count_outside(&self.covered, &self.discs[j])
    }

    /// Returns the number of cells that only the `j`-th device covers, if it was added.
    #[inline(always)]
    pub(super) fn loss(&self, j: usize) -> u32 {
        count_outside(&self.covered_twice, &self.discs[j])
    }

    /// Adds a device that was not added before.
    #[inline(always)]
    pub(super) fn add(&mut self, j: usize) {
        let Self {
            stride,
            covered,
            covered_twice,
            discs,
        } = self;
        let disc = &discs[j];
        for (begin, to_east, to_west) in disc.tiles(*stride) {
            let shift = disc.shift;
            let (covered, covered_twice) = (rows_from(covered, begin), rows_from(covered_twice, begin));
            for i in 0..DISC_SIDE {
                let cells = u64::from(disc.rows[i]) << shift << to_east >> to_west;
                covered_twice[i] |= covered[i] & cells;
                covered[i] |= cells;
            }
        }
    }

    /// Removes a device that was added. `others` are the added devices without it.
    #[inline(always)]
    pub(super) fn remove(&mut self, j: usize, others: &[u32]) {
        let Self {
            stride,
            covered,
            covered_twice,
            discs,
        } = self;
        let disc = &discs[j];
        // Only cells of the disc change. Here the others cover them.
        let (mut by_others, mut by_others_twice) = ([0; DISC_SIDE], [0; DISC_SIDE]);
        for other in others {
            discs[*other as usize].for_each_row_in(disc, |i, cells| {
                by_others_twice[i] |= by_others[i] & cells;
                by_others[i] |= cells;
            });
        }
        for (begin, to_east, to_west) in disc.tiles(*stride) {
            let shift = disc.shift;
            let (covered, covered_twice) = (rows_from(covered, begin), rows_from(covered_twice, begin));
            for i in 0..DISC_SIDE {
                let in_tile = |cells: u32| u64::from(cells) << shift << to_east >> to_west;
                let cells = in_tile(disc.rows[i]);
                covered[i] = covered[i] & !cells | in_tile(by_others[i] & disc.rows[i]);
                covered_twice[i] = covered_twice[i] & !cells | in_tile(by_others_twice[i] & disc.rows[i]);
            }
        }
    }

    /// Whether the discs of two devices may have a common cell. If not, neither affects the gain or loss of the other.
    pub(super) fn may_overlap(&self, a: usize, b: usize) -> bool {
        self.discs[a].offset_in(&self.discs[b]).is_some()
    }

    /// Returns the number of covered cells.
    pub(super) fn covered_count(&self) -> u32 {
        // Each column is in the low half of exactly one tile.
        self.covered.iter().map(|word| (*word as u32).count_ones()).sum()
    }

    /// Returns whether the `j`-th device covers the cell.
    #[inline(always)]
    pub(super) fn reaches(&self, j: usize, row: u32, column: u32) -> bool {
        let BitDisc { first_cell, rows, .. } = &self.discs[j];
        let (row, column) = (
            row.wrapping_sub(first_cell.0) as usize,
            column.wrapping_sub(first_cell.1),
        );
        row < DISC_SIDE && column < 32 && rows[row] >> column & 1 == 1
    }

    /// Returns the word of a cell and its bit in it, less than 32.
    pub(super) const fn place(stride: usize, row: u32, column: u32) -> (u32, u8) {
        ((1 + column / 32) * stride as u32 + row, (column % 32) as u8)
    }

    /// Number of words per tile.
    pub(super) const fn stride(&self) -> usize {
        self.stride
    }

    /// Returns whether no device covers the cell.
    #[cfg(test)]
    pub(super) fn is_uncovered(&self, row: u32, column: u32) -> bool {
        let (word, bit) = Self::place(self.stride, row, column);
        self.covered[word as usize] >> bit & 1 == 0
    }

    /// Returns the cells of a block that no device covers, by the bits of `CellPosition::block_bit`.
    #[inline(always)]
    pub(super) fn uncovered_in(&self, block: &Block) -> u16 {
        let words = self.covered[block.word as usize..].first_chunk::<BLOCK_SIDE>();
        // A block lies in the low half of a tile, so its columns fit the word.
        let columns = words
            .expect(ROWS_FIT)
            .map(|word| (word >> block.shift) as u16 & ((1 << BLOCK_SIDE) - 1));
        let covered = (0..BLOCK_SIDE).fold(0, |covered, row| covered | columns[row] << (row * BLOCK_SIDE));
        !covered & block.cell_bits
    }
}

const ROWS_FIT: &str = "there are empty rows above";

/// Returns the rows of a disc in `words`, of which `begin` is the first.
#[inline(always)]
fn rows_from(words: &mut [u64], begin: usize) -> &mut [u64; DISC_SIDE] {
    words[begin..].first_chunk_mut::<DISC_SIDE>().expect(ROWS_FIT)
}

/// Returns the number of cells of `disc` that are not in `words`.
#[inline(always)]
fn count_outside(words: &[u64], disc: &BitDisc) -> u32 {
    let words = words[disc.word as usize..].first_chunk::<DISC_SIDE>().expect(ROWS_FIT);
    let rows = words.iter().zip(&disc.rows);
    rows.map(|(word, cells)| (!((word >> disc.shift) as u32) & cells).count_ones())
        .sum()
}
