//! The part of the area that no device reaches, from the exact Voronoi cells: for `energy_balance`. No digest depends
//! on it.

use super::voronoi::{sorted_distinct_sites, visit_cells};
use super::{Area, Point};

/// The share of `area` that is farther than `radius` metres from each of `points`, `[0, 1]`; 1 without points.
///
/// `points` are devices in `area`. A place is out of reach if it is out of reach of its closest device, so each Voronoi
/// cell contributes its surface without the disc around its device. The result is exact except for rounding.
pub fn share_out_of_reach(points: &[Point], area: Area, radius: f64) -> f64 {
    let sites = sorted_distinct_sites(points);
    if sites.is_empty() {
        return 1.0;
    }
    let mut uncovered = 0.0;
    visit_cells(&sites, area, |site, cell| {
        // A cell within the disc is skipped, so that rounding leaves no remainder.
        if cell.iter().any(|corner| corner.distance(site) > radius) {
            uncovered += surface_outside_disc(site, cell, radius);
        }
    });
    (uncovered / area.surface()).clamp(0.0, 1.0)
}

/// The surface of the convex, anticlockwise polygon `cell` outside the disc of `radius` around `centre`, which lies in
/// the polygon; square metres.
fn surface_outside_disc(centre: Point, cell: &[Point], radius: f64) -> f64 {
    let corner = |i: usize| Point::new(cell[i].x - centre.x, cell[i].y - centre.y);
    let edges = (0..cell.len()).map(|i| (corner(i), corner((i + 1) % cell.len())));
    edges
        .map(|(from, to)| 0.5 * cross(from, to) - triangle_in_disc(from, to, radius))
        .sum()
}

/// The surface that the triangle of the origin, `from` and `to` shares with the disc of `radius` around the origin.
fn triangle_in_disc(from: Point, to: Point, radius: f64) -> f64 {
    let direction = Point::new(to.x - from.x, to.y - from.y);
    let sector = |a: Point, b: Point| 0.5 * radius * radius * libm::atan2(cross(a, b), dot(a, b));
    // The edge is `from + t · direction`; it crosses the circle at the roots of a quadratic equation in t.
    let (square, half_linear) = (dot(direction, direction), dot(from, direction));
    let discriminant = half_linear * half_linear - square * (dot(from, from) - radius * radius);
    if square == 0.0 || discriminant <= 0.0 {
        return sector(from, to);
    }
    let root = discriminant.sqrt();
    let (enters, leaves) = ((-half_linear - root) / square, (-half_linear + root) / square);
    if leaves <= 0.0 || enters >= 1.0 {
        return sector(from, to);
    }
    let point_at = |t: f64| Point::new(from.x + t * direction.x, from.y + t * direction.y);
    let (inner_start, inner_end) = (point_at(enters.max(0.0)), point_at(leaves.min(1.0)));
    sector(from, inner_start) + 0.5 * cross(inner_start, inner_end) + sector(inner_end, to)
}

fn dot(a: Point, b: Point) -> f64 {
    a.x * b.x + a.y * b.y
}

fn cross(a: Point, b: Point) -> f64 {
    a.x * b.y - a.y * b.x
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::geometry::{Layout, place_devices};
    use crate::rng::{Purpose, Stream};

    const AREA: Area = Area {
        width: 20.0,
        height: 10.0,
    };

    #[test]
    fn discs_have_their_closed_forms() {
        let share = |points: &[(f64, f64)], radius: f64| {
            let points: Vec<Point> = points.iter().map(|&(x, y)| Point::new(x, y)).collect();
            share_out_of_reach(&points, AREA, radius)
        };
        // The lens of two discs of radius 4 whose centres are 4 m apart.
        let lens = 2.0 * 16.0 * libm::acos(0.5) - 0.5 * 4.0 * 48.0_f64.sqrt();
        let segment = 9.0 * libm::acos(1.0 / 3.0) - 8.0_f64.sqrt();
        for (points, radius, covered) in [
            (&[(10.0, 5.0)][..], 4.0, 16.0 * PI),
            (&[(10.0, 5.0), (10.0, 5.0)], 4.0, 16.0 * PI),
            (&[(0.0, 0.0)], 4.0, 4.0 * PI),
            (&[(10.0, 0.0)], 4.0, 8.0 * PI),
            (&[(10.0, 1.0)], 3.0, 9.0 * PI - segment),
            (&[(8.0, 5.0), (12.0, 5.0)], 4.0, 32.0 * PI - lens),
            (&[(4.0, 5.0), (15.0, 5.0)], 4.0, 32.0 * PI),
            (&[(10.0, 5.0)], 11.2, 200.0),
            (&[], 4.0, 0.0),
        ] {
            let (found, expected) = (share(points, radius), 1.0 - covered / 200.0);
            assert!(
                (found - expected).abs() < 1e-12,
                "{points:?}, {radius} m: {found}, not {expected}"
            );
        }
        assert!(share(&[(10.0, 5.0)], 11.2) <= 0.0, "no rounding error remains");
    }

    /// The reference draws places and measures the distance to every device.
    #[test]
    fn the_share_equals_a_monte_carlo_estimate() {
        let mut stream = Stream::new(5, Purpose::Epicentre, 0);
        for (layout, n, radius) in [
            (Layout::Uniform, 8, 2.5),
            (Layout::Uniform, 40, 1.0),
            (Layout::JitteredGrid, 25, 1.2),
            (Layout::Uniform, 300, 0.6),
        ] {
            let points = place_devices(&layout, AREA, n, 7);
            let share = share_out_of_reach(&points, AREA, radius);
            let draws = 40_000;
            let outside = (0..draws)
                .filter(|_| {
                    let place = Point::new(stream.unit() * AREA.width, stream.unit() * AREA.height);
                    points.iter().all(|point| point.distance(place) > radius)
                })
                .count();
            let estimate = outside as f64 / f64::from(draws);
            let error = (share * (1.0 - share) / f64::from(draws)).sqrt();
            assert!(
                (estimate - share).abs() < 4.0 * error && share > 0.01,
                "{n} devices, {radius} m: {share}, Monte Carlo {estimate} ± {error}"
            );
        }
    }
}
