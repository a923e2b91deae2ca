//! Adjacency of Voronoi cells and tints that distinguish neighbouring clusters, for the deployment figure, and ticks in
//! metres. Nothing but the look of figures depends on it.

use std::collections::BTreeSet;

use reveille_common::geometry::Point;

use super::scale::{AxisTick, Scale};

/// Returns the device on the other side of the edge `from`–`to` of the cell of `device`, if any.
fn device_across(positions: &[Point], device: usize, from: Point, to: Point) -> Option<usize> {
    let middle = Point::new(0.5 * (from.x + to.x), 0.5 * (from.y + to.y));
    let distance = middle.distance(positions[device]);
    let others = (0..positions.len()).filter(|j| positions[*j] != positions[device]);
    // On a common edge both devices are equally far from the middle; on the border of the area all others are farther.
    let closest_device = others.min_by(|a, b| {
        positions[*a]
            .distance(middle)
            .total_cmp(&positions[*b].distance(middle))
    })?;
    (positions[closest_device].distance(middle) <= distance + 1e-6).then_some(closest_device)
}

/// Returns the edges of a cell, as pairs of corners. Edges of zero length are omitted.
fn edges(cell: &[Point]) -> impl Iterator<Item = (Point, Point)> + '_ {
    let next = cell.iter().cycle().skip(1);
    let pairs = cell.iter().zip(next).map(|(a, b)| (*a, *b));
    pairs.filter(|(a, b)| a.distance(*b) > 1e-9)
}

/// Returns pairs of devices with adjacent cells, in both orders. `cells` are the cells of the devices at `positions`.
pub(super) fn adjacent_devices(positions: &[Point], cells: &[Vec<Point>]) -> BTreeSet<(usize, usize)> {
    let mut pairs = BTreeSet::new();
    for (device, cell) in cells.iter().enumerate() {
        for other in edges(cell).filter_map(|(from, to)| device_across(positions, device, from, to)) {
            pairs.insert((device, other));
            pairs.insert((other, device));
        }
    }
    pairs
}

/// Returns the edges between cells of different clusters; `cluster_of` holds the cluster of each device.
pub(super) fn cluster_borders(positions: &[Point], cells: &[Vec<Point>], cluster_of: &[u32]) -> Vec<(Point, Point)> {
    let mut lines = Vec::new();
    for (device, cell) in cells.iter().enumerate() {
        let is_border = |(from, to): &(Point, Point)| {
            // Both cells have the edge; it is taken from the one with the lower number.
            device_across(positions, device, *from, *to)
                .is_some_and(|other| device < other && cluster_of[device] != cluster_of[other])
        };
        lines.extend(edges(cell).filter(is_border));
    }
    lines
}

/// Returns the tint of each cluster, `0 .. tint_count`. Adjacent clusters differ, except where those with lower numbers
/// have all tints.
pub(super) fn assign_tints(neighbours: &BTreeSet<(usize, usize)>, cluster_of: &[u32], tint_count: usize) -> Vec<usize> {
    let clusters = cluster_of.iter().max().map_or(0, |last| *last as usize + 1);
    let mut adjacent_clusters = vec![BTreeSet::new(); clusters];
    for (a, b) in neighbours {
        if cluster_of[*a] != cluster_of[*b] {
            adjacent_clusters[cluster_of[*a] as usize].insert(cluster_of[*b] as usize);
        }
    }
    let mut tints: Vec<usize> = Vec::with_capacity(clusters);
    for (cluster, adjacent) in adjacent_clusters.iter().enumerate() {
        // Clusters with higher numbers have no tint yet; they will avoid this one.
        let taken: Vec<usize> = adjacent.iter().filter_map(|other| tints.get(*other).copied()).collect();
        let free = (0..tint_count).find(|tint| !taken.contains(tint));
        tints.push(free.unwrap_or(cluster % tint_count));
    }
    tints
}

/// Returns the ticks from 0 to `length` metres.
pub(super) fn metre_ticks(length: f64) -> Vec<AxisTick> {
    let ticks = Scale::Linear { from: 0.0, to: length }.ticks();
    ticks.into_iter().filter(|t| t.value <= length + 1e-9).collect()
}

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Area, Layout, place_devices, voronoi_cells};

    use super::*;

    const AREA: Area = Area {
        width: 20.0,
        height: 20.0,
    };

    #[test]
    fn a_grid_has_horizontal_and_vertical_neighbours() {
        let points = place_devices(&Layout::Grid, AREA, 9, 0);
        let cells = voronoi_cells(&points, AREA);
        let pairs = adjacent_devices(&points, &cells);
        assert_eq!(pairs.len(), 24, "12 borders, both ways");
        let device_near = |x: f64, y: f64| {
            let distance = |j: &usize| points[*j].distance(Point::new(x, y));
            (0..9)
                .min_by(|a, b| distance(a).total_cmp(&distance(b)))
                .expect("nine devices")
        };
        let (corner, side, centre) = (device_near(3.0, 3.0), device_near(10.0, 3.0), device_near(10.0, 10.0));
        assert!(pairs.contains(&(corner, side)) && pairs.contains(&(side, centre)));
        assert!(!pairs.contains(&(corner, centre)), "they share only a corner");
        let clusters: Vec<u32> = points.iter().map(|point| u32::from(point.x > 7.0)).collect();
        let lines = cluster_borders(&points, &cells, &clusters);
        let length: f64 = lines.iter().map(|(a, b)| a.distance(*b)).sum();
        assert!((length - 20.0).abs() < 1e-6, "one line across the area");
    }

    #[test]
    fn cluster_borders_leave_out_the_edge_of_the_area() {
        let points = [Point::new(9.5, 10.0), Point::new(10.5, 10.0)];
        let lines = cluster_borders(&points, &voronoi_cells(&points, AREA), &[0, 1]);
        assert_eq!(lines.len(), 1, "{lines:?}");
        assert!((lines[0].0.distance(lines[0].1) - 20.0).abs() < 1e-9);
    }

    #[test]
    fn adjacent_clusters_have_different_tints() {
        let points = place_devices(&Layout::Uniform, AREA, 120, 5);
        let cells = voronoi_cells(&points, AREA);
        let pairs = adjacent_devices(&points, &cells);
        // Each device is its own cluster.
        let clusters: Vec<u32> = (0..120).collect();
        let tints = assign_tints(&pairs, &clusters, 6);
        assert!(pairs.iter().all(|(a, b)| tints[*a] != tints[*b]));
    }
}
