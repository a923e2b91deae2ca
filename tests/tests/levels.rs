//! Battery estimates from reported levels (`bs.battery_knowledge = reported`) under `q-learning`, for devices whose
//! harvest stops unexpectedly. The base station has to infer that from missing reports. `reference.rs` compares
//! estimates under `knn` and `adjusted` with the reference implementation, which lacks the rule for long silences used
//! here. The limits in the assertions only ensure that an effect is clear.

use reveille_bs::observer::{Notification, Observer};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_lab::preparation::start;
use reveille_tests::compare::ONE_TTI_PER_GRANT;
use reveille_tests::process::TestFolder;
use reveille_tests::scenarios::paper;

const DEVICES: u32 = 40;
const TTIS: usize = 12_000;

/// Observes how many devices sense, and which events are reported.
struct SensingObserver {
    /// Plan in effect; empty before the first.
    plan: Plan,
    /// Number of devices with δ = 1 in each TTI.
    sensing_counts: Vec<usize>,
    /// Start of each ended event, and whether it was reported.
    events: Vec<(Tti, bool)>,
}

impl SensingObserver {
    fn mean_sensing_count(&self, ttis: std::ops::Range<usize>) -> f64 {
        let n = ttis.len() as f64;
        self.sensing_counts[ttis].iter().sum::<usize>() as f64 / n
    }

    /// Returns the share of reported events among the events that start in TTI `first` or later.
    fn reported_share_from(&self, first: u64) -> f64 {
        let late_events = self.events.iter().filter(|(start, _)| start.0 >= first);
        let reported = late_events.clone().filter(|(_, is_reported)| *is_reported);
        reported.count() as f64 / late_events.count() as f64
    }
}

impl Observer for SensingObserver {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::PlanSent { update, .. } => self.plan = update.plan.clone(),
            Notification::EventEnded(event) => self.events.push((event.start, event.tally.reports > 0)),
            Notification::TtiClosed(k) => {
                let is_on = |j: &u32| self.plan.duty_cycle(DeviceId(*j)).is_on(*k);
                self.sensing_counts.push((0..DEVICES).filter(is_on).count());
            }
            Notification::TtisGranted(_)
            | Notification::EventStarted(_)
            | Notification::ReportReceived(_)
            | Notification::ReportLost(_)
            | Notification::DevicesRemoved(_)
            | Notification::ActionTaken(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpSent { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::BeliefUpdated { .. }
            | Notification::DeviceStates(_) => {}
        }
    }
}

/// Runs `q-learning` with `harvest_rows`, units per TTI; nothing arrives after the last row. Writes `energy.csv` in
/// `folder`.
fn observe_run(
    folder: &TestFolder,
    battery_knowledge: &str,
    harvest_rows: impl Iterator<Item = u32>,
) -> SensingObserver {
    let lines: Vec<String> = harvest_rows.map(|units| units.to_string()).collect();
    let file = folder.write("energy.csv", &format!("e\n{}\n", lines.join("\n")));
    let scenario = paper(&[
        "policy.name=q-learning",
        &format!("devices={DEVICES}"),
        &format!("ttis={TTIS}"),
        "harvest.kind=trace",
        "harvest.trace.column=e",
        "harvest.trace.end=stop",
        &format!("harvest.trace.file={}", file.display()),
        &format!("bs.battery_knowledge={battery_knowledge}"),
    ]);
    let mut observer = SensingObserver {
        plan: Plan::from_bits([]),
        sensing_counts: Vec::new(),
        events: Vec::new(),
    };
    start(&scenario, ONE_TTI_PER_GRANT).finish(&mut observer);
    assert_eq!(observer.sensing_counts.len(), TTIS);
    observer
}

#[test]
fn devices_without_harvest_are_planned_ever_less_often() {
    let folder = TestFolder::new();
    // Two units in each of the first 200 TTIs.
    let observed = observe_run(&folder, "reported", std::iter::repeat_n(2, 200));
    // In each thousand TTIs.
    let mean_counts: Vec<f64> = (0..12)
        .map(|i| observed.mean_sensing_count(1000 * i..1000 * (i + 1)))
        .collect();
    assert!(mean_counts[0] > 3.0, "{mean_counts:?}");
    assert!(mean_counts[11] < 0.5, "still planned after 12000 TTIs: {mean_counts:?}");
    let (early_sum, late_sum): (f64, f64) = (mean_counts[2..7].iter().sum(), mean_counts[7..].iter().sum());
    assert!(late_sum < 0.5 * early_sum, "{mean_counts:?}");
}

#[test]
fn events_are_reported_again_after_a_pause_of_the_harvest() {
    let folder = TestFolder::new();
    // A night of 600 TTIs, then day to the end.
    let harvest_rows = || (0..TTIS).map(|k| if (200..800).contains(&k) { 0 } else { 2 });
    let [with_true_levels, with_estimates] = ["oracle", "reported"].map(|battery_knowledge| {
        let observed = observe_run(&folder, battery_knowledge, harvest_rows());
        observed.reported_share_from(6000)
    });
    assert!(
        with_true_levels > 0.5 && with_estimates > 0.9 * with_true_levels,
        "reported share {with_estimates} with estimates, {with_true_levels} with true levels"
    );
}
