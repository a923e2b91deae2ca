//! Clusters of devices in the reference, as in the `knn` policy (Sec. V-A, Algorithm 1), by exhaustive computation.
//! They must equal the clusters of `bs/src/beliefs/clusters/` (`tests/tests/clusters.rs`) with the same draws in the
//! same order, but share no code with it. Its limits of rounds are repeated here.

use std::f64::consts::PI;

use reveille_bs::beliefs::clusters::ClusterSettings;
use reveille_common::geometry::{Area, Point};
use reveille_common::rng::Stream;

/// Maximum number of voting rounds.
const MAX_VOTING_ROUNDS: usize = 100;
/// Maximum number of rounds in which the two halves of a cluster are improved.
const MAX_SPLIT_ROUNDS: usize = 10;

/// Computes the clusters of devices at `points`: devices in the order of numbers, clusters by their first device.
/// `stream` must be new, with `Purpose::Clusters`. Without neighbours no device moves.
///
/// M = ⌈ξ/(π d_max²)⌉ centres, with ξ the size of the area, are drawn from the devices, the first uniformly. Each other
/// centre is drawn with probability proportional to its squared distance from the nearest centre so far. Every device
/// joins its nearest centre. Then all devices simultaneously join the most frequent cluster among their `neighbours`
/// nearest devices, until none moves, in at most `MAX_VOTING_ROUNDS` rounds. Ties go to the cluster with the nearer
/// centroid. With `limit_radius` a cluster with a member farther than `d_max` from its mean is split in two, until
/// every member is that near.
pub fn clusters(
    points: &[Point],
    area: Area,
    d_max: f64,
    settings: ClusterSettings,
    stream: Stream,
) -> Vec<Vec<usize>> {
    let centre_count = (area.width * area.height / (PI * d_max * d_max)).ceil() as usize;
    let mut voting = ReferenceVoting::start(points, centre_count.max(1).min(points.len()), stream);
    let voters: Vec<Vec<usize>> = (0..points.len())
        .map(|j| nearest(points, j, settings.neighbours as usize))
        .collect();
    for _ in 0..MAX_VOTING_ROUNDS {
        let previous_voting = voting.clone();
        voting.vote(&voters);
        if voting == previous_voting {
            break;
        }
    }
    let mut formed_clusters: Vec<Vec<usize>> = (0..voting.centroids.len())
        .map(|cluster| voting.members(cluster))
        .collect();
    if settings.limit_radius {
        formed_clusters = formed_clusters
            .into_iter()
            .flat_map(|cluster| split(points, cluster, d_max))
            .collect();
    }
    formed_clusters.sort();
    formed_clusters
}

fn squared_distance(a: Point, b: Point) -> f64 {
    (a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y)
}

/// Returns the `count` devices nearest to device `j`, without `j`; ties go to the lower number.
fn nearest(points: &[Point], j: usize, count: usize) -> Vec<usize> {
    let mut others: Vec<usize> = (0..points.len()).filter(|&other| other != j).collect();
    // A stable sort keeps the order of numbers.
    others.sort_by(|&a, &b| squared_distance(points[a], points[j]).total_cmp(&squared_distance(points[b], points[j])));
    others.truncate(count);
    others
}

/// Returns the mean position of some devices.
fn mean(points: &[Point], devices: &[usize]) -> Point {
    let (mut x, mut y) = (0.0, 0.0);
    for &j in devices {
        x += points[j].x;
        y += points[j].y;
    }
    Point::new(x / devices.len() as f64, y / devices.len() as f64)
}

/// Clusters while devices vote.
#[derive(Clone, PartialEq)]
struct ReferenceVoting<'a> {
    points: &'a [Point],
    /// Cluster of each device.
    cluster_of: Vec<usize>,
    /// Mean position of each cluster.
    centroids: Vec<Point>,
}

impl<'a> ReferenceVoting<'a> {
    /// Draws `centre_count` centres, at most one per device, and forms their clusters.
    fn start(points: &'a [Point], centre_count: usize, mut stream: Stream) -> Self {
        let mut centroids: Vec<Point> = Vec::new();
        // By device, the squared distance from the nearest centre so far.
        let mut squared_distances = vec![f64::INFINITY; points.len()];
        for _ in 0..centre_count {
            let drawn_device = if centroids.is_empty() {
                stream.below(points.len() as u64) as usize
            } else {
                draw_index(&squared_distances, stream.unit())
            };
            centroids.push(points[drawn_device]);
            for (j, squared) in squared_distances.iter_mut().enumerate() {
                *squared = squared.min(squared_distance(points[j], points[drawn_device]));
            }
        }
        let closest_centre = |p: &Point| {
            let distances: Vec<f64> = centroids.iter().map(|centre| squared_distance(*p, *centre)).collect();
            let least = distances.iter().copied().fold(f64::INFINITY, f64::min);
            // Ties go to the centre with the lower number.
            distances.iter().position(|distance| *distance <= least).unwrap_or(0)
        };
        let mut voting = Self {
            points,
            cluster_of: points.iter().map(closest_centre).collect(),
            centroids,
        };
        voting.recentre_and_fill();
        voting
    }

    /// Returns the devices of a cluster, by number.
    fn members(&self, cluster: usize) -> Vec<usize> {
        (0..self.points.len())
            .filter(|&j| self.cluster_of[j] == cluster)
            .collect()
    }

    /// Moves each centroid to the mean of its devices; the centroid of an empty cluster stays.
    fn recentre(&mut self) {
        for cluster in 0..self.centroids.len() {
            let members = self.members(cluster);
            if !members.is_empty() {
                self.centroids[cluster] = mean(self.points, &members);
            }
        }
    }

    /// Recomputes the centroids as means and fills each empty cluster: it takes the device farthest from its centroid,
    /// among clusters with more than one device. The order of distances stays the same for all empty clusters.
    fn recentre_and_fill(&mut self) {
        self.recentre();
        let distance_from_centroid = |j: usize| squared_distance(self.points[j], self.centroids[self.cluster_of[j]]);
        let mut farthest_first: Vec<usize> = (0..self.points.len()).collect();
        farthest_first.sort_by(|&a, &b| distance_from_centroid(b).total_cmp(&distance_from_centroid(a)));
        let mut next_farthest = 0;
        let empty_clusters: Vec<usize> = (0..self.centroids.len())
            .filter(|&cluster| self.members(cluster).is_empty())
            .collect();
        for &cluster in &empty_clusters {
            let is_alone = |j: usize| self.members(self.cluster_of[j]).len() < 2;
            while next_farthest < farthest_first.len() && is_alone(farthest_first[next_farthest]) {
                next_farthest += 1;
            }
            if next_farthest < farthest_first.len() {
                self.cluster_of[farthest_first[next_farthest]] = cluster;
                next_farthest += 1;
            }
        }
        if !empty_clusters.is_empty() {
            self.recentre();
        }
    }

    /// Moves every device to the most frequent cluster among its `voters`.
    fn vote(&mut self, voters: &[Vec<usize>]) {
        let chosen_cluster = |j: usize| {
            let votes = |cluster: usize| {
                let is_vote = |voter: &&usize| self.cluster_of[**voter] == cluster;
                voters[j].iter().filter(is_vote).count()
            };
            let most_votes = (0..self.centroids.len()).map(votes).max().unwrap_or(0);
            // A single device has no neighbours and stays.
            if most_votes == 0 {
                return self.cluster_of[j];
            }
            let mut best: Option<(f64, usize)> = None;
            for cluster in (0..self.centroids.len()).filter(|&cluster| votes(cluster) == most_votes) {
                let distance = squared_distance(self.points[j], self.centroids[cluster]);
                if best.is_none_or(|(least, _)| distance < least) {
                    best = Some((distance, cluster));
                }
            }
            best.map_or(self.cluster_of[j], |(_, cluster)| cluster)
        };
        self.cluster_of = (0..self.points.len()).map(chosen_cluster).collect();
        self.recentre_and_fill();
    }
}

/// Draws an index in proportion to its weight; `unit` selects the position in the sum of all weights.
fn draw_index(weights: &[f64], unit: f64) -> usize {
    let mut remainder = unit * weights.iter().sum::<f64>();
    let positive: Vec<usize> = (0..weights.len()).filter(|&j| weights[j] > 0.0).collect();
    for &j in &positive {
        if remainder < weights[j] {
            return j;
        }
        remainder -= weights[j];
    }
    // Rounding can leave a remainder after the last weight.
    positive.last().copied().unwrap_or(0)
}

/// Splits a cluster into parts whose members are all within `d_max` of the part's mean.
fn split(points: &[Point], cluster: Vec<usize>, d_max: f64) -> Vec<Vec<usize>> {
    let middle = mean(points, &cluster);
    let is_wide = cluster.iter().any(|&j| distance(points[j], middle) > d_max);
    if !is_wide {
        return vec![cluster];
    }
    let farthest = |from: Point| {
        let mut best = from;
        for &j in &cluster {
            if squared_distance(points[j], from) > squared_distance(best, from) {
                best = points[j];
            }
        }
        best
    };
    let first_pole = farthest(middle);
    let mut poles = (first_pole, farthest(first_pole));
    let mut halves = (cluster.clone(), Vec::new());
    for _ in 0..MAX_SPLIT_ROUNDS {
        let is_in_first = |j: &&usize| squared_distance(points[**j], poles.0) <= squared_distance(points[**j], poles.1);
        let (first, second): (Vec<usize>, Vec<usize>) = (
            cluster.iter().filter(is_in_first).copied().collect(),
            cluster.iter().filter(|j| !is_in_first(j)).copied().collect(),
        );
        if first.is_empty() || second.is_empty() || first == halves.0 {
            break;
        }
        poles = (mean(points, &first), mean(points, &second));
        halves = (first, second);
    }
    let (first, second) = halves;
    if second.is_empty() {
        return vec![first];
    }
    let mut parts = split(points, first, d_max);
    parts.extend(split(points, second, d_max));
    parts
}

/// Distance between two points, metres. Used by all of the reference, so that it does not depend on `Point::distance`.
pub(super) fn distance(a: Point, b: Point) -> f64 {
    ((a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y)).sqrt()
}
