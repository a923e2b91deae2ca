//! Cells of the area, with a margin of unused cells.

use reveille_common::geometry::{Area, Point};

use crate::beliefs::grid::{self, Raster};

/// Cells along d_max. This density puts the middles of at most [`SIDE`] cells within a length of 2·d_max in any area:
/// with c = ⌈7.5 w/d_max⌉ cells along a width w, either c ≤ 16, or 2·d_max is less than 15·c/(c − 1) < 16 cells long.
const PER_RANGE: f64 = 7.5;

/// Maximum number of rows, and of columns, of cells within d_max of a device.
pub(super) const SIDE: usize = 16;

/// The area in cells of about d_max/7.5, row by row. [`SIDE`] unused cells follow each row, and [`SIDE`] unused rows
/// follow the last. So a square of this side can be read from any cell on.
#[derive(Clone, Debug)]
pub(super) struct Cells {
    raster: Raster,
}

/// Cells of one row whose middles are within d_max of a device: `count` cells starting at `first`, 1 to [`SIDE`].
#[derive(Clone, Copy, Debug)]
pub(super) struct CellSpan {
    pub(super) row: usize,
    pub(super) first: usize,
    pub(super) count: usize,
}

impl Cells {
    pub(super) fn new(area: Area, d_max: f64) -> Self {
        Self {
            raster: Raster::new(area, d_max, PER_RANGE),
        }
    }

    /// Returns the number of cells of `area`, without unused ones.
    pub(super) fn count(area: Area, d_max: f64) -> f64 {
        grid::cells(area, d_max, PER_RANGE)
    }

    /// Area of a cell, m².
    pub(super) fn surface(&self) -> f64 {
        self.raster.width * self.raster.height
    }

    /// Number of rows and of columns of the area.
    pub(super) const fn shape(&self) -> [usize; 2] {
        [self.raster.rows, self.raster.columns]
    }

    /// Offset from a cell to the cell above it.
    pub(super) const fn stride(&self) -> usize {
        self.raster.columns + SIDE
    }

    /// Number of cells, including unused ones.
    pub(super) const fn len(&self) -> usize {
        self.stride() * (self.raster.rows + SIDE)
    }

    /// Indices of the cells of the area.
    pub(super) fn all(&self) -> impl Iterator<Item = usize> + use<> {
        let (columns, stride) = (self.raster.columns, self.stride());
        (0..self.raster.rows).flat_map(move |row| (0..columns).map(move |column| row * stride + column))
    }

    /// Returns the cell that contains `at`, or the nearest cell of the area.
    pub(super) fn cell(&self, at: Point) -> usize {
        let of = |length: f64, size: f64, count: usize| ((length / size).max(0.0) as usize).min(count - 1);
        let Raster {
            columns,
            rows,
            width,
            height,
        } = self.raster;
        of(at.y, height, rows) * self.stride() + of(at.x, width, columns)
    }

    /// Returns the middle of the cell in `row` and `column`.
    pub(super) fn middle(&self, row: usize, column: usize) -> Point {
        let Raster { width, height, .. } = self.raster;
        Point::new(width * (column as f64 + 0.5), height * (row as f64 + 0.5))
    }

    /// Returns the cells whose middles are within `d_max` of `centre`, row by row.
    pub(super) fn within(&self, centre: Point, d_max: f64) -> Vec<CellSpan> {
        let [rows, columns] = self.raster.around(centre, d_max);
        let mut stretches = Vec::new();
        for row in rows {
            // A disc cuts one span out of a row, so the columns inside it are adjacent.
            let mut inside = columns
                .clone()
                .filter(|&column| self.middle(row, column).distance(centre) <= d_max);
            if let Some(first) = inside.next() {
                let count = 1 + inside.count();
                stretches.push(CellSpan { row, first, count });
            }
        }
        let rows = stretches.len();
        assert!(rows <= SIDE && stretches.iter().all(|stretch| stretch.count <= SIDE));
        stretches
    }
}
