//! Algorithm 1 on layouts with known clusters, and the invariants of a partition on random layouts.

use proptest::prelude::*;
use reveille_common::geometry::{Layout, place_devices};

use super::*;
use reveille_common::rng::Purpose;

fn start(seed: u64) -> Stream {
    Stream::new(seed, Purpose::Clusters, 0)
}

const AREA: Area = Area {
    width: 20.0,
    height: 20.0,
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

/// Checks that each device is in exactly one cluster, no cluster is empty, and the order is the documented one.
fn is_partition(clusters: &Clusters, n: usize) -> bool {
    let mut seen = vec![0; n];
    for (index, members) in clusters.members.iter().enumerate() {
        for j in members {
            seen[j.index()] += 1;
            if clusters.cluster_of[j.index()] as usize != index {
                return false;
            }
        }
    }
    clusters.cluster_of.len() == n
        && seen.iter().all(|&times| times == 1)
        && clusters.members.iter().all(|m| !m.is_empty() && m.is_sorted())
        && clusters.members.is_sorted_by_key(|m| m[0])
}

fn widest(points: &[Point], clusters: &Clusters) -> f64 {
    let radius = |m: &Vec<DeviceId>| {
        let n = m.len() as f64;
        let x = m.iter().map(|j| points[j.index()].x).sum::<f64>() / n;
        let y = m.iter().map(|j| points[j.index()].y).sum::<f64>() / n;
        let reach = m.iter().map(|j| points[j.index()].distance(Point::new(x, y)));
        reach.fold(0.0, f64::max)
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
        let clusters = Clusters::form(&points, AREA, d_max, settings(k, limit), start(seed));
        prop_assert!(is_partition(&clusters, n as usize), "{clusters:?}");
        // The smallest number of discs whose total area is at least the deployment area.
        let (discs, surface) = (clusters.formed_count as f64, 400.0);
        let disc = PI * d_max * d_max;
        let is_limited = clusters.formed_count == n as usize;
        prop_assert!((discs - 1.0) * disc < surface && (discs * disc >= surface || is_limited));
        if limit {
            prop_assert!(clusters.members.len() >= clusters.formed_count);
            prop_assert!(widest(&points, &clusters) <= d_max + 1e-9);
        } else {
            prop_assert_eq!(clusters.members.len(), clusters.formed_count);
        }
        prop_assert_eq!(&clusters, &Clusters::form(&points, AREA, d_max, settings(k, limit), start(seed)));
    }

    #[test]
    fn coincident_devices_are_no_trouble(
        places in prop::collection::vec((0_u8..4, 0_u8..4), 1..60), k in 1_u32..70, limit: bool, seed: u64,
    ) {
        let points: Vec<_> = places.iter().map(|&(x, y)| Point::new(f64::from(x), f64::from(y))).collect();
        let clusters = Clusters::form(&points, AREA, 1.5, settings(k, limit), start(seed));
        prop_assert!(is_partition(&clusters, points.len()), "{clusters:?}");
        prop_assert!(!limit || widest(&points, &clusters) <= 1.5 + 1e-9);
    }

    #[test]
    fn neighbours_are_those_of_a_full_sort(layout in layouts(), n in 1_u32..150, seed: u64, k in 1_usize..160) {
        let points = place_devices(&layout, AREA, n, seed);
        for (j, found) in nearest_neighbours(&points, AREA, k).into_iter().enumerate() {
            let mut others: Vec<_> = (0..n).filter(|&i| i as usize != j).collect();
            let gap = |i: u32| points[i as usize].distance_squared(points[j]);
            others.sort_by(|&a, &b| gap(a).total_cmp(&gap(b)).then(a.cmp(&b)));
            others.truncate(k);
            prop_assert_eq!(found, others);
        }
    }
}

fn blob(x: f64, y: f64) -> impl Iterator<Item = Point> {
    let around = [
        (0.0, 0.0),
        (0.5, 0.0),
        (0.0, 0.5),
        (-0.5, 0.0),
        (0.0, -0.5),
        (0.3, 0.3),
        (-0.3, 0.3),
    ];
    around.into_iter().map(move |(dx, dy)| Point::new(x + dx, y + dy))
}

#[test]
fn two_blobs_make_two_clusters() {
    let points: Vec<_> = blob(4.0, 4.0).chain(blob(16.0, 15.0)).collect();
    // ξ/(π d_max²) = 400/(π · 81) = 1.57: two clusters.
    for seed in 0..50 {
        let clusters = Clusters::form(&points, AREA, 9.0, settings(5, true), start(seed));
        let expected = [0..7, 7..14].map(|ids| ids.map(DeviceId).collect::<Vec<_>>());
        assert_eq!(clusters.formed_count, 2);
        assert_eq!(clusters.members, expected, "seed {seed}");
    }
}

#[test]
fn a_cluster_that_is_too_wide_is_split() {
    let points: Vec<_> = blob(4.0, 4.0).chain(blob(16.0, 15.0)).collect();
    let halves = split(&points, (0..14).map(DeviceId).collect(), 4.0);
    assert_eq!(halves.iter().map(Vec::len).collect::<Vec<_>>(), [7, 7]);
    assert_eq!(split(&points, (0..14).map(DeviceId).collect(), 10.0).len(), 1);
}

#[test]
fn a_device_joins_the_majority_then_the_nearer_centroid_then_the_lower_number() {
    let points: Vec<_> = (0..7).map(|x| Point::new(f64::from(x), 0.0)).collect();
    let assignment = Partition {
        points: &points,
        cluster_of: vec![0, 0, 0, 1, 1, 2, 2],
        centroids: vec![Point::new(1.0, 0.0), Point::new(3.5, 0.0), Point::new(5.5, 0.0)],
    };
    let joined = |device, votes: &[(u32, u32)]| assignment.winning_cluster(device, votes);
    assert_eq!(joined(6, &[(2, 1), (0, 3), (1, 1)]), 0);
    assert_eq!(joined(2, &[(0, 2), (1, 2), (2, 1)]), 0);
    assert_eq!(joined(3, &[(0, 2), (1, 2)]), 1);
    let even = Partition {
        centroids: vec![Point::new(5.0, 0.0), Point::new(1.0, 0.0), Point::new(9.0, 0.0)],
        ..assignment.clone()
    };
    assert_eq!(even.winning_cluster(3, &[(1, 2), (0, 2)]), 0);
    assert_eq!(joined(4, &[]), 1);
}

#[test]
fn an_empty_cluster_gets_the_device_farthest_from_its_centroid() {
    let points: Vec<_> = [0.0, 1.0, 2.0, 9.0].map(|x| Point::new(x, 0.0)).to_vec();
    let mut assignment = Partition {
        points: &points,
        cluster_of: vec![0, 0, 0, 0],
        centroids: vec![Point::default(); 3],
    };
    assignment.recentre();
    // The mean is 3: device 3 is 6 away, device 0 is 3 away.
    assert_eq!(assignment.cluster_of, [2, 0, 0, 1]);
    assert_eq!(assignment.centroids, [1.5, 9.0, 0.0].map(|x| Point::new(x, 0.0)));
}

#[test]
fn the_paper_forms_eight_clusters() {
    // 400 m² over π d_max² by hand: 7.96, 127.3, 14.1, 1.27, 0.57; never more clusters than devices.
    for (d_max, n, formed) in [
        (4.0, 250, 8),
        (1.0, 250, 128),
        (3.0, 250, 15),
        (10.0, 250, 2),
        (15.0, 250, 1),
        (1.0, 30, 30),
    ] {
        let points = place_devices(&Layout::JitteredGrid, AREA, n, 1);
        let clusters = Clusters::form(&points, AREA, d_max, settings(5, true), start(1));
        assert_eq!(clusters.formed_count, formed, "d_max {d_max}");
    }
}

#[test]
fn a_deployment_without_devices_has_no_clusters() {
    assert_eq!(
        Clusters::form(&[], AREA, 4.0, settings(5, true), start(1))
            .members
            .len(),
        0
    );
}
