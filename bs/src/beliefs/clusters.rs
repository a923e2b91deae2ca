//! Clusters of neighbouring devices, of which one senses at a time (Sec. V-A, Algorithm 1, lines 1 and 2).

use std::f64::consts::PI;

use kdtree::{ErrorKind, KdTree};
use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::rng::Stream;

/// Rounds of voting after which devices that still change clusters stay where they are.
const ROUNDS: u32 = 100;

/// Rounds of 2-means that settle the halves of a cluster that is split.
const HALVING_ROUNDS: u32 = 10;

/// How clusters are formed (Algorithm 1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Voting {
    /// Neighbours K that vote on a device's cluster, ≥ 1.
    pub neighbours: u32,
    /// Whether a cluster with a member farther than d_max from its centroid is split.
    pub limit_radius: bool,
}

/// A partition of the devices.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Clusters {
    /// The devices of each cluster, at least one, by rising number. Clusters are in the order of their first devices.
    pub members: Vec<Vec<DeviceId>>,
    /// The cluster of each device, an index into `members`.
    pub of: Vec<u32>,
    /// The number M = ⌈ξ/(π `d_max`²)⌉ of clusters that were formed, at most N: `members.len()` before splitting.
    pub formed: usize,
}

impl Clusters {
    /// Clusters of the devices at `points` in `area` for the sensing range `d_max`, metres, > 0; `start`
    /// draws the centres of the k-means++ start. With [`Voting::limit_radius`] no device is farther than `d_max`
    /// from the mean of its cluster.
    pub fn form(points: &[Point], area: Area, d_max: f64, voting: Voting, start: Stream) -> Self {
        let wanted = (area.surface() / (PI * d_max * d_max)).ceil() as usize;
        let formed = wanted.max(1).min(points.len());
        let mut members = vote(points, formed, voting.neighbours as usize, start);
        if voting.limit_radius {
            members = members.into_iter().flat_map(|m| split(points, m, d_max)).collect();
        }
        members.sort_unstable();
        let mut of = vec![0; points.len()];
        for (cluster, members) in (0..).zip(&members) {
            for member in members {
                of[member.index()] = cluster;
            }
        }
        Self { members, of, formed }
    }
}

/// Up to `count` clusters by the votes of each device's `k` nearest neighbours.
fn vote(points: &[Point], count: usize, k: usize, start: Stream) -> Vec<Vec<DeviceId>> {
    let neighbours = nearest_neighbours(points, k);
    let mut assignment = Assignment::start(points, count, start);
    for _ in 0..ROUNDS {
        let next = assignment.round(&neighbours);
        let settled = next == assignment;
        assignment = next;
        if settled {
            break;
        }
    }
    let mut members = vec![Vec::new(); count];
    for (device, &cluster) in (0..).zip(&assignment.of) {
        members[cluster as usize].push(DeviceId(device));
    }
    members
}

/// The cluster of each device and the centroid of each cluster.
#[derive(Clone, Debug, PartialEq)]
struct Assignment<'a> {
    points: &'a [Point],
    of: Vec<u32>,
    centroids: Vec<Point>,
}

impl<'a> Assignment<'a> {
    /// Each device with the nearest of `count` k-means++ centres, at most as many as devices.
    fn start(points: &'a [Point], count: usize, mut stream: Stream) -> Self {
        let mut squared = vec![f64::INFINITY; points.len()];
        let mut of = vec![0; points.len()];
        let mut centroids = Vec::with_capacity(count);
        for cluster in 0..count {
            let centre = if cluster == 0 {
                points[stream.below(points.len() as u64) as usize]
            } else {
                points[draw_by_weight(&squared, &mut stream)]
            };
            centroids.push(centre);
            for ((p, squared), of) in points.iter().zip(&mut squared).zip(&mut of) {
                let d2 = p.distance_squared(centre);
                if d2 < *squared {
                    (*squared, *of) = (d2, cluster as u32);
                }
            }
        }
        let mut assignment = Self { points, of, centroids };
        assignment.recentre();
        assignment
    }

    /// The assignment in which each device joins the cluster of most of its neighbours under this one.
    fn round(&self, neighbours: &[Vec<u32>]) -> Self {
        let mut tally = Vec::new();
        let of = (0..).zip(neighbours).map(|(device, near)| {
            tally.clear();
            for &neighbour in near {
                let cluster = self.of[neighbour as usize];
                match tally.iter_mut().find(|(c, _)| *c == cluster) {
                    Some((_, votes)) => *votes += 1,
                    None => tally.push((cluster, 1_u32)),
                }
            }
            self.winner(device, &tally)
        });
        let mut next = Self {
            points: self.points,
            of: of.collect(),
            centroids: self.centroids.clone(),
        };
        next.recentre();
        next
    }

    /// The cluster with the most votes; of several the one with the nearest centroid, then with the lowest number. A
    /// device without neighbours stays.
    fn winner(&self, device: usize, tally: &[(u32, u32)]) -> u32 {
        let gap = |cluster: u32| self.points[device].distance_squared(self.centroids[cluster as usize]);
        let best = tally.iter().min_by(|(a, votes_a), (b, votes_b)| {
            let by_votes = votes_b.cmp(votes_a);
            by_votes.then_with(|| gap(*a).total_cmp(&gap(*b))).then(a.cmp(b))
        });
        best.map_or(self.of[device], |&(cluster, _)| cluster)
    }

    /// Moves centroids to their members' means. Each empty cluster gets one of the devices farthest from their own
    /// centroids as its only member.
    fn recentre(&mut self) {
        let mut sizes = self.move_centroids();
        if !sizes.contains(&0) {
            return;
        }
        let away = |j: usize| self.points[j].distance_squared(self.centroids[self.of[j] as usize]);
        let mut farthest: Vec<_> = (0..self.of.len()).map(|j| (away(j), j)).collect();
        farthest.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut farthest = farthest.into_iter().map(|(_, j)| j);
        for empty in 0..sizes.len() {
            if sizes[empty] > 0 {
                continue;
            }
            // There are no more clusters than devices, so one with a device to spare exists.
            if let Some(j) = farthest.find(|&j| sizes[self.of[j] as usize] > 1) {
                sizes[self.of[j] as usize] -= 1;
                sizes[empty] = 1;
                self.of[j] = empty as u32;
            }
        }
        self.move_centroids();
    }

    /// Moves the centroids of all clusters with members; returns the sizes.
    fn move_centroids(&mut self) -> Vec<u32> {
        let mut sums = vec![(0.0, 0.0); self.centroids.len()];
        let mut sizes = vec![0_u32; self.centroids.len()];
        for (p, &cluster) in self.points.iter().zip(&self.of) {
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

/// An index drawn with probability proportional to its weight; the first one if no weight is above 0.
fn draw_by_weight(weights: &[f64], stream: &mut Stream) -> usize {
    let mut left = stream.unit() * weights.iter().sum::<f64>();
    let mut drawn = 0;
    for (index, &weight) in weights.iter().enumerate() {
        if weight > 0.0 {
            drawn = index;
            if left < weight {
                break;
            }
            left -= weight;
        }
    }
    drawn
}

/// The `k` devices nearest to each device, or all others if there are fewer, equally far ones by rising number.
fn nearest_neighbours(points: &[Point], k: usize) -> Vec<Vec<u32>> {
    let search = || -> Result<_, ErrorKind> {
        let mut tree = KdTree::new(2);
        for (index, p) in (0_u32..).zip(points) {
            tree.add([p.x, p.y], index)?;
        }
        let metric = |a: &[f64], b: &[f64]| Point::new(a[0], a[1]).distance_squared(Point::new(b[0], b[1]));
        let mut all = Vec::with_capacity(points.len());
        for (index, p) in (0_u32..).zip(points) {
            // One more than K, as the device finds itself. The tree breaks ties as it likes, so it only tells how far
            // to look.
            let reach = tree.nearest(&[p.x, p.y], k + 1, &metric)?.last().map_or(0.0, |n| n.0);
            let mut near = tree.within(&[p.x, p.y], reach, &metric)?;
            near.retain(|&(_, &other)| other != index);
            near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(b.1)));
            all.push(near.into_iter().take(k).map(|(_, &other)| other).collect());
        }
        Ok(all)
    };
    search().expect("positions are pairs of finite coordinates")
}

/// `members` in parts none of which has a member farther than `d_max` from its mean.
fn split(points: &[Point], members: Vec<DeviceId>, d_max: f64) -> Vec<Vec<DeviceId>> {
    let (mut open, mut done) = (vec![members], Vec::new());
    while let Some(members) = open.pop() {
        let centroid = mean(points, &members);
        let is_wide = members.iter().any(|j| points[j.index()].distance(centroid) > d_max);
        match is_wide.then(|| halve(points, &members, centroid)) {
            Some([near, far]) if !near.is_empty() && !far.is_empty() => open.extend([near, far]),
            _ => done.push(members),
        }
    }
    done
}

/// 2-means from the member farthest from the centroid and the member farthest from that one.
fn halve(points: &[Point], members: &[DeviceId], centroid: Point) -> [Vec<DeviceId>; 2] {
    let first = farthest(points, members, centroid);
    let mut seeds = [first, farthest(points, members, first)];
    let mut halves = [members.to_vec(), Vec::new()];
    for _ in 0..HALVING_ROUNDS {
        let nearer = |j: &DeviceId| {
            let p = points[j.index()];
            p.distance_squared(seeds[0]) <= p.distance_squared(seeds[1])
        };
        let (a, b): (Vec<_>, Vec<_>) = members.iter().partition(|j| nearer(j));
        if a.is_empty() || b.is_empty() || a == halves[0] {
            break;
        }
        seeds = [mean(points, &a), mean(points, &b)];
        halves = [a, b];
    }
    halves
}

/// The position of the member farthest from `place`, of several of the one with the lowest number.
fn farthest(points: &[Point], members: &[DeviceId], place: Point) -> Point {
    let positions = members.iter().map(|j| points[j.index()]);
    positions.fold(place, |far, p| {
        if p.distance_squared(place) > far.distance_squared(place) {
            p
        } else {
            far
        }
    })
}

/// The mean position of `members`, of which there is at least one.
fn mean(points: &[Point], members: &[DeviceId]) -> Point {
    let n = members.len() as f64;
    let positions = members.iter().map(|j| points[j.index()]);
    let (x, y) = positions.fold((0.0, 0.0), |(x, y), p| (x + p.x, y + p.y));
    Point::new(x / n, y / n)
}

#[cfg(test)]
#[path = "clusters_tests.rs"]
mod tests;
