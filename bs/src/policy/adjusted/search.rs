//! Choice among the duty cycles of a grid (Sec. V-A, P2): the (t_on, t_DRX) of least mean consumption among those that
//! reach I_min in their pilot runs. If none does, the one with the most information is chosen. If no pilot run has an
//! event, the least consumption decides. `lab/src/preparation.rs` makes the pilot runs; `tests/src/reference/search.rs`
//! must choose the same pair.

use std::sync::Arc;

use super::settings::AdjustedSettings;
use crate::beliefs::ranking::i_min;
use crate::knowledge::Knowledge;
use crate::policy::factory::{PilotRuns, PilotSearch, PolicyFactory};

/// Duty cycle of the grid with the results of its pilot run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PilotResult {
    /// t_on, TTIs.
    pub t_on: u32,
    /// t_DRX, TTIs.
    pub t_drx: u32,
    /// Information per event, `[0, Ψ]`; NaN if there was no event.
    pub information_per_event: f64,
    /// Units spent per device and TTI.
    pub energy_per_device_tti: f64,
}

/// Duty cycle chosen by a search, with the cost of the search: facts of the run's summary (`Adjusted::summary_facts`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DutyCycleChoice {
    /// t_on, TTIs.
    pub t_on: u32,
    /// t_DRX, TTIs.
    pub t_drx: u32,
    /// Whether the pair reached I_min in its pilot run; if false, no pair did.
    pub reaches_i_min: bool,
    /// Number of judged pairs.
    pub searched_pairs: u32,
    /// Number of events in the pilot run with the fewest; the fact `pilot_events`.
    pub fewest_pilot_events: u64,
    /// Length of a pilot run, TTIs.
    pub pilot_ttis: u64,
    /// Total device-TTIs of all pilot runs.
    pub device_ttis: u64,
}

/// Returns the duty cycles of the grid with the results of their pilot runs, in the order of the grid. The metrics in
/// `pilots` must have the order of [`AdjustedSettings::pairs`], as the candidates of the search do.
pub fn collect_pilot_results(settings: &AdjustedSettings, pilots: &PilotRuns) -> Vec<PilotResult> {
    let pairs = settings.pairs().zip(&pilots.metrics);
    let results = pairs.map(|((t_on, t_drx), metrics)| PilotResult {
        t_on,
        t_drx,
        information_per_event: metrics.info_per_event,
        energy_per_device_tti: metrics.energy_per_device_tti,
    });
    results.collect()
}

/// Returns the search over the grid of `settings`, with a candidate for each pair.
pub(super) fn pilot_search(settings: &AdjustedSettings) -> PilotSearch {
    let candidate = |(t_on, t_drx)| {
        // A pilot run reads only the pair; the other fields are placeholders.
        let choice = DutyCycleChoice {
            t_on,
            t_drx,
            reaches_i_min: false,
            searched_pairs: 1,
            fewest_pilot_events: 0,
            pilot_ttis: 0,
            device_ttis: 0,
        };
        Arc::new(choice) as Arc<dyn PolicyFactory>
    };
    PilotSearch {
        initial_ttis: settings.pilot_ttis,
        min_events: settings.pilot_events,
        max_ttis: settings.pilot_limit,
        candidates: settings.pairs().map(candidate).collect(),
        judge: {
            let settings = settings.clone();
            Box::new(move |known, pilots| {
                let choice = choose_cycle(&settings, known, pilots);
                (Arc::new(choice), warnings(&settings, pilots))
            })
        },
    }
}

fn choose_cycle(settings: &AdjustedSettings, known: &Knowledge, pilots: &PilotRuns) -> DutyCycleChoice {
    let threshold = i_min(&known.positions(), known.area, &known.sensing);
    // `AdjustedSettings::from_fields` refuses a grid without a pair.
    let (best, reaches_i_min) =
        best_result(&collect_pilot_results(settings, pilots), threshold).expect("the grid holds a pair");
    DutyCycleChoice {
        t_on: best.t_on,
        t_drx: best.t_drx,
        reaches_i_min,
        searched_pairs: pilots.metrics.len() as u32,
        fewest_pilot_events: pilots.fewest_events(),
        pilot_ttis: pilots.run_ttis,
        device_ttis: pilots.total_ttis.saturating_mul(known.n() as u64),
    }
}

fn warnings(settings: &AdjustedSettings, pilots: &PilotRuns) -> Vec<String> {
    if pilots.fewest_events() >= settings.pilot_events {
        return Vec::new();
    }
    vec![format!(
        "the duty cycle of adjusted is unreliable: not all pilot runs have {} events (policy.adjusted.pilot_events) in \
         {} TTIs; raise policy.adjusted.pilot_limit, or keep one pair in policy.adjusted.t_on and \
         policy.adjusted.t_drx",
        settings.pilot_events, pilots.run_ttis
    )]
}

/// Returns the best of `results` for the threshold `i_min`, and whether it reaches the threshold. Ties go to the first.
/// `None` if `results` is empty.
pub fn best_result(results: &[PilotResult], i_min: f64) -> Option<(PilotResult, bool)> {
    // NaN, the information of a run without events, is below every threshold.
    let reaching = results.iter().filter(|result| result.information_per_event >= i_min);
    let cheapest_reaching = reaching.min_by(|a, b| a.energy_per_device_tti.total_cmp(&b.energy_per_device_tti));
    if let Some(result) = cheapest_reaching {
        return Some((*result, true));
    }
    let with_events = results.iter().filter(|result| !result.information_per_event.is_nan());
    // `max_by` takes the last of equals; in reverse order that is the first pair of the grid.
    let most_informative = with_events
        .rev()
        .max_by(|a, b| a.information_per_event.total_cmp(&b.information_per_event));
    let cheapest = || {
        results
            .iter()
            .min_by(|a, b| a.energy_per_device_tti.total_cmp(&b.energy_per_device_tti))
    };
    most_informative.or_else(cheapest).map(|result| (*result, false))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_choice_is_the_cheapest_that_reaches_i_min_or_else_the_most_informative() {
        let result = |t_on, information_per_event, energy_per_device_tti| PilotResult {
            t_on,
            t_drx: 9,
            information_per_event,
            energy_per_device_tti,
        };
        let results = [
            result(1, 0.2, 0.5),
            result(2, 0.4, 0.3),
            result(3, 0.6, 0.4),
            result(4, 0.6, 0.4),
            result(5, f64::NAN, 0.1),
        ];
        let choice = |i_min| best_result(&results, i_min).map(|(result, reaches)| (result.t_on, reaches));
        assert_eq!(choice(0.3), Some((2, true)));
        assert_eq!(choice(0.1), Some((2, true)));
        assert_eq!(choice(0.5), Some((3, true)));
        assert_eq!(choice(0.7), Some((3, false)));
        assert_eq!(best_result(&[], 0.1), None);
        // Without any event, the first of the pairs with the least consumption.
        let without_events =
            [(1, 0.4), (2, 0.3), (3, 0.5), (4, 0.3)].map(|(t_on, energy)| result(t_on, f64::NAN, energy));
        let chosen = best_result(&without_events, 0.1).map(|(result, reaches)| (result.t_on, reaches));
        assert_eq!(chosen, Some((2, false)));
    }
}
