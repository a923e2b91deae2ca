//! `summary.json`: the results of a run, also printed by `--json` and as a table (`results_table`).
//!
//! The field names are a file format (`docs/results.md`): raise [`SUMMARY_VERSION`] if one changes its meaning.
//! `compare`, `inspect verify`, `run_folder`, `run_reader`, `bench`, `tests/` and `python/` read fields by name.

use std::collections::BTreeMap;

use reveille_bs::cycle::RunOutcome;
use reveille_bs::scenario::{Scenario, preset_label};
use reveille_common::radio::RadioSettings;
use reveille_common::score::{ClassRecord, DIGEST_VERSION, Digest, EventActivity, Metrics};
use reveille_common::totals::Totals;
use serde::Serialize;

/// The version of the format of `summary.json`; raised when a field changes its meaning.
const SUMMARY_VERSION: u32 = 5;

/// `summary.json`.
#[derive(Debug, Serialize)]
pub(crate) struct Summary<'a> {
    /// The run's digest.
    pub digest: Digest,
    /// Whether the run was `complete` or `interrupted`. `commands`, `results_table` and `run_folder` repeat `complete`.
    pub status: &'static str,
    /// The policy's name.
    pub policy: &'static str,
    /// Number of devices N.
    pub n: u32,
    /// Length of the run K in TTIs.
    pub ttis: u64,
    /// TTIs that were run.
    pub ttis_done: u64,
    /// The seed.
    pub seed: u64,
    /// The preset that the scenario starts from.
    pub preset: &'a str,
    /// The name of the preset, with a remark if the scenario differs from it.
    #[serde(skip)]
    pub preset_label: String,
    /// Facts that the policy reports about the deployment, such as the number of clusters.
    pub policy_facts: BTreeMap<&'static str, f64>,
    /// SHA-256 of the resolved scenario.
    pub scenario_hash: String,
    /// The mean probability that an event starts in a measured TTI: the α of `info_p1`.
    pub start_probability: f64,
    /// The metrics; metrics per event are null if no event was counted.
    pub metrics: Metrics,
    /// The exact totals behind the metrics; energies in micro-units.
    pub totals: Totals,
    /// The results of each device class, if there are several.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub classes: Vec<ClassSummary<'a>>,
    /// The audited part of a run over the bus: `complete`, `partial: TTI …` (the TTIs before it), or `off`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub audit: Option<String>,
    /// Durations and counters of the execution. They differ between two equal runs of a scenario, and so can `audit`.
    pub timing: Timing,
    /// Versions of the program and the formats.
    pub versions: Versions,
    /// The radio of the scenario, which decides the rows of the results table.
    #[serde(skip)]
    pub radio: RadioSettings,
}

/// The devices of one class.
#[derive(Debug, Serialize)]
pub(crate) struct ClassSummary<'a> {
    /// Its name.
    pub name: &'a str,
    /// Number of devices.
    pub n: u64,
    /// The metrics that are defined for a subset of the devices.
    pub metrics: BTreeMap<&'static str, f64>,
    /// Activity of its devices for the counted events.
    #[serde(flatten)]
    pub activity: EventActivity,
}

impl<'a> ClassSummary<'a> {
    fn all(scenario: &'a Scenario, outcome: &RunOutcome) -> Vec<Self> {
        // A single class would repeat the metrics of the whole run.
        if scenario.classes.len() < 2 {
            return Vec::new();
        }
        let summary_of = |(index, name): (u16, &'a str)| {
            let record = ClassRecord::new(index, &outcome.devices, outcome.totals.ttis);
            let rows = record.metrics.rows();
            let device_metrics = Metrics::ALL
                .iter()
                .zip(rows)
                .filter(|(metric, _)| metric.is_by_device());
            Self {
                name,
                n: record.devices,
                metrics: device_metrics
                    .map(|(metric, (_, value, _))| (metric.name, value))
                    .collect(),
                activity: record.activity,
            }
        };
        let names = scenario.classes.iter().map(|class| class.name.as_str());
        (0..).zip(names).map(summary_of).collect()
    }
}

/// Durations and counters of the execution.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(crate) struct Timing {
    /// Seconds until all devices had joined.
    pub ready_s: f64,
    /// Seconds from the first TTI to the last ledger.
    pub run_s: f64,
    /// Mean TTIs per second over that time.
    pub ttis_per_s: f64,
    /// Number of device processes (1 if the base station ran the devices), or 0 for a run in memory.
    pub hosts: usize,
    /// Barriers over all hosts; fewer than TTIs if lookahead joined some.
    pub grants: u64,
    /// TTIs that began late under a real-time pace.
    pub late_ttis: u64,
    /// The largest delay, milliseconds.
    pub max_late_ms: f64,
    /// Dropped payloads on the bus that were not valid messages.
    pub malformed_messages: u64,
    /// Dropped messages on the bus that were unexpected or implausible.
    pub unexpected_messages: u64,
    /// Decisions of a policy process, under `external`.
    pub decisions: u64,
    /// Answers of the policy process that were invalid or came after the valid one.
    pub decisions_refused: u64,
    /// Decision requests without an answer in time: the plan stayed the same, or no device was woken.
    pub decisions_held: u64,
    /// Losses of device processes that ended with the return of the process or with a takeover of its devices.
    pub losses: usize,
    /// The longest of them, seconds.
    pub longest_loss_s: f64,
    /// Mean resident memory of a device process in MB; absent unless `up` started it on this machine.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub host_rss_mb: Option<f64>,
    /// Mean proportional memory of a device process in MB (shared pages split); absent like `host_rss_mb`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub host_pss_mb: Option<f64>,
}

/// Versions of the program and of its formats.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Versions {
    /// The version of Reveille.
    pub reveille: &'static str,
    /// The version of the message format.
    pub wire: u8,
    /// The version of this file's format.
    pub summary: u32,
    /// The version of the digest's content: digests of different versions are not comparable.
    pub digest: u32,
}

impl<'a> Summary<'a> {
    /// Creates the summary of a run of `scenario`.
    pub(crate) fn new(scenario: &'a Scenario, outcome: &RunOutcome, timing: Timing) -> Self {
        Self {
            digest: outcome.digest,
            status: if outcome.is_complete { "complete" } else { "interrupted" },
            policy: scenario.policy.name(),
            n: scenario.run.devices,
            ttis: scenario.run.ttis,
            ttis_done: outcome.ttis_done,
            seed: scenario.run.seed,
            preset: &scenario.run.preset,
            preset_label: preset_label(scenario),
            policy_facts: outcome.facts.iter().copied().collect(),
            scenario_hash: scenario.hash_hex(),
            start_probability: outcome.start_probability,
            metrics: outcome.metrics,
            totals: outcome.totals,
            classes: ClassSummary::all(scenario, outcome),
            audit: None,
            timing,
            versions: Versions {
                reveille: env!("CARGO_PKG_VERSION"),
                wire: reveille_common::codec::WIRE_VERSION,
                summary: SUMMARY_VERSION,
                digest: DIGEST_VERSION,
            },
            radio: scenario.radio,
        }
    }

    /// Returns the summary as JSON text.
    ///
    /// # Errors
    /// Never in practice.
    pub(crate) fn to_json(&self) -> anyhow::Result<String> {
        Ok(serde_json::to_string_pretty(self)? + "\n")
    }
}
