//! Ages where every device in S1 within d_max detects an event.

use reveille_common::geometry::Point;

use super::cells::{Cells, SIDE};
use super::index_table::AgeIndexTable;

/// Cells that a device covers: the cells with a byte of all ones in the square at `corner`.
#[derive(Clone, Debug)]
struct Disc {
    corner: usize,
    mask: [[u8; SIDE]; SIDE],
}

impl Disc {
    fn new(cells: &Cells, centre: Point, d_max: f64) -> Self {
        let stretches = cells.within(centre, d_max);
        let south = stretches.first().map_or(0, |stretch| stretch.row);
        let west = stretches.iter().map(|stretch| stretch.first).min().unwrap_or(0);
        let mut mask = [[0; SIDE]; SIDE];
        for stretch in &stretches {
            let first = stretch.first - west;
            mask[stretch.row - south][first..first + stretch.count].fill(u8::MAX);
        }
        Self {
            corner: south * cells.stride() + west,
            mask,
        }
    }

    /// Returns the rows of the square in `cells`, which has `stride` cells per row, each with its mask.
    #[inline]
    fn rows<'a, T>(&'a self, cells: &'a [T], stride: usize) -> impl Iterator<Item = (&'a [T; SIDE], &'a [u8; SIDE])> {
        let rows = cells[self.corner..].chunks(stride).filter_map(|row| row.first_chunk());
        rows.zip(&self.mask)
    }

    #[inline]
    fn rows_mut<'a, T>(
        &'a self,
        cells: &'a mut [T],
        stride: usize,
    ) -> impl Iterator<Item = (&'a mut [T; SIDE], &'a [u8; SIDE])> {
        let rows = cells[self.corner..]
            .chunks_mut(stride)
            .filter_map(|row| row.first_chunk_mut());
        rows.zip(&self.mask)
    }
}

/// Ages in whole TTIs.
#[derive(Clone, Debug)]
pub(super) struct CertainAges {
    stride: usize,
    discs: Vec<Disc>,
    worths: AgeIndexTable,
    ages: Vec<u8>,
    /// Worth of each cell; 0 outside the area.
    whole: Vec<u8>,
    /// Worth of each cell, or 0 if a chosen device covers it.
    left: Vec<u8>,
    /// Number of chosen devices that cover each cell.
    lookers: Vec<u16>,
    cells: Vec<u32>,
}

impl CertainAges {
    pub(super) fn new(cells: &Cells, positions: &[Point], d_max: f64, worths: AgeIndexTable) -> Self {
        let zeros = vec![0; cells.len()];
        let mut sure = Self {
            stride: cells.stride(),
            discs: positions.iter().map(|&p| Disc::new(cells, p, d_max)).collect(),
            worths,
            ages: zeros.clone(),
            whole: zeros.clone(),
            left: zeros,
            lookers: vec![0; cells.len()],
            cells: cells.all().map(|cell| cell as u32).collect(),
        };
        sure.advance(true);
        sure
    }

    /// Returns the gain of the `j`-th device, at most 16 · 16 · 255.
    #[inline]
    pub(super) fn gain(&self, j: usize) -> u32 {
        let mut sum = 0;
        for (left, mask) in self.discs[j].rows(&self.left, self.stride) {
            for i in 0..SIDE {
                sum += u32::from(left[i] & mask[i]);
            }
        }
        sum
    }

    pub(super) fn unused(&self) -> u64 {
        self.left.iter().copied().map(u64::from).sum()
    }

    pub(super) fn all(&self) -> u64 {
        self.whole.iter().copied().map(u64::from).sum()
    }

    pub(super) fn add(&mut self, j: usize) {
        let disc = &self.discs[j];
        let rows = disc.rows_mut(&mut self.left, self.stride);
        for ((left, mask), (lookers, _)) in rows.zip(disc.rows_mut(&mut self.lookers, self.stride)) {
            for i in 0..SIDE {
                left[i] &= !mask[i];
                // A byte of the mask is 0 or 255, so its lowest bit counts one device.
                lookers[i] = lookers[i].saturating_add(u16::from(mask[i] & 1));
            }
        }
    }

    pub(super) fn remove(&mut self, j: usize) {
        let disc = &self.discs[j];
        let rows = disc.rows_mut(&mut self.left, self.stride);
        let lookers = disc.rows_mut(&mut self.lookers, self.stride);
        let whole = disc.rows(&self.whole, self.stride);
        for (((left, mask), (lookers, _)), (whole, _)) in rows.zip(lookers).zip(whole) {
            for i in 0..SIDE {
                lookers[i] -= u16::from(mask[i] & 1);
                left[i] = if lookers[i] == 0 { whole[i] } else { 0 };
            }
        }
    }

    pub(super) fn clear(&mut self) {
        self.lookers.fill(0);
        self.left.copy_from_slice(&self.whole);
    }

    pub(super) fn advance(&mut self, is_found: bool) {
        if is_found {
            self.ages.fill(1);
        } else {
            for (age, &lookers) in self.ages.iter_mut().zip(&self.lookers) {
                *age = if lookers > 0 { 1 } else { age.saturating_add(1) };
            }
        }
        // Cells outside the area keep a worth of 0, so no device is chosen for them.
        for &cell in &self.cells {
            self.whole[cell as usize] = self.worths[usize::from(self.ages[cell as usize])];
        }
        self.clear();
    }

    pub(super) fn age(&self, cell: usize) -> u8 {
        self.ages[cell]
    }
}
