//! Adjacency of Voronoi cells, and tints that distinguish neighbouring clusters.

use std::collections::BTreeSet;

use reveille_common::geometry::Point;

use super::scale::{AxisTick, Scale};

/// Returns the device on the other side of the edge `from`–`to` of the cell of `own`, if any.
fn across(points: &[Point], own: usize, from: Point, to: Point) -> Option<usize> {
    let middle = Point::new(0.5 * (from.x + to.x), 0.5 * (from.y + to.y));
    let reach = middle.distance(points[own]);
    let others = (0..points.len()).filter(|j| points[*j] != points[own]);
    // On a common edge both devices are equally far from the middle; on the border of the area all others are farther.
    let near = others.min_by(|a, b| points[*a].distance(middle).total_cmp(&points[*b].distance(middle)))?;
    (points[near].distance(middle) <= reach + 1e-6).then_some(near)
}

/// Returns the edges of a cell, as pairs of corners. Edges of zero length are omitted.
fn edges(cell: &[Point]) -> impl Iterator<Item = (Point, Point)> + '_ {
    let next = cell.iter().cycle().skip(1);
    let pairs = cell.iter().zip(next).map(|(a, b)| (*a, *b));
    pairs.filter(|(a, b)| a.distance(*b) > 1e-9)
}

/// Returns pairs of devices with adjacent cells, in both orders. `cells` are the cells of the devices at `points`.
pub(super) fn neighbours(points: &[Point], cells: &[Vec<Point>]) -> BTreeSet<(usize, usize)> {
    let mut pairs = BTreeSet::new();
    for (own, cell) in cells.iter().enumerate() {
        for other in edges(cell).filter_map(|(from, to)| across(points, own, from, to)) {
            pairs.insert((own, other));
            pairs.insert((other, own));
        }
    }
    pairs
}

/// Returns the edges between cells of different clusters; `of` is the cluster of each device.
pub(super) fn borders(points: &[Point], cells: &[Vec<Point>], of: &[u32]) -> Vec<(Point, Point)> {
    let mut lines = Vec::new();
    for (own, cell) in cells.iter().enumerate() {
        let is_border = |(from, to): &(Point, Point)| {
            // Both cells have the edge; it is taken from the one with the lower number.
            across(points, own, *from, *to).is_some_and(|other| own < other && of[own] != of[other])
        };
        lines.extend(edges(cell).filter(is_border));
    }
    lines
}

/// Returns the tint of each cluster, `0 .. count`. Adjacent clusters differ if that many tints suffice.
pub(super) fn tints(neighbours: &BTreeSet<(usize, usize)>, of: &[u32], count: usize) -> Vec<usize> {
    let clusters = of.iter().max().map_or(0, |last| *last as usize + 1);
    let mut touching = vec![BTreeSet::new(); clusters];
    for (a, b) in neighbours {
        if of[*a] != of[*b] {
            touching[of[*a] as usize].insert(of[*b] as usize);
        }
    }
    let mut tints: Vec<usize> = Vec::with_capacity(clusters);
    for (cluster, touched) in touching.iter().enumerate() {
        // Clusters with higher numbers have no tint yet; they will avoid this one.
        let taken: Vec<usize> = touched.iter().filter_map(|other| tints.get(*other).copied()).collect();
        let free = (0..count).find(|tint| !taken.contains(tint));
        tints.push(free.unwrap_or(cluster % count));
    }
    tints
}

/// Returns the ticks from 0 to `length` metres.
pub(super) fn ticks(length: f64) -> Vec<AxisTick> {
    let ticks = Scale::Linear { from: 0.0, to: length }.ticks();
    ticks.into_iter().filter(|t| t.value <= length + 1e-9).collect()
}

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Area, Layout, cells, place};

    use super::*;

    const SQUARE: Area = Area {
        width: 20.0,
        height: 20.0,
    };

    #[test]
    fn a_grid_has_the_neighbours_of_a_chess_board() {
        let points = place(&Layout::Grid, SQUARE, 9, 0);
        let cells = cells(&points, SQUARE);
        let pairs = neighbours(&points, &cells);
        assert_eq!(pairs.len(), 24, "12 borders, both ways");
        let at = |x: f64, y: f64| {
            let by = |j: &usize| points[*j].distance(Point::new(x, y));
            (0..9).min_by(|a, b| by(a).total_cmp(&by(b))).expect("nine devices")
        };
        let (corner, side, centre) = (at(3.0, 3.0), at(10.0, 3.0), at(10.0, 10.0));
        assert!(pairs.contains(&(corner, side)) && pairs.contains(&(side, centre)));
        assert!(!pairs.contains(&(corner, centre)), "they share only a corner");
        let halves: Vec<u32> = points.iter().map(|p| u32::from(p.x > 7.0)).collect();
        let lines = borders(&points, &cells, &halves);
        let length: f64 = lines.iter().map(|(a, b)| a.distance(*b)).sum();
        assert!((length - 20.0).abs() < 1e-6, "one line across the area");
    }

    #[test]
    fn the_edge_of_the_area_is_no_border() {
        let points = [Point::new(9.5, 10.0), Point::new(10.5, 10.0)];
        let lines = borders(&points, &cells(&points, SQUARE), &[0, 1]);
        assert_eq!(lines.len(), 1, "{lines:?}");
        assert!((lines[0].0.distance(lines[0].1) - 20.0).abs() < 1e-9);
    }

    #[test]
    fn touching_clusters_have_different_tints() {
        let points = place(&Layout::Uniform, SQUARE, 120, 5);
        let cells = cells(&points, SQUARE);
        let pairs = neighbours(&points, &cells);
        let of: Vec<u32> = (0..120).collect();
        let tints = tints(&pairs, &of, 6);
        assert!(pairs.iter().all(|(a, b)| tints[*a] != tints[*b]));
    }
}
