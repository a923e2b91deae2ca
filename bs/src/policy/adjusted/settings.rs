//! Settings of the policy `adjusted` (Sec. V-A, first approach): the grid of duty cycles to search, and the length of
//! its pilot runs. The fields, in their order, are part of scenario files, their hashes and docs/scenario.md. The order
//! of [`AdjustedSettings::pairs`] decides ties of the search; `tests/src/reference/search.rs` repeats it. Texts of
//! fields repeat `PILOT_WARM_UP` (a quarter) and the doubling of `lab/src/preparation.rs`.

use reveille_common::declare;
use reveille_common::declare::{FieldReader, ScenarioError, whole, wholes};
use reveille_common::plan::DutyCycle;
use reveille_common::scenario::MAX_TTIS;

/// Longest list of t_on or t_DRX to search.
const MAX_LIST_LENGTH: usize = 64;

declare! {
    /// Settings of the policy `adjusted` (Sec. V-A, first approach).
    #[derive(Clone, Debug, PartialEq)]
    pub struct AdjustedSettings in "policy.adjusted" {
        /// Values of t_on to search. At least one must not exceed the longest of `t_drx`.
        pub t_on: Vec<u32> = wholes(1, DutyCycle::MAX_T_DRX, MAX_LIST_LENGTH, &[1, 2])
            .unit("TTIs")
            .source("Sec. V-A"),
        /// Values of t_DRX to search.
        pub t_drx: Vec<u32> = wholes(1, DutyCycle::MAX_T_DRX, MAX_LIST_LENGTH, &[2, 4, 8, 16, 32])
            .unit("TTIs")
            .source("Sec. V-A"),
        /// Length of the pilot run that evaluates a pair, without its first quarter. It grows if events are rare.
        pub pilot_ttis: u64 = whole(4, MAX_TTIS, 2000).unit("TTIs"),
        /// Minimum number of events in each pilot run. Until every run reaches it, the length of all pilot runs
        /// doubles.
        pub pilot_events: u64 = whole(0, 1_000_000, 30),
        /// Maximum length of pilot runs after doubling. A pilot run that still has too few events causes a warning.
        pub pilot_limit: u64 = whole(4, MAX_TTIS, 200_000).unit("TTIs"),
    }
}

impl AdjustedSettings {
    /// Reads the settings.
    ///
    /// # Errors
    /// A value is out of range, or no pair has t_on ≤ t_DRX.
    pub fn from_fields(reader: &FieldReader<'_>) -> Result<Self, ScenarioError> {
        let settings = Self::read(reader)?;
        if settings.pairs().next().is_none() {
            let allowed = "must contain a value that does not exceed the longest of policy.adjusted.t_drx";
            return Err(reader.invalid_value("policy.adjusted.t_on", format!("{:?}", settings.t_on), allowed));
        }
        Ok(settings)
    }

    /// Returns the pairs (t_on, t_DRX) with t_on ≤ t_DRX to search: for each t_on, all t_DRX, in the order of the
    /// lists.
    pub fn pairs(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        let all_pairs = self
            .t_on
            .iter()
            .flat_map(|&t_on| self.t_drx.iter().map(move |&t_drx| (t_on, t_drx)));
        all_pairs.filter(|(t_on, t_drx)| t_on <= t_drx)
    }
}
