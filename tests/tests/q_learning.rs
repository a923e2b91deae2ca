//! The choice of sensing devices under `q-learning` (`DutyLearner`) against the reference implementation, with a window
//! and with ages. Learning and wake-ups are not checked here.

use proptest::prelude::*;
use reveille_bs::policy::q_learning::duty::{DutyLearner, DutyParameters};
use reveille_bs::policy::q_learning::learned::{AREA_BUCKETS, DutyTable, Lookback, QWeights, Schedule};
use reveille_bs::policy::q_learning::settings::QLearningSettings;
use reveille_bs::scenario::EnergyModel;
use reveille_common::geometry::{Area, Layout, place_devices};
use reveille_common::ids::DeviceId;
use reveille_common::rng::{Purpose, Stream};
use reveille_common::sensing::{DetectionKind, Fusion, Sensing};
use reveille_common::units::Energy;
use reveille_tests::reference::{ReferenceAgeIndex, ReferenceDutySelector, choose_by_ages};
use reveille_tests::scenarios::paper;

/// Width and height of areas, m. The third is smaller than a sensing disc.
const AREAS: [(f64, f64); 4] = [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (9.0, 14.0)];

fn units(x: f64) -> Energy {
    Energy::from_units(x).expect("an energy")
}

/// Battery and costs of all devices, with the values of the preset `paper` except a rounded `e_wur`.
fn energy() -> EnergyModel {
    EnergyModel {
        e_max: units(100.0),
        e_idle: units(1.0),
        e_wur: units(0.1),
        e_tx: units(10.0),
        initial: units(50.0),
    }
}

/// Returns parameters for a perfect radio. Of the others only `lookback` affects the choice.
fn duty_parameters(lookback: Lookback) -> DutyParameters {
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

/// Draws a table in which the advantage of sensing rises with the covered area: from `bias` by 0.2 per area bucket,
/// with random deviations of up to 4. It is mostly negative for a `bias` of −2.5, and mostly positive for 1.
fn draw_table(stream: &mut Stream, bias: f64) -> DutyTable {
    let mut table = DutyTable::optimistic(0.0, |_| 1.0);
    for (index, entry) in table.q.iter_mut().enumerate() {
        entry.value = 20.0 + 4.0 * (stream.unit() - 0.5);
        entry.visits = stream.below(5000) as u32;
        // The order of `DutyTable::q`: battery, area, δ. Every second entry is for sensing.
        if index % 2 == 1 {
            entry.value += bias + (index / 2 % AREA_BUCKETS) as f64 * 0.2;
        }
    }
    table
}

/// Draws battery levels for [`energy`]; about one device in five cannot sense and report.
fn draw_levels(device_count: usize, stream: &mut Stream) -> Vec<Energy> {
    let level = |u: f64| units(if u < 0.2 { 50.0 * u } else { 100.0 * u });
    (0..device_count).map(|_| level(stream.unit())).collect()
}

fn to_indices(devices: &[DeviceId]) -> Vec<usize> {
    devices.iter().map(|device| device.index()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(300) })]

    #[test]
    fn the_choice_equals_the_choice_of_the_reference(
        is_probabilistic in prop::bool::weighted(0.3), window in prop::sample::select(vec![1_u32, 2, 4]),
        area_index in 0..AREAS.len(), devices in 1_u32..40, seed: u64, bias in -2.5..1.0_f64,
    ) {
        let (width, height) = AREAS[area_index];
        let area = Area { width, height };
        let sensing = Sensing {
            kind: if is_probabilistic { DetectionKind::Probabilistic } else { DetectionKind::Range },
            d_max: 4.0,
            eta: 0.3,
            psi: 1.0,
            g: Fusion::Max,
        };
        let points = place_devices(&Layout::Uniform, area, devices, seed);
        let mut stream = Stream::new(seed, Purpose::Training, 1);
        let table = draw_table(&mut stream, bias);
        let energies = vec![energy(); devices as usize];
        let parameters = duty_parameters(Lookback::Window(window));
        let mut learner = DutyLearner::new(table.clone(), parameters, &points, energies, area, &sensing);
        let mut reference = ReferenceDutySelector::new(&points, area, &sensing, energy(), window as usize);
        for k in 0..6 {
            let levels = draw_levels(devices as usize, &mut stream);
            let chosen = to_indices(&learner.choose(&levels));
            prop_assert_eq!(chosen, reference.choose(&table, &levels), "TTI {}, {:?}", k, sensing.kind);
        }
    }
}

/// Uses the shipped tables with their usual numbers of devices. `paper` selects them by default.
#[test]
fn the_choice_with_shipped_tables_equals_the_choice_of_the_reference() {
    let mut sensing_choices = 0;
    for (window, devices) in [(1, 250), (2, 100), (4, 100)] {
        let scenario = paper(&[
            "policy.name=q-learning",
            &format!("devices={devices}"),
            &format!("policy.q-learning.window={window}"),
        ]);
        let settings = scenario
            .policy
            .settings()
            .downcast_ref::<QLearningSettings>()
            .expect("q-learning");
        let (area, sensing, energy) = (scenario.area, &scenario.sensing, scenario.classes[0].energy);
        let points = place_devices(&scenario.layout, area, devices, 9);
        let table = settings.initial_tables.duty.clone();
        let energies = vec![energy; devices as usize];
        let parameters = duty_parameters(Lookback::Window(window));
        let mut learner = DutyLearner::new(table.clone(), parameters, &points, energies, area, sensing);
        let mut reference = ReferenceDutySelector::new(&points, area, sensing, energy, window as usize);
        let mut stream = Stream::new(u64::from(window), Purpose::Training, 1);
        for k in 0..2 * window {
            let levels = draw_levels(devices as usize, &mut stream);
            let chosen = to_indices(&learner.choose(&levels));
            sensing_choices += chosen.len();
            assert_eq!(chosen, reference.choose(&table, &levels), "window {window}, TTI {k}");
        }
    }
    assert!(sensing_choices > 60, "only {sensing_choices} sensing devices");
}

#[test]
fn the_choice_with_ages_equals_the_choice_of_the_reference() {
    let [mut compared, mut undecided] = [0; 2];
    for seed in 0..60_u64 {
        let kind = ["range", "probabilistic"][usize::from(seed % 3 == 0)];
        let (width, height) = [AREAS[0], AREAS[1], AREAS[3]][seed as usize / 3 % 3];
        let scenario = paper(&[
            "policy.name=q-learning",
            &format!("sensing.kind={kind}"),
            &format!("area.width={width}"),
            &format!("area.height={height}"),
            "sensing.eta=0.3",
        ]);
        let mut stream = Stream::new(seed, Purpose::Training, 2);
        let devices = 2 + stream.below(30) as u32;
        let points = place_devices(&Layout::Uniform, scenario.area, devices, seed);
        let energies = vec![energy(); devices as usize];
        let bias = 4.0 * stream.unit() - 3.0;
        let table = draw_table(&mut stream, bias);
        let mut learner = DutyLearner::new(
            table.clone(),
            duty_parameters(Lookback::Ages),
            &points,
            energies.clone(),
            scenario.area,
            &scenario.sensing,
        );
        // The price has no effect here: `choose_by_ages` uses the table.
        let Some(mut reference) = ReferenceAgeIndex::new(&scenario, &points, energies, 1.0) else {
            continue;
        };
        for k in 0..10 {
            let levels = draw_levels(devices as usize, &mut stream);
            let chosen = to_indices(&learner.choose(&levels));
            match choose_by_ages(&reference, &table, &energy(), &levels) {
                Some(expected) => {
                    assert_eq!(chosen, expected, "seed {seed}, TTI {k}, {kind}");
                    compared += 1;
                }
                None => undecided += 1,
            }
            let is_event_reported = stream.unit() < 0.2;
            reference.advance(&chosen, is_event_reported);
            if is_event_reported {
                learner.record_event();
            }
        }
    }
    assert!(
        compared > 400 && undecided < 60,
        "{compared} TTIs compared, {undecided} too close to call"
    );
}
