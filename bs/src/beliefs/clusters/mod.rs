//! Clusters of neighbouring devices, with one device in S1 at a time (Sec. V-A, Algorithm 1, lines 1 and 2), for the
//! policy `knn`.
//!
//! `tests/src/reference/clusters.rs` computes the same clusters exhaustively. Ties and the order of random draws are
//! part of the result, and so of digests and of the cluster numbers in maps.

use std::f64::consts::PI;

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::DeviceId;
use reveille_common::rng::Stream;

/// Maximum number of voting rounds, since votes can alternate for ever.
const MAX_VOTING_ROUNDS: u32 = 100;

/// Maximum number of 2-means rounds when a cluster is split.
const MAX_HALVING_ROUNDS: u32 = 10;

/// Settings for forming clusters (Algorithm 1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClusterSettings {
    /// Number K of neighbours that vote on a device's cluster, ≥ 1.
    pub neighbours: u32,
    /// Whether a cluster with a member farther than d_max from its centroid is split.
    pub limit_radius: bool,
}

/// A partition of the devices.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Clusters {
    /// Devices of each cluster, at least one, in ascending order. Clusters are in the order of their first devices.
    pub members: Vec<Vec<DeviceId>>,
    /// The cluster of each device, an index into `members`.
    pub cluster_of: Vec<u32>,
    /// Number M = ⌈ξ/(π `d_max`²)⌉ of clusters formed, at most N: `members.len()` before splitting.
    pub formed_count: usize,
}

impl Clusters {
    /// Forms clusters of the devices at `points` in `area` for the sensing range `d_max`, metres, > 0. `centre_stream`
    /// draws the centres of the k-means++ start. With [`ClusterSettings::limit_radius`], no device is farther than
    /// `d_max` from the mean of its cluster.
    pub fn form(points: &[Point], area: Area, d_max: f64, settings: ClusterSettings, centre_stream: Stream) -> Self {
        let discs_per_area = (area.surface() / (PI * d_max * d_max)).ceil() as usize;
        let formed_count = discs_per_area.max(1).min(points.len());
        let mut members = vote(points, area, formed_count, settings.neighbours as usize, centre_stream);
        if settings.limit_radius {
            members = members.into_iter().flat_map(|m| split(points, m, d_max)).collect();
        }
        members.sort_unstable();
        let mut cluster_of = vec![0; points.len()];
        for (cluster, members) in (0..).zip(&members) {
            for member in members {
                cluster_of[member.index()] = cluster;
            }
        }
        Self {
            members,
            cluster_of,
            formed_count,
        }
    }
}

/// Forms up to `count` clusters by the votes of each device's `k` nearest neighbours.
fn vote(points: &[Point], area: Area, count: usize, k: usize, centre_stream: Stream) -> Vec<Vec<DeviceId>> {
    let neighbours = nearest_neighbours(points, area, k);
    let mut partition = Partition::start(points, count, centre_stream);
    for _ in 0..MAX_VOTING_ROUNDS {
        let next = partition.vote_once(&neighbours);
        let is_settled = next == partition;
        partition = next;
        if is_settled {
            break;
        }
    }
    let mut members = vec![Vec::new(); count];
    for (device, &cluster) in (0..).zip(&partition.cluster_of) {
        members[cluster as usize].push(DeviceId(device));
    }
    members
}

/// The cluster of each device and the centroid of each cluster.
#[derive(Clone, Debug, PartialEq)]
struct Partition<'a> {
    points: &'a [Point],
    cluster_of: Vec<u32>,
    centroids: Vec<Point>,
}

impl<'a> Partition<'a> {
    /// Assigns each device to the nearest of `count` k-means++ centres; `count` is at most the number of devices.
    fn start(points: &'a [Point], count: usize, mut stream: Stream) -> Self {
        let mut squared_distances = vec![f64::INFINITY; points.len()];
        let mut cluster_of = vec![0; points.len()];
        let mut centroids = Vec::with_capacity(count);
        for cluster in 0..count {
            let centre = if cluster == 0 {
                points[stream.below(points.len() as u64) as usize]
            } else {
                points[draw_by_weight(&squared_distances, &mut stream)]
            };
            centroids.push(centre);
            let devices = points.iter().zip(&mut squared_distances).zip(&mut cluster_of);
            for ((p, nearest_squared), cluster_of) in devices {
                let squared_distance = p.distance_squared(centre);
                if squared_distance < *nearest_squared {
                    (*nearest_squared, *cluster_of) = (squared_distance, cluster as u32);
                }
            }
        }
        let mut partition = Self {
            points,
            cluster_of,
            centroids,
        };
        partition.recentre();
        partition
    }

    /// Returns the partition in which each device joins the current cluster of most of its neighbours.
    fn vote_once(&self, neighbours: &[Vec<u32>]) -> Self {
        let mut tally = Vec::new();
        let cluster_of = (0..).zip(neighbours).map(|(device, own_neighbours)| {
            tally.clear();
            for &neighbour in own_neighbours {
                let cluster = self.cluster_of[neighbour as usize];
                match tally.iter_mut().find(|(c, _)| *c == cluster) {
                    Some((_, votes)) => *votes += 1,
                    None => tally.push((cluster, 1_u32)),
                }
            }
            self.winning_cluster(device, &tally)
        });
        let mut next = Self {
            points: self.points,
            cluster_of: cluster_of.collect(),
            centroids: self.centroids.clone(),
        };
        next.recentre();
        next
    }

    /// Returns the cluster with the most votes in `tally`, pairs of cluster and votes. Ties go to the nearest centroid,
    /// then to the lowest number. A device without neighbours keeps its cluster.
    fn winning_cluster(&self, device: usize, tally: &[(u32, u32)]) -> u32 {
        let squared_gap = |cluster: u32| self.points[device].distance_squared(self.centroids[cluster as usize]);
        let best = tally.iter().min_by(|(a, votes_a), (b, votes_b)| {
            let by_votes = votes_b.cmp(votes_a);
            by_votes
                .then_with(|| squared_gap(*a).total_cmp(&squared_gap(*b)))
                .then(a.cmp(b))
        });
        best.map_or(self.cluster_of[device], |&(cluster, _)| cluster)
    }

    /// Moves centroids to their members' means. Each empty cluster gets one of the devices farthest from their own
    /// centroids as its only member.
    fn recentre(&mut self) {
        let mut sizes = self.move_centroids();
        if !sizes.contains(&0) {
            return;
        }
        let squared_distance = |j: usize| self.points[j].distance_squared(self.centroids[self.cluster_of[j] as usize]);
        let mut by_distance: Vec<_> = (0..self.cluster_of.len()).map(|j| (squared_distance(j), j)).collect();
        by_distance.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut farthest_first = by_distance.into_iter().map(|(_, j)| j);
        for cluster in 0..sizes.len() {
            if sizes[cluster] > 0 {
                continue;
            }
            // There are no more clusters than devices, so a cluster with a device to spare exists.
            if let Some(j) = farthest_first.find(|&j| sizes[self.cluster_of[j] as usize] > 1) {
                sizes[self.cluster_of[j] as usize] -= 1;
                sizes[cluster] = 1;
                self.cluster_of[j] = cluster as u32;
            }
        }
        self.move_centroids();
    }

    /// Moves the centroids of all clusters with members; returns the sizes.
    fn move_centroids(&mut self) -> Vec<u32> {
        let mut sums = vec![(0.0, 0.0); self.centroids.len()];
        let mut sizes = vec![0_u32; self.centroids.len()];
        for (p, &cluster) in self.points.iter().zip(&self.cluster_of) {
            sums[cluster as usize].0 += p.x;
            sums[cluster as usize].1 += p.y;
            sizes[cluster as usize] += 1;
        }
        for ((centroid, sum), &size) in self.centroids.iter_mut().zip(sums).zip(&sizes) {
            if size > 0 {
                *centroid = Point::new(sum.0 / f64::from(size), sum.1 / f64::from(size));
            }
        }
        sizes
    }
}

/// Draws an index with probability proportional to its weight; returns the first index if no weight is above 0.
fn draw_by_weight(weights: &[f64], stream: &mut Stream) -> usize {
    let mut remaining = stream.unit() * weights.iter().sum::<f64>();
    let mut drawn = 0;
    for (index, &weight) in weights.iter().enumerate() {
        if weight > 0.0 {
            drawn = index;
            // Rounding can leave a remainder after the last weight; the last index with a weight is then drawn.
            if remaining < weight {
                break;
            }
            remaining -= weight;
        }
    }
    drawn
}

/// Returns the `k` nearest devices of each device, or all others if there are fewer. Ties are in ascending order.
fn nearest_neighbours(points: &[Point], area: Area, k: usize) -> Vec<Vec<u32>> {
    let buckets = Buckets::new(points, area, 0.0);
    let neighbours = (0..).zip(points).map(|(device, p)| {
        // One of the k + 1 nearest is the device itself, unless more than k others have the same position.
        let nearest = buckets.nearest(*p, k + 1).into_iter().map(|(_, other)| other);
        nearest.filter(|other| *other != device).take(k).collect()
    });
    neighbours.collect()
}

/// Splits `members` until no part has a member farther than `d_max` from its mean.
fn split(points: &[Point], members: Vec<DeviceId>, d_max: f64) -> Vec<Vec<DeviceId>> {
    let (mut pending, mut done) = (vec![members], Vec::new());
    while let Some(members) = pending.pop() {
        let centroid = mean_position(points, &members);
        let is_too_wide = members.iter().any(|j| points[j.index()].distance(centroid) > d_max);
        match is_too_wide.then(|| halve(points, &members, centroid)) {
            // Both parts are smaller than the whole, so the loop ends; with an empty part it would not.
            Some([a, b]) if !a.is_empty() && !b.is_empty() => pending.extend([a, b]),
            _ => done.push(members),
        }
    }
    done
}

/// Splits by 2-means, from the member farthest from the centroid and the member farthest from that one.
fn halve(points: &[Point], members: &[DeviceId], centroid: Point) -> [Vec<DeviceId>; 2] {
    let first_centre = farthest(points, members, centroid);
    let mut centres = [first_centre, farthest(points, members, first_centre)];
    let mut halves = [members.to_vec(), Vec::new()];
    for _ in 0..MAX_HALVING_ROUNDS {
        let is_nearer_to_first = |j: &DeviceId| {
            let p = points[j.index()];
            p.distance_squared(centres[0]) <= p.distance_squared(centres[1])
        };
        let (a, b): (Vec<_>, Vec<_>) = members.iter().partition(|j| is_nearer_to_first(j));
        if a.is_empty() || b.is_empty() || a == halves[0] {
            break;
        }
        centres = [mean_position(points, &a), mean_position(points, &b)];
        halves = [a, b];
    }
    halves
}

/// Returns the position of the member farthest from `origin`; ties go to the first in `members`.
fn farthest(points: &[Point], members: &[DeviceId], origin: Point) -> Point {
    let positions = members.iter().map(|j| points[j.index()]);
    positions.fold(origin, |far, p| {
        if p.distance_squared(origin) > far.distance_squared(origin) {
            p
        } else {
            far
        }
    })
}

/// Returns the mean position of `members`, which must not be empty.
fn mean_position(points: &[Point], members: &[DeviceId]) -> Point {
    let n = members.len() as f64;
    let positions = members.iter().map(|j| points[j.index()]);
    let (x, y) = positions.fold((0.0, 0.0), |(x, y), p| (x + p.x, y + p.y));
    Point::new(x / n, y / n)
}

#[cfg(test)]
mod tests;
