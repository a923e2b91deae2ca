//! The cells of the area, with room around them.

use reveille_common::geometry::{Area, Point};

use crate::beliefs::raster::{self, Raster};

/// Cells along d_max. The middles of at most [`SIDE`] cells are then within a length of 2·d_max, whatever the area:
/// with c = ⌈7.5 w/d_max⌉ cells along a width w, either c ≤ 16, or 2·d_max is less than 15·c/(c − 1) < 16 cells long.
const PER_RANGE: f64 = 7.5;

/// The most rows, and columns, of cells within d_max of a device.
pub(super) const SIDE: usize = 16;

/// The area in cells of about d_max/7.5, one row after the other. Rows are followed by [`SIDE`] cells that are no part
/// of the area, and so is the last of them by as many rows: wherever a cell is, as many others can be read from it on.
#[derive(Clone, Debug)]
pub(super) struct Cells {
    raster: Raster,
}

/// The cells of one row whose middles are within d_max of a device: from `first` on, `count` of them,
/// 1 to [`SIDE`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Stretch {
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

    /// How many there are in `area`, but for those that are no part of it.
    pub(super) fn count(area: Area, d_max: f64) -> f64 {
        raster::cells(area, d_max, PER_RANGE)
    }

    /// The surface of one, m².
    pub(super) fn surface(&self) -> f64 {
        self.raster.width * self.raster.height
    }

    /// Rows and columns of the area.
    pub(super) const fn shape(&self) -> [usize; 2] {
        [self.raster.rows, self.raster.columns]
    }

    /// From a cell to that above it.
    pub(super) const fn stride(&self) -> usize {
        self.raster.columns + SIDE
    }

    /// Cells, those that are no part of the area included.
    pub(super) const fn len(&self) -> usize {
        self.stride() * (self.raster.rows + SIDE)
    }

    /// The cells of the area.
    pub(super) fn all(&self) -> impl Iterator<Item = usize> + use<> {
        let (columns, stride) = (self.raster.columns, self.stride());
        (0..self.raster.rows).flat_map(move |row| (0..columns).map(move |column| row * stride + column))
    }

    /// The cell that `at` is in, or the nearest of the area.
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

    /// The middle of the cell in `row` and `column`.
    pub(super) fn middle(&self, row: usize, column: usize) -> Point {
        let Raster { width, height, .. } = self.raster;
        Point::new(width * (column as f64 + 0.5), height * (row as f64 + 0.5))
    }

    /// The cells whose middles are within `d_max` of `centre`, row by row.
    pub(super) fn within(&self, centre: Point, d_max: f64) -> Vec<Stretch> {
        let [rows, columns] = self.raster.around(centre, d_max);
        let mut stretches = Vec::new();
        for row in rows {
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
