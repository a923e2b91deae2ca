//! Tests of the reward shares against Sec. V-B, and of learned tables against the choice without exploration.

use std::collections::VecDeque;

use reveille_common::geometry::{Layout, place_devices};
use reveille_common::rng::Purpose;
use reveille_common::sensing::{DetectionKind, Fusion};

use super::*;

const KINDS: [DetectionKind; 2] = [DetectionKind::Range, DetectionKind::Probabilistic];
const GROUNDS: [(f64, f64); 4] = [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (9.0, 14.0)];

fn units(x: f64) -> Energy {
    Energy::from_units(x).expect("an energy")
}

fn sensing(kind: DetectionKind) -> Sensing {
    Sensing {
        kind,
        d_max: 4.0,
        eta: 0.3,
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
    /// South-west corner and size of each cell.
    cells: Vec<[f64; 4]>,
    positions: Vec<Point>,
}

impl UncoveredCells {
    fn new(area: Area, kind: DetectionKind, positions: &[Point]) -> Self {
        let sensing = sensing(kind);
        // Cells along d_max.
        let fine = match kind {
            DetectionKind::Range => 15.0,
            DetectionKind::Probabilistic => 10.0,
        };
        let count = |length: f64| (fine * length / sensing.d_max).ceil().max(1.0);
        let (columns, rows) = (count(area.width), count(area.height));
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
    fn share(&self, [x, y, width, height]: [f64; 4], device: usize) -> f64 {
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
        let missed = |&cell: &[f64; 4]| devices.iter().map(|&j| 1.0 - self.share(cell, j)).product::<f64>();
        self.cells.iter().map(missed).sum::<f64>() / self.cells.len() as f64
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
    // One in five cannot sense.
    let level = |u: f64| units(if u < 0.2 { 50.0 * u } else { 100.0 * u });
    (0..n).map(|_| level(stream.unit())).collect()
}

fn weights(mu1: f64) -> QWeights {
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
        self.learner_of(Lookback::Window(self.window), table, weights, alpha)
    }

    fn learner_of(&self, lookback: Lookback, table: DutyTable, weights: QWeights, alpha: f64) -> DutyLearner {
        let terms = DutyParameters {
            schedule: Schedule::default(),
            weights,
            alpha,
            lookback,
            loss_probability: 0.0,
        };
        let energies = vec![energy(); self.devices as usize];
        DutyLearner::new(
            table,
            terms,
            &self.positions(),
            energies,
            self.area,
            &sensing(self.kind),
        )
    }
}

/// Each kind of detection, window and area, with a number of devices.
fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for kind in KINDS {
        for window in [1, 2, 4] {
            for ((width, height), devices) in GROUNDS.into_iter().zip([25, 14, 3, 9]) {
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
fn the_shares_add_up_to_the_papers_reward_in_every_tti() {
    let (mut sensed, mut repeated, mut exceeded) = (0, 0, 0);
    for case in cases() {
        let n = case.devices as usize;
        let mut stream = Stream::new(case.seed, Purpose::Training, 3);
        let (alpha, mu1) = (0.05 + stream.unit(), 20.0 * stream.unit());
        let weights = weights(mu1);
        let mut duty = case.learner(random_table(&mut stream), weights, alpha);
        let ground = UncoveredCells::new(case.area, case.kind, &case.positions());
        let mut plans: Vec<Vec<usize>> = Vec::new();
        let mut gains: VecDeque<Vec<f64>> = VecDeque::new();
        for k in 0..30 {
            let levels = random_levels(n, &mut stream);
            let plan = duty.explore(
                &levels,
                stream.unit(),
                &mut Stream::new(case.seed, Purpose::Exploration, k),
            );
            plans.push(plan.iter().map(|j| j.index()).collect());
            let before = plans.len().saturating_sub(case.window as usize);
            let window: Vec<usize> = plans[before..].concat();
            let expected = 1.0 - plan.len() as f64 / n as f64 - alpha * mu1 * ground.uncovered(&window);
            let (reward, shares) = duty.rewards().expect("an exploration");
            let shares: Vec<f64> = shares.collect();
            assert_eq!(shares.len(), n);
            let sum: f64 = shares.iter().sum();
            let what = format!(
                "{:?}, {} m, window {}, TTI {k}",
                case.kind, case.area.width, case.window
            );
            // With probabilistic detection, the coverage of a cell is counted in 65536ths.
            let rounded = match case.kind {
                DetectionKind::Range => 1e-9,
                DetectionKind::Probabilistic => 1e-9 + window.len() as f64 / 65536.0,
            };
            let slack = (alpha * mu1).max(1.0) * rounded;
            assert!(
                (sum - expected).abs() < slack,
                "{what}: shares {sum}, r(k) = {expected}"
            );
            assert!((reward - expected).abs() < slack, "{what}: {reward}, r(k) = {expected}");
            assert!((reward - sum).abs() < 1e-9, "{what}: shares {sum}, {reward}");
            // A choice promises in each TTI of the window at least its newly covered part; with a window of 1, exactly
            // it.
            let last = duty.last_decision.as_ref().expect("an exploration");
            let own = |share: &DeviceShare| if share.is_sensing { share.gain } else { 0.0 };
            gains.push_back(last.shares.iter().map(own).collect());
            if gains.len() > case.window as usize {
                gains.pop_front();
            }
            for (j, credit) in last.credits.iter().enumerate() {
                let promised: f64 = gains.iter().map(|then| then[j]).sum();
                assert!(
                    *credit > promised - rounded,
                    "{what}: {j} has {credit}, promised {promised}"
                );
                let is_more = *credit > promised + 1e-9;
                assert!(
                    !is_more || case.window > 1,
                    "{what}: {j} has {credit}, promised {promised}"
                );
                exceeded += usize::from(is_more);
            }
            sensed += plan.len();
            repeated += usize::from(window.len() > plan.len());
            duty.learn(&random_levels(n, &mut stream));
            assert!(duty.rewards().is_none(), "learned from");
        }
    }
    assert!(
        sensed > 1000 && repeated > 300 && exceeded > 300,
        "{sensed}, {repeated} and {exceeded} are too few to tell"
    );
}

/// Places of an area and their ages, computed from docs/age-index.md alone.
struct PlaceAges {
    kind: DetectionKind,
    middles: Vec<Point>,
    ages: Vec<f64>,
    positions: Vec<Point>,
}

impl PlaceAges {
    fn new(case: &Case) -> Self {
        let along = |length: f64| (7.5 * length / 4.0).ceil().max(1.0);
        let (columns, rows) = (along(case.area.width), along(case.area.height));
        let mut middles = Vec::new();
        for row in 0..rows as u32 {
            for column in 0..columns as u32 {
                let middle = |at: u32, count: f64, length: f64| (f64::from(at) + 0.5) * length / count;
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

    /// Returns the probability that no device of `looking` detects an event at a place.
    fn missed(&self, place: usize, looking: &[DeviceId]) -> f64 {
        let detects = |j: &DeviceId| match self.positions[j.index()].distance(self.middles[place]) {
            d if d > 4.0 => 0.0,
            _ if self.kind == DetectionKind::Range => 1.0,
            d => libm::exp(-0.3 * d),
        };
        looking.iter().map(|j| 1.0 - detects(j)).product()
    }

    /// Returns the mean over all places of a(a + 1)/2, as far as no device of `looking` covers them.
    fn left(&self, looking: &[DeviceId]) -> f64 {
        let index = |age: f64| age * (age + 1.0) / 2.0;
        let worth = |age: f64| {
            let (below, above) = (age.floor().min(22.0), (age.floor() + 1.0).min(22.0));
            index(below) + (age - age.floor()) * (index(above) - index(below))
        };
        let each = (0..self.middles.len()).map(|place| worth(self.ages[place]) * self.missed(place, looking));
        each.sum::<f64>() / self.middles.len() as f64
    }

    fn pass(&mut self, looking: &[DeviceId], is_found: bool) {
        for place in 0..self.middles.len() {
            let old = if is_found {
                0.0
            } else {
                self.ages[place] * self.missed(place, looking)
            };
            self.ages[place] = old + 1.0;
        }
    }
}

#[test]
fn with_ages_the_shares_add_up_to_the_reward_by_what_places_are_worth() {
    let mut older = 0;
    for case in cases() {
        let n = f64::from(case.devices);
        let mut stream = Stream::new(case.seed, Purpose::Training, 4);
        let (alpha, mu1) = (0.05 + stream.unit(), 20.0 * stream.unit());
        let weights = weights(mu1);
        let mut duty = case.learner_of(Lookback::Ages, random_table(&mut stream), weights, alpha);
        let mut places = PlaceAges::new(&case);
        for k in 0..30 {
            let levels = random_levels(case.devices as usize, &mut stream);
            let mut dice = Stream::new(case.seed, Purpose::Exploration, k);
            let plan = duty.explore(&levels, stream.unit(), &mut dice);
            let left = places.left(&plan);
            older += usize::from(places.left(&[]) > 2.0);
            let expected = 1.0 - plan.len() as f64 / n - alpha * mu1 * left;
            let (reward, shares) = duty.rewards().expect("an exploration");
            let sum: f64 = shares.sum();
            let what = format!("{:?}, {} m, TTI {k}", case.kind, case.area.width);
            let bound = 1e-6 * (1.0 + expected.abs());
            assert!((sum - expected).abs() < bound, "{what}: shares {sum}, not {expected}");
            assert!((reward - expected).abs() < bound, "{what}: {reward}, not {expected}");
            let at = Point::new(stream.unit() * case.area.width, stream.unit() * case.area.height);
            // The prior is the age of the place's cell, in the TTI of the last decision.
            let near = |p: &Point| (p.x - at.x).abs().max((p.y - at.y).abs());
            let cell = (0..places.middles.len())
                .min_by(|a, b| near(&places.middles[*a]).total_cmp(&near(&places.middles[*b])))
                .expect("places");
            assert!(
                (duty.prior(at) - places.ages[cell]).abs() < 1e-6 * places.ages[cell],
                "{what}"
            );
            let is_found = stream.unit() < 0.1;
            places.pass(&plan, is_found);
            if is_found {
                duty.record_event();
            }
            duty.learn(&random_levels(case.devices as usize, &mut stream));
        }
    }
    assert!(older > 300, "{older} are too few to tell");
}

#[test]
fn without_dice_a_policy_that_learns_chooses_as_one_that_does_not() {
    for case in cases() {
        let mut stream = Stream::new(case.seed, Purpose::Training, 1);
        let weights = weights(10.0);
        let table = random_table(&mut stream);
        for lookback in [Lookback::Window(case.window), Lookback::Ages] {
            let [mut duty, mut learner] = [(); 2].map(|()| case.learner_of(lookback, table.clone(), weights, 0.2));
            for k in 0..6 {
                let levels = random_levels(case.devices as usize, &mut stream);
                let explored = learner.explore(&levels, 0.0, &mut Stream::new(case.seed, Purpose::Exploration, k));
                assert_eq!(duty.choose(&levels), explored, "{:?}, {lookback}, TTI {k}", case.kind);
            }
        }
    }
}

#[test]
fn random_tables_choose_some_and_not_all() {
    // The test above relies on this.
    let case = &cases()[0];
    let mut stream = Stream::new(9, Purpose::Training, 1);
    let weights = weights(10.0);
    let mut counts = Vec::new();
    for _ in 0..40 {
        let mut duty = case.learner(random_table(&mut stream), weights, 0.2);
        counts.push(duty.choose(&random_levels(25, &mut stream)).len());
    }
    assert!(
        counts.iter().filter(|&&count| count > 2 && count < 18).count() > 20,
        "{counts:?}"
    );
}
