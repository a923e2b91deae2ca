//! The area in cells.

use reveille_common::geometry::{Area, Point};

/// Cells along d_max. The middles of at most [`SIDE`] cells are then within a length of 2·d_max, whatever the area:
/// with c = ⌈7.5 w/d_max⌉ cells along a width w, either c ≤ 16, or 2·d_max is less than 15·c/(c − 1) < 16 cells long.
pub(super) const CELLS_PER_RANGE: f64 = 7.5;

/// The most rows, and columns, of cells within d_max of a device.
pub(super) const SIDE: usize = 16;

/// The area in cells of about d_max/7.5. Rows are followed by [`SIDE`] cells that are no part of the area, and so is
/// the last of them by as many rows: wherever a cell is, as many others can be read from it on.
#[derive(Clone, Debug)]
pub(super) struct Raster {
    columns: usize,
    rows: usize,
    /// Size of a cell, metres.
    pub(super) width: f64,
    pub(super) height: f64,
}

/// The cells of one row of the raster whose middles are within d_max of a device: from `first` on, `count` of them, 1
/// to [`SIDE`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Stretch {
    pub(super) row: usize,
    pub(super) first: usize,
    pub(super) count: usize,
}

impl Raster {
    pub(super) fn new(area: Area, d_max: f64) -> Self {
        let cells = |length: f64| ((length / d_max * CELLS_PER_RANGE).ceil() as usize).max(1);
        let (columns, rows) = (cells(area.width), cells(area.height));
        Self {
            columns,
            rows,
            width: area.width / columns as f64,
            height: area.height / rows as f64,
        }
    }

    /// From a cell to that above it.
    pub(super) const fn stride(&self) -> usize {
        self.columns + SIDE
    }

    /// Cells, those that are no part of the area included.
    pub(super) const fn len(&self) -> usize {
        self.stride() * (self.rows + SIDE)
    }

    /// The cells of the area.
    pub(super) fn all(&self) -> impl Iterator<Item = usize> + use<> {
        let (columns, stride) = (self.columns, self.stride());
        (0..self.rows).flat_map(move |row| (0..columns).map(move |column| row * stride + column))
    }

    /// The cell that `at` is in, or the nearest of the area.
    pub(super) fn cell(&self, at: Point) -> usize {
        let of = |length: f64, size: f64, count: usize| ((length / size).max(0.0) as usize).min(count - 1);
        of(at.y, self.height, self.rows) * self.stride() + of(at.x, self.width, self.columns)
    }

    /// The middle of the cell in `row` and `column`.
    pub(super) fn middle(&self, row: usize, column: usize) -> Point {
        Point::new(self.width * (column as f64 + 0.5), self.height * (row as f64 + 0.5))
    }

    /// The cells whose middles are within `d_max` of `centre`, row by row.
    pub(super) fn within(&self, centre: Point, d_max: f64) -> Vec<Stretch> {
        let span = |at: f64, size: f64, count: usize| {
            let first = ((at - d_max) / size).floor().max(0.0) as usize;
            let end = ((at + d_max) / size).ceil().max(0.0) as usize;
            first.min(count)..end.min(count)
        };
        let columns = span(centre.x, self.width, self.columns);
        let mut stretches = Vec::new();
        for row in span(centre.y, self.height, self.rows) {
            // They are neighbours.
            let mut inside = columns
                .clone()
                .filter(|&column| self.middle(row, column).distance(centre) <= d_max);
            if let Some(first) = inside.next() {
                let count = 1 + inside.count();
                stretches.push(Stretch { row, first, count });
            }
        }
        let rows = stretches.len();
        assert!(rows <= SIDE && stretches.iter().all(|stretch| stretch.count <= SIDE));
        stretches
    }
}
