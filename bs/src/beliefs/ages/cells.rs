//! Cells of the area, with a margin of unused cells, so that the square around any disc can be read without bounds
//! tests. `CertainAges` and `ProbabilisticAges` index their cells by [`Cells`]. `CertainStaleness` uses a margin only
//! in areas smaller than a square.
//!
//! Gains depend on the cells, therefore digests and learned tables do too. docs/age-index.md states the cells;
//! `tests/src/reference/age_index.rs` and a test of `q-learning` compute them too.

use reveille_common::geometry::{Area, Point};

use crate::beliefs::grid::{self, Raster};

/// Cells along d_max. This density puts the middles of at most [`DISC_SIDE`] cells within a length of 2·d_max in any
/// area: with c = ⌈7.5 w/d_max⌉ cells along a width w, either c ≤ 16, or 2·d_max is less than 15·c/(c − 1) < 16 cells
/// long.
const CELLS_PER_RANGE: f64 = 7.5;

/// Maximum number of rows, and of columns, of cells within d_max of a device.
pub(super) const DISC_SIDE: usize = 16;

/// Offset between rows of areas that are narrow enough. With a constant, the compiler omits bounds checks.
pub(super) const NARROW_STRIDE: usize = 64;

/// The area in cells of at most d_max/7.5, row by row. At least [`DISC_SIDE`] unused cells follow each row, and
/// [`DISC_SIDE`] unused rows follow the last. So a square of this side can be read from any cell on.
#[derive(Clone, Debug)]
pub(super) struct Cells {
    raster: Raster,
}

/// Cells of one row whose middles are within d_max of a device: `count` cells from `first_column` on, 1 to
/// [`DISC_SIDE`].
#[derive(Clone, Copy, Debug)]
pub(super) struct CellSpan {
    pub(super) row: usize,
    pub(super) first_column: usize,
    pub(super) count: usize,
}

impl Cells {
    pub(super) fn new(area: Area, d_max: f64) -> Self {
        Self {
            raster: Raster::new(area, d_max, CELLS_PER_RANGE),
        }
    }

    /// Returns the number of cells of `area`, without unused ones.
    pub(super) fn count(area: Area, d_max: f64) -> f64 {
        grid::count_cells(area, d_max, CELLS_PER_RANGE)
    }

    /// Area of a cell, m².
    pub(super) fn surface(&self) -> f64 {
        self.raster.cell_width * self.raster.cell_height
    }

    /// Number of rows, and of columns, in the area.
    pub(super) const fn rows_and_columns(&self) -> [usize; 2] {
        [self.raster.rows, self.raster.columns]
    }

    /// Offset from the index of a cell to the index of its neighbour in the next row.
    pub(super) const fn stride(&self) -> usize {
        let stride = self.raster.columns + DISC_SIDE;
        if stride < NARROW_STRIDE { NARROW_STRIDE } else { stride }
    }

    /// Number of cells, including unused ones.
    pub(super) const fn len(&self) -> usize {
        self.stride() * (self.raster.rows + DISC_SIDE)
    }

    /// Indices of the cells of the area.
    pub(super) fn all(&self) -> impl Iterator<Item = usize> + use<> {
        let (columns, stride) = (self.raster.columns, self.stride());
        (0..self.raster.rows).flat_map(move |row| (0..columns).map(move |column| row * stride + column))
    }

    /// Returns the cell that contains `point`, or the nearest cell of the area.
    pub(super) fn cell_at(&self, point: Point) -> usize {
        let index_along = |length: f64, size: f64, count: usize| ((length / size).max(0.0) as usize).min(count - 1);
        let Raster {
            columns,
            rows,
            cell_width,
            cell_height,
        } = self.raster;
        index_along(point.y, cell_height, rows) * self.stride() + index_along(point.x, cell_width, columns)
    }

    /// Writes the index of [`Self::cell_at`] for the places at `x` and `y`, metres, to `cells`, as a whole number. All
    /// have the same length. Fast where it is inlined into `VectorWidth::run`.
    #[inline(always)]
    pub(super) fn write_cells(&self, x: &[f64], y: &[f64], cells: &mut [f64]) {
        let Raster {
            columns,
            rows,
            cell_width,
            cell_height,
        } = self.raster;
        let index_along = |length: f64, size: f64, last: f64| {
            let index = length / size;
            let index = if index > 0.0 { index } else { 0.0 };
            (if index < last { index } else { last }).floor()
        };
        let (last_row, last_column, stride) = ((rows - 1) as f64, (columns - 1) as f64, self.stride() as f64);
        for ((cell, &x), &y) in cells.iter_mut().zip(x).zip(y) {
            *cell = index_along(y, cell_height, last_row) * stride + index_along(x, cell_width, last_column);
        }
    }

    /// Returns the middle of a cell of the area.
    pub(super) fn middle(&self, row: usize, column: usize) -> Point {
        let Raster {
            cell_width,
            cell_height,
            ..
        } = self.raster;
        Point::new(cell_width * (column as f64 + 0.5), cell_height * (row as f64 + 0.5))
    }

    /// Returns the cells whose middles are within `d_max` of `centre`, row by row.
    pub(super) fn within(&self, centre: Point, d_max: f64) -> Vec<CellSpan> {
        let [rows, columns] = self.raster.disc_bounds(centre, d_max);
        let mut spans = Vec::new();
        for row in rows {
            // A disc cuts one span out of a row, so the columns inside it are adjacent.
            let mut inside = columns
                .clone()
                .filter(|&column| self.middle(row, column).distance(centre) <= d_max);
            if let Some(first_column) = inside.next() {
                let count = 1 + inside.count();
                spans.push(CellSpan {
                    row,
                    first_column,
                    count,
                });
            }
        }
        // `CELLS_PER_RANGE` ensures it.
        assert!(spans.len() <= DISC_SIDE && spans.iter().all(|span| span.count <= DISC_SIDE));
        spans
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::rng::{Purpose, Stream};

    use super::*;
    use crate::vector_width::VectorWidth;

    #[test]
    fn cells_of_many_places_are_those_of_each_place() {
        let mut stream = Stream::new(5, Purpose::Epicentre, 0);
        for (width, height) in [(20.0, 20.0), (0.3, 61.7), (100.0, 1.0)] {
            let cells = Cells::new(Area { width, height }, 3.0);
            // Places in the area, beyond its edges, and on borders of cells.
            let mut draw = |length: f64, size: f64| match stream.below(4) {
                0 => size * stream.below(40) as f64,
                1 => -stream.unit(),
                _ => 1.1 * length * stream.unit(),
            };
            let x: Vec<f64> = (0..999).map(|_| draw(width, cells.raster.cell_width)).collect();
            let y: Vec<f64> = (0..999).map(|_| draw(height, cells.raster.cell_height)).collect();
            let places = x.iter().zip(&y);
            let expected: Vec<usize> = places.map(|(&x, &y)| cells.cell_at(Point::new(x, y))).collect();
            for vector_width in VectorWidth::supported() {
                let mut written = vec![0.0; 999];
                vector_width.run(|| cells.write_cells(&x, &y, &mut written));
                assert!(written.iter().map(|&cell| cell as usize).eq(expected.iter().copied()));
            }
        }
    }
}
