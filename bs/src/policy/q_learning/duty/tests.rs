//! Tests of [`DutyLearner`]: its rewards and their shares against Sec. V-B, computed cell by cell, and exploration
//! without randomness against the choice of a policy that does not learn. The choice itself is checked in
//! `tests/tests/q_learning.rs`, learned values in `lab/src/training/tests/`. No test here loses reports.

use std::collections::VecDeque;

use reveille_common::geometry::{Layout, place_devices};
use reveille_common::rng::Purpose;
use reveille_common::sensing::{DetectionKind, Fusion};

use super::*;

const D_MAX: f64 = 4.0;
const ETA: f64 = 0.3;
const KINDS: [DetectionKind; 2] = [DetectionKind::Range, DetectionKind::Probabilistic];
/// Width and height, m.
const AREAS: [(f64, f64); 4] = [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (9.0, 14.0)];

fn units(x: f64) -> Energy {
    Energy::from_units(x).expect("an energy")
}

fn sensing_of(kind: DetectionKind) -> Sensing {
    Sensing {
        kind,
        d_max: D_MAX,
        eta: ETA,
        psi: 1.0,
        g: Fusion::Max,
    }
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

/// Uncovered part of an area, computed cell by cell from the definition alone.
struct UncoveredCells {
    kind: DetectionKind,
    sensing: Sensing,
    /// South-west corner, width and height of each cell.
    cells: Vec<[f64; 4]>,
    positions: Vec<Point>,
}

impl UncoveredCells {
    fn new(area: Area, kind: DetectionKind, positions: &[Point]) -> Self {
        let sensing = sensing_of(kind);
        // As `beliefs/coverage/`: other cells cover other shares.
        let cells_per_range = match kind {
            DetectionKind::Range => 15.0,
            DetectionKind::Probabilistic => 10.0,
        };
        let count_along = |length: f64| (cells_per_range * length / sensing.d_max).ceil().max(1.0);
        let (columns, rows) = (count_along(area.width), count_along(area.height));
        let (width, height) = (area.width / columns, area.height / rows);
        let mut cells = Vec::new();
        for row in 0..rows as u32 {
            for column in 0..columns as u32 {
                cells.push([f64::from(column) * width, f64::from(row) * height, width, height]);
            }
        }
        Self {
            kind,
            sensing,
            cells,
            positions: positions.to_vec(),
        }
    }

    /// Returns the share of one cell that `device` covers.
    fn covered_share(&self, [x, y, width, height]: [f64; 4], device: usize) -> f64 {
        let p = self.positions[device];
        match self.kind {
            DetectionKind::Range => {
                let corners = [(x, y), (x + width, y), (x, y + height), (x + width, y + height)];
                let is_within = |&(x, y): &(f64, f64)| Point::new(x, y).distance(p) <= self.sensing.d_max;
                f64::from(u8::from(corners.iter().all(is_within)))
            }
            DetectionKind::Probabilistic => {
                let d = Point::new(x + 0.5 * width, y + 0.5 * height).distance(p);
                if d <= self.sensing.d_max {
                    libm::exp(-self.sensing.eta * d)
                } else {
                    0.0
                }
            }
        }
    }

    /// Returns U with the given `devices`; duplicates count once.
    fn uncovered(&self, devices: &[usize]) -> f64 {
        let mut devices = devices.to_vec();
        devices.sort_unstable();
        devices.dedup();
        let miss_probability = |&cell: &[f64; 4]| {
            devices
                .iter()
                .map(|&j| 1.0 - self.covered_share(cell, j))
                .product::<f64>()
        };
        self.cells.iter().map(miss_probability).sum::<f64>() / self.cells.len() as f64
    }
}

fn random_table(stream: &mut Stream) -> DutyTable {
    let mut table = DutyTable::optimistic(0.0, |_| 1.0);
    for cell in table.q.iter_mut().chain(&mut table.value) {
        cell.value = 20.0 + 4.0 * (stream.unit() - 0.5);
        cell.visits = stream.below(5000) as u32;
    }
    table
}

fn random_levels(n: usize, stream: &mut Stream) -> Vec<Energy> {
    // One in five has at most 10 units, too little to sense.
    let level = |u: f64| units(if u < 0.2 { 50.0 * u } else { 100.0 * u });
    (0..n).map(|_| level(stream.unit())).collect()
}

fn weights_with(mu1: f64) -> QWeights {
    QWeights {
        mu1,
        mu2: 1.0,
        zeta: 0.9,
    }
}

struct Case {
    kind: DetectionKind,
    area: Area,
    window: u32,
    devices: u32,
    seed: u64,
}

impl Case {
    fn positions(&self) -> Vec<Point> {
        place_devices(&Layout::Uniform, self.area, self.devices, self.seed)
    }

    fn learner(&self, table: DutyTable, weights: QWeights, alpha: f64) -> DutyLearner {
        self.learner_with(Lookback::Window(self.window), table, weights, alpha)
    }

    fn learner_with(&self, lookback: Lookback, table: DutyTable, weights: QWeights, alpha: f64) -> DutyLearner {
        let parameters = DutyParameters {
            schedule: Schedule::default(),
            weights,
            alpha,
            lookback,
            loss_probability: 0.0,
        };
        let energies = vec![energy(); self.devices as usize];
        DutyLearner::new(
            table,
            parameters,
            &self.positions(),
            energies,
            self.area,
            &sensing_of(self.kind),
        )
    }
}

/// Each kind of detection and window in each area, with a number of devices.
fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for kind in KINDS {
        for window in [1, 2, 4] {
            for ((width, height), devices) in AREAS.into_iter().zip([25, 14, 3, 9]) {
                cases.push(Case {
                    kind,
                    area: Area { width, height },
                    window,
                    devices,
                    seed: u64::from(window) * 100 + u64::from(devices),
                });
            }
        }
    }
    cases
}

#[test]
fn the_shares_add_up_to_the_reward_of_the_paper_in_every_tti() {
    let (mut sensing_count, mut repeated_count, mut exceeded_count) = (0, 0, 0);
    for case in cases() {
        let n = case.devices as usize;
        let mut stream = Stream::new(case.seed, Purpose::Training, 3);
        let (alpha, mu1) = (0.05 + stream.unit(), 20.0 * stream.unit());
        let weights = weights_with(mu1);
        let mut learner = case.learner(random_table(&mut stream), weights, alpha);
        let cells = UncoveredCells::new(case.area, case.kind, &case.positions());
        let mut plans: Vec<Vec<usize>> = Vec::new();
        let mut window_promises: VecDeque<Vec<f64>> = VecDeque::new();
        for k in 0..30 {
            let levels = random_levels(n, &mut stream);
            let plan = learner.explore(
                &levels,
                stream.unit(),
                &mut Stream::new(case.seed, Purpose::Exploration, k),
            );
            plans.push(plan.iter().map(|j| j.index()).collect());
            let window_start = plans.len().saturating_sub(case.window as usize);
            let window_devices: Vec<usize> = plans[window_start..].concat();
            let expected = 1.0 - plan.len() as f64 / n as f64 - alpha * mu1 * cells.uncovered(&window_devices);
            let (reward, shares) = learner.rewards().expect("an exploration");
            let shares: Vec<f64> = shares.collect();
            assert_eq!(shares.len(), n);
            let sum: f64 = shares.iter().sum();
            let context = format!(
                "{:?}, {} m, window {}, TTI {k}",
                case.kind, case.area.width, case.window
            );
            // With probabilistic detection, the coverage of a cell is counted in 65536ths.
            let rounding = match case.kind {
                DetectionKind::Range => 1e-9,
                DetectionKind::Probabilistic => 1e-9 + window_devices.len() as f64 / 65536.0,
            };
            let tolerance = (alpha * mu1).max(1.0) * rounding;
            assert!(
                (sum - expected).abs() < tolerance,
                "{context}: shares add up to {sum}, r(k) = {expected}"
            );
            assert!(
                (reward - expected).abs() < tolerance,
                "{context}: reward {reward}, r(k) = {expected}"
            );
            assert!(
                (reward - sum).abs() < 1e-9,
                "{context}: shares add up to {sum}, reward {reward}"
            );
            // A choice promises in each TTI of the window at least its newly covered part; with a window of 1, exactly
            // it.
            let decision = learner.last_decision.as_ref().expect("an exploration");
            let promise = |device: &DeviceDecision| if device.is_sensing { device.gain } else { 0.0 };
            window_promises.push_back(decision.by_device.iter().map(promise).collect());
            if window_promises.len() > case.window as usize {
                window_promises.pop_front();
            }
            for (j, credit) in decision.credits.iter().enumerate() {
                let promised: f64 = window_promises.iter().map(|promises| promises[j]).sum();
                assert!(
                    *credit > promised - rounding,
                    "{context}: device {j} has credit {credit}, promised {promised}"
                );
                let is_exceeded = *credit > promised + 1e-9;
                assert!(
                    !is_exceeded || case.window > 1,
                    "{context}: device {j} has credit {credit}, promised {promised}"
                );
                exceeded_count += usize::from(is_exceeded);
            }
            sensing_count += plan.len();
            repeated_count += usize::from(window_devices.len() > plan.len());
            learner.learn(&random_levels(n, &mut stream));
            assert!(learner.rewards().is_none(), "rewards are learned once");
        }
    }
    // Guards against an empty comparison; the bounds have no other meaning.
    assert!(
        sensing_count > 1000 && repeated_count > 300 && exceeded_count > 300,
        "too few cases: {sensing_count} devices in S1, {repeated_count} windows, {exceeded_count} larger credits"
    );
}

/// Cells along d_max, as in `beliefs/ages/`.
const CELLS_PER_RANGE: f64 = 7.5;
/// Age from which on the worth is constant, TTIs, as in `beliefs/ages/`. The greatest age is not reached in 30 TTIs.
const CONSTANT_WORTH_AGE: f64 = 22.0;

/// Places of an area and their ages, computed from docs/age-index.md alone. The places are the middles of cells.
struct PlaceAges {
    kind: DetectionKind,
    middles: Vec<Point>,
    ages: Vec<f64>,
    positions: Vec<Point>,
}

impl PlaceAges {
    fn new(case: &Case) -> Self {
        let count_along = |length: f64| (CELLS_PER_RANGE * length / D_MAX).ceil().max(1.0);
        let (columns, rows) = (count_along(case.area.width), count_along(case.area.height));
        let mut middles = Vec::new();
        for row in 0..rows as u32 {
            for column in 0..columns as u32 {
                let middle = |index: u32, count: f64, length: f64| (f64::from(index) + 0.5) * length / count;
                middles.push(Point::new(
                    middle(column, columns, case.area.width),
                    middle(row, rows, case.area.height),
                ));
            }
        }
        Self {
            kind: case.kind,
            ages: vec![1.0; middles.len()],
            middles,
            positions: case.positions(),
        }
    }

    /// Returns the probability that no device of `sensing_devices` detects an event at a place.
    fn miss_probability(&self, place: usize, sensing_devices: &[DeviceId]) -> f64 {
        let detection_probability = |j: &DeviceId| match self.positions[j.index()].distance(self.middles[place]) {
            d if d > D_MAX => 0.0,
            _ if self.kind == DetectionKind::Range => 1.0,
            d => libm::exp(-ETA * d),
        };
        sensing_devices.iter().map(|j| 1.0 - detection_probability(j)).product()
    }

    /// Returns the mean over all places of the worth a(a + 1)/2 that no device of `sensing_devices` covers.
    fn uncovered_worth(&self, sensing_devices: &[DeviceId]) -> f64 {
        let whittle_index = |age: f64| age * (age + 1.0) / 2.0;
        let worth = |age: f64| {
            let (below, above) = (
                age.floor().min(CONSTANT_WORTH_AGE),
                (age.floor() + 1.0).min(CONSTANT_WORTH_AGE),
            );
            whittle_index(below) + (age - age.floor()) * (whittle_index(above) - whittle_index(below))
        };
        let uncovered_worths = (0..self.middles.len())
            .map(|place| worth(self.ages[place]) * self.miss_probability(place, sensing_devices));
        uncovered_worths.sum::<f64>() / self.middles.len() as f64
    }

    fn advance(&mut self, sensing_devices: &[DeviceId], is_event_reported: bool) {
        for place in 0..self.middles.len() {
            let unseen_age = if is_event_reported {
                0.0
            } else {
                self.ages[place] * self.miss_probability(place, sensing_devices)
            };
            self.ages[place] = unseen_age + 1.0;
        }
    }
}

#[test]
fn with_ages_the_shares_add_up_to_the_reward_by_uncovered_worth() {
    let mut aged_count = 0;
    for case in cases() {
        let n = f64::from(case.devices);
        let mut stream = Stream::new(case.seed, Purpose::Training, 4);
        let (alpha, mu1) = (0.05 + stream.unit(), 20.0 * stream.unit());
        let weights = weights_with(mu1);
        let mut learner = case.learner_with(Lookback::Ages, random_table(&mut stream), weights, alpha);
        let mut places = PlaceAges::new(&case);
        for k in 0..30 {
            let levels = random_levels(case.devices as usize, &mut stream);
            let mut exploration = Stream::new(case.seed, Purpose::Exploration, k);
            let plan = learner.explore(&levels, stream.unit(), &mut exploration);
            let uncovered_worth = places.uncovered_worth(&plan);
            aged_count += usize::from(places.uncovered_worth(&[]) > 2.0);
            let expected = 1.0 - plan.len() as f64 / n - alpha * mu1 * uncovered_worth;
            let (reward, shares) = learner.rewards().expect("an exploration");
            let sum: f64 = shares.sum();
            let context = format!("{:?}, {} m, TTI {k}", case.kind, case.area.width);
            let tolerance = 1e-6 * (1.0 + expected.abs());
            assert!(
                (sum - expected).abs() < tolerance,
                "{context}: shares add up to {sum}, not {expected}"
            );
            assert!(
                (reward - expected).abs() < tolerance,
                "{context}: reward {reward}, not {expected}"
            );
            let at = Point::new(stream.unit() * case.area.width, stream.unit() * case.area.height);
            // The prior is the age of the place's cell, in the TTI of the last decision.
            let max_offset = |p: &Point| (p.x - at.x).abs().max((p.y - at.y).abs());
            let nearest_place = (0..places.middles.len())
                .min_by(|a, b| max_offset(&places.middles[*a]).total_cmp(&max_offset(&places.middles[*b])))
                .expect("places");
            assert!(
                (learner.prior(at) - places.ages[nearest_place]).abs() < 1e-6 * places.ages[nearest_place],
                "{context}: prior {} at {at:?}, age {}",
                learner.prior(at),
                places.ages[nearest_place]
            );
            let is_event_reported = stream.unit() < 0.1;
            places.advance(&plan, is_event_reported);
            if is_event_reported {
                learner.record_event();
            }
            learner.learn(&random_levels(case.devices as usize, &mut stream));
        }
    }
    assert!(aged_count > 300, "too few cases: {aged_count} TTIs with old places");
}

#[test]
fn without_randomness_exploration_equals_the_choice() {
    for case in cases() {
        let mut stream = Stream::new(case.seed, Purpose::Training, 1);
        let weights = weights_with(10.0);
        let table = random_table(&mut stream);
        for lookback in [Lookback::Window(case.window), Lookback::Ages] {
            let [mut chooser, mut explorer] =
                [(); 2].map(|()| case.learner_with(lookback, table.clone(), weights, 0.2));
            for k in 0..6 {
                let levels = random_levels(case.devices as usize, &mut stream);
                let explored = explorer.explore(&levels, 0.0, &mut Stream::new(case.seed, Purpose::Exploration, k));
                assert_eq!(
                    chooser.choose(&levels),
                    explored,
                    "{:?}, {lookback}, TTI {k}",
                    case.kind
                );
            }
        }
    }
}

/// `without_randomness_exploration_equals_the_choice` relies on this.
#[test]
fn random_tables_choose_some_but_not_all_devices() {
    let case = &cases()[0];
    let mut stream = Stream::new(9, Purpose::Training, 1);
    let weights = weights_with(10.0);
    let mut counts = Vec::new();
    for _ in 0..40 {
        let mut learner = case.learner(random_table(&mut stream), weights, 0.2);
        counts.push(learner.choose(&random_levels(case.devices as usize, &mut stream)).len());
    }
    assert!(
        counts.iter().filter(|&&count| count > 2 && count < 18).count() > 20,
        "devices chosen by each table: {counts:?}"
    );
}
