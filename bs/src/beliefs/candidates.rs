//! Wake-up candidates of a policy, best first, by either ranking: by `P_4,2` ([`Ranking`]) or by the belief over the
//! epicentre ([`EpicentreBelief`]). `age-index`, `dt` and `q-learning` use them directly, `knn` and `adjusted` through
//! the information target. Digests depend on their order. Learned wake tables depend on the scale of the scores, so
//! another scale needs new tables.
//!
//! An event begins with [`WakeUpCandidates::start_event`]. Then candidates are taken and further reports added, in any
//! order. All calls of one event need the same prior.

use reveille_common::ids::DeviceId;
use reveille_common::message::Report;
use reveille_common::scenario::WakeUpRanking;

use super::posterior::{EpicentreBelief, PlacePrior, uniform_prior};
use super::ranking::{Correlation, Ranking};
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// Minimum expected information of a wake-up, as a share of Ψ, for `age-index` and `dt`; docs/age-index.md and
/// docs/dt.md state it. Values from 0.01 to 0.03 gather the same information per energy; below 0.01, hopeless devices
/// are woken.
pub(crate) const MIN_GAIN_SHARE: f64 = 0.02;

/// Wake-up candidates of one event at a time, by `bs.ranking` of the scenario.
#[derive(Clone, Debug)]
pub struct WakeUpCandidates(CandidateRanking);

#[derive(Clone, Debug)]
enum CandidateRanking {
    P42(Box<Ranking>),
    Posterior(Box<EpicentreBelief>),
}

impl WakeUpCandidates {
    /// Creates candidates among the devices in `known`, ordered by its settings.
    pub fn new(known: &Knowledge) -> Self {
        Self::with_ranking(known.bs.ranking, known)
    }

    /// Creates candidates among the devices in `known`, ordered by `ranking`.
    pub fn with_ranking(ranking: WakeUpRanking, known: &Knowledge) -> Self {
        let (positions, area, sensing) = (known.positions(), known.area, &known.sensing);
        Self(match ranking {
            WakeUpRanking::P42 => {
                let correlation = Correlation::new(sensing, &known.correlation_bounds);
                CandidateRanking::P42(Box::new(Ranking::new(&positions, area, correlation)))
            }
            WakeUpRanking::Posterior => {
                let belief = EpicentreBelief::new(&positions, area, sensing);
                CandidateRanking::Posterior(Box::new(belief.with_loss(known.radio.no_report_probability())))
            }
        })
    }

    /// Sets the cost of a failed wake-up when devices are compared: `miss_cost`, ≥ 0, in units of information. Scores
    /// remain the expected gains. The ranking by `P_4,2` ignores it.
    #[must_use]
    pub(crate) fn with_miss_cost(self, miss_cost: f64) -> Self {
        Self(match self.0 {
            CandidateRanking::P42(ranking) => CandidateRanking::P42(ranking),
            CandidateRanking::Posterior(belief) => {
                CandidateRanking::Posterior(Box::new(belief.with_miss_cost(miss_cost)))
            }
        })
    }

    /// Begins an event with its first reports. The ranking by belief also uses the silence of devices that could have
    /// reported.
    pub fn start_event(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        self.start_event_with_prior(seen, reports, &uniform_prior);
    }

    /// Begins an event like [`Self::start_event`], with a non-uniform prior over the epicentre. `prior` is a relative
    /// density, at least 2⁻⁵¹². The ranking by `P_4,2` ignores it.
    pub(crate) fn start_event_with_prior(
        &mut self,
        seen: &Observation<'_>,
        reports: &[Report],
        prior: &impl PlacePrior,
    ) {
        self.clear();
        for report in reports {
            self.add_report_with_prior(seen, report, prior);
        }
        if let CandidateRanking::Posterior(belief) = &mut self.0 {
            // A device without energy for a report is silent wherever the event is.
            belief.observe_silence(|device| !seen.is_asleep(device) && seen.can_report(device), prior);
        }
    }

    /// Begins an event without any report.
    pub fn clear(&mut self) {
        match &mut self.0 {
            CandidateRanking::P42(ranking) => ranking.start_event(),
            CandidateRanking::Posterior(belief) => belief.start_event(),
        }
    }

    /// Adds a further report.
    pub fn add_report(&mut self, seen: &Observation<'_>, report: &Report) {
        self.add_report_with_prior(seen, report, &uniform_prior);
    }

    /// Adds a report like [`Self::add_report`], with the prior of the event.
    pub(crate) fn add_report_with_prior(&mut self, seen: &Observation<'_>, report: &Report, prior: &impl PlacePrior) {
        if let CandidateRanking::P42(ranking) = &mut self.0 {
            // The reporter is awake. It may have missed the plan that lets it sleep, so the plan alone does not exclude
            // it.
            ranking.exclude(report.device);
        }
        let distance = seen.known.sensing.distance(report.information);
        match (&mut self.0, distance) {
            (CandidateRanking::P42(ranking), Some(d)) => ranking.add_reporter(report.device, d),
            (CandidateRanking::Posterior(belief), Some(d)) => belief.add_reporter(report.device, d, prior),
            (CandidateRanking::Posterior(belief), None) => belief.add_far_reporter(report.device),
            // A report from beyond d_max has I = 0, so it has no distance to rank by.
            (CandidateRanking::P42(_), None) => {}
        }
    }

    /// The belief over the epicentre, if the ranking uses one.
    pub const fn belief(&self) -> Option<&EpicentreBelief> {
        match &self.0 {
            CandidateRanking::P42(_) => None,
            CandidateRanking::Posterior(belief) => Some(belief),
        }
    }

    /// Returns the best sleeping device for which `may_wake` holds, with its score. The device must be able to pay for
    /// a report as far as known (Sec. IV), and is returned once per event. The score is `P_4,2` times Ψ or the expected
    /// information gain, both `[0, Ψ]`.
    pub fn next_candidate(
        &mut self,
        seen: &Observation<'_>,
        may_wake: impl Fn(DeviceId) -> bool,
    ) -> Option<(DeviceId, f64)> {
        let is_candidate = |device| seen.is_asleep(device) && may_wake(device) && seen.can_report(device);
        match &mut self.0 {
            CandidateRanking::P42(ranking) => {
                let (device, probability) = ranking.next_candidate(is_candidate)?;
                Some((device, probability * seen.known.sensing.psi))
            }
            CandidateRanking::Posterior(belief) => belief.next_candidate(seen.information, is_candidate),
        }
    }
}
