//! The area as a grid of cells, on which coverage and ages are counted.

use std::ops::Range;

use reveille_common::geometry::{Area, Point};

/// Maximum number of cells.
pub(crate) const MOST_CELLS: f64 = 16_777_216.0;

/// Returns the number of cells of `area` with at least `per_range` cells along `d_max`.
pub(super) fn cells(area: Area, d_max: f64, per_range: f64) -> f64 {
    along(area.width, d_max, per_range) * along(area.height, d_max, per_range)
}

fn along(length: f64, d_max: f64, per_range: f64) -> f64 {
    (length / d_max * per_range).ceil()
}

/// A grid of cells over the area, with at least the requested number of cells along d_max.
#[derive(Clone, Debug)]
pub(super) struct Raster {
    pub(super) columns: usize,
    pub(super) rows: usize,
    /// Width of a cell, metres.
    pub(super) width: f64,
    pub(super) height: f64,
}

impl Raster {
    pub(super) fn new(area: Area, d_max: f64, per_range: f64) -> Self {
        let cells = |length: f64| (along(length, d_max, per_range) as usize).max(1);
        let (columns, rows) = (cells(area.width), cells(area.height));
        Self {
            columns,
            rows,
            width: area.width / columns as f64,
            height: area.height / rows as f64,
        }
    }

    pub(super) fn cells(&self) -> usize {
        self.columns * self.rows
    }

    /// Returns the rows and columns that a disc of radius `d_max` around `centre` may touch.
    pub(super) fn around(&self, centre: Point, d_max: f64) -> [Range<usize>; 2] {
        let span = |at: f64, size: f64, count: usize| {
            let first = ((at - d_max) / size).floor().max(0.0) as usize;
            let end = ((at + d_max) / size).ceil().max(0.0) as usize;
            first.min(count)..end.min(count)
        };
        [
            span(centre.y, self.height, self.rows),
            span(centre.x, self.width, self.columns),
        ]
    }

    /// Returns the distance from `p` to the farthest point and to the middle of a cell, metres.
    pub(super) fn distances(&self, row: usize, column: usize, p: Point) -> (f64, f64) {
        let (west, south) = (column as f64 * self.width, row as f64 * self.height);
        let x = (p.x - west).abs().max((west + self.width - p.x).abs());
        let y = (p.y - south).abs().max((south + self.height - p.y).abs());
        let middle = Point::new(west + 0.5 * self.width, south + 0.5 * self.height);
        (Point::new(x, y).distance(Point::default()), middle.distance(p))
    }
}
