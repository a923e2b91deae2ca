//! Radio of the reference, computed TTI by TTI from the definition, for `world.rs`.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_bs::scenario::Scenario;
use reveille_common::radio::{InterferenceBursts, RadioLossRates, RadioSettings};
use reveille_common::rng::{Geometric, Purpose, Stream, unit_for_pair};

/// Radio of a run. Its clock advances whether or not anything is sent: call [`Self::begin`] once for each TTI, in
/// order, and then [`Self::draw_false_wake_up`] once for each device. A loss depends on device, TTI and kind of message
/// only, so a repeated query has the same answer.
#[derive(Clone, Debug)]
pub(super) struct ReferenceRadio {
    seed: u64,
    settings: RadioSettings,
    /// Mean rates, as known to the base station.
    loss_rates: RadioLossRates,
    interference: Option<InterferencePhases>,
    /// By device, its random stream and the TTIs until its next false wake-up.
    false_wake_ups: Vec<(Stream, u64)>,
    /// By device, whether a plan has reached it. All plans of a run are equal, so that a later loss has no effect.
    has_plan: Vec<bool>,
    /// Current TTI.
    k: u64,
}

/// Bursts and the quiet phases between them.
#[derive(Clone, Debug)]
struct InterferencePhases {
    bursts: InterferenceBursts,
    stream: Stream,
    is_burst: bool,
    /// TTIs until the phase ends.
    remaining_ttis: u64,
}

impl InterferencePhases {
    fn new(bursts: InterferenceBursts, seed: u64) -> Self {
        let mut stream = Stream::new(seed, Purpose::InterferencePhases, 0);
        let is_burst = stream.unit() < bursts.burst_ttis / (bursts.burst_ttis + bursts.quiet_ttis);
        let mut phases = Self {
            bursts,
            stream,
            is_burst,
            remaining_ttis: 0,
        };
        phases.remaining_ttis = phases.draw_length();
        phases
    }

    fn draw_length(&mut self) -> u64 {
        let mean = if self.is_burst {
            self.bursts.burst_ttis
        } else {
            self.bursts.quiet_ttis
        };
        Geometric::new(1.0 / mean).draw(&mut self.stream)
    }

    /// Advances to the next TTI.
    fn advance(&mut self) {
        if self.remaining_ttis == 0 {
            self.is_burst = !self.is_burst;
            self.remaining_ttis = self.draw_length();
        }
        self.remaining_ttis -= 1;
    }
}

impl ReferenceRadio {
    pub(super) fn new(scenario: &Scenario, devices: usize) -> Self {
        let (seed, settings) = (scenario.run.seed, scenario.radio);
        let gap_law = Geometric::new(settings.false_wake_up);
        let false_wake_ups = (0..devices as u64).map(|id| {
            let mut stream = Stream::new(seed, Purpose::FalseWakeUps, id);
            let gap = gap_law.draw(&mut stream);
            (stream, gap)
        });
        Self {
            seed,
            settings,
            loss_rates: mean_loss_rates(&settings),
            interference: settings.bursts.map(|bursts| InterferencePhases::new(bursts, seed)),
            false_wake_ups: false_wake_ups.collect(),
            has_plan: vec![false; devices],
            k: 0,
        }
    }

    /// Begins TTI `k`, with a broadcast of the plan if `is_plan_sent`. Returns the number of devices that miss it. Call
    /// once for each TTI, in order.
    pub(super) fn begin(&mut self, k: u64, is_plan_sent: bool) -> u64 {
        self.k = k;
        if let Some(interference) = &mut self.interference {
            interference.advance();
        }
        let mut missed_plans = 0;
        for j in (0..self.has_plan.len()).filter(|_| is_plan_sent) {
            if self.is_lost(Purpose::PlanLoss, j, self.settings.plan_loss) {
                missed_plans += 1;
            } else {
                self.has_plan[j] = true;
            }
        }
        missed_plans
    }

    /// Whether a plan has reached device `j`.
    pub(super) fn has_plan(&self, j: usize) -> bool {
        self.has_plan[j]
    }

    /// Draws whether a false wake-up occurs for device `j` in this TTI, which has an effect only if it sleeps. Call
    /// once per TTI, whatever its state.
    pub(super) fn draw_false_wake_up(&mut self, j: usize) -> bool {
        let (stream, remaining_ttis) = &mut self.false_wake_ups[j];
        // A gap is at least 1, so this does not wrap.
        *remaining_ttis -= 1;
        let is_now = *remaining_ttis == 0;
        if is_now {
            *remaining_ttis = Geometric::new(self.settings.false_wake_up).draw(stream);
        }
        is_now
    }

    /// Whether a wake-up of device `j` is lost in this TTI.
    pub(super) fn misses_wake_up(&self, j: usize) -> bool {
        self.is_lost(Purpose::WakeMiss, j, self.settings.wake_miss)
    }

    /// Whether a report of device `j` is lost in this TTI.
    pub(super) fn loses_report(&self, j: usize) -> bool {
        self.is_lost(Purpose::UplinkLoss, j, self.settings.uplink_loss)
    }

    /// Probability that plan loss or uplink loss prevents the report of a device that is planned to sense, as known to
    /// the base station.
    pub(super) fn silence_probability(&self) -> f64 {
        1.0 - (1.0 - self.loss_rates.plan_loss) * (1.0 - self.loss_rates.uplink_loss)
    }

    /// Probability that a missed wake-up or uplink loss prevents the report of a woken device, as known to the base
    /// station.
    pub(super) fn no_answer_probability(&self) -> f64 {
        1.0 - (1.0 - self.loss_rates.wake_miss) * (1.0 - self.loss_rates.uplink_loss)
    }

    /// Whether a message of device `j` is lost, which has the probability `quiet_loss` between bursts.
    fn is_lost(&self, purpose: Purpose, j: usize, quiet_loss: f64) -> bool {
        // A burst never makes a loss less likely.
        let burst = self.interference.as_ref().filter(|phases| phases.is_burst);
        let p = burst.map_or(quiet_loss, |phases| phases.bursts.loss.max(quiet_loss));
        unit_for_pair(self.seed, purpose, j as u64, self.k) < p
    }
}

/// Returns the mean loss probabilities over bursts and quiet phases.
fn mean_loss_rates(settings: &RadioSettings) -> RadioLossRates {
    let mean = |p: f64| match settings.bursts {
        None => p,
        Some(InterferenceBursts {
            burst_ttis,
            quiet_ttis,
            loss,
        }) => (burst_ttis * loss.max(p) + quiet_ttis * p) / (burst_ttis + quiet_ttis),
    };
    RadioLossRates {
        wake_miss: mean(settings.wake_miss),
        uplink_loss: mean(settings.uplink_loss),
        plan_loss: mean(settings.plan_loss),
    }
}
