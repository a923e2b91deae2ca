//! Ages where every device in S1 within d_max detects an event and the radio loses no report. All worths are whole
//! numbers, so sums do not depend on their order. [`Ages`](super::Ages) documents the methods and their preconditions.
//! `CertainStaleness` keeps the same ages in less memory and must give the same gains, as its test checks.

use std::array;

use reveille_common::geometry::Point;

use super::cells::{Cells, DISC_SIDE, NARROW_STRIDE};
use super::index_table::SATURATION_AGE;
use crate::vector_width::VectorWidth;

/// One row of a square of cells.
type Row = [u8; DISC_SIDE];
/// Two rows, which vector instructions of 256 bits process together.
type RowPair = [Row; 2];

/// Cells that a device covers: the cells with a byte of all ones in the square at `corner`.
#[derive(Clone, Debug)]
struct MaskDisc {
    corner: usize,
    mask: [[u8; DISC_SIDE]; DISC_SIDE],
}

impl MaskDisc {
    fn new(cells: &Cells, centre: Point, d_max: f64) -> Self {
        let spans = cells.within(centre, d_max);
        let south = spans.first().map_or(0, |span| span.row);
        let west = spans.iter().map(|span| span.first_column).min().unwrap_or(0);
        let mut mask = [[0; DISC_SIDE]; DISC_SIDE];
        for span in &spans {
            let first = span.first_column - west;
            mask[span.row - south][first..first + span.count].fill(u8::MAX);
        }
        Self {
            corner: south * cells.stride() + west,
            mask,
        }
    }

    /// Returns the rows of the square in `cells`, which has `stride` cells per row, two by two. The unused rows after
    /// the area make every slice of 16 whole rows valid.
    #[inline(always)]
    fn row_pairs<'a>(&self, cells: &'a [u8], stride: usize) -> impl Iterator<Item = RowPair> + use<'a> {
        // Stated before the loop, so that the compiler omits the test of each row.
        assert!(stride >= DISC_SIDE, "unused cells follow each row");
        let mut rest = &cells[self.corner..][..DISC_SIDE * stride];
        std::iter::from_fn(
            #[inline(always)]
            move || {
                let pair;
                (pair, rest) = rest.split_at_checked(2 * stride)?;
                let (first, second) = pair.split_at(stride);
                Some([*first.first_chunk()?, *second.first_chunk()?])
            },
        )
    }

    /// Returns the masks of the rows of the square, two by two.
    #[inline(always)]
    fn mask_pairs(&self) -> &[RowPair] {
        self.mask.as_chunks().0
    }
}

/// Returns the row of a square from the cell `start` on. The unused cells after the area leave room for it.
#[inline(always)]
fn row_at(cells: &[u8], start: usize) -> &Row {
    cells[start..].first_chunk().expect(ROW_FITS)
}

#[inline(always)]
fn row_at_mut(cells: &mut [u8], start: usize) -> &mut Row {
    cells[start..].first_chunk_mut().expect(ROW_FITS)
}

const ROW_FITS: &str = "unused cells follow each row";

/// Passes a TTI in neighbouring cells of a row: a cell is 1 TTI old if a chosen device covers it, and otherwise ages.
#[inline]
fn pass_tti(
    ages: &mut [u8; DISC_SIDE],
    worths: &mut [u8; DISC_SIDE],
    uncovered_worths: &[u8; DISC_SIDE],
    inside: &[u8; DISC_SIDE],
) {
    // Masks instead of branches, which would prevent vector instructions. An uncovered place has a worth of at least 1.
    let covered: [u8; DISC_SIDE] = array::from_fn(|i| all_ones_if(uncovered_worths[i] == 0));
    let next_ages: [u8; DISC_SIDE] = array::from_fn(|i| ages[i].saturating_add(1));
    // a(a + 1)/2 is the sum of all whole numbers up to a.
    let growths: [u8; DISC_SIDE] = array::from_fn(|i| next_ages[i] & all_ones_if(next_ages[i] <= SATURATION_AGE));
    *ages = array::from_fn(|i| next_ages[i] & !covered[i] | covered[i] & 1);
    *worths = array::from_fn(|i| ((worths[i] + growths[i]) & !covered[i] | covered[i] & 1) & inside[i]);
}

/// Returns a byte of all ones if `condition`, otherwise of zeros.
#[inline]
fn all_ones_if(condition: bool) -> u8 {
    u8::from(condition).wrapping_neg()
}

/// Returns the sum of the worths whose byte in the mask is all ones, over at most 8 pairs of `worths` and masks.
#[inline(always)]
fn sum_masked(width: VectorWidth, pairs: impl Iterator<Item = (RowPair, RowPair)>) -> u32 {
    #[cfg(target_arch = "x86_64")]
    {
        if let VectorWidth::V3(v3) = width {
            let avx2 = v3.avx2;
            // As a signed number, a byte of all ones is −1. So one instruction applies the mask, adds two neighbours
            // and changes the sign. A lane of 16 bits holds 8 sums of at most 2 · 255.
            let add_pair = |sums, (worths, mask): (RowPair, RowPair)| {
                avx2._mm256_add_epi16(sums, avx2._mm256_maddubs_epi16(pulp::cast(worths), pulp::cast(mask)))
            };
            let sums = pairs.fold(v3.avx._mm256_setzero_si256(), add_pair);
            let lanes: [i32; 8] = pulp::cast(avx2._mm256_madd_epi16(sums, v3.avx._mm256_set1_epi16(-1)));
            return lanes.iter().sum::<i32>().cast_unsigned();
        }
        // Every x86-64 CPU has SSE2, so this is decided at compile time.
        if let Some(sse2) = pulp::core_arch::x86::Sse2::try_new() {
            let zero = sse2._mm_setzero_si128();
            // The sum of absolute differences to 0 adds eight bytes in one instruction.
            let add_row = |sums, (worths, mask): (Row, Row)| {
                let masked = sse2._mm_and_si128(pulp::cast(worths), pulp::cast(mask));
                sse2._mm_add_epi64(sums, sse2._mm_sad_epu8(masked, zero))
            };
            let sums = pairs.fold(zero, |sums, (worths, mask)| {
                let sums = add_row(sums, (worths[0], mask[0]));
                add_row(sums, (worths[1], mask[1]))
            });
            let [first, second]: [u64; 2] = pulp::cast(sums);
            return (first + second) as u32;
        }
    }
    _ = width;
    sum_masked_portably(pairs)
}

/// Returns the sum that [`sum_masked`] describes, on any CPU.
#[inline]
fn sum_masked_portably(pairs: impl Iterator<Item = (RowPair, RowPair)>) -> u32 {
    // The columns are summed in parallel: a sum of 16 bytes fits 16 bits.
    let column_sums = pairs.fold([0; DISC_SIDE], |sums: [u16; DISC_SIDE], (worths, mask)| {
        array::from_fn(|i| sums[i] + u16::from(worths[0][i] & mask[0][i]) + u16::from(worths[1][i] & mask[1][i]))
    });
    column_sums.into_iter().map(u32::from).sum()
}

/// A cell that this many chosen devices cover stays covered until the choice is cleared, since their number is unknown.
/// No choice comes near it: each chosen device has a cell that the devices chosen before it leave uncovered.
const MANY: u8 = u8::MAX;

/// Ages in whole TTIs, at most `MAX_AGE`.
#[derive(Clone, Debug)]
pub(super) struct CertainAges {
    stride: usize,
    /// Number of rows in the area.
    rows: usize,
    /// The columns of a row, 16 at a time: a byte of all ones for those in the area. The unused cells after a row leave
    /// room for the last.
    inside: Vec<[u8; DISC_SIDE]>,
    discs: Vec<MaskDisc>,
    ages: Vec<u8>,
    /// Worth of each cell; 0 outside the area.
    cell_worths: Vec<u8>,
    /// Worth of each cell, or 0 if a chosen device covers it.
    uncovered_worths: Vec<u8>,
    /// Number of chosen devices that cover each cell; [`MANY`] stands for that many or more.
    cover_counts: Vec<u8>,
    vector_width: VectorWidth,
}

impl CertainAges {
    pub(super) fn new(cells: &Cells, positions: &[Point], d_max: f64) -> Self {
        let zeros = vec![0; cells.len()];
        let [rows, columns] = cells.rows_and_columns();
        let mut inside = vec![[0; DISC_SIDE]; columns.div_ceil(DISC_SIDE)];
        inside.as_flattened_mut()[..columns].fill(u8::MAX);
        let mut ages = Self {
            stride: cells.stride(),
            rows,
            inside,
            discs: positions.iter().map(|&p| MaskDisc::new(cells, p, d_max)).collect(),
            ages: zeros.clone(),
            cell_worths: zeros.clone(),
            uncovered_worths: zeros,
            cover_counts: vec![0; cells.len()],
            vector_width: VectorWidth::fastest(),
        };
        // Before the first TTI every place has age 1, as after a reported event.
        ages.advance(true);
        ages
    }

    /// Returns the gain of the `j`-th device, at most 16 · 16 · 255.
    #[inline(always)]
    pub(super) fn gain(&self, j: usize) -> u32 {
        let disc = &self.discs[j];
        let masks = disc.mask_pairs().iter().copied();
        if self.stride == NARROW_STRIDE {
            let worths = disc.row_pairs(&self.uncovered_worths, NARROW_STRIDE);
            sum_masked(self.vector_width, worths.zip(masks))
        } else {
            let worths = disc.row_pairs(&self.uncovered_worths, self.stride);
            sum_masked(self.vector_width, worths.zip(masks))
        }
    }

    /// Returns the worth that the chosen devices leave uncovered.
    pub(super) fn uncovered_worth(&self) -> u64 {
        self.uncovered_worths.iter().copied().map(u64::from).sum()
    }

    /// Returns the worth of the area if no device was chosen.
    pub(super) fn total_worth(&self) -> u64 {
        self.cell_worths.iter().copied().map(u64::from).sum()
    }

    #[inline(always)]
    pub(super) fn add(&mut self, j: usize) {
        let disc = &self.discs[j];
        let mut start = disc.corner;
        for mask in &disc.mask {
            let uncovered = row_at_mut(&mut self.uncovered_worths, start);
            let counts = row_at_mut(&mut self.cover_counts, start);
            // Arrays computed as a whole become vector instructions.
            *uncovered = array::from_fn(|i| uncovered[i] & !mask[i]);
            // A byte of the mask is 0 or 255, so its lowest bit counts one device.
            *counts = array::from_fn(|i| counts[i].saturating_add(mask[i] & 1));
            start += self.stride;
        }
    }

    #[inline(always)]
    pub(super) fn remove(&mut self, j: usize) {
        let disc = &self.discs[j];
        let mut start = disc.corner;
        for mask in &disc.mask {
            let uncovered = row_at_mut(&mut self.uncovered_worths, start);
            let counts = row_at_mut(&mut self.cover_counts, start);
            let worths = row_at(&self.cell_worths, start);
            // Masks instead of branches, which would prevent vector instructions.
            *counts = array::from_fn(|i| counts[i] - (all_ones_if(counts[i] < MANY) & mask[i] & 1));
            *uncovered = array::from_fn(|i| worths[i] & all_ones_if(counts[i] == 0));
            start += self.stride;
        }
    }

    pub(super) fn clear(&mut self) {
        self.cover_counts.fill(0);
        self.uncovered_worths.copy_from_slice(&self.cell_worths);
    }

    pub(super) fn advance(&mut self, is_event_reported: bool) {
        // Cells outside the area keep a worth of 0, so no device is chosen for them.
        let padded_columns = self.inside.as_flattened().len();
        for start in (0..self.rows).map(|row| row * self.stride) {
            let row = start..start + padded_columns;
            let (ages, _) = self.ages[row.clone()].as_chunks_mut();
            let (worths, _) = self.cell_worths[row.clone()].as_chunks_mut();
            let (uncovered, _) = self.uncovered_worths[row].as_chunks();
            for (((ages, worths), uncovered), inside) in ages.iter_mut().zip(worths).zip(uncovered).zip(&self.inside) {
                if is_event_reported {
                    *ages = [1; DISC_SIDE];
                    *worths = array::from_fn(|i| inside[i] & 1);
                } else {
                    pass_tti(ages, worths, uncovered, inside);
                }
            }
        }
        self.clear();
    }

    pub(super) fn age(&self, cell: usize) -> u8 {
        self.ages[cell]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn worths_under_the_mask_are_summed() {
        let pair = |seed: usize| -> RowPair {
            array::from_fn(|row| array::from_fn(|i| (seed * 59 + row * 97 + i * 41) as u8))
        };
        let mask = |seed: usize| pair(seed).map(|row| row.map(|byte| all_ones_if(byte % 3 == 0)));
        let mixed: [(RowPair, RowPair); DISC_SIDE / 2] = array::from_fn(|i| (pair(i), mask(i + 100)));
        let largest = [([[u8::MAX; DISC_SIDE]; 2], [[u8::MAX; DISC_SIDE]; 2]); DISC_SIDE / 2];
        for pairs in [&mixed[..], &mixed[..1], &[], &largest] {
            let worths = pairs.iter().flat_map(|(worths, _)| worths.as_flattened());
            let masks = pairs.iter().flat_map(|(_, mask)| mask.as_flattened());
            let inside = worths.zip(masks).filter(|(_, mask)| **mask > 0);
            let expected: u32 = inside.map(|(worth, _)| u32::from(*worth)).sum();
            for width in VectorWidth::supported() {
                assert_eq!(
                    width.run(|| sum_masked(width, pairs.iter().copied())),
                    expected,
                    "{width:?}"
                );
            }
            assert_eq!(sum_masked_portably(pairs.iter().copied()), expected);
        }
    }
}
