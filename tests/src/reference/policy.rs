//! Policies of the reference: duty cycles and wake-up choices.

use std::f64::consts::PI;

use reveille_bs::policy::knn::KnnSettings;
use reveille_bs::scenario::Scenario;
use reveille_common::geometry::Point;
use reveille_common::rng::{Purpose, Stream};

use super::clusters::{clusters, distance};
use super::i_min::least_information;

/// Points of the midpoint rule for the mean over φ.
const POINTS: u32 = 2048;
/// Two values of `P_4,2` closer than this can change order with the integration rule.
const CLOSE_P: f64 = 1e-6;
/// An Î closer than this to `I_min` can fall on either side of it.
const CLOSE_INFORMATION: f64 = 1e-9;

/// Policy with its choices.
#[derive(Clone, Debug)]
pub enum ReferencePolicy {
    /// Clusters whose devices sense in turn.
    Knn {
        /// Devices of each cluster, in order of id.
        members: Vec<Vec<usize>>,
        /// `I_min`.
        enough: f64,
    },
    /// One staggered duty cycle; every device is a wake-up candidate.
    Adjusted {
        /// Position of each device in the order of offsets.
        turns: Vec<u64>,
        /// `t_on`.
        t_on: u64,
        /// `t_DRX`.
        t_drx: u64,
        /// All devices as one cluster.
        everyone: Vec<Vec<usize>>,
        /// `I_min`.
        enough: f64,
    },
    /// (`t_on`, `t_DRX`, offset) of each device.
    Random(Vec<(u64, u64, u64)>),
    /// All devices sleep; the closest is woken.
    Genie,
}

/// State for a wake-up decision: the base station's knowledge, and the ground truth that only the genie may use.
#[derive(Debug)]
pub(super) struct Situation<'a> {
    pub(super) scenario: &'a Scenario,
    pub(super) positions: &'a [Point],
    pub(super) k: u64,
    /// Whether this is the event's first TTI.
    pub(super) first: bool,
    pub(super) epicentre: Point,
    /// Devices whose reports had information.
    pub(super) reporters: &'a [Reporter],
    /// Î.
    pub(super) information: f64,
    /// Devices woken in this TTI.
    pub(super) woken: &'a [usize],
    /// By device, whether it can pay for a report, as known to the base station.
    pub(super) able: &'a [bool],
    /// Whether a powered device can fail to answer a wake-up.
    pub(super) lossy: bool,
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
    /// Creates the policy of `scenario` for devices at `positions`, if it needs no search.
    pub fn new(scenario: &Scenario, positions: &[Point]) -> Self {
        match scenario.policy.name() {
            "genie" => Self::Genie,
            "random" => Self::Random(
                (0..positions.len() as u64)
                    // The draws must come in the emulator's order, since they share a stream.
                    .map(|id| {
                        let mut stream = Stream::new(scenario.run.seed, Purpose::DutyCycle, id);
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
                    (settings.neighbours as usize, settings.limit_radius),
                    Stream::new(scenario.run.seed, Purpose::Clusters, 0),
                );
                Self::Knn {
                    members,
                    enough: least_information(positions, scenario.area, &scenario.sensing),
                }
            }
            other => panic!("{other} has no second implementation here, or must be searched for first"),
        }
    }

    /// Creates adjusted duty cycling with this pair and offsets from the seed of `scenario`.
    pub(super) fn adjusted(scenario: &Scenario, positions: &[Point], (t_on, t_drx): (u64, u64)) -> Self {
        // Fisher–Yates shuffle, from the last element.
        let mut turns: Vec<u64> = (0..positions.len() as u64).collect();
        let mut stream = Stream::new(scenario.run.seed, Purpose::Offsets, 0);
        for last in (1..turns.len()).rev() {
            turns.swap(last, stream.below(last as u64 + 1) as usize);
        }
        Self::Adjusted {
            turns,
            t_on,
            t_drx,
            everyone: vec![(0..positions.len()).collect()],
            enough: least_information(positions, scenario.area, &scenario.sensing),
        }
    }

    /// Whether the policy ranks devices by belief for wake-ups.
    pub(super) const fn ranks(&self) -> bool {
        matches!(self, Self::Knn { .. } | Self::Adjusted { .. })
    }

    /// Returns δ of `device` in TTI `k`.
    pub fn senses(&self, device: usize, k: u64) -> bool {
        match self {
            Self::Genie => false,
            Self::Random(cycles) => {
                let (t_on, t_drx, offset) = cycles[device];
                (k + offset) % t_drx < t_on
            }
            Self::Adjusted { turns, t_on, t_drx, .. } => (k + turns[device]) % t_drx < *t_on,
            Self::Knn { members, .. } => {
                let cluster = &members[cluster_of(members, device)];
                cluster[(k % cluster.len() as u64) as usize] == device
            }
        }
    }

    /// Derives the conditional state probabilities of other devices from a report by `device`, `d` metres from the
    /// event.
    pub(super) fn reporter(&self, scenario: &Scenario, positions: &[Point], device: usize, d: f64) -> Reporter {
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
    pub(super) fn choose(&self, seen: &Situation<'_>) -> WakeUpChoice {
        match self {
            Self::Genie if seen.first && seen.woken.is_empty() || (seen.lossy && seen.reporters.is_empty()) => {
                closest(seen).map_or(WakeUpChoice::Stop, WakeUpChoice::Wake)
            }
            Self::Random(_) | Self::Genie => WakeUpChoice::Stop,
            Self::Adjusted { everyone, enough, .. } => self.most_correlated(seen, everyone, *enough),
            Self::Knn { members, enough } => self.most_correlated(seen, members, *enough),
        }
    }

    fn most_correlated(&self, seen: &Situation<'_>, members: &[Vec<usize>], enough: f64) -> WakeUpChoice {
        if seen.reporters.is_empty() {
            return WakeUpChoice::Stop;
        }
        if (seen.information - enough).abs() < CLOSE_INFORMATION {
            return WakeUpChoice::Ambiguous;
        }
        if seen.information >= enough {
            return WakeUpChoice::Stop;
        }
        let floor = libm::exp(-seen.scenario.sensing.eta * seen.scenario.sensing.d_max);
        let heard: Vec<usize> = seen.reporters.iter().map(|h| cluster_of(members, h.device)).collect();
        let mut best: Option<(ReporterCorrelation, usize)> = None;
        let mut candidates = Vec::new();
        for j in 0..seen.positions.len() {
            if self.senses(j, seen.k) || seen.woken.contains(&j) || !heard.contains(&cluster_of(members, j)) {
                continue;
            }
            if !seen.able[j] {
                continue;
            }
            let likelihood = p42(seen, j);
            if (likelihood.value - floor).abs() < CLOSE_P {
                return WakeUpChoice::Ambiguous;
            }
            if likelihood.value >= floor {
                candidates.push(likelihood);
                if best.is_none_or(|(most, _)| likelihood.value > most.value) {
                    best = Some((likelihood, j));
                }
            }
        }
        let Some((most, device)) = best else {
            return WakeUpChoice::Stop;
        };
        // An exact tie goes to the lower id under any integration rule.
        if candidates
            .iter()
            .any(|&other| other != most && most.value - other.value < CLOSE_P)
        {
            return WakeUpChoice::Ambiguous;
        }
        WakeUpChoice::Wake(device)
    }
}

fn cluster_of(members: &[Vec<usize>], device: usize) -> usize {
    members
        .iter()
        .position(|cluster| cluster.contains(&device))
        .expect("every device is in a cluster")
}

/// Returns the device closest to the epicentre that was not yet woken, if it is within sensing range.
fn closest(seen: &Situation<'_>) -> Option<usize> {
    let mut best: Option<(f64, usize)> = None;
    for (j, position) in seen.positions.iter().enumerate() {
        let d = distance(*position, seen.epicentre);
        if !seen.woken.contains(&j) && best.is_none_or(|(least, _)| d < least) {
            best = Some((d, j));
        }
    }
    best.filter(|&(d, _)| d <= seen.scenario.sensing.d_max).map(|(_, j)| j)
}

/// `P_4,2` of a device, and its origin. Devices with the same origin have exactly the same value under every
/// integration rule.
#[derive(Clone, Copy, Debug, PartialEq)]
struct ReporterCorrelation {
    value: f64,
    reporter: usize,
    gamma: f64,
}

/// Returns the largest Pr(`S_j` = S3 | `S_h` = S3) over the reporters h.
fn p42(seen: &Situation<'_>, j: usize) -> ReporterCorrelation {
    let mut most = ReporterCorrelation {
        value: 0.0,
        reporter: 0,
        gamma: 0.0,
    };
    for reporter in seen.reporters {
        let (gamma, value) = reporter.correlation[j];
        if value > most.value {
            most = ReporterCorrelation {
                value,
                reporter: reporter.device,
                gamma,
            };
        }
    }
    most
}

/// Returns the mean of exp(-η √(d² + γ² − 2dγ cos φ)) over φ.
fn mean_over_directions(eta: f64, d: f64, gamma: f64) -> f64 {
    let mut sum = 0.0;
    // The integrand is even in φ, so half of the circle is enough.
    for i in 0..POINTS {
        let phi = PI * (f64::from(i) + 0.5) / f64::from(POINTS);
        let squared = d * d + gamma * gamma - 2.0 * d * gamma * libm::cos(phi);
        // Rounding can make the square negative where d = γ and φ is small.
        sum += libm::exp(-eta * squared.max(0.0).sqrt());
    }
    sum / f64::from(POINTS)
}
