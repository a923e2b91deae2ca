//! Deployments: where the devices stand.

use std::path::PathBuf;
use std::sync::Arc;

use super::{Area, Point};

/// How devices are placed in the area. Positions are known to the base station.
#[derive(Clone, Debug, PartialEq)]
pub enum Layout {
    /// Independent and uniform on the area.
    Uniform,
    /// One device, uniform, in each of N random cells of the smallest square grid with at least N cells.
    JitteredGrid,
    /// Random, but no two devices close together.
    PoissonDisk,
    /// Rows and columns as even as N allows; a square N on a square area gives a perfect grid.
    Grid,
    /// As `Grid`, with every other row shifted by half a spacing and rows √3/2 as far apart as devices in a row.
    Hex,
    /// Read from a CSV file with the columns `x` and `y`, metres.
    File {
        /// The file.
        path: PathBuf,
        /// Its first N points.
        points: Arc<Vec<Point>>,
    },
}

/// The positions of `n` devices in `area`, the same for the same `seed`.
pub fn place(_layout: &Layout, _area: Area, _n: u32, _seed: u64) -> Vec<Point> {
    Vec::new()
}
