//! The decision transformer (Sec. V-C, Algorithm 2): learned offline from recorded trajectories, run online at the BS.
//!
//! In each TTI every device has a token of what the BS knows of it ([`senses`]). The [`model`] attends over the last Z
//! TTIs of each device and then over the devices, and tells how many times as many events each is likely to find as it
//! would be without history. Devices are then chosen as under `age-index`: while what they would look at is worth its
//! price, which is the lower the more is expected; where energy is scarce, the more than usual (`usual`). A price is
//! given, or the model names the one that goes with a target return.

pub mod model;
pub mod record;
pub mod senses;
pub mod settings;
mod usual;

use std::sync::Arc;

use reveille_common::declare::{Reader, ScenarioError, Section};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::scenario::{PolicyChoice, PolicyKind, PolicySettings, Site, WakeUpRanking};

use self::model::infer::Forward;
use self::model::shape::{HEADS, Objective};
use self::senses::Senses;
use self::settings::DtSettings;
use self::usual::Usual;
use super::contract::{Opaque, Policy};
use super::kind::{Profile, Registered, own};
use super::mind::Mind;
use super::tally::Tally;
use crate::beliefs::ages;
use crate::beliefs::ages::choice::Choice;
use crate::beliefs::ages::price::{Prices, needed};
use crate::beliefs::candidates::{Candidates, LEAST_GAIN};
use crate::beliefs::posterior::Belief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `dt` policy.
pub struct Dt {
    senses: Senses,
    forward: Forward,
    objective: Objective,
    target: f64,
    prices: Prices,
    choice: Choice,
    candidates: Candidates,
    /// By device, what history makes of the information that a wake-up is expected to bring.
    wake_factors: Vec<f64>,
    /// By device, of its price.
    factors: Vec<f64>,
    usual: Usual,
    tally: Tally,
}

impl Dt {
    /// The policy for the devices in `known`.
    pub fn new(known: &Knowledge, settings: &DtSettings) -> Self {
        let positions = known.positions();
        let senses = Senses::new(known, |j| needed(&known.devices[j].energy));
        let reach = ages::reach(&known.sensing) / senses.ages().cell_surface();
        let price = settings.fixed_price().unwrap_or(1.0);
        Self {
            forward: Forward::new(Arc::clone(&settings.weights), known.n()),
            objective: settings.weights.shape().objective,
            target: settings.target,
            prices: Prices::new(known, price * reach),
            choice: Choice::new(&positions, known.area, known.sensing.d_max),
            candidates: Candidates::by(WakeUpRanking::Posterior, known).charging(settings.in_vain * known.sensing.psi),
            wake_factors: vec![1.0; known.n()],
            factors: vec![1.0; known.n()],
            usual: Usual::new(known.n()),
            tally: Tally::default(),
            senses,
        }
    }
}

impl Dt {
    /// Those that a teacher would have sense: where the log-odds are above 0.
    fn imitated(&mut self) -> Vec<DeviceId> {
        let said = self.forward.step(self.senses.tokens()).as_chunks::<HEADS>().0;
        let would = |(j, log_odds): (usize, &[f32; HEADS])| {
            let is_on = log_odds[0] > 0.0 && self.senses.can_sense(j);
            is_on.then_some(DeviceId(j as u32))
        };
        said.iter().enumerate().filter_map(would).collect()
    }

    /// Those whose looks are worth their price.
    fn worthwhile(&mut self, seen: &Observation<'_>) -> Vec<DeviceId> {
        let expected = self.forward.step(self.senses.tokens());
        for (j, logarithms) in expected.as_chunks::<HEADS>().0.iter().enumerate() {
            let [events, information] = logarithms.map(|log| f64::from(libm::expf(log)));
            let (level, e_max) = (seen.batteries[j], seen.known.devices[j].energy.e_max);
            self.factors[j] = self.usual.factor(j, events, level, e_max);
            self.wake_factors[j] = information;
        }
        if self.target > 0.0 {
            let price = f64::from(libm::expf(self.forward.price(self.target as f32)));
            self.factors.iter_mut().for_each(|factor| *factor *= price);
        }
        let prices = self.prices.scaled(seen.batteries, |j| self.factors[j]);
        let mut chosen = self.choice.choose(self.senses.ages_mut(), prices);
        chosen.sort_unstable();
        chosen
    }
}

impl Policy for Dt {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        self.senses.begin(seen);
        let chosen = match self.objective {
            Objective::Events => self.worthwhile(seen),
            Objective::Actions => self.imitated(),
        };
        let plan = self.tally.plan(seen.known.n(), &chosen);
        self.senses.look(seen.now, &plan, self.objective == Objective::Events);
        plan
    }

    /// Decides in every TTI: places get older.
    fn next_decision(&self, now: Tti) -> Tti {
        now + 1
    }

    fn looks_at_batteries(&self) -> bool {
        true
    }

    fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        for report in reports {
            self.senses.hear(seen, report);
        }
        let ages = self.senses.ages();
        self.candidates.start_with(seen, reports, |place| ages.at(place));
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let (device, gain) = self.candidates.next(seen, |_| true)?;
        (gain * self.wake_factors[device.index()] >= LEAST_GAIN * seen.known.sensing.psi).then_some(device)
    }

    fn belief(&self) -> Option<&Belief> {
        self.candidates.belief()
    }

    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        if let Some(report) = report {
            self.senses.hear(seen, report);
            let ages = self.senses.ages();
            self.candidates.add_with(seen, report, |place| ages.at(place));
        }
    }

    fn facts(&self) -> Vec<(&'static str, f64)> {
        vec![self.tally.fact()]
    }
}

/// The policy `dt`.
#[derive(Clone, Copy, Debug)]
pub struct DtKind;

impl PolicyKind for DtKind {
    fn name(&self) -> &'static str {
        "dt"
    }

    fn about(&self) -> &'static str {
        "Decision transformer (Algorithm 2), learned offline: expects events by what was found where and when."
    }

    fn section(&self) -> Option<&'static Section> {
        Some(DtSettings::SECTION)
    }

    fn settle(&self, reader: &Reader<'_>, site: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(DtSettings::settle(reader, site)?))
    }
}

impl Registered for DtKind {
    fn profile(&self) -> Profile {
        Profile {
            wakes: true,
            runtime: "O(N²)",
            ..Profile::plain(4)
        }
    }

    fn build(&self, choice: &PolicyChoice, known: &Knowledge, _: Option<&Opaque>) -> Mind {
        Mind::of(Dt::new(known, own(choice)))
    }
}
