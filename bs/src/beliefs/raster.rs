//! The area in cells: what covers it and how long ago it was looked at are counted on them.

use std::ops::Range;

use reveille_common::geometry::{Area, Point};

/// The most cells that are counted on.
pub const MOST_CELLS: f64 = 16_777_216.0;

/// How many cells `area` has with `per_range` of them along `d_max`, or a few more.
pub(super) fn cells(area: Area, d_max: f64, per_range: f64) -> f64 {
    along(area.width, d_max, per_range) * along(area.height, d_max, per_range)
}

fn along(length: f64, d_max: f64, per_range: f64) -> f64 {
    (length / d_max * per_range).ceil()
}

/// The area in cells, as many along d_max as asked for or a few more.
#[derive(Clone, Debug)]
pub(super) struct Raster {
    pub(super) columns: usize,
    pub(super) rows: usize,
    /// Size of a cell, metres.
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

    /// The rows and columns that a disc of radius `d_max` around `centre` may touch.
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

    /// The largest and the middle distance of a cell's points from `p`, metres.
    pub(super) fn distances(&self, row: usize, column: usize, p: Point) -> (f64, f64) {
        let (west, south) = (column as f64 * self.width, row as f64 * self.height);
        let x = (p.x - west).abs().max((west + self.width - p.x).abs());
        let y = (p.y - south).abs().max((south + self.height - p.y).abs());
        let middle = Point::new(west + 0.5 * self.width, south + 0.5 * self.height);
        (Point::new(x, y).distance(Point::default()), middle.distance(p))
    }
}
