use reveille_common::geometry::{Layout, place};
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

/// What stays uncovered of an area, cell by cell and by the definition alone.
struct Ground {
    kind: DetectionKind,
    sensing: Sensing,
    /// South-west corner and size of each cell.
    cells: Vec<[f64; 4]>,
    positions: Vec<Point>,
}

impl Ground {
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

    /// The share of one cell that `device` covers.
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

    /// U, with everyone of `devices`, each of whom counts once.
    fn uncovered(&self, devices: &[usize]) -> f64 {
        let mut devices = devices.to_vec();
        devices.sort_unstable();
        devices.dedup();
        let missed = |&cell: &[f64; 4]| devices.iter().map(|&j| 1.0 - self.share(cell, j)).product::<f64>();
        self.cells.iter().map(missed).sum::<f64>() / self.cells.len() as f64
    }
}

/// A table in which each value is drawn at random.
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

struct Case {
    kind: DetectionKind,
    area: Area,
    window: u32,
    devices: u32,
    seed: u64,
}

impl Case {
    fn positions(&self) -> Vec<Point> {
        place(&Layout::Uniform, self.area, self.devices, self.seed)
    }

    fn learner(&self, table: DutyTable, weights: Weights, alpha: f64) -> Duty {
        let terms = Terms {
            schedule: Schedule::default(),
            weights,
            alpha,
            window: self.window,
        };
        let energies = vec![energy(); self.devices as usize];
        Duty::new(
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
        let weights = Weights {
            mu1,
            mu2: 1.0,
            zeta: 0.9,
        };
        let mut duty = case.learner(random_table(&mut stream), weights, alpha);
        let ground = Ground::new(case.area, case.kind, &case.positions());
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
            assert!((sum - expected).abs() < 1e-9, "{what}: shares {sum}, r(k) = {expected}");
            assert!((reward - expected).abs() < 1e-9, "{what}: {reward}, r(k) = {expected}");
            // What is promised at a choice: in each TTI of the window at least what it newly covered, and with a window
            // of one TTI just that.
            let last = duty.last.as_ref().expect("an exploration");
            let own = |share: &Share| if share.on { share.gain } else { 0.0 };
            gains.push_back(last.shares.iter().map(own).collect());
            if gains.len() > case.window as usize {
                gains.pop_front();
            }
            for (j, credit) in last.credits.iter().enumerate() {
                let promised: f64 = gains.iter().map(|then| then[j]).sum();
                assert!(
                    *credit > promised - 1e-9,
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

#[test]
fn without_dice_a_policy_that_learns_chooses_as_one_that_does_not() {
    for case in cases() {
        let mut stream = Stream::new(case.seed, Purpose::Training, 1);
        let weights = Weights {
            mu1: 10.0,
            mu2: 1.0,
            zeta: 0.9,
        };
        let mut duty = case.learner(random_table(&mut stream), weights, 0.2);
        for k in 0..6 {
            let levels = random_levels(case.devices as usize, &mut stream);
            let explored = duty
                .clone()
                .explore(&levels, 0.0, &mut Stream::new(case.seed, Purpose::Exploration, k));
            assert_eq!(duty.choose(&levels), explored, "{:?}, TTI {k}", case.kind);
        }
    }
}

#[test]
fn random_tables_choose_some_and_not_all() {
    // What the test above relies on.
    let case = &cases()[0];
    let mut stream = Stream::new(9, Purpose::Training, 1);
    let weights = Weights {
        mu1: 10.0,
        mu2: 1.0,
        zeta: 0.9,
    };
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
