//! Choice of sensing devices under `q-learning`, compared with the second implementation.

use proptest::prelude::*;
use reveille_bs::policy::q_learning::duty::{DutyLearner, DutyParameters};
use reveille_bs::policy::q_learning::learned::{AREA_BUCKETS, DutyTable, Lookback, QWeights, Schedule};
use reveille_bs::policy::q_learning::settings::QLearningSettings;
use reveille_bs::scenario::{EnergyModel, Override, load};
use reveille_common::geometry::{Area, Layout, place_devices};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::sensing::{DetectionKind, Fusion, Sensing};
use reveille_common::units::Energy;
use reveille_tests::reference::{ReferenceAgeIndex, Sequential, choose_by_ages};

const GROUNDS: [(f64, f64); 4] = [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (9.0, 14.0)];

fn units(x: f64) -> Energy {
    Energy::from_units(x).expect("an energy")
}

fn energy() -> EnergyModel {
    EnergyModel {
        e_max: units(100.0),
        e_idle: units(1.0),
        e_wur: units(0.1),
        e_tx: units(10.0),
        initial: units(50.0),
    }
}

fn terms(lookback: Lookback) -> DutyParameters {
    DutyParameters {
        schedule: Schedule::default(),
        weights: QWeights {
            mu1: 10.0,
            mu2: 1.0,
            zeta: 0.9,
        },
        alpha: 0.2,
        lookback,
        loss_probability: 0.0,
    }
}

/// Returns a table with random values. The value of sensing rises with the covered area; in some tables it is near 0,
/// in some almost always positive.
fn table(stream: &mut Stream, bias: f64) -> DutyTable {
    let mut table = DutyTable::optimistic(0.0, |_| 1.0);
    for (index, cell) in table.q.iter_mut().enumerate() {
        cell.value = 20.0 + 4.0 * (stream.unit() - 0.5);
        cell.visits = stream.below(5000) as u32;
        if index % 2 == 1 {
            cell.value += bias + (index / 2 % AREA_BUCKETS) as f64 * 0.2;
        }
    }
    table
}

/// Returns random battery levels; one device in five cannot sense.
fn levels(devices: usize, stream: &mut Stream) -> Vec<Energy> {
    let level = |u: f64| units(if u < 0.2 { 50.0 * u } else { 100.0 * u });
    (0..devices).map(|_| level(stream.unit())).collect()
}

fn numbers(chosen: &[reveille_common::ids::DeviceId]) -> Vec<usize> {
    chosen.iter().map(|device| device.index()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(300) })]

    #[test]
    fn the_choice_is_that_of_the_second_implementation(
        chance in prop::bool::weighted(0.3), window in prop::sample::select(vec![1_u32, 2, 4]),
        ground in 0_usize..4, devices in 1_u32..40, seed: u64, bias in -2.5..1.0_f64,
    ) {
        let (width, height) = GROUNDS[ground];
        let area = Area { width, height };
        let sensing = Sensing {
            kind: if chance { DetectionKind::Probabilistic } else { DetectionKind::Range },
            d_max: 4.0,
            eta: 0.3,
            psi: 1.0,
            g: Fusion::Max,
        };
        let points = place_devices(&Layout::Uniform, area, devices, seed);
        let mut stream = Stream::new(seed, Purpose::Training, 1);
        let table = table(&mut stream, bias);
        let energies = vec![energy(); devices as usize];
        let parameters = terms(Lookback::Window(window));
        let mut duty = DutyLearner::new(table.clone(), parameters, &points, energies, area, &sensing);
        let mut reference = Sequential::new(&points, area, &sensing, energy(), window as usize);
        for k in 0..6 {
            let levels = levels(devices as usize, &mut stream);
            let chosen = numbers(&duty.choose(&levels));
            prop_assert_eq!(chosen, reference.choose(&table, &levels), "TTI {}, {:?}", k, sensing.kind);
        }
    }
}

/// Uses the shipped tables, at full size.
#[test]
fn shipped_tables_choose_as_the_second_implementation_does() {
    let mut sensing_devices = 0;
    for (window, devices) in [(1, 250), (2, 100), (4, 100)] {
        let set = [
            "policy.name=q-learning".to_owned(),
            format!("devices={devices}"),
            format!("policy.q-learning.window={window}"),
        ];
        let set = set.map(|text| Override::parse(&text).expect("an override"));
        let scenario = load("paper", &set).expect("a scenario").scenario;
        let settings = scenario
            .policy
            .settings()
            .downcast_ref::<QLearningSettings>()
            .expect("q-learning");
        let (area, sensing, energy) = (scenario.area, &scenario.sensing, scenario.classes[0].energy);
        let points = place_devices(&scenario.layout, area, devices, 9);
        let table = settings.initial_tables.duty.clone();
        let energies = vec![energy; devices as usize];
        let mut duty = DutyLearner::new(
            table.clone(),
            terms(Lookback::Window(window)),
            &points,
            energies,
            area,
            sensing,
        );
        let mut reference = Sequential::new(&points, area, sensing, energy, window as usize);
        let mut stream = Stream::new(u64::from(window), Purpose::Training, 1);
        for k in 0..2 * window {
            let levels = levels(devices as usize, &mut stream);
            let chosen = numbers(&duty.choose(&levels));
            sensing_devices += chosen.len();
            assert_eq!(chosen, reference.choose(&table, &levels), "window {window}, TTI {k}");
        }
    }
    assert!(sensing_devices > 60, "only {sensing_devices} sensing devices");
}

/// Uses ages, computed from the rule, the table and plain sums over places.
#[test]
fn with_ages_the_choice_is_that_of_the_second_implementation() {
    let mut compared = [0; 2];
    for seed in 0..60_u64 {
        let kind = ["range", "probabilistic"][usize::from(seed % 3 == 0)];
        let (width, height) = [GROUNDS[0], GROUNDS[1], GROUNDS[3]][seed as usize % 3];
        let set = [
            "policy.name=q-learning".to_owned(),
            format!("sensing.kind={kind}"),
            format!("area.width={width}"),
            format!("area.height={height}"),
            "sensing.eta=0.3".to_owned(),
        ];
        let set = set.map(|text| Override::parse(&text).expect("an override"));
        let scenario = load("paper", &set).expect("a scenario").scenario;
        let mut stream = Stream::new(seed, Purpose::Training, 2);
        let devices = 2 + stream.below(30) as u32;
        let points = place_devices(&Layout::Uniform, scenario.area, devices, seed);
        let energies = vec![energy(); devices as usize];
        let bias = 4.0 * stream.unit() - 3.0;
        let table = table(&mut stream, bias);
        let lookback = terms(Lookback::Ages);
        let mut duty = DutyLearner::new(
            table.clone(),
            lookback,
            &points,
            energies.clone(),
            scenario.area,
            &scenario.sensing,
        );
        let Some(mut places) = ReferenceAgeIndex::new(&scenario, &points, energies, 1.0) else {
            continue;
        };
        for k in 0..10 {
            let levels = levels(devices as usize, &mut stream);
            let chosen = numbers(&duty.choose(&levels));
            let expected = choose_by_ages(&places, &table, &energy(), &levels);
            compared[usize::from(expected.is_none())] += 1;
            if let Some(expected) = expected {
                assert_eq!(chosen, expected, "seed {seed}, TTI {k}, {kind}");
            }
            let is_found = stream.unit() < 0.2;
            places.pass(&chosen, is_found);
            if is_found {
                duty.record_event();
            }
        }
    }
    assert!(compared[0] > 400 && compared[1] < 60, "{compared:?}");
}
