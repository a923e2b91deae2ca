//! Settings of the `adjusted` policy (Sec. V-A, first approach).

use reveille_common::declare;
use reveille_common::declare::{Reader, ScenarioError, Section, Sink, whole, wholes};
use reveille_common::plan::DutyCycle;
use reveille_common::scenario::{MAX_TTIS, PolicySettings};

/// The longest list of t_on or t_DRX to search.
const MOST_CYCLES: usize = 64;

declare! {
    /// Settings of the policy `adjusted` (Sec. V-A, first approach).
    #[derive(Clone, Debug)]
    struct Fields in "policy.adjusted" {
        /// Values of t_on to search. At least one is not longer than one of `t_drx`.
        t_on: Vec<u32> = wholes(1, DutyCycle::LONGEST, MOST_CYCLES, &[1, 2]).unit("TTIs").source("Sec. V-A"),
        /// Values of t_DRX to search.
        t_drx: Vec<u32> = wholes(1, DutyCycle::LONGEST, MOST_CYCLES, &[2, 4, 8, 16, 32])
            .unit("TTIs")
            .source("Sec. V-A"),
        /// Length of the pilot run that judges a pair; its first quarter is left out. Longer where events are rare.
        pilot_ttis: u64 = whole(4, MAX_TTIS, 2000).unit("TTIs"),
        /// Events that each pilot run has to hold, or all are made twice as long, and again.
        pilot_events: u64 = whole(0, 1_000_000, 30),
        /// How long pilot runs may get for the sake of events; one that still holds too few is warned of.
        pilot_limit: u64 = whole(4, MAX_TTIS, 200_000).unit("TTIs"),
    }
}

/// Settings of the `adjusted` policy (Sec. V-A, first approach).
#[derive(Clone, Debug, PartialEq)]
pub struct AdjustedSettings {
    /// Values of t_on to search, TTIs, each 1 ..= 2²⁴.
    pub t_on: Vec<u32>,
    /// Values of t_DRX to search, TTIs, each 1 ..= 2²⁴. At least one pair has t_on ≤ t_DRX.
    pub t_drx: Vec<u32>,
    /// Length of the pilot run that judges a pair, TTIs, ≥ 4; its first quarter is left out. Made longer where events
    /// are rare.
    pub pilot_ttis: u64,
    /// Events that each pilot run has to hold, or all are made twice as long, and again.
    pub pilot_events: u64,
    /// How long pilot runs may get for the sake of events, TTIs.
    pub pilot_limit: u64,
}

impl AdjustedSettings {
    /// Its fields as they are declared.
    pub const SECTION: &'static Section = Fields::SECTION;

    /// The settings that `reader` has.
    ///
    /// # Errors
    /// A value that may not be, or no pair with t_on ≤ t_DRX.
    pub fn settle(reader: &Reader<'_>) -> Result<Self, ScenarioError> {
        let Fields {
            t_on,
            t_drx,
            pilot_ttis,
            pilot_events,
            pilot_limit,
        } = Fields::read(reader)?;
        let settings = Self {
            t_on,
            t_drx,
            pilot_ttis,
            pilot_events,
            pilot_limit,
        };
        if settings.pairs().next().is_none() {
            let allowed = "must hold a value that is not longer than one of policy.adjusted.t_drx";
            return Err(reader.refuse("policy.adjusted.t_on", format!("{:?}", settings.t_on), allowed));
        }
        Ok(settings)
    }

    /// The pairs (t_on, t_DRX) to search, in the order of the lists.
    pub fn pairs(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        let all = self
            .t_on
            .iter()
            .flat_map(|&t_on| self.t_drx.iter().map(move |&t_drx| (t_on, t_drx)));
        all.filter(|(t_on, t_drx)| t_on <= t_drx)
    }
}

impl PolicySettings for AdjustedSettings {
    fn visit(&self, sink: &mut dyn Sink) {
        let fields = Fields {
            t_on: self.t_on.clone(),
            t_drx: self.t_drx.clone(),
            pilot_ttis: self.pilot_ttis,
            pilot_events: self.pilot_events,
            pilot_limit: self.pilot_limit,
        };
        fields.visit(sink);
    }

    fn own_runs(&self) -> Vec<(&'static str, u64)> {
        // What `pilot_limit` allows on top is cut to what sums allow.
        vec![("policy.adjusted.pilot_ttis", self.pilot_ttis)]
    }
}
