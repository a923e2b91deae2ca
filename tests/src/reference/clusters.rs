//! Clusters of devices as in the `knn` policy (Sec. V-A, Algorithm 1), by exhaustive computation.

use std::f64::consts::PI;

use reveille_common::geometry::{Area, Point};
use reveille_common::rng::Stream;

/// Maximum number of voting rounds.
const VOTES: usize = 100;
/// Maximum number of draws of the two halves of a cluster.
const HALVINGS: usize = 10;

/// Computes the clusters of devices at `points`: devices in the order of numbers, clusters by their first device.
///
/// M = ⌈ξ/(π d_max²)⌉ centres are drawn from the devices, the first uniformly. Each other centre is drawn with
/// probability proportional to its squared distance from the nearest centre so far. Every device joins its nearest
/// centre. Then all devices simultaneously join the most frequent cluster among their `neighbours` nearest devices,
/// until none moves. Ties go to the cluster with the nearer centroid. With `limit` a cluster with a member farther than
/// `d_max` from its mean is split in two.
pub fn clusters(
    points: &[Point],
    area: Area,
    d_max: f64,
    (neighbours, limit): (usize, bool),
    stream: Stream,
) -> Vec<Vec<usize>> {
    let count = (area.width * area.height / (PI * d_max * d_max)).ceil() as usize;
    let mut voting = ReferenceVoting::start(points, count.max(1).min(points.len()), stream);
    let near: Vec<Vec<usize>> = (0..points.len()).map(|j| nearest(points, j, neighbours)).collect();
    for _ in 0..VOTES {
        let before = voting.clone();
        voting.vote(&near);
        if voting == before {
            break;
        }
    }
    let of = |cluster| (0..points.len()).filter(|&j| voting.of[j] == cluster).collect();
    let mut found: Vec<Vec<usize>> = (0..voting.centroids.len()).map(of).collect();
    if limit {
        found = found
            .into_iter()
            .flat_map(|cluster| parted(points, cluster, d_max))
            .collect();
    }
    found.sort();
    found
}

fn squared(a: Point, b: Point) -> f64 {
    (a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y)
}

/// Returns the `count` devices nearest to device `j`, without `j`; ties go to the lower number.
fn nearest(points: &[Point], j: usize, count: usize) -> Vec<usize> {
    let mut others: Vec<usize> = (0..points.len()).filter(|&other| other != j).collect();
    // A stable sort keeps the order of numbers.
    others.sort_by(|&a, &b| squared(points[a], points[j]).total_cmp(&squared(points[b], points[j])));
    others.truncate(count);
    others
}

/// Returns the mean position of some devices.
fn mean(points: &[Point], of: &[usize]) -> Point {
    let (mut x, mut y) = (0.0, 0.0);
    for &j in of {
        x += points[j].x;
        y += points[j].y;
    }
    Point::new(x / of.len() as f64, y / of.len() as f64)
}

#[derive(Clone, PartialEq)]
struct ReferenceVoting<'a> {
    points: &'a [Point],
    of: Vec<usize>,
    centroids: Vec<Point>,
}

impl<'a> ReferenceVoting<'a> {
    fn start(points: &'a [Point], count: usize, mut stream: Stream) -> Self {
        let mut centroids: Vec<Point> = Vec::new();
        let mut gaps = vec![f64::INFINITY; points.len()];
        for _ in 0..count {
            let drawn = if centroids.is_empty() {
                stream.below(points.len() as u64) as usize
            } else {
                draw(&gaps, stream.unit())
            };
            centroids.push(points[drawn]);
            for (j, gap) in gaps.iter_mut().enumerate() {
                *gap = gap.min(squared(points[j], points[drawn]));
            }
        }
        let closest = |p: &Point| {
            let gaps: Vec<f64> = centroids.iter().map(|centre| squared(*p, *centre)).collect();
            let least = gaps.iter().copied().fold(f64::INFINITY, f64::min);
            // Ties go to the centre with the lower number.
            gaps.iter().position(|gap| *gap <= least).unwrap_or(0)
        };
        let mut voting = Self {
            points,
            of: points.iter().map(closest).collect(),
            centroids,
        };
        voting.settle();
        voting
    }

    fn members(&self, cluster: usize) -> Vec<usize> {
        (0..self.points.len()).filter(|&j| self.of[j] == cluster).collect()
    }

    fn recentre(&mut self) {
        for cluster in 0..self.centroids.len() {
            let members = self.members(cluster);
            if !members.is_empty() {
                self.centroids[cluster] = mean(self.points, &members);
            }
        }
    }

    /// Recomputes the centroids as means and fills each empty cluster: it takes the device farthest from its centroid,
    /// among clusters with more than one device. All of them use the same distances.
    fn settle(&mut self) {
        self.recentre();
        let off = |voting: &Self, j: usize| squared(voting.points[j], voting.centroids[voting.of[j]]);
        let mut far: Vec<usize> = (0..self.points.len()).collect();
        far.sort_by(|&a, &b| off(self, b).total_cmp(&off(self, a)));
        let mut next = 0;
        let empty: Vec<usize> = (0..self.centroids.len())
            .filter(|&c| self.members(c).is_empty())
            .collect();
        for &cluster in &empty {
            while next < far.len() && self.members(self.of[far[next]]).len() < 2 {
                next += 1;
            }
            if next < far.len() {
                self.of[far[next]] = cluster;
                next += 1;
            }
        }
        if !empty.is_empty() {
            self.recentre();
        }
    }

    fn vote(&mut self, near: &[Vec<usize>]) {
        let chosen = |j: usize| {
            let votes = |cluster: usize| near[j].iter().filter(|&&other| self.of[other] == cluster).count();
            let most = (0..self.centroids.len()).map(votes).max().unwrap_or(0);
            // A single device has no neighbours and stays.
            if most == 0 {
                return self.of[j];
            }
            let mut best: Option<(f64, usize)> = None;
            for cluster in (0..self.centroids.len()).filter(|&cluster| votes(cluster) == most) {
                let gap = squared(self.points[j], self.centroids[cluster]);
                if best.is_none_or(|(least, _)| gap < least) {
                    best = Some((gap, cluster));
                }
            }
            best.map_or(self.of[j], |(_, cluster)| cluster)
        };
        self.of = (0..self.points.len()).map(chosen).collect();
        self.settle();
    }
}

/// Draws an index in proportion to its weight; `unit` selects the position in the sum of all weights.
fn draw(weights: &[f64], unit: f64) -> usize {
    let mut left = unit * weights.iter().sum::<f64>();
    let heavy: Vec<usize> = (0..weights.len()).filter(|&j| weights[j] > 0.0).collect();
    for &j in &heavy {
        if left < weights[j] {
            return j;
        }
        left -= weights[j];
    }
    // Rounding can leave a remainder after the last weight.
    heavy.last().copied().unwrap_or(0)
}

/// Splits a cluster into parts whose members are all within `d_max` of the part's mean.
fn parted(points: &[Point], cluster: Vec<usize>, d_max: f64) -> Vec<Vec<usize>> {
    let middle = mean(points, &cluster);
    let is_wide = cluster.iter().any(|&j| distance(points[j], middle) > d_max);
    if !is_wide {
        return vec![cluster];
    }
    let farthest = |from: Point| {
        let mut far = from;
        for &j in &cluster {
            if squared(points[j], from) > squared(far, from) {
                far = points[j];
            }
        }
        far
    };
    let first = farthest(middle);
    let mut ends = (first, farthest(first));
    let mut halves = (cluster.clone(), Vec::new());
    for _ in 0..HALVINGS {
        let is_first = |j: &&usize| squared(points[**j], ends.0) <= squared(points[**j], ends.1);
        let (a, b): (Vec<usize>, Vec<usize>) = (
            cluster.iter().filter(is_first).copied().collect(),
            cluster.iter().filter(|j| !is_first(j)).copied().collect(),
        );
        if a.is_empty() || b.is_empty() || a == halves.0 {
            break;
        }
        ends = (mean(points, &a), mean(points, &b));
        halves = (a, b);
    }
    let (a, b) = halves;
    if b.is_empty() {
        return vec![a];
    }
    let mut parts = parted(points, a, d_max);
    parts.extend(parted(points, b, d_max));
    parts
}

/// Distance between two points, metres.
pub(super) fn distance(a: Point, b: Point) -> f64 {
    ((a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y)).sqrt()
}
