//! The TOML form of a scenario. Every field is optional here; a preset supplies what a file leaves out.

use serde::Deserialize;

use super::learning::{BatteryKnowledge, WakeUpRanking};
use super::model::TraceEnd;
use crate::sensing::{DetectionKind, Fusion};

/// A whole scenario file. Units and ranges are those of [`super::Scenario`].
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawScenario {
    pub(super) preset: Option<String>,
    pub(super) devices: Option<u64>,
    pub(super) ttis: Option<u64>,
    pub(super) seed: Option<u64>,
    pub(super) warm_up: Option<f64>,
    pub(super) tau: Option<f64>,
    pub(super) area: RawArea,
    pub(super) layout: RawLayout,
    pub(super) energy: RawEnergy,
    pub(super) harvest: RawHarvest,
    pub(super) sensing: RawSensing,
    pub(super) events: RawEvents,
    pub(super) bs: RawBs,
    pub(super) policy: RawPolicy,
    pub(super) class: Vec<RawClass>,
}

/// `[area]`.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawArea {
    pub(super) width: Option<f64>,
    pub(super) height: Option<f64>,
}

/// `[layout]`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawLayout {
    pub(super) kind: Option<LayoutKind>,
    pub(super) file: Option<String>,
}

/// `layout.kind`.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "kebab-case", expecting = "a string")]
pub(super) enum LayoutKind {
    Uniform,
    JitteredGrid,
    PoissonDisk,
    Grid,
    Hex,
    File,
}

/// `[energy]`, in units.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawEnergy {
    pub(super) e_max: Option<f64>,
    pub(super) e_idle: Option<f64>,
    pub(super) e_wur: Option<f64>,
    pub(super) e_tx: Option<f64>,
    pub(super) initial: Option<f64>,
}

/// `[harvest]`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawHarvest {
    pub(super) kind: Option<HarvestKind>,
    pub(super) lambda: Option<f64>,
    pub(super) e_b: Option<f64>,
    pub(super) off_mean: Option<f64>,
    pub(super) trace: RawTrace,
}

/// `harvest.kind`.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "kebab-case", expecting = "a string")]
pub(super) enum HarvestKind {
    Eq5,
    ExpMinusLambda,
    Mpp,
    Trace,
}

/// `[harvest.trace]`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawTrace {
    pub(super) file: Option<String>,
    pub(super) column: Option<String>,
    pub(super) columns: Option<Vec<String>>,
    pub(super) scale: Option<f64>,
    pub(super) ttis_per_row: Option<u64>,
    pub(super) end: Option<TraceEnd>,
}

/// `[sensing]`.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawSensing {
    pub(super) kind: Option<DetectionKind>,
    pub(super) d_max: Option<f64>,
    pub(super) eta: Option<f64>,
    pub(super) psi: Option<f64>,
    pub(super) g: Option<Fusion>,
}

/// `[events]`.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawEvents {
    pub(super) alpha: Option<f64>,
    pub(super) duration: Option<u64>,
}

/// `[bs]`.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawBs {
    pub(super) sync_interval: Option<u64>,
    pub(super) ranking: Option<WakeUpRanking>,
    pub(super) battery_knowledge: Option<BatteryKnowledge>,
}

/// `[policy]`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawPolicy {
    pub(super) name: Option<PolicyName>,
    pub(super) knn: RawKnn,
    pub(super) adjusted: RawAdjusted,
    #[serde(rename = "q-learning")]
    pub(super) q_learning: RawQLearning,
}

/// `policy.name`.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "kebab-case", expecting = "a string")]
pub(super) enum PolicyName {
    Knn,
    Adjusted,
    QLearning,
    Random,
    Genie,
}

/// `[policy.knn]`.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawKnn {
    pub(super) neighbours: Option<u64>,
    pub(super) limit_radius: Option<bool>,
}

/// `[policy.adjusted]`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawAdjusted {
    pub(super) t_on: Option<Vec<u64>>,
    pub(super) t_drx: Option<Vec<u64>>,
    pub(super) pilot_ttis: Option<u64>,
}

/// `[policy.q-learning]`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawQLearning {
    pub(super) mu1: Option<f64>,
    pub(super) mu2: Option<f64>,
    pub(super) zeta: Option<f64>,
    pub(super) window: Option<u64>,
    pub(super) table: Option<String>,
    pub(super) learn: Option<bool>,
    pub(super) epsilon: Option<f64>,
    pub(super) epsilon_last: Option<f64>,
    pub(super) rate_decay: Option<f64>,
    pub(super) rate_floor: Option<f64>,
    pub(super) optimism: Option<f64>,
}

/// One `[[class]]`. Its sections override single fields of the top-level ones.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "a table")]
pub(super) struct RawClass {
    pub(super) name: Option<String>,
    pub(super) share: Option<f64>,
    pub(super) energy: RawEnergy,
    pub(super) harvest: RawHarvest,
}
