//! The area as a grid of cells, on which [`coverage`](super::coverage) and [`ages`](super::ages) are counted. Digests,
//! learned tables and rewards depend on the number of cells and on the rounding of distances.

use std::ops::Range;

use reveille_common::geometry::{Area, Point};

/// Maximum number of cells (2²⁴). The settings of policies that count on a grid reject scenarios with more, before a
/// [`Raster`] is made.
pub(crate) const MAX_CELLS: f64 = 16_777_216.0;

/// Returns the number of cells of `area` with at least `cells_per_range` cells along `d_max`.
pub(super) fn count_cells(area: Area, d_max: f64, cells_per_range: f64) -> f64 {
    cells_along(area.width, d_max, cells_per_range) * cells_along(area.height, d_max, cells_per_range)
}

/// Returns the number of cells along a side of the area, a whole number.
fn cells_along(length: f64, d_max: f64, cells_per_range: f64) -> f64 {
    (length / d_max * cells_per_range).ceil()
}

/// A grid of cells over the area, with at least the requested number of cells along d_max.
#[derive(Clone, Debug)]
pub(super) struct Raster {
    pub(super) columns: usize,
    pub(super) rows: usize,
    /// Metres.
    pub(super) cell_width: f64,
    /// Metres.
    pub(super) cell_height: f64,
}

impl Raster {
    pub(super) fn new(area: Area, d_max: f64, cells_per_range: f64) -> Self {
        let count = |length: f64| (cells_along(length, d_max, cells_per_range) as usize).max(1);
        let (columns, rows) = (count(area.width), count(area.height));
        Self {
            columns,
            rows,
            cell_width: area.width / columns as f64,
            cell_height: area.height / rows as f64,
        }
    }

    pub(super) fn cell_count(&self) -> usize {
        self.columns * self.rows
    }

    /// Returns the rows and columns that a disc of radius `d_max` around `centre` may touch.
    pub(super) fn disc_bounds(&self, centre: Point, d_max: f64) -> [Range<usize>; 2] {
        let clipped_range = |coordinate: f64, cell_size: f64, count: usize| {
            let first = ((coordinate - d_max) / cell_size).floor().max(0.0) as usize;
            let end = ((coordinate + d_max) / cell_size).ceil().max(0.0) as usize;
            first.min(count)..end.min(count)
        };
        [
            clipped_range(centre.y, self.cell_height, self.rows),
            clipped_range(centre.x, self.cell_width, self.columns),
        ]
    }

    /// Returns the distance from `position` to the farthest point and to the middle of a cell, metres.
    pub(super) fn cell_distances(&self, row: usize, column: usize, position: Point) -> (f64, f64) {
        let (west, south) = (column as f64 * self.cell_width, row as f64 * self.cell_height);
        let (east, north) = (west + self.cell_width, south + self.cell_height);
        let x = (position.x - west).abs().max((east - position.x).abs());
        let y = (position.y - south).abs().max((north - position.y).abs());
        let middle = Point::new(west + 0.5 * self.cell_width, south + 0.5 * self.cell_height);
        (Point::new(x, y).distance(Point::default()), middle.distance(position))
    }
}
