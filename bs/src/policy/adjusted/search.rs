//! The choice among the duty cycles of a grid (Sec. V-A, P2): the (t_on, t_DRX) of least mean consumption among those
//! that reach I_min in their pilot runs, or, if none does, the one of most information.

use reveille_common::score::Metrics;

use super::settings::AdjustedSettings;
use crate::beliefs::ranking::i_min;
use crate::knowledge::Knowledge;
use crate::policy::contract::Opaque;
use crate::policy::pilots::Pilots;

/// A duty cycle of the grid and how its pilot run went.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trial {
    /// t_on, TTIs.
    pub t_on: u32,
    /// t_DRX, TTIs.
    pub t_drx: u32,
    /// Information per event, `[0, Ψ]`; NaN if there was no event.
    pub information: f64,
    /// Units spent per device and TTI.
    pub energy: f64,
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

/// The search with its settings.
#[derive(Clone, Debug)]
pub struct Search(pub AdjustedSettings);

impl Search {
    /// The duty cycles of the grid with what their pilot runs brought, in the order of the grid.
    pub fn trials(&self, pilots: &[Metrics]) -> Vec<Trial> {
        let trial = |((t_on, t_drx), metrics): ((u32, u32), &Metrics)| Trial {
            t_on,
            t_drx,
            information: metrics.info_per_event,
            energy: metrics.energy_per_device_tti,
        };
        self.0.pairs().zip(pilots).map(trial).collect()
    }
}

impl Pilots for Search {
    fn ttis(&self) -> u64 {
        self.0.pilot_ttis
    }

    fn candidates(&self) -> Vec<Opaque> {
        let candidate = |(t_on, t_drx)| DutyChoice {
            t_on,
            t_drx,
            reaches_i_min: false,
            pairs: 1,
            device_ttis: 0,
        };
        self.0.pairs().map(|pair| Opaque::new(candidate(pair))).collect()
    }

    fn judge(&self, known: &Knowledge, pilots: &[Metrics]) -> Opaque {
        let threshold = i_min(&known.positions(), known.area, &known.sensing);
        let (best, reaches_i_min) = choose(&self.trials(pilots), threshold).expect("the grid holds a pair");
        let pairs = pilots.len() as u32;
        Opaque::new(DutyChoice {
            t_on: best.t_on,
            t_drx: best.t_drx,
            reaches_i_min,
            pairs,
            device_ttis: u64::from(pairs) * known.n() as u64 * self.0.pilot_ttis,
        })
    }
}

/// The first of the best of `trials` for the threshold `i_min`, and whether it reaches it.
pub fn choose(trials: &[Trial], i_min: f64) -> Option<(Trial, bool)> {
    let reaching = trials.iter().filter(|trial| trial.information >= i_min);
    let least = reaching.min_by(|a, b| a.energy.total_cmp(&b.energy));
    let information = |trial: &Trial| {
        if trial.information.is_nan() {
            -1.0
        } else {
            trial.information
        }
    };
    // Of equals `max_by` takes the last, hence the reversal.
    let most = || {
        let rising = trials.iter().rev();
        rising.max_by(|a, b| information(a).total_cmp(&information(b)))
    };
    least
        .map(|trial| (*trial, true))
        .or_else(|| most().map(|trial| (*trial, false)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_choice_is_the_cheapest_that_reaches_i_min_or_else_the_best() {
        let trial = |t_on, information, energy| Trial {
            t_on,
            t_drx: 9,
            information,
            energy,
        };
        let all = [
            trial(1, 0.2, 0.5),
            trial(2, 0.4, 0.3),
            trial(3, 0.6, 0.4),
            trial(4, 0.6, 0.4),
            trial(5, f64::NAN, 0.1),
        ];
        let chosen = |i_min| choose(&all, i_min).map(|(trial, reaches)| (trial.t_on, reaches));
        assert_eq!(chosen(0.3), Some((2, true)));
        assert_eq!(chosen(0.1), Some((2, true)));
        assert_eq!(chosen(0.5), Some((3, true)));
        assert_eq!(chosen(0.7), Some((3, false)));
        assert_eq!(choose(&[], 0.1), None);
    }
}
