//! Paths of lines and curves, in points, y downwards: the shapes of a [`super::scene::Scene`]. [`super::svg`] and
//! [`super::png`] handle each [`PathStep`], and `font` makes paths of glyphs.

use libm::{cos, sin};

/// Axis-parallel box: left, top, right, bottom, in points.
pub type Rect = [f64; 4];

/// Whether two boxes overlap. Boxes that only touch do not.
pub(super) fn boxes_overlap(a: &Rect, b: &Rect) -> bool {
    a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3]
}

/// One step of a path. Coordinates are absolute.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PathStep {
    /// Starts a new part at this point.
    Move(f64, f64),
    /// A straight line to this point.
    Line(f64, f64),
    /// A quadratic curve: control point, end point.
    Quad(f64, f64, f64, f64),
    /// A cubic curve: two control points, end point.
    Cubic(f64, f64, f64, f64, f64, f64),
    /// A straight line back to the start of the part.
    Close,
}

/// A path of any number of parts, each of which begins with [`PathStep::Move`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VectorPath(pub Vec<PathStep>);

impl VectorPath {
    /// Creates straight lines through `points`.
    pub(crate) fn open_line(points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        let mut steps: Vec<PathStep> = Vec::new();
        for (x, y) in points {
            steps.push(if steps.is_empty() {
                PathStep::Move(x, y)
            } else {
                PathStep::Line(x, y)
            });
        }
        Self(steps)
    }

    /// Creates straight lines through `points` and back to the first: a polygon.
    pub(crate) fn closed_line(points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        let mut path = Self::open_line(points);
        if !path.0.is_empty() {
            path.0.push(PathStep::Close);
        }
        path
    }

    /// Creates one straight line.
    pub fn segment(from: (f64, f64), to: (f64, f64)) -> Self {
        Self::open_line([from, to])
    }

    /// Creates a rectangle from its left, top, right and bottom.
    pub fn rectangle([left, top, right, bottom]: Rect) -> Self {
        Self::closed_line([(left, top), (right, top), (right, bottom), (left, bottom)])
    }

    /// Creates a circle of radius `r` from four cubic curves.
    pub fn circle((x, y): (f64, f64), r: f64) -> Self {
        // Standard distance of control points for a quarter of a circle.
        let c = 0.552_284_75 * r;
        Self(vec![
            PathStep::Move(x + r, y),
            PathStep::Cubic(x + r, y + c, x + c, y + r, x, y + r),
            PathStep::Cubic(x - c, y + r, x - r, y + c, x - r, y),
            PathStep::Cubic(x - r, y - c, x - c, y - r, x, y - r),
            PathStep::Cubic(x + c, y - r, x + r, y - c, x + r, y),
            PathStep::Close,
        ])
    }

    /// Creates a regular polygon of `count` outer corners on a circle of this radius. The first is `first_angle`
    /// radians clockwise from the right. With `inner_share` < 1 it becomes a star whose inner corners are at
    /// `inner_share` of the radius.
    pub fn polygon((x, y): (f64, f64), radius: f64, count: u32, first_angle: f64, inner_share: f64) -> Self {
        let corner = |i: u32| {
            let angle = first_angle + std::f64::consts::PI * f64::from(i) / f64::from(count);
            let distance = if i.is_multiple_of(2) {
                radius
            } else {
                inner_share * radius
            };
            (x + distance * cos(angle), y + distance * sin(angle))
        };
        let step = if inner_share < 1.0 { 1 } else { 2 };
        Self::closed_line((0..2 * count).step_by(step).map(corner))
    }

    /// Returns the path shifted by the given offset.
    #[must_use]
    pub fn shifted(self, (right, down): (f64, f64)) -> Self {
        let step = |step| match step {
            PathStep::Move(x, y) => PathStep::Move(x + right, y + down),
            PathStep::Line(x, y) => PathStep::Line(x + right, y + down),
            PathStep::Quad(a, b, x, y) => PathStep::Quad(a + right, b + down, x + right, y + down),
            PathStep::Cubic(a, b, c, d, x, y) => {
                PathStep::Cubic(a + right, b + down, c + right, d + down, x + right, y + down)
            }
            PathStep::Close => PathStep::Close,
        };
        Self(self.0.into_iter().map(step).collect())
    }

    /// Appends another path.
    pub fn extend(&mut self, other: Self) {
        self.0.extend(other.0);
    }

    /// Bounding box of all points, control points included. An empty path has infinite bounds, with left > right. A NaN
    /// is kept only if no number follows it.
    pub fn bounds(&self) -> Rect {
        let mut bounds = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        let mut include = |x: f64, y: f64| {
            // Unlike `min` and `max`, these comparisons take over NaN: `Scene::outside` reports it.
            let [left, top, right, bottom] = bounds;
            bounds = [
                if x >= left { left } else { x },
                if y >= top { top } else { y },
                if x <= right { right } else { x },
                if y <= bottom { bottom } else { y },
            ];
        };
        for step in &self.0 {
            match *step {
                PathStep::Move(x, y) | PathStep::Line(x, y) => include(x, y),
                PathStep::Quad(a, b, x, y) => {
                    include(a, b);
                    include(x, y);
                }
                PathStep::Cubic(a, b, c, d, x, y) => {
                    include(a, b);
                    include(c, d);
                    include(x, y);
                }
                PathStep::Close => {}
            }
        }
        bounds
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_of_a_polygon_lie_on_its_circles() {
        for n in 3..8 {
            for (inner, corners) in [(1.0, n), (0.5, 2 * n)] {
                let VectorPath(steps) = VectorPath::polygon((3.0, 4.0), 2.0, n, 0.3, inner);
                let radius = |step: &PathStep| match *step {
                    PathStep::Move(x, y) | PathStep::Line(x, y) => {
                        ((x - 3.0) * (x - 3.0) + (y - 4.0) * (y - 4.0)).sqrt()
                    }
                    PathStep::Quad(..) | PathStep::Cubic(..) | PathStep::Close => panic!("{step:?}"),
                };
                let radii: Vec<f64> = steps[..steps.len() - 1].iter().map(radius).collect();
                assert_eq!(radii.len(), corners as usize);
                assert!((radii[0] - 2.0).abs() < 1e-12);
                assert!((radii[1] - 2.0 * inner).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_shifted_path_keeps_its_form() {
        let bounds = VectorPath::circle((1.0, 2.0), 1.5).bounds();
        let mut path = VectorPath(vec![PathStep::Quad(1.0, -3.0, 2.0, 9.0)]);
        path.extend(VectorPath::circle((1.0, 2.0), 1.5));
        let shifted = path.clone().shifted((10.0, -5.0));
        assert_eq!(shifted.0[0], PathStep::Quad(11.0, -8.0, 12.0, 4.0));
        let shifted_bounds = VectorPath(shifted.0[1..].to_vec()).bounds();
        let expected = [bounds[0] + 10.0, bounds[1] - 5.0, bounds[2] + 10.0, bounds[3] - 5.0];
        assert!(shifted_bounds.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12));
        assert_eq!(path.0.len(), shifted.0.len());
    }

    #[test]
    fn bounds_contain_nan_if_the_last_point_does() {
        let path = VectorPath::open_line([(1.0, 1.0), (f64::NAN, 2.0)]);
        assert!(path.bounds()[0].is_nan());
    }

    #[test]
    fn bounds_of_a_circle_touch_it() {
        let bounds = VectorPath::circle((1.0, 2.0), 1.0).bounds();
        assert!(
            bounds
                .iter()
                .zip([0.0, 1.0, 2.0, 3.0])
                .all(|(a, b)| (a - b).abs() < 1e-12)
        );
    }
}
