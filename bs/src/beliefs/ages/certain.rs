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

    /// Returns the rows of the square in `cells`, which has `stride` cells per row, each with its mask.
    #[inline]
    fn rows<'a, T>(
        &'a self,
        cells: &'a [T],
        stride: usize,
    ) -> impl Iterator<Item = (&'a [T; DISC_SIDE], &'a [u8; DISC_SIDE])> {
        let rows = cells[self.corner..].chunks(stride).filter_map(|row| row.first_chunk());
        rows.zip(&self.mask)
    }

    #[inline]
    fn rows_mut<'a, T>(
        &'a self,
        cells: &'a mut [T],
        stride: usize,
    ) -> impl Iterator<Item = (&'a mut [T; DISC_SIDE], &'a [u8; DISC_SIDE])> {
        let rows = cells[self.corner..]
            .chunks_mut(stride)
            .filter_map(|row| row.first_chunk_mut());
        rows.zip(&self.mask)
    }
}

/// A cell that this many chosen devices cover stays covered until the choice is cleared, since their number is unknown.
/// No choice comes near it: each chosen device has a cell that the devices chosen before it leave uncovered.
const MANY: u8 = u8::MAX;

/// Ages in whole TTIs, at most `MAX_AGE`.
#[derive(Clone, Debug)]
pub(super) struct CertainAges {
    stride: usize,
    /// Number of rows, and of columns, in the area.
    rows: usize,
    columns: usize,
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
        let mut ages = Self {
            stride: cells.stride(),
            rows,
            columns,
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
        // The columns are summed in parallel: a sum of 16 bytes fits 16 bits.
        let mut column_sums = [0_u16; DISC_SIDE];
        for (uncovered, mask) in self.discs[j].rows(&self.uncovered_worths, self.stride) {
            column_sums = array::from_fn(|i| column_sums[i] + u16::from(uncovered[i] & mask[i]));
        }
        column_sums.into_iter().map(u32::from).sum()
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
            *uncovered = array::from_fn(|i| if counts[i] == 0 { worths[i] } else { 0 });
        }
    }

    pub(super) fn clear(&mut self) {
        self.cover_counts.fill(0);
        self.uncovered_worths.copy_from_slice(&self.cell_worths);
    }

    pub(super) fn advance(&mut self, is_event_reported: bool) {
        // Cells outside the area keep a worth of 0, so no device is chosen for them.
        for start in (0..self.rows).map(|row| row * self.stride) {
            let row = start..start + self.columns;
            let ages = &mut self.ages[row.clone()];
            let worths = &mut self.cell_worths[row.clone()];
            if is_event_reported {
                ages.fill(1);
                worths.fill(1);
                continue;
            }
            let cells = ages.iter_mut().zip(worths).zip(&self.uncovered_worths[row]);
            for ((age, worth), &uncovered_worth) in cells {
                // An uncovered place has a worth of at least 1.
                let is_covered = uncovered_worth == 0;
                let next_age = age.saturating_add(1);
                // a(a + 1)/2 is the sum of all whole numbers up to a.
                let growth = if next_age <= SATURATION_AGE { next_age } else { 0 };
                *age = if is_covered { 1 } else { next_age };
                *worth = if is_covered { 1 } else { *worth + growth };
            }
        }
        self.clear();
    }

    pub(super) fn age(&self, cell: usize) -> u8 {
        self.ages[cell]
    }
}
