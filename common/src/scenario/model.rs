//! A validated scenario: what every part of a run may rely on. [`super::load()`] makes it; nothing here is optional.

use std::path::PathBuf;
use std::sync::Arc;

use super::learning::{BatteryKnowledge, QLearningSettings, WakeUpRanking};
use crate::geometry::{Area, Layout};
use crate::harvest::HarvestSetup;
use crate::ids::Tti;
use crate::sensing::Sensing;
use crate::units::Energy;

/// The largest number of devices N.
pub const MAX_DEVICES: u32 = 1_000_000;
/// The longest run K, event or interval, in TTIs.
pub const MAX_TTIS: u64 = 1_000_000_000;
/// The largest number of device classes.
pub const MAX_CLASSES: usize = 256;

/// Everything that decides a run: two runs of one scenario are the same, bit for bit.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// The name of the preset it starts from: `paper`, `paper-literal` or `quick`.
    pub preset: String,
    /// Number of devices N, `1 ..= 1 000 000`.
    pub devices: u32,
    /// Length of the run K in TTIs, `1 ..= 10⁹`, the warm-up included.
    pub ttis: u64,
    /// Seed of every random stream.
    pub seed: u64,
    /// Share of K that is simulated and left out of every metric, `[0, 1)` (MODEL default 0.1).
    pub warm_up: f64,
    /// Duration τ of a TTI in units of model time, > 0.
    pub tau: f64,
    /// The served area ξ.
    pub area: Area,
    /// Where the devices stand.
    pub layout: Layout,
    /// Device classes, at least one; their shares add up to 1.
    pub classes: Vec<DeviceClass>,
    /// The sensing model.
    pub sensing: Sensing,
    /// The event process.
    pub events: Events,
    /// The BS's settings.
    pub bs: BsSettings,
    /// Who senses and who is woken.
    pub policy: PolicyConfig,
}

impl Scenario {
    /// The first TTI that counts in the metrics.
    pub fn warm_up_end(&self) -> Tti {
        Tti((self.ttis as f64 * self.warm_up).floor() as u64)
    }
}

/// The event process (paper Sec. II).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Events {
    /// Probability α that an event starts in a TTI in which none is active, `(0, 1]`.
    pub alpha: f64,
    /// TTIs that an event lasts unless a report ends it, ≥ 1.
    pub duration: u64,
}

/// Settings of the base station.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BsSettings {
    /// TTIs between two synchronisation broadcasts of the δ plan, ≥ 1 (paper Sec. V-D: far longer than a TTI).
    pub sync_interval: u64,
    /// How wake-up candidates are ranked.
    pub ranking: WakeUpRanking,
    /// What a policy that looks at batteries is told of them.
    pub battery_knowledge: BatteryKnowledge,
}

/// A kind of device with its own battery, costs and energy source.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceClass {
    /// Its name in files and tables.
    pub name: String,
    /// Its share of the N devices, `(0, 1]`.
    pub share: f64,
    /// Battery and costs.
    pub energy: EnergyModel,
    /// The energy source.
    pub harvest: Harvest,
}

/// Battery and costs of a device (Table II).
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct EnergyModel {
    /// Battery capacity `E_max`, > 0 (100 units).
    pub e_max: Energy,
    /// Cost `E_idle` of a TTI in S1 (1 unit).
    pub e_idle: Energy,
    /// Cost `E_WuR` of a TTI in S4 with the wake-up radio on (1/14 unit).
    pub e_wur: Energy,
    /// Cost `E_Tx` of a transmission (10 units).
    pub e_tx: Energy,
    /// Battery level at the start, `0 ..= e_max` (`E_max` / 2).
    pub initial: Energy,
}

/// An energy source (paper Sec. III-A). λ is per unit of model time and at least 0; `E_B` is the energy of one arrival.
#[derive(Clone, Debug, PartialEq)]
pub enum Harvest {
    /// An arrival in a TTI with probability λτ·exp(-λτ), Eq. (5).
    Eq5 {
        /// λ.
        lambda: f64,
        /// `E_B`.
        e_b: Energy,
    },
    /// An arrival in a TTI with probability exp(-λ), the other reading in Sec. III-B.
    ExpMinusLambda {
        /// λ.
        lambda: f64,
        /// `E_B`.
        e_b: Energy,
    },
    /// An on/off source with exponential durations, `E_B` in each TTI that begins while it is on.
    Mpp {
        /// λ: on-durations have the mean 1/λ.
        lambda: f64,
        /// `E_B`.
        e_b: Energy,
        /// Mean off-duration in units of model time, > 0. By default such that the source is on for the share
        /// λτ·exp(-λτ) of the time, which is how the paper reads Eq. (5).
        off_mean: f64,
    },
    /// Recorded energy.
    Trace(Trace),
}

impl Harvest {
    /// The mean harvest in a TTI of duration `tau`; of a trace's first column.
    pub fn mean(&self, tau: f64) -> Energy {
        let rows = match self {
            Self::Trace(trace) => trace.values.first().cloned().map(Arc::new),
            Self::Eq5 { .. } | Self::ExpMinusLambda { .. } | Self::Mpp { .. } => None,
        };
        HarvestSetup::new(self, tau, 0).mean(rows.as_slice())
    }
}

/// Recorded energy per TTI.
#[derive(Clone, Debug, PartialEq)]
pub struct Trace {
    /// The file it came from.
    pub file: PathBuf,
    /// Where the columns were taken.
    pub columns: TraceColumns,
    /// Units of energy for one unit in the file, ≥ 0.
    pub scale: f64,
    /// TTIs that one row lasts, ≥ 1; its energy comes in each of them.
    pub ttis_per_row: u64,
    /// What follows the last row.
    pub end: TraceEnd,
    /// Energy per TTI by column and row, scaled.
    pub values: Arc<Vec<Vec<Energy>>>,
}

/// Which column of a trace a device reads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TraceColumns {
    /// All devices of the class read this column.
    Shared(String),
    /// The i-th device of the class reads the i-th of these columns, in a circle.
    PerDevice(Vec<String>),
}

/// What follows the last row of a trace.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TraceEnd {
    /// It begins again.
    Cycle,
    /// Nothing more is harvested.
    Stop,
}

/// A policy with its settings. The names are those of the command line and of every file.
#[derive(Clone, Debug, PartialEq)]
pub enum PolicyConfig {
    /// KNN-based duty cycling and wake-up, Algorithm 1.
    Knn(KnnSettings),
    /// One duty cycle for all devices, found by exhaustive search, and wake-up by correlation.
    Adjusted(AdjustedSettings),
    /// Tabular Q-learning of who senses and whom to wake.
    QLearning(QLearningSettings),
    /// Each device draws its own duty cycle; no wake-up.
    Random,
    /// Every device sleeps; the one closest to the epicentre is woken.
    Genie,
}

impl PolicyConfig {
    /// The policy's name.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Knn(_) => "knn",
            Self::Adjusted(_) => "adjusted",
            Self::QLearning(_) => "q-learning",
            Self::Random => "random",
            Self::Genie => "genie",
        }
    }
}

/// Settings of the `knn` policy (Sec. V-A).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KnnSettings {
    /// Neighbours K that vote on a device's cluster, ≥ 1 (MODEL default 5).
    pub neighbours: u32,
    /// Whether a cluster with a member farther than `d_max` from its centroid is split (MODEL default true).
    pub limit_radius: bool,
}

/// Settings of the `adjusted` policy (Sec. V-A, first approach).
#[derive(Clone, Debug, PartialEq)]
pub struct AdjustedSettings {
    /// Values of t_on to search, TTIs, each 1 ..= 2²⁴.
    pub t_on: Vec<u32>,
    /// Values of t_DRX to search, TTIs, each 1 ..= 2²⁴. At least one pair has t_on ≤ t_DRX.
    pub t_drx: Vec<u32>,
    /// Length of the pilot run that judges a pair, TTIs, ≥ 4; its first quarter is left out.
    pub pilot_ttis: u64,
    /// What the search has found for the deployment of this scenario; it is made before a run and is part of no file.
    pub found: Option<DutyChoice>,
}

impl AdjustedSettings {
    /// The pairs (t_on, t_DRX) to search, in the order of the lists.
    pub fn pairs(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        let all = self
            .t_on
            .iter()
            .flat_map(|&t_on| self.t_drx.iter().map(move |&t_drx| (t_on, t_drx)));
        all.filter(|(t_on, t_drx)| t_on <= t_drx)
    }
}

/// The duty cycle that a search has chosen, and what it cost to find.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DutyChoice {
    /// t_on, TTIs.
    pub t_on: u32,
    /// t_DRX, TTIs.
    pub t_drx: u32,
    /// Whether the pair reached I_min in its pilot run; if not, none did.
    pub reaches_i_min: bool,
    /// Pairs judged.
    pub pairs: u32,
    /// Device-TTIs of all pilot runs together.
    pub device_ttis: u64,
}
