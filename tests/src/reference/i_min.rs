//! I_min of a deployment (Sec. V-A): the information in the closest device's report at the worst place, found by trying
//! all candidate places. The time grows with the fourth power of the number of devices.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::Sensing;

use super::clusters::distance;

/// Tolerance for places outside the area due to rounding, metres.
const EDGE_TOLERANCE: f64 = 1e-9;

/// Returns Ψ p(d*), where d* is the largest distance of a place in `area` from its nearest device. This distance is
/// largest in corners, where three devices are equally near, or where the bisector of two devices meets the border. 0
/// without devices.
pub fn least_information(points: &[Point], area: Area, sensing: &Sensing) -> f64 {
    let mut places = vec![
        Point::new(0.0, 0.0),
        Point::new(area.width, 0.0),
        Point::new(0.0, area.height),
        Point::new(area.width, area.height),
    ];
    for (i, &a) in points.iter().enumerate() {
        for (j, &b) in points.iter().enumerate().take(i) {
            places.extend(equidistant_on_border(a, b, area));
            places.extend(points[..j].iter().filter_map(|&c| equidistant(a, b, c)));
        }
    }
    let is_inside = |p: &&Point| {
        (-EDGE_TOLERANCE..=area.width + EDGE_TOLERANCE).contains(&p.x)
            && (-EDGE_TOLERANCE..=area.height + EDGE_TOLERANCE).contains(&p.y)
    };
    let distance_to_nearest = |p: &Point| {
        points
            .iter()
            .map(|&device| distance(device, *p))
            .fold(f64::INFINITY, f64::min)
    };
    let largest_distance = places
        .iter()
        .filter(is_inside)
        .map(distance_to_nearest)
        .fold(0.0, f64::max);
    sensing.psi * libm::exp(-sensing.eta * largest_distance)
}

/// Returns the intersections of the perpendicular bisector of `a` and `b` with the lines through the four sides of the
/// area, also outside it. Empty if `a` and `b` coincide.
fn equidistant_on_border(a: Point, b: Point, area: Area) -> Vec<Point> {
    // The bisector |p − a|² = |p − b|² is the line n·p = offset.
    let (nx, ny) = (2.0 * (b.x - a.x), 2.0 * (b.y - a.y));
    let offset = b.x * b.x + b.y * b.y - a.x * a.x - a.y * a.y;
    let mut places = Vec::new();
    for x in [0.0, area.width] {
        places.push(Point::new(x, (offset - nx * x) / ny));
    }
    for y in [0.0, area.height] {
        places.push(Point::new((offset - ny * y) / nx, y));
    }
    places.retain(|p| p.x.is_finite() && p.y.is_finite());
    places
}

/// Returns the place equally far from three devices; `None` if they are collinear.
fn equidistant(a: Point, b: Point, c: Point) -> Option<Point> {
    let (bx, by, cx, cy) = (b.x - a.x, b.y - a.y, c.x - a.x, c.y - a.y);
    // Formula of the circumcentre; the divisor is 0 if the devices are collinear.
    let divisor = 2.0 * (bx * cy - by * cx);
    let (bb, cc) = (bx * bx + by * by, cx * cx + cy * cy);
    let place = Point::new(a.x + (cy * bb - by * cc) / divisor, a.y + (bx * cc - cx * bb) / divisor);
    (place.x.is_finite() && place.y.is_finite()).then_some(place)
}
