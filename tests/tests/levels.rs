//! Battery estimates from reported levels (`bs.battery_knowledge = reported`) under `q-learning`, for devices whose
//! harvest stops unexpectedly. The base station has to infer that from missing reports. The estimates themselves are
//! compared with the reference implementation in `reference.rs`.

use reveille_bs::observer::{Notification, Observer};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_lab::preparation::start;
use reveille_tests::compare::ONE_TTI_PER_GRANT;
use reveille_tests::process::TestFolder;
use reveille_tests::scenarios::paper;

const DEVICES: u32 = 40;
const TTIS: usize = 12_000;

struct SensingObserver {
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

/// Runs `q-learning` with harvest `rows`, units per TTI; nothing arrives after the last row.
fn run(folder: &TestFolder, knowledge: &str, rows: impl Iterator<Item = u32>) -> SensingObserver {
    let rows: Vec<String> = rows.map(|units| units.to_string()).collect();
    let file = folder.write("energy.csv", &format!("e\n{}\n", rows.join("\n")));
    let scenario = paper(&[
        "policy.name=q-learning",
        &format!("devices={DEVICES}"),
        &format!("ttis={TTIS}"),
        "harvest.kind=trace",
        "harvest.trace.column=e",
        "harvest.trace.end=stop",
        &format!("harvest.trace.file={}", file.display()),
        &format!("bs.battery_knowledge={knowledge}"),
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
    let observed = run(&folder, "reported", std::iter::repeat_n(2, 200));
    // By part of 1000 TTIs.
    let means: Vec<f64> = (0..12)
        .map(|i| observed.mean_sensing_count(1000 * i..1000 * (i + 1)))
        .collect();
    assert!(means[0] > 3.0, "{means:?}");
    assert!(means[11] < 0.5, "still planned after 12000 TTIs: {means:?}");
    let (early, late): (f64, f64) = (means[2..7].iter().sum(), means[7..].iter().sum());
    assert!(late < 0.5 * early, "{means:?}");
}

#[test]
fn events_are_reported_again_after_a_pause_of_the_harvest() {
    let folder = TestFolder::new();
    // A night of 600 TTIs, then day to the end.
    let rows = || (0..TTIS).map(|k| if (200..800).contains(&k) { 0 } else { 2 });
    let [with_true_levels, with_estimates] = ["oracle", "reported"].map(|knowledge| {
        let observed = run(&folder, knowledge, rows());
        observed.reported_share_from(6000)
    });
    assert!(
        with_true_levels > 0.5 && with_estimates > 0.9 * with_true_levels,
        "reported share {with_estimates} with estimates, {with_true_levels} with true levels"
    );
}
