//! The Voronoi diagram clipped to the area: for the distance bound of Eq. (`E_Info3`), the share of the area within
//! reach, figures and the dashboard. I_min follows from the bound, so decisions and digests depend on it bit for bit,
//! and on the edges that `delaunator` chooses among equally valid ones. Points must lie in the area.

use std::cmp::Ordering;

use super::{Area, Point};

/// The distance d* of Eq. (`E_Info3`), metres: the largest distance from a device to a vertex of its Voronoi cell, the
/// cells being clipped to `area`. No event of the area is farther than this from its closest device.
///
/// Devices at the same place share a cell. Without devices the distance is infinite.
pub fn farthest_cell_vertex(points: &[Point], area: Area) -> f64 {
    let sites = sorted_distinct_sites(points);
    if sites.is_empty() {
        return f64::INFINITY;
    }
    let mut farthest = 0.0_f64;
    visit_cells(&sites, area, |site, cell| {
        farthest = cell.iter().map(|v| v.distance_squared(site)).fold(farthest, f64::max);
    });
    farthest.sqrt()
}

/// The Voronoi cell of each of `points`, clipped to `area`: the corners of a convex polygon, anticlockwise seen with y
/// upwards, in metres. Devices at the same place have the same cell. Of two devices whose places differ by rounding
/// errors alone, one may have an empty cell.
pub fn voronoi_cells(points: &[Point], area: Area) -> Vec<Vec<Point>> {
    let sites = sorted_distinct_sites(points);
    let mut cell_of_site = vec![Vec::new(); sites.len()];
    let find_site = |p: Point| sites.binary_search_by(|site| compare_coordinates(site, &p));
    visit_cells(&sites, area, |site, cell| {
        if let Ok(i) = find_site(site) {
            cell_of_site[i] = cell.to_vec();
        }
    });
    // Adding zero as in `sorted_distinct_sites`.
    let cell_of_point = |p: &Point| find_site(Point::new(p.x + 0.0, p.y + 0.0)).map(|i| cell_of_site[i].clone());
    points.iter().map(|p| cell_of_point(p).unwrap_or_default()).collect()
}

/// Calls `visit` for each of `sites`, in order, with the corners of its cell. `sites` must come from
/// [`sorted_distinct_sites`]; one of two sites that differ by rounding errors alone may be left out.
pub(super) fn visit_cells(sites: &[Point], area: Area, mut visit: impl FnMut(Point, &[Point])) {
    let edges = delaunay_edges(sites, area);
    let (mut cell, mut spare) = (Vec::new(), Vec::new());
    for site_edges in edges.chunk_by(|a, b| a.0 == b.0) {
        // The far sites own no part of the area.
        let Some(&site) = sites.get(site_edges[0].0) else {
            continue;
        };
        cell.clear();
        cell.extend([
            Point::new(0.0, 0.0),
            Point::new(area.width, 0.0),
            Point::new(area.width, area.height),
            Point::new(0.0, area.height),
        ]);
        // The bisectors towards the far sites lie outside the area.
        for &other in site_edges.iter().filter_map(|edge| sites.get(edge.1)) {
            clip(&cell, site, other, &mut spare);
            std::mem::swap(&mut cell, &mut spare);
        }
        visit(site, &cell);
    }
}

/// Sorts `points` by their coordinates and removes duplicates.
pub(super) fn sorted_distinct_sites(points: &[Point]) -> Vec<Point> {
    // Adding zero turns -0 into 0, which `total_cmp` would tell apart.
    let mut sites: Vec<_> = points.iter().map(|p| Point::new(p.x + 0.0, p.y + 0.0)).collect();
    sites.sort_by(compare_coordinates);
    sites.dedup();
    sites
}

/// The order of sites: by x, then by y.
fn compare_coordinates(a: &Point, b: &Point) -> Ordering {
    a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y))
}

/// The edges of the Delaunay triangulation in both directions, sorted. They include every pair of sites that share a
/// border in the area.
///
/// Four additional sites are too far away to own a point of the area; their indices follow `sites`. They give every set
/// of sites a triangulation, also a single site or sites in a line. Cells are clipped by bisectors instead of built
/// from circumcentres, which are badly conditioned for needle-like triangles.
fn delaunay_edges(sites: &[Point], area: Area) -> Vec<(usize, usize)> {
    let (x, y, far) = (0.5 * area.width, 0.5 * area.height, 4.0 * area.diagonal());
    let far_sites = [(x - far, y), (x + far, y), (x, y - far), (x, y + far)];
    let all: Vec<_> = sites
        .iter()
        .map(|p| (p.x, p.y))
        .chain(far_sites)
        .map(delaunator::Point::from)
        .collect();
    let triangles = delaunator::triangulate(&all).triangles;
    let mut edges: Vec<_> = triangles
        .chunks_exact(3)
        .flat_map(|t| {
            let [a, b, c] = [t[0], t[1], t[2]];
            [(a, b), (b, c), (c, a), (b, a), (c, b), (a, c)]
        })
        .collect();
    edges.sort_unstable();
    edges.dedup();
    edges
}

/// Writes the part of the convex polygon `cell` that is at least as close to `site` as to `other` to `clipped`.
fn clip(cell: &[Point], site: Point, other: Point, clipped: &mut Vec<Point>) {
    let normal = Point::new(other.x - site.x, other.y - site.y);
    let middle = Point::new(0.5 * (site.x + other.x), 0.5 * (site.y + other.y));
    let beyond = |v: Point| (v.x - middle.x) * normal.x + (v.y - middle.y) * normal.y;
    clipped.clear();
    for (i, &from) in cell.iter().enumerate() {
        let to = cell[(i + 1) % cell.len()];
        let (at_from, at_to) = (beyond(from), beyond(to));
        if at_from <= 0.0 {
            clipped.push(from);
        }
        // A corner on the bisector is kept above, and adds no second corner here.
        if (at_from < 0.0 && at_to > 0.0) || (at_from > 0.0 && at_to < 0.0) {
            let t = at_from / (at_from - at_to);
            clipped.push(Point::new(from.x + t * (to.x - from.x), from.y + t * (to.y - from.y)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Layout, place_devices};
    use crate::rng::{Purpose, Stream};

    const SQUARE: Area = Area {
        width: 20.0,
        height: 20.0,
    };

    /// Computes [`farthest_cell_vertex`] by definition: candidates are all crossings of two border lines (bisectors of
    /// any two sites and the area's sides). Crossings in the area without a closer site count.
    fn farthest_crossing(points: &[Point], area: Area) -> f64 {
        let (w, h) = (area.width, area.height);
        let mut farthest = 0.0_f64;
        for (j, &site) in points.iter().enumerate() {
            // a x + b y = c
            let mut lines = vec![(1.0, 0.0, 0.0), (1.0, 0.0, w), (0.0, 1.0, 0.0), (0.0, 1.0, h)];
            for (i, other) in points.iter().enumerate() {
                if i != j && *other != site {
                    let c = other.x * other.x + other.y * other.y - site.x * site.x - site.y * site.y;
                    lines.push((2.0 * (other.x - site.x), 2.0 * (other.y - site.y), c));
                }
            }
            for (k, &(a, b, c)) in lines.iter().enumerate() {
                for &(d, e, f) in &lines[..k] {
                    let determinant = a * e - b * d;
                    let v = Point::new((c * e - b * f) / determinant, (a * f - c * d) / determinant);
                    let inside = v.x >= -1e-9 && v.x <= w + 1e-9 && v.y >= -1e-9 && v.y <= h + 1e-9;
                    let distance = v.distance(site);
                    if determinant != 0.0 && inside && points.iter().all(|p| p.distance(v) >= distance - 1e-9) {
                        farthest = farthest.max(distance);
                    }
                }
            }
        }
        farthest
    }

    fn compare_with_definition(points: &[Point], area: Area, case: &str) {
        let (distance, expected) = (farthest_cell_vertex(points, area), farthest_crossing(points, area));
        assert!(
            (distance - expected).abs() < 1e-6,
            "{case}: {distance} m, not {expected}, for {points:?}"
        );
    }

    #[test]
    fn a_perfect_grid_gives_half_the_diagonal_of_its_cells() {
        for side in [1_u32, 2, 3, 4, 5, 7, 10, 15, 16, 31, 100] {
            let n = side * side;
            let points = place_devices(&Layout::Grid, SQUARE, n, 0);
            let expected = (SQUARE.surface() / (2.0 * f64::from(n))).sqrt();
            let distance = farthest_cell_vertex(&points, SQUARE);
            assert!(
                (distance - expected).abs() < 1e-9,
                "N = {n}: {distance}, not {expected}"
            );
        }
    }

    #[test]
    fn uniform_sites_equal_the_definition() {
        let mut stream = Stream::new(11, Purpose::Layout, 9);
        let flat = Area {
            width: 30.0,
            height: 4.0,
        };
        for case in 0..600 {
            let (area, n) = ([SQUARE, flat][case % 2], 1 + case % 13);
            let points: Vec<_> = (0..n)
                .map(|_| Point::new(stream.unit() * area.width, stream.unit() * area.height))
                .collect();
            compare_with_definition(&points, area, "uniform");
        }
    }

    #[test]
    fn sites_on_lines_edges_and_a_lattice_equal_the_definition() {
        let mut stream = Stream::new(12, Purpose::Layout, 9);
        for case in 0..300 {
            let n = 1 + case % 9;
            let (slope, offset) = (stream.unit(), stream.unit());
            let line: Vec<_> = (0..n)
                .map(|_| stream.unit() * 19.0)
                .map(|x| Point::new(x, slope * x + offset))
                .collect();
            compare_with_definition(&line, SQUARE, "line");
            let vertical_line: Vec<_> = line.iter().map(|p| Point::new(7.0, p.x)).collect();
            compare_with_definition(&vertical_line, SQUARE, "vertical line");
            let edges: Vec<_> = (0..n)
                .map(|_| (stream.below(4), stream.unit() * 20.0))
                .map(|(side, t)| match side {
                    0 => Point::new(t, 0.0),
                    1 => Point::new(t, 20.0),
                    2 => Point::new(0.0, t),
                    _ => Point::new(20.0, t),
                })
                .collect();
            compare_with_definition(&edges, SQUARE, "edges");
            let lattice: Vec<_> = (0..n)
                .map(|_| Point::new(stream.below(5) as f64 * 5.0, stream.below(5) as f64 * 5.0))
                .collect();
            compare_with_definition(&lattice, SQUARE, "lattice with duplicates");
            let scale = [1e-15, 1e-12, 1e-9][case % 3];
            let mut nudge = |t: f64| (t + scale * (stream.unit() - 0.5)).clamp(0.0, 20.0);
            let nudged: Vec<_> = lattice.iter().map(|p| Point::new(nudge(p.x), nudge(p.y))).collect();
            let (distance, expected) = (
                farthest_cell_vertex(&nudged, SQUARE),
                farthest_crossing(&lattice, SQUARE),
            );
            assert!(
                (distance - expected).abs() < 1e-6,
                "nudged lattice: {distance} m, not {expected}, for {nudged:?}"
            );
        }
    }

    #[test]
    fn no_place_is_farther_from_its_closest_site_than_the_farthest_vertex() {
        let mut stream = Stream::new(13, Purpose::Epicentre, 0);
        for seed in 0..20 {
            let points = place_devices(&Layout::Uniform, SQUARE, 250, seed);
            let bound = farthest_cell_vertex(&points, SQUARE);
            let mut farthest = 0.0_f64;
            for _ in 0..20_000 {
                let place = Point::new(stream.unit() * 20.0, stream.unit() * 20.0);
                let closest = points.iter().map(|p| p.distance(place)).fold(f64::INFINITY, f64::min);
                farthest = farthest.max(closest);
            }
            // Of 20 000 random places, some lie close to the farthest vertex: the bound is not too large.
            assert!(
                farthest <= bound && farthest > 0.93 * bound,
                "seed {seed}: a place at {farthest} m, the farthest vertex at {bound} m"
            );
        }
    }

    #[test]
    fn cells_cover_the_area_and_contain_the_places_closest_to_their_device() {
        let mut stream = Stream::new(14, Purpose::Epicentre, 0);
        for (seed, n) in [(1, 1), (2, 2), (3, 60), (4, 250)] {
            let points = place_devices(&Layout::Uniform, SQUARE, n, seed);
            let cells = voronoi_cells(&points, SQUARE);
            // The shoelace formula.
            let doubled_area = |cell: &[Point]| -> f64 {
                let next = cell.iter().cycle().skip(1);
                cell.iter().zip(next).map(|(a, b)| a.x * b.y - b.x * a.y).sum()
            };
            let surface: f64 = cells.iter().map(|cell| 0.5 * doubled_area(cell)).sum();
            assert!(
                (surface - SQUARE.surface()).abs() < 1e-6,
                "{n} devices: cells of {surface} m² in total"
            );
            for _ in 0..2_000 {
                let place = Point::new(stream.unit() * 20.0, stream.unit() * 20.0);
                let closest =
                    (0..points.len()).min_by(|a, b| points[*a].distance(place).total_cmp(&points[*b].distance(place)));
                let cell = &cells[closest.expect("devices")];
                let next = cell.iter().cycle().skip(1);
                let is_left_of_edge =
                    |(a, b): (&Point, &Point)| (b.x - a.x) * (place.y - a.y) - (b.y - a.y) * (place.x - a.x) > -1e-6;
                assert!(
                    cell.iter().zip(next).all(is_left_of_edge),
                    "{place:?} is outside {cell:?}"
                );
            }
        }
        let twins = [Point::new(3.0, 4.0), Point::new(3.0, 4.0)];
        assert_eq!(
            voronoi_cells(&twins, SQUARE).iter().map(Vec::len).collect::<Vec<_>>(),
            [4, 4]
        );
        assert!(voronoi_cells(&[], SQUARE).is_empty());
    }

    #[test]
    fn near_and_exact_duplicates_change_nothing() {
        let points = place_devices(&Layout::JitteredGrid, SQUARE, 40, 3);
        let without_twins = farthest_cell_vertex(&points, SQUARE);
        for gap in [0.0, 1e-15, 1e-13, 1e-10, 1e-7] {
            let twins = points.iter().map(|p| Point::new(p.x + gap, p.y - gap));
            let with_twins: Vec<_> = points.iter().copied().chain(twins).collect();
            let distance = farthest_cell_vertex(&with_twins, SQUARE);
            assert!(
                (distance - without_twins).abs() <= 2.0 * gap + 1e-9,
                "gap {gap}: {distance} m, not {without_twins}"
            );
        }
        let coincident = vec![Point::new(0.0, 0.0); 50];
        assert!((farthest_cell_vertex(&coincident, SQUARE) - SQUARE.diagonal()).abs() < 1e-12);
        assert!(farthest_cell_vertex(&[], SQUARE).is_infinite());
    }
}
