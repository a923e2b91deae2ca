//! The phases of a run with actions in the report of `inspect misses`: missed events before the first action, between
//! actions and after the last one, with the energy from `windows.csv`.

use std::fmt::Write as _;

use reveille_common::digits::format_significant;
use reveille_common::ids::Tti;
use reveille_study::misses::{Phase, cause_name};
use serde_json::{Value, json};

use crate::run_folder::WINDOWS_FILE;
use crate::run_reader::RunReader;

/// Energy spent per device and TTI in each window of a run: first TTI, TTI after the last, units.
#[derive(Default)]
pub(super) struct PhaseEnergy(Vec<(Tti, Tti, f64)>);

impl PhaseEnergy {
    /// Reads the windows of `run`. The list is empty for a run without `windows.csv`.
    ///
    /// # Errors
    /// If the table is invalid.
    pub(super) fn read(run: &RunReader) -> anyhow::Result<Self> {
        let Some(table) = run.table(WINDOWS_FILE)? else {
            return Ok(Self(Vec::new()));
        };
        let windows = table.rows().map(|row| {
            let (first, end) = (Tti(row.number("first_tti")?), Tti(row.number("end_tti")?));
            Ok((first, end, row.number("energy_per_device_tti")?))
        });
        windows.collect::<anyhow::Result<_>>().map(Self)
    }

    /// Returns the mean energy per device and TTI over the windows inside `phase`; `None` if no window is inside.
    fn mean(&self, phase: &Phase) -> Option<f64> {
        let windows = self
            .0
            .iter()
            .filter(|(first, end, _)| *first >= phase.first && *end <= phase.end);
        let (sum, ttis) = windows.fold((0.0, 0.0), |(sum, ttis), (first, end, energy)| {
            let length = (*end - *first) as f64;
            (sum + energy * length, ttis + length)
        });
        (ttis > 0.0).then(|| sum / ttis)
    }

    pub(super) fn to_json(&self, phase: &Phase) -> Value {
        json!({
            "first_tti": phase.first,
            "end_tti": phase.end,
            "failed_devices": phase.failed_devices,
            "events": phase.events,
            "missed": phase.missed,
            "missed_pct": phase.missed_pct(),
            "main_cause": phase.main_cause.map(|(cause, _)| cause_name(cause)),
            "energy_per_device_tti": self.mean(phase),
        })
    }

    /// Formats the phases as a table.
    pub(super) fn format(&self, phases: &[Phase]) -> String {
        let mut text = format!(
            "Phases between actions\n{:>9} {:>9} {:>7} {:>7} {:>7} {:>8} {:>7}  main cause\n",
            "from TTI", "to TTI", "failed", "events", "missed", "missed %", "energy"
        );
        for phase in phases {
            let cause = phase.main_cause.map_or_else(
                || "–".to_owned(),
                |(cause, count)| format!("{} ({count})", cause_name(cause)),
            );
            let missed_pct = if phase.events == 0 {
                "–".to_owned()
            } else {
                format!("{:.2}", phase.missed_pct())
            };
            let energy = self.mean(phase);
            let energy = energy.map_or_else(|| "–".to_owned(), |energy| format_significant(energy, 3));
            let _infallible = writeln!(
                text,
                "{:>9} {:>9} {:>7} {:>7} {:>7} {missed_pct:>8} {energy:>7}  {cause}",
                phase.first.to_string(),
                (phase.end.0 - 1).to_string(),
                phase.failed_devices,
                phase.events,
                phase.missed
            );
        }
        text + "failed: most devices failed at a time; energy: units per device and TTI, over\n\
                the windows inside the phase and over all devices (failed ones spend nothing,\n\
                so a drop after failures is no saving)\n"
    }
}
