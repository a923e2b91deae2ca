//! `summary.json`: what a run came to.

use std::collections::BTreeMap;

use reveille_bs::outcome::Outcome;
use reveille_common::ids::Tti;
use reveille_common::scenario::Scenario;
use reveille_common::score::{Acts, ClassRecord, DIGEST_VERSION, Digest, Metrics};
use reveille_common::totals::Totals;
use serde::Serialize;

/// The form of `summary.json`; raised when a field changes its meaning.
const SUMMARY_VERSION: u32 = 2;

/// `summary.json`.
#[derive(Debug, Serialize)]
pub struct Summary<'a> {
    /// The run's fingerprint.
    pub digest: Digest,
    /// Whether the run was `complete` or `interrupted`.
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
    /// What the policy found out about the deployment, such as the number of clusters.
    pub policy_facts: BTreeMap<&'static str, f64>,
    /// SHA-256 of the resolved scenario.
    pub scenario_hash: String,
    /// The mean over the measured TTIs of the probability that an event starts in one: the α of `info_p1`.
    pub start_probability: f64,
    /// The metrics; those per event are null where no event was counted.
    pub metrics: Metrics,
    /// The exact totals behind them; energies in micro-units.
    pub totals: Totals,
    /// Where there are several device classes, what each came to.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub classes: Vec<Class<'a>>,
    /// How far a run over the bus was compared with a replay: `whole`, `before TTI …`, or `off`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub audit: Option<String>,
    /// How long things took; the only part that differs between two runs of a scenario.
    pub timing: Timing,
    /// Versions of what wrote this.
    pub versions: Versions,
}

/// The devices of one class.
#[derive(Debug, Serialize)]
pub struct Class<'a> {
    /// Its name.
    pub name: &'a str,
    /// Number of devices.
    pub n: u64,
    /// The metrics that can be taken over some devices alone.
    pub metrics: BTreeMap<&'static str, f64>,
    /// What its devices did for the counted events.
    #[serde(flatten)]
    pub acts: Acts,
}

impl<'a> Class<'a> {
    fn all(scenario: &'a Scenario, outcome: &Outcome) -> Vec<Self> {
        if scenario.classes.len() < 2 {
            return Vec::new();
        }
        let class = |(class, name): (u16, &'a str)| {
            let record = ClassRecord::of(class, &outcome.devices, outcome.totals.ttis);
            let rows = record.metrics.rows();
            let own = Metrics::ALL
                .iter()
                .zip(rows)
                .filter(|(metric, _)| metric.group.is_by_device());
            Self {
                name,
                n: record.devices,
                metrics: own.map(|(metric, (_, value, _))| (metric.name, value)).collect(),
                acts: record.acts,
            }
        };
        let names = scenario.classes.iter().map(|class| class.name.as_str());
        (0..).zip(names).map(class).collect()
    }
}

/// How long things took.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Timing {
    /// Seconds until all devices had joined.
    pub ready_s: f64,
    /// Seconds from the first TTI to the last ledger.
    pub run_s: f64,
    /// TTIs per second over that time.
    pub ttis_per_s: f64,
    /// Processes that carried devices (1 where the base station's own did), or 0 for a run in memory.
    pub hosts: usize,
    /// Barriers over all hosts; fewer than TTIs where lookahead joined them.
    pub grants: u64,
    /// TTIs that began late under a real-time pace.
    pub late_ttis: u64,
    /// The largest delay, milliseconds.
    pub max_late_ms: f64,
    /// Payloads on the bus that were no messages and were dropped.
    pub malformed: u64,
    /// Messages on the bus that nobody waited for, or that could not be true, and were dropped.
    pub strays: u64,
    /// Decisions of a policy process, under `external`.
    pub decisions: u64,
    /// Its answers that decided nothing, or came after the one that counted.
    pub decisions_refused: u64,
    /// Decisions that nobody made in time: the plan in force held, or nobody was woken.
    pub decisions_held: u64,
    /// Times that a device process was lost and its devices were carried again.
    pub losses: usize,
    /// The longest of those, seconds.
    pub longest_loss_s: f64,
    /// Mean resident memory of a device process in MB, 0 where there is none.
    pub host_rss_mb: f64,
    /// Mean proportional memory of a device process in MB (shared pages split), 0 where there is none.
    pub host_pss_mb: f64,
}

/// What made the summary, and in which forms.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Versions {
    /// The version of Reveille.
    pub reveille: &'static str,
    /// The version of the form of messages.
    pub wire: u8,
    /// The version of the form of this file.
    pub summary: u32,
    /// The version of what the digest is of: digests of different versions cannot be compared.
    pub digest: u32,
}

impl<'a> Summary<'a> {
    /// The summary of a run of `scenario`.
    pub fn new(scenario: &'a Scenario, outcome: &Outcome, timing: Timing) -> Self {
        Self {
            digest: outcome.digest,
            status: if outcome.complete { "complete" } else { "interrupted" },
            policy: scenario.policy.name(),
            n: scenario.devices,
            ttis: scenario.ttis,
            ttis_done: outcome.ttis_done,
            seed: scenario.seed,
            preset: &scenario.preset,
            policy_facts: outcome.facts.iter().copied().collect(),
            scenario_hash: scenario.hash_hex(),
            start_probability: scenario.events.mean_start_probability(
                scenario.seed,
                scenario.warm_up_end(),
                Tti(outcome.ttis_done),
            ),
            metrics: outcome.metrics,
            totals: outcome.totals,
            classes: Class::all(scenario, outcome),
            audit: None,
            timing,
            versions: Versions {
                reveille: env!("CARGO_PKG_VERSION"),
                wire: reveille_common::codec::WIRE_VERSION,
                summary: SUMMARY_VERSION,
                digest: DIGEST_VERSION,
            },
        }
    }

    /// The summary as JSON text.
    ///
    /// # Errors
    /// Never in practice.
    pub fn to_json(&self) -> anyhow::Result<String> {
        Ok(serde_json::to_string_pretty(self)? + "\n")
    }
}
