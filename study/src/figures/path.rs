//! Paths: lines and curves, in points.

use libm::{cos, sin};

/// One step of a path. Coordinates are absolute.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Step {
    /// Start a new part here.
    Move(f64, f64),
    /// A straight line to here.
    Line(f64, f64),
    /// A quadratic curve: its control point, its end.
    Quad(f64, f64, f64, f64),
    /// A cubic curve: its control points, its end.
    Cubic(f64, f64, f64, f64, f64, f64),
    /// A straight line back to the start of the part.
    Close,
}

/// A path of any number of parts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Path(pub Vec<Step>);

impl Path {
    /// The lines through `points`, closed into a polygon if so wished.
    pub fn polyline(points: impl IntoIterator<Item = (f64, f64)>, closed: bool) -> Self {
        let mut steps: Vec<Step> = Vec::new();
        for (x, y) in points {
            steps.push(if steps.is_empty() {
                Step::Move(x, y)
            } else {
                Step::Line(x, y)
            });
        }
        if closed && !steps.is_empty() {
            steps.push(Step::Close);
        }
        Self(steps)
    }

    /// One straight line.
    pub fn segment(from: (f64, f64), to: (f64, f64)) -> Self {
        Self::polyline([from, to], false)
    }

    /// A rectangle by its corners.
    pub fn rectangle([left, top, right, bottom]: [f64; 4]) -> Self {
        Self::polyline([(left, top), (right, top), (right, bottom), (left, bottom)], true)
    }

    /// A circle, as four curves.
    pub fn circle((x, y): (f64, f64), r: f64) -> Self {
        // The usual distance of control points for a quarter of a circle.
        let c = 0.552_284_75 * r;
        Self(vec![
            Step::Move(x + r, y),
            Step::Cubic(x + r, y + c, x + c, y + r, x, y + r),
            Step::Cubic(x - c, y + r, x - r, y + c, x - r, y),
            Step::Cubic(x - r, y - c, x - c, y - r, x, y - r),
            Step::Cubic(x + c, y - r, x + r, y - c, x + r, y),
            Step::Close,
        ])
    }

    /// A regular polygon of `n` corners on a circle of radius `r`, the first corner `turn` radians from the right,
    /// clockwise as seen. With `inner` < 1 it becomes a star whose inner corners are at `inner · r`.
    pub fn polygon((x, y): (f64, f64), r: f64, n: u32, turn: f64, inner: f64) -> Self {
        let corner = |i: u32| {
            let angle = turn + std::f64::consts::PI * f64::from(i) / f64::from(n);
            let reach = if i.is_multiple_of(2) { r } else { inner * r };
            (x + reach * cos(angle), y + reach * sin(angle))
        };
        let step = if inner < 1.0 { 1 } else { 2 };
        Self::polyline((0..2 * n).step_by(step).map(corner), true)
    }

    /// The same path elsewhere.
    #[must_use]
    pub fn moved(self, (right, down): (f64, f64)) -> Self {
        let step = |step| match step {
            Step::Move(x, y) => Step::Move(x + right, y + down),
            Step::Line(x, y) => Step::Line(x + right, y + down),
            Step::Quad(a, b, x, y) => Step::Quad(a + right, b + down, x + right, y + down),
            Step::Cubic(a, b, c, d, x, y) => Step::Cubic(a + right, b + down, c + right, d + down, x + right, y + down),
            Step::Close => Step::Close,
        };
        Self(self.0.into_iter().map(step).collect())
    }

    /// Appends another path.
    pub fn extend(&mut self, other: Self) {
        self.0.extend(other.0);
    }

    /// The corners of the box around all its points, control points included: left, top, right, bottom.
    pub fn bounds(&self) -> [f64; 4] {
        let mut b = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        let mut include = |x: f64, y: f64| {
            // Unlike `min` and `max` this keeps what is not a number, so that nobody overlooks it.
            b = [
                if x >= b[0] { b[0] } else { x },
                if y >= b[1] { b[1] } else { y },
                if x <= b[2] { b[2] } else { x },
                if y <= b[3] { b[3] } else { y },
            ];
        };
        for step in &self.0 {
            match *step {
                Step::Move(x, y) | Step::Line(x, y) => include(x, y),
                Step::Quad(a, b, x, y) => {
                    include(a, b);
                    include(x, y);
                }
                Step::Cubic(a, b, c, d, x, y) => {
                    include(a, b);
                    include(c, d);
                    include(x, y);
                }
                Step::Close => {}
            }
        }
        b
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_lie_on_the_circle() {
        for n in 3..8 {
            for (inner, corners) in [(1.0, n), (0.5, 2 * n)] {
                let Path(steps) = Path::polygon((3.0, 4.0), 2.0, n, 0.3, inner);
                let reach = |step: &Step| match *step {
                    Step::Move(x, y) | Step::Line(x, y) => ((x - 3.0) * (x - 3.0) + (y - 4.0) * (y - 4.0)).sqrt(),
                    Step::Quad(..) | Step::Cubic(..) | Step::Close => panic!("{step:?}"),
                };
                let reaches: Vec<f64> = steps[..steps.len() - 1].iter().map(reach).collect();
                assert_eq!(reaches.len(), corners as usize);
                assert!((reaches[0] - 2.0).abs() < 1e-12);
                assert!((reaches[1] - 2.0 * inner).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_moved_path_has_its_form() {
        let here = Path::circle((1.0, 2.0), 1.5).bounds();
        let mut path = Path(vec![Step::Quad(1.0, -3.0, 2.0, 9.0)]);
        path.extend(Path::circle((1.0, 2.0), 1.5));
        let there = path.clone().moved((10.0, -5.0));
        assert_eq!(there.0[0], Step::Quad(11.0, -8.0, 12.0, 4.0));
        let moved = Path(there.0[1..].to_vec()).bounds();
        let expected = [here[0] + 10.0, here[1] - 5.0, here[2] + 10.0, here[3] - 5.0];
        assert!(moved.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12));
        assert_eq!(path.0.len(), there.0.len());
    }

    #[test]
    fn a_number_that_is_none_is_not_overlooked() {
        let path = Path::polyline([(1.0, 1.0), (f64::NAN, 2.0)], false);
        assert!(path.bounds()[0].is_nan());
        let bounds = Path::circle((1.0, 2.0), 1.0).bounds();
        assert!(
            bounds
                .iter()
                .zip([0.0, 1.0, 2.0, 3.0])
                .all(|(a, b)| (a - b).abs() < 1e-12)
        );
    }
}
