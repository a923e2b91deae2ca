//! The clusters of `knn` (`Clusters::form`) and `i_min` against the reference implementation, which is exhaustive. It
//! ends the rounds of votes and of halving at the same limits, so clusters must be equal even without convergence.

use proptest::prelude::*;
use proptest::test_runner::Config;
use reveille_bs::beliefs::clusters::{ClusterSettings, Clusters};
use reveille_bs::beliefs::ranking::i_min;
use reveille_common::geometry::{Area, Layout, Point, place_devices};
use reveille_common::ids::DeviceId;
use reveille_common::rng::{Purpose, Stream};
use reveille_common::sensing::{DetectionKind, Fusion, Sensing};
use reveille_tests::reference;

fn layouts() -> impl Strategy<Value = Layout> {
    prop_oneof![
        Just(Layout::Uniform),
        Just(Layout::JitteredGrid),
        Just(Layout::PoissonDisk),
        Just(Layout::Grid),
        Just(Layout::Hex),
    ]
}

fn areas() -> impl Strategy<Value = Area> {
    (4.0..30.0f64, 4.0..30.0f64).prop_map(|(width, height)| Area { width, height })
}

fn emulated_clusters(
    points: &[Point],
    area: Area,
    d_max: f64,
    settings: ClusterSettings,
    stream: Stream,
) -> Vec<Vec<usize>> {
    let members = Clusters::form(points, area, d_max, settings, stream).members;
    members
        .into_iter()
        .map(|cluster| cluster.into_iter().map(DeviceId::index).collect())
        .collect()
}

proptest! {
    #![proptest_config(Config { cases: 400, failure_persistence: None, ..Config::default() })]

    #[test]
    fn clusters_equal_the_clusters_of_the_reference(
        layout in layouts(), area in areas(), n in 1..=130u32, seed: u64, neighbours in 1..=9u32, limit_radius: bool,
        d_max in 1.0..12.0f64,
    ) {
        let points = place_devices(&layout, area, n, seed);
        let stream = || Stream::new(seed, Purpose::Clusters, 0);
        let settings = ClusterSettings { neighbours, limit_radius };
        let clusters = emulated_clusters(&points, area, d_max, settings, stream());
        let expected = reference::clusters(&points, area, d_max, settings, stream());
        prop_assert_eq!(clusters, expected);
    }

    #[test]
    fn clusters_of_devices_at_equal_positions_equal_the_clusters_of_the_reference(
        places in prop::collection::vec((0u8..5, 0u8..4), 1..60), neighbours in 1..70u32, limit_radius: bool, seed: u64,
    ) {
        let points: Vec<Point> = places.iter().map(|&(x, y)| Point::new(f64::from(x), f64::from(y))).collect();
        let area = Area { width: 20.0, height: 20.0 };
        let stream = || Stream::new(seed, Purpose::Clusters, 0);
        let settings = ClusterSettings { neighbours, limit_radius };
        let clusters = emulated_clusters(&points, area, 1.5, settings, stream());
        let expected = reference::clusters(&points, area, 1.5, settings, stream());
        prop_assert_eq!(clusters, expected);
    }

    #[test]
    fn i_min_equals_the_least_information_of_the_reference(
        layout in layouts(), area in areas(), n in 1..=40u32, seed: u64, eta in 0.05..2.0f64, psi in 0.1..5.0f64,
    ) {
        let points = place_devices(&layout, area, n, seed);
        let sensing = Sensing { kind: DetectionKind::Range, d_max: 4.0, eta, psi, g: Fusion::Max };
        let expected = reference::least_information(&points, area, &sensing);
        let least_information = i_min(&points, area, &sensing);
        prop_assert!(
            (least_information / expected - 1.0).abs() < 1e-9, "I_min {}, expected {}", least_information, expected
        );
    }
}

/// The comparison with random deployments covers clusters that are split, and devices that move between clusters. Only
/// the reference runs here.
#[test]
fn clusters_of_random_deployments_are_split_and_change() {
    let area = Area {
        width: 20.0,
        height: 20.0,
    };
    let (mut split_deployments, mut changed_deployments) = (0, 0);
    for seed in 0..40 {
        let points = place_devices(&Layout::Uniform, area, 60, seed);
        let stream = || Stream::new(seed, Purpose::Clusters, 0);
        let clusters_with = |neighbours, limit_radius| {
            let settings = ClusterSettings {
                neighbours,
                limit_radius,
            };
            reference::clusters(&points, area, 4.0, settings, stream())
        };
        let unlimited = clusters_with(5, false);
        let limited = clusters_with(5, true);
        // Only the reference accepts 0 neighbours.
        let without_votes = clusters_with(0, false);
        split_deployments += usize::from(limited.len() > unlimited.len());
        changed_deployments += usize::from(without_votes != unlimited);
    }
    assert!(
        split_deployments > 30 && changed_deployments > 30,
        "deployments: {split_deployments} with split clusters, {changed_deployments} with changed clusters"
    );
}
