//! Tests of [`Clusters`]: Algorithm 1 on layouts with known clusters, the invariants of a partition on random layouts,
//! and neighbours against a full sort.

use proptest::prelude::*;
use reveille_common::geometry::{Layout, place_devices};
use reveille_common::rng::Purpose;

use super::*;

fn stream(seed: u64) -> Stream {
    Stream::new(seed, Purpose::Clusters, 0)
}

const AREA: Area = Area {
    width: 20.0,
    height: 20.0,
};

/// The default settings of `knn`, which `policy/knn.rs` declares.
const PAPER_SETTINGS: ClusterSettings = ClusterSettings {
    neighbours: 5,
    limit_radius: true,
};

fn settings(neighbours: u32, limit_radius: bool) -> ClusterSettings {
    ClusterSettings {
        neighbours,
        limit_radius,
    }
}

fn layouts() -> impl Strategy<Value = Layout> {
    prop_oneof![
        Just(Layout::Uniform),
        Just(Layout::JitteredGrid),
        Just(Layout::PoissonDisk),
        Just(Layout::Grid),
        Just(Layout::Hex),
    ]
}

/// Returns whether each device is in exactly one cluster, no cluster is empty, and clusters and members are in order of
/// their ids.
fn is_partition(clusters: &Clusters, n: usize) -> bool {
    let mut memberships = vec![0; n];
    for (index, members) in clusters.members.iter().enumerate() {
        for j in members {
            memberships[j.index()] += 1;
            if clusters.cluster_of[j.index()] as usize != index {
                return false;
            }
        }
    }
    clusters.cluster_of.len() == n
        && memberships.iter().all(|&times| times == 1)
        && clusters.members.iter().all(|m| !m.is_empty() && m.is_sorted())
        && clusters.members.is_sorted_by_key(|m| m[0])
}

/// Returns the largest distance of a member from the centroid of its cluster.
fn max_radius(points: &[Point], clusters: &Clusters) -> f64 {
    let radius = |m: &Vec<DeviceId>| {
        let n = m.len() as f64;
        let x = m.iter().map(|j| points[j.index()].x).sum::<f64>() / n;
        let y = m.iter().map(|j| points[j.index()].y).sum::<f64>() / n;
        let distances = m.iter().map(|j| points[j.index()].distance(Point::new(x, y)));
        distances.fold(0.0, f64::max)
    };
    clusters.members.iter().map(radius).fold(0.0, f64::max)
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(200) })]

    #[test]
    fn clusters_partition_the_devices(
        layout in layouts(), n in 1_u32..=300, seed: u64, k in 1_u32..=12, limit: bool, d_max in 1.0..30.0_f64,
    ) {
        let points = place_devices(&layout, AREA, n, seed);
        let clusters = Clusters::form(&points, AREA, d_max, settings(k, limit), stream(seed));
        prop_assert!(is_partition(&clusters, n as usize), "{clusters:?}");
        // The smallest number of discs whose total area is at least the deployment area, but at most one per device.
        let formed_count = clusters.formed_count as f64;
        let disc_area = PI * d_max * d_max;
        let is_one_per_device = clusters.formed_count == n as usize;
        prop_assert!((formed_count - 1.0) * disc_area < AREA.surface()
            && (formed_count * disc_area >= AREA.surface() || is_one_per_device));
        if limit {
            prop_assert!(clusters.members.len() >= clusters.formed_count);
            prop_assert!(max_radius(&points, &clusters) <= d_max + 1e-9);
        } else {
            prop_assert_eq!(clusters.members.len(), clusters.formed_count);
        }
        prop_assert_eq!(&clusters, &Clusters::form(&points, AREA, d_max, settings(k, limit), stream(seed)));
    }

    #[test]
    fn coincident_devices_are_partitioned(
        places in prop::collection::vec((0_u8..4, 0_u8..4), 1..60), k in 1_u32..70, limit: bool, seed: u64,
    ) {
        let points: Vec<_> = places.iter().map(|&(x, y)| Point::new(f64::from(x), f64::from(y))).collect();
        let clusters = Clusters::form(&points, AREA, 1.5, settings(k, limit), stream(seed));
        prop_assert!(is_partition(&clusters, points.len()), "{clusters:?}");
        prop_assert!(!limit || max_radius(&points, &clusters) <= 1.5 + 1e-9);
    }

    #[test]
    fn nearest_neighbours_equal_a_full_sort(layout in layouts(), n in 1_u32..150, seed: u64, k in 1_usize..160) {
        let points = place_devices(&layout, AREA, n, seed);
        for (j, neighbours) in nearest_neighbours(&points, AREA, k).into_iter().enumerate() {
            let mut expected: Vec<_> = (0..n).filter(|&i| i as usize != j).collect();
            let distance = |i: u32| points[i as usize].distance_squared(points[j]);
            expected.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)));
            expected.truncate(k);
            prop_assert_eq!(neighbours, expected);
        }
    }
}

/// Returns seven points within 0.5 m around (x, y).
fn group(x: f64, y: f64) -> impl Iterator<Item = Point> {
    let offsets = [
        (0.0, 0.0),
        (0.5, 0.0),
        (0.0, 0.5),
        (-0.5, 0.0),
        (0.0, -0.5),
        (0.3, 0.3),
        (-0.3, 0.3),
    ];
    offsets.into_iter().map(move |(dx, dy)| Point::new(x + dx, y + dy))
}

#[test]
fn two_groups_form_two_clusters() {
    let points: Vec<_> = group(4.0, 4.0).chain(group(16.0, 15.0)).collect();
    // ξ/(π d_max²) = 400/(π · 81) = 1.57: two clusters.
    for seed in 0..50 {
        let clusters = Clusters::form(&points, AREA, 9.0, PAPER_SETTINGS, stream(seed));
        let expected = [0..7, 7..14].map(|ids| ids.map(DeviceId).collect::<Vec<_>>());
        assert_eq!(clusters.formed_count, 2, "seed {seed}");
        assert_eq!(clusters.members, expected, "seed {seed}");
    }
}

#[test]
fn a_cluster_wider_than_the_limit_is_split() {
    let points: Vec<_> = group(4.0, 4.0).chain(group(16.0, 15.0)).collect();
    let halves = split(&points, (0..14).map(DeviceId).collect(), 4.0);
    assert_eq!(halves.iter().map(Vec::len).collect::<Vec<_>>(), [7, 7]);
    assert_eq!(split(&points, (0..14).map(DeviceId).collect(), 10.0).len(), 1);
}

#[test]
fn a_device_joins_the_majority_then_the_nearest_centroid_then_the_lowest_cluster() {
    let points: Vec<_> = (0..7).map(|x| Point::new(f64::from(x), 0.0)).collect();
    let partition = Partition {
        points: &points,
        cluster_of: vec![0, 0, 0, 1, 1, 2, 2],
        centroids: vec![Point::new(1.0, 0.0), Point::new(3.5, 0.0), Point::new(5.5, 0.0)],
    };
    let winner = |device, votes: &[(u32, u32)]| partition.winning_cluster(device, votes);
    assert_eq!(winner(6, &[(2, 1), (0, 3), (1, 1)]), 0);
    assert_eq!(winner(2, &[(0, 2), (1, 2), (2, 1)]), 0);
    assert_eq!(winner(3, &[(0, 2), (1, 2)]), 1);
    let equidistant = Partition {
        centroids: vec![Point::new(5.0, 0.0), Point::new(1.0, 0.0), Point::new(9.0, 0.0)],
        ..partition.clone()
    };
    assert_eq!(equidistant.winning_cluster(3, &[(1, 2), (0, 2)]), 0);
    assert_eq!(winner(4, &[]), 1);
}

#[test]
fn an_empty_cluster_gets_the_device_farthest_from_its_centroid() {
    let points: Vec<_> = [0.0, 1.0, 2.0, 9.0].map(|x| Point::new(x, 0.0)).to_vec();
    let mut partition = Partition {
        points: &points,
        cluster_of: vec![0, 0, 0, 0],
        centroids: vec![Point::default(); 3],
    };
    partition.recentre();
    // The mean is 3: device 3 is 6 away, device 0 is 3 away.
    assert_eq!(partition.cluster_of, [2, 0, 0, 1]);
    assert_eq!(partition.centroids, [1.5, 9.0, 0.0].map(|x| Point::new(x, 0.0)));
}

#[test]
fn the_number_of_clusters_is_area_over_disc_rounded_up() {
    // 400 m² over π d_max² is 7.96 (the paper's setting), 127.3, 14.1, 1.27 and 0.57; at most one cluster per device.
    for (d_max, n, expected) in [
        (4.0, 250, 8),
        (1.0, 250, 128),
        (3.0, 250, 15),
        (10.0, 250, 2),
        (15.0, 250, 1),
        (1.0, 30, 30),
    ] {
        let points = place_devices(&Layout::JitteredGrid, AREA, n, 1);
        let clusters = Clusters::form(&points, AREA, d_max, PAPER_SETTINGS, stream(1));
        assert_eq!(clusters.formed_count, expected, "d_max {d_max}, {n} devices");
    }
}

#[test]
fn a_deployment_without_devices_has_no_clusters() {
    let clusters = Clusters::form(&[], AREA, 4.0, PAPER_SETTINGS, stream(1));
    assert!(clusters.members.is_empty());
}
