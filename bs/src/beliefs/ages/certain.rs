//! Ages where every device in S1 within d_max detects an event and the radio loses no report. All worths are whole
//! numbers, so sums do not depend on their order. [`Ages`](super::Ages) documents the methods and their preconditions.
//! `CertainStaleness` keeps the same ages in less memory and must give the same gains, as its test checks.

use std::array;

use reveille_common::geometry::Point;

use super::cells::{Cells, DISC_SIDE};
use super::index_table::SATURATION_AGE;

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

    /// Returns the rows of the square in `cells`, which has `stride` cells per row, each with its mask. The unused rows
    /// after the area make every slice of 16 whole rows valid.
    #[inline]
    fn rows<'a, T>(
        &'a self,
        cells: &'a [T],
        stride: usize,
    ) -> impl Iterator<Item = (&'a [T; DISC_SIDE], &'a [u8; DISC_SIDE])> {
        let rows = cells[self.corner..][..DISC_SIDE * stride].chunks_exact(stride);
        rows.filter_map(|row| row.first_chunk()).zip(&self.mask)
    }

    #[inline]
    fn rows_mut<'a, T>(
        &'a self,
        cells: &'a mut [T],
        stride: usize,
    ) -> impl Iterator<Item = (&'a mut [T; DISC_SIDE], &'a [u8; DISC_SIDE])> {
        let rows = cells[self.corner..][..DISC_SIDE * stride].chunks_exact_mut(stride);
        rows.filter_map(|row| row.first_chunk_mut()).zip(&self.mask)
    }
}

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

/// Returns the sum of all bytes in `rows`, of which there are at most [`DISC_SIDE`].
#[inline]
fn sum_bytes(rows: impl Iterator<Item = [u8; DISC_SIDE]>) -> u32 {
    // Every x86-64 CPU has SSE2, so this is decided at compile time.
    #[cfg(target_arch = "x86_64")]
    if let Some(sse2) = pulp::core_arch::x86::Sse2::try_new() {
        let zero = sse2._mm_setzero_si128();
        // The sum of absolute differences to 0 adds eight bytes in one instruction.
        let add_row = |sums, row| sse2._mm_add_epi64(sums, sse2._mm_sad_epu8(pulp::cast(row), zero));
        let [first, second]: [u64; 2] = pulp::cast(rows.fold(zero, add_row));
        return (first + second) as u32;
    }
    sum_bytes_portably(rows)
}

/// Returns the sum that [`sum_bytes`] describes, on any CPU.
#[inline]
fn sum_bytes_portably(rows: impl Iterator<Item = [u8; DISC_SIDE]>) -> u32 {
    // The columns are summed in parallel: a sum of 16 bytes fits 16 bits.
    let add_row = |sums: [u16; DISC_SIDE], row: [u8; DISC_SIDE]| array::from_fn(|i| sums[i] + u16::from(row[i]));
    let column_sums = rows.fold([0; DISC_SIDE], add_row);
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
        };
        // Before the first TTI every place has age 1, as after a reported event.
        ages.advance(true);
        ages
    }

    /// Returns the gain of the `j`-th device, at most 16 · 16 · 255.
    #[inline]
    pub(super) fn gain(&self, j: usize) -> u32 {
        let rows = self.discs[j].rows(&self.uncovered_worths, self.stride);
        sum_bytes(rows.map(|(uncovered, mask)| array::from_fn(|i| uncovered[i] & mask[i])))
    }

    /// Returns the worth that the chosen devices leave uncovered.
    pub(super) fn uncovered_worth(&self) -> u64 {
        self.uncovered_worths.iter().copied().map(u64::from).sum()
    }

    /// Returns the worth of the area if no device was chosen.
    pub(super) fn total_worth(&self) -> u64 {
        self.cell_worths.iter().copied().map(u64::from).sum()
    }

    pub(super) fn add(&mut self, j: usize) {
        let disc = &self.discs[j];
        let rows = disc.rows_mut(&mut self.uncovered_worths, self.stride);
        for ((uncovered, mask), (counts, _)) in rows.zip(disc.rows_mut(&mut self.cover_counts, self.stride)) {
            // Arrays computed as a whole become vector instructions.
            *uncovered = array::from_fn(|i| uncovered[i] & !mask[i]);
            // A byte of the mask is 0 or 255, so its lowest bit counts one device.
            *counts = array::from_fn(|i| counts[i].saturating_add(mask[i] & 1));
        }
    }

    pub(super) fn remove(&mut self, j: usize) {
        let disc = &self.discs[j];
        let rows = disc.rows_mut(&mut self.uncovered_worths, self.stride);
        let counts = disc.rows_mut(&mut self.cover_counts, self.stride);
        let worths = disc.rows(&self.cell_worths, self.stride);
        for (((uncovered, mask), (counts, _)), (worths, _)) in rows.zip(counts).zip(worths) {
            *counts = array::from_fn(|i| counts[i] - (u8::from(counts[i] < MANY) & mask[i]));
            // Without a branch, which would prevent vector instructions.
            *uncovered = array::from_fn(|i| worths[i] & all_ones_if(counts[i] == 0));
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
    fn all_bytes_are_summed() {
        let rows: [[u8; DISC_SIDE]; DISC_SIDE] = array::from_fn(|i| array::from_fn(|j| (i * 97 + j * 41) as u8));
        for rows in [&rows[..], &rows[..1], &[], &[[u8::MAX; DISC_SIDE]; DISC_SIDE]] {
            let expected: u32 = rows.as_flattened().iter().copied().map(u32::from).sum();
            assert_eq!(sum_bytes(rows.iter().copied()), expected);
            assert_eq!(sum_bytes_portably(rows.iter().copied()), expected);
        }
    }
}
