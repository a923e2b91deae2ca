//! The area, the positions of devices in it, and the bounded Voronoi diagram. Digests depend on distances bit for bit.
//! [`Point`] is also part of messages: a change of its fields raises `WIRE_VERSION`. Doc comments of the fields of
//! [`Area`] appear in `docs/scenario.md`.

mod buckets;
mod file;
mod layout;
mod reach;
mod voronoi;

use serde::{Deserialize, Serialize};

use crate::declare::{POSITIVE, number};

pub use buckets::Buckets;
pub use file::FileLayout;
pub use layout::{Layout, LayoutKind, place_devices};
pub use reach::share_out_of_reach;
pub use voronoi::{farthest_cell_vertex, voronoi_cells};

/// A point, usually of the area, in metres from its south-west corner. Nothing checks that it lies in the area.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// Metres east, `0 ..= width`.
    pub x: f64,
    /// Metres north, `0 ..= height`.
    pub y: f64,
}

impl Point {
    /// Creates the point (`x`, `y`).
    pub const fn new(x: f64, y: f64) -> Self {
        Self { x, y }
    }

    /// The Euclidean distance to `other`, metres.
    pub fn distance(self, other: Self) -> f64 {
        self.distance_squared(other).sqrt()
    }

    /// The squared distance to `other`, square metres.
    pub fn distance_squared(self, other: Self) -> f64 {
        let (dx, dy) = (self.x - other.x, self.y - other.y);
        dx * dx + dy * dy
    }
}

crate::declare! {
    /// Rectangle ξ that the base station serves.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct Area in "area" {
        /// East-west side.
        pub width: f64 = number(POSITIVE, 20.0).unit("metres").source("Table II"),
        /// North-south side.
        pub height: f64 = number(POSITIVE, 20.0).unit("metres").source("Table II"),
    }
}

impl Area {
    /// The surface ξ, square metres.
    pub fn surface(self) -> f64 {
        self.width * self.height
    }

    /// The length of a diagonal, metres: no two points of the area are farther apart.
    pub fn diagonal(self) -> f64 {
        Point::default().distance(Point::new(self.width, self.height))
    }

    /// Whether `p` lies in the area or on its edge.
    pub fn contains(self, p: Point) -> bool {
        (0.0..=self.width).contains(&p.x) && (0.0..=self.height).contains(&p.y)
    }
}
