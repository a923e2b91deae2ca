//! Policies of the reference: duty cycles and wake-up choices under `bs.ranking = p42`, for `world.rs`.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use std::f64::consts::PI;

use reveille_bs::beliefs::clusters::ClusterSettings;
use reveille_bs::policy::knn::KnnSettings;
use reveille_bs::scenario::Scenario;
use reveille_common::geometry::Point;
use reveille_common::rng::{Purpose, Stream};

use super::clusters::{clusters, distance};
use super::i_min::least_information;

/// Points of the midpoint rule for the mean over φ.
const INTEGRATION_POINTS: u32 = 2048;
/// Two values of `P_4,2` closer than this can change order with the integration rule.
const P42_TOLERANCE: f64 = 1e-6;
/// An Î closer than this to `I_min` can fall on either side of it.
const INFORMATION_TOLERANCE: f64 = 1e-9;

/// Policy with the decisions that it draws before the run.
#[derive(Clone, Debug)]
pub enum ReferencePolicy {
    /// Clusters whose devices sense in turn.
    Knn {
        /// Devices of each cluster, in order of id. Every device is in one cluster.
        members: Vec<Vec<usize>>,
        /// `I_min`.
        i_min: f64,
    },
    /// One staggered duty cycle; every device is a wake-up candidate.
    Adjusted {
        /// Offset of each device: its position in a random order of all devices.
        offsets: Vec<u64>,
        /// `t_on`.
        t_on: u64,
        /// `t_DRX`.
        t_drx: u64,
        /// A single cluster with all devices, in the form of `Knn`.
        members: Vec<Vec<usize>>,
        /// `I_min`.
        i_min: f64,
    },
    /// (`t_on`, `t_DRX`, offset) of each device.
    Random(Vec<(u64, u64, u64)>),
    /// All devices sleep; the device closest to the event is woken.
    Genie,
}

/// State for a wake-up decision: the base station's knowledge, and the ground truth that only the genie may use.
#[derive(Debug)]
pub(super) struct Situation<'a> {
    pub(super) scenario: &'a Scenario,
    pub(super) positions: &'a [Point],
    pub(super) k: u64,
    /// Whether the event starts in this TTI.
    pub(super) is_first_tti: bool,
    pub(super) epicentre: Point,
    /// Devices whose reports had information; all reported in this TTI.
    pub(super) reporters: &'a [Reporter],
    /// Information Î gathered about the event so far.
    pub(super) information: f64,
    /// Devices woken in this TTI.
    pub(super) woken: &'a [usize],
    /// By device, whether it can pay for a report, as known to the base station. All true under a policy that does not
    /// rank.
    pub(super) can_report: &'a [bool],
    /// Whether a powered device can fail to answer a wake-up.
    pub(super) answers_can_be_lost: bool,
}

/// Device that has reported its distance from the event.
#[derive(Clone, Debug)]
pub(super) struct Reporter {
    pub(super) device: usize,
    /// By device j: its distance γ, and Pr(`S_j` = S3 | `S_h` = S3). Empty under policies that do not rank.
    pub(super) correlation: Vec<(f64, f64)>,
}

/// Next wake-up decision.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WakeUpChoice {
    /// Wake this device.
    Wake(usize),
    /// No further wake-up.
    Stop,
    /// Too close to call: the choice depends on the integration rule.
    Ambiguous,
}

impl ReferencePolicy {
    /// Creates the policy of `scenario` for devices at `positions`: `genie`, `random` with its default cycles, or
    /// `knn`. [`build_policy`](super::build_policy) also creates `adjusted`, which needs a search first.
    ///
    /// # Panics
    /// If `scenario` has another policy.
    pub fn new(scenario: &Scenario, positions: &[Point]) -> Self {
        match scenario.policy.name() {
            "genie" => Self::Genie,
            "random" => Self::Random(
                (0..positions.len() as u64)
                    // The draws must come in the emulator's order, since they share a stream.
                    .map(|id| {
                        let mut stream = Stream::new(scenario.run.seed, Purpose::DutyCycle, id);
                        // The default lists in `bs/src/policy/random.rs`; a scenario with others is not supported.
                        let t_on = [1, 2][stream.below(2) as usize];
                        let t_drx = [2, 4, 8][stream.below(3) as usize];
                        (t_on, t_drx, stream.below(t_drx))
                    })
                    .collect(),
            ),
            "knn" => {
                let settings = scenario
                    .policy
                    .settings()
                    .downcast_ref::<KnnSettings>()
                    .expect("settings of knn");
                let members = clusters(
                    positions,
                    scenario.area,
                    scenario.sensing.d_max,
                    ClusterSettings {
                        neighbours: settings.neighbours,
                        limit_radius: settings.limit_radius,
                    },
                    Stream::new(scenario.run.seed, Purpose::Clusters, 0),
                );
                Self::Knn {
                    members,
                    i_min: least_information(positions, scenario.area, &scenario.sensing),
                }
            }
            other => panic!("{other} has no second implementation here, or must be searched for first"),
        }
    }

    /// Creates adjusted duty cycling with this pair, which the search found, and offsets from the seed of `scenario`.
    pub(super) fn adjusted(scenario: &Scenario, positions: &[Point], (t_on, t_drx): (u64, u64)) -> Self {
        // Fisher–Yates shuffle, from the last element.
        let mut offsets: Vec<u64> = (0..positions.len() as u64).collect();
        let mut stream = Stream::new(scenario.run.seed, Purpose::Offsets, 0);
        for last in (1..offsets.len()).rev() {
            offsets.swap(last, stream.below(last as u64 + 1) as usize);
        }
        Self::Adjusted {
            offsets,
            t_on,
            t_drx,
            members: vec![(0..positions.len()).collect()],
            i_min: least_information(positions, scenario.area, &scenario.sensing),
        }
    }

    /// Whether the policy ranks devices by belief for wake-ups.
    pub(super) const fn ranks(&self) -> bool {
        matches!(self, Self::Knn { .. } | Self::Adjusted { .. })
    }

    /// Returns δ of `device` in TTI `k`: whether its plan is to sense. A lost plan or an empty battery can prevent it.
    pub fn senses(&self, device: usize, k: u64) -> bool {
        match self {
            Self::Genie => false,
            Self::Random(cycles) => {
                let (t_on, t_drx, offset) = cycles[device];
                (k + offset) % t_drx < t_on
            }
            Self::Adjusted {
                offsets, t_on, t_drx, ..
            } => (k + offsets[device]) % t_drx < *t_on,
            Self::Knn { members, .. } => {
                let cluster = &members[cluster_of(members, device)];
                cluster[(k % cluster.len() as u64) as usize] == device
            }
        }
    }

    /// Creates the reporter for a report by `device`, `d` metres from the event, with the conditional state
    /// probabilities of other devices if the policy ranks.
    pub(super) fn new_reporter(&self, scenario: &Scenario, positions: &[Point], device: usize, d: f64) -> Reporter {
        let mut correlation = Vec::new();
        if self.ranks() {
            for position in positions {
                let gamma = distance(*position, positions[device]);
                correlation.push((gamma, mean_over_directions(scenario.sensing.eta, d, gamma)));
            }
        }
        Reporter { device, correlation }
    }

    /// Chooses the next device to wake.
    pub(super) fn choose(&self, situation: &Situation<'_>) -> WakeUpChoice {
        match self {
            Self::Genie
                if situation.is_first_tti && situation.woken.is_empty()
                    || (situation.answers_can_be_lost && situation.reporters.is_empty()) =>
            {
                closest(situation).map_or(WakeUpChoice::Stop, WakeUpChoice::Wake)
            }
            Self::Random(_) | Self::Genie => WakeUpChoice::Stop,
            Self::Adjusted { members, i_min, .. } | Self::Knn { members, i_min } => {
                self.most_correlated(situation, members, *i_min)
            }
        }
    }

    /// Chooses the candidate with the largest `P_4,2`, while Î is below `i_min`: a device in S4 of a reporter's cluster
    /// that can report and was not yet woken.
    fn most_correlated(&self, situation: &Situation<'_>, members: &[Vec<usize>], i_min: f64) -> WakeUpChoice {
        if situation.reporters.is_empty() {
            return WakeUpChoice::Stop;
        }
        if (situation.information - i_min).abs() < INFORMATION_TOLERANCE {
            return WakeUpChoice::Ambiguous;
        }
        if situation.information >= i_min {
            return WakeUpChoice::Stop;
        }
        // P_4,2 of a device at d_max.
        let min_p42 = libm::exp(-situation.scenario.sensing.eta * situation.scenario.sensing.d_max);
        let reporting_clusters: Vec<usize> = situation
            .reporters
            .iter()
            .map(|reporter| cluster_of(members, reporter.device))
            .collect();
        let mut best: Option<(P42, usize)> = None;
        let mut candidate_values = Vec::new();
        for j in 0..situation.positions.len() {
            let is_candidate = !self.senses(j, situation.k)
                && !situation.woken.contains(&j)
                && reporting_clusters.contains(&cluster_of(members, j))
                && situation.can_report[j];
            if !is_candidate {
                continue;
            }
            let p42 = largest_p42(situation, j);
            if (p42.value - min_p42).abs() < P42_TOLERANCE {
                return WakeUpChoice::Ambiguous;
            }
            if p42.value >= min_p42 {
                candidate_values.push(p42);
                if best.is_none_or(|(largest, _)| p42.value > largest.value) {
                    best = Some((p42, j));
                }
            }
        }
        let Some((largest, device)) = best else {
            return WakeUpChoice::Stop;
        };
        // An exact tie goes to the lower id under any integration rule.
        if candidate_values
            .iter()
            .any(|&other| other != largest && largest.value - other.value < P42_TOLERANCE)
        {
            return WakeUpChoice::Ambiguous;
        }
        WakeUpChoice::Wake(device)
    }
}

/// Returns the index of the cluster that contains `device`.
fn cluster_of(members: &[Vec<usize>], device: usize) -> usize {
    members
        .iter()
        .position(|cluster| cluster.contains(&device))
        .expect("every device is in a cluster")
}

/// Returns the device closest to the epicentre that was not yet woken, if it is within sensing range.
fn closest(situation: &Situation<'_>) -> Option<usize> {
    let mut best: Option<(f64, usize)> = None;
    for (j, position) in situation.positions.iter().enumerate() {
        let d = distance(*position, situation.epicentre);
        if !situation.woken.contains(&j) && best.is_none_or(|(least, _)| d < least) {
            best = Some((d, j));
        }
    }
    best.filter(|&(d, _)| d <= situation.scenario.sensing.d_max)
        .map(|(_, j)| j)
}

/// `P_4,2` of a device, with the reporter and the distance γ from which it follows. Devices with the same reporter and
/// distance have exactly the same value under every integration rule.
#[derive(Clone, Copy, Debug, PartialEq)]
struct P42 {
    value: f64,
    reporter: usize,
    gamma: f64,
}

/// Returns the largest Pr(`S_j` = S3 | `S_h` = S3) over the reporters h.
fn largest_p42(situation: &Situation<'_>, j: usize) -> P42 {
    let mut largest = P42 {
        value: 0.0,
        reporter: 0,
        gamma: 0.0,
    };
    for reporter in situation.reporters {
        let (gamma, value) = reporter.correlation[j];
        if value > largest.value {
            largest = P42 {
                value,
                reporter: reporter.device,
                gamma,
            };
        }
    }
    largest
}

/// Returns the mean of exp(-η √(d² + γ² − 2dγ cos φ)) over φ.
fn mean_over_directions(eta: f64, d: f64, gamma: f64) -> f64 {
    let mut sum = 0.0;
    // The integrand is even in φ, so half of the circle is enough.
    for i in 0..INTEGRATION_POINTS {
        let phi = PI * (f64::from(i) + 0.5) / f64::from(INTEGRATION_POINTS);
        let squared = d * d + gamma * gamma - 2.0 * d * gamma * libm::cos(phi);
        // Rounding can make the square negative if d = γ and φ is small.
        sum += libm::exp(-eta * squared.max(0.0).sqrt());
    }
    sum / f64::from(INTEGRATION_POINTS)
}
