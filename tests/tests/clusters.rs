//! Clusters and `I_min` against a second, exhaustive implementation.

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

fn emulated(points: &[Point], area: Area, d_max: f64, voting: ClusterSettings, start: Stream) -> Vec<Vec<usize>> {
    let members = Clusters::form(points, area, d_max, voting, start).members;
    members
        .into_iter()
        .map(|cluster| cluster.into_iter().map(DeviceId::index).collect())
        .collect()
}

proptest! {
    #![proptest_config(Config { cases: 400, failure_persistence: None, ..Config::default() })]

    #[test]
    fn clusters_are_those_of_the_description(
        layout in layouts(), area in areas(), n in 1..=130u32, seed: u64, neighbours in 1..=9u32, limit_radius: bool,
        d_max in 1.0..12.0f64,
    ) {
        let points = place_devices(&layout, area, n, seed);
        let start = || Stream::new(seed, Purpose::Clusters, 0);
        let found = emulated(&points, area, d_max, ClusterSettings { neighbours, limit_radius }, start());
        let expected = reference::clusters(&points, area, d_max, (neighbours as usize, limit_radius), start());
        prop_assert_eq!(found, expected);
    }

    #[test]
    fn clusters_of_devices_that_stand_together_are_those_of_the_description(
        places in prop::collection::vec((0u8..5, 0u8..4), 1..60), neighbours in 1..70u32, limit_radius: bool, seed: u64,
    ) {
        let points: Vec<Point> = places.iter().map(|&(x, y)| Point::new(f64::from(x), f64::from(y))).collect();
        let area = Area { width: 20.0, height: 20.0 };
        let start = || Stream::new(seed, Purpose::Clusters, 0);
        let found = emulated(&points, area, 1.5, ClusterSettings { neighbours, limit_radius }, start());
        let expected = reference::clusters(&points, area, 1.5, (neighbours as usize, limit_radius), start());
        prop_assert_eq!(found, expected);
    }

    #[test]
    fn i_min_is_that_of_the_worst_place(
        layout in layouts(), area in areas(), n in 1..=40u32, seed: u64, eta in 0.05..2.0f64, psi in 0.1..5.0f64,
    ) {
        let points = place_devices(&layout, area, n, seed);
        let sensing = Sensing { kind: DetectionKind::Range, d_max: 4.0, eta, psi, g: Fusion::Max };
        let (found, expected) = (i_min(&points, area, &sensing), reference::least_information(&points, area, &sensing));
        prop_assert!((found / expected - 1.0).abs() < 1e-9, "{} and {}", found, expected);
    }
}

/// The random deployments cover all cases: clusters are split, start empty, and move.
#[test]
fn random_deployments_make_clusters_of_all_kinds() {
    let area = Area {
        width: 20.0,
        height: 20.0,
    };
    let (mut split, mut moved) = (0, 0);
    for seed in 0..40 {
        let points = place_devices(&Layout::Uniform, area, 60, seed);
        let start = || Stream::new(seed, Purpose::Clusters, 0);
        let whole = reference::clusters(&points, area, 4.0, (5, false), start());
        let parts = reference::clusters(&points, area, 4.0, (5, true), start());
        let unmoved = reference::clusters(&points, area, 4.0, (0, false), start());
        split += usize::from(parts.len() > whole.len());
        moved += usize::from(unmoved != whole);
    }
    assert!(split > 30 && moved > 30, "{split} split, {moved} moved");
}
