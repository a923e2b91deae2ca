//! Battery estimates of a base station that gets only reported levels (`bs.battery_knowledge = reported`). It cannot
//! know that expected energy no longer arrives, but it can detect that.

use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::{Override, load};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_lab::preparation::start;
use reveille_lab::run::RunOptions;
use reveille_tests::process::TestFolder;

/// Number of sensing devices in each TTI, and the ended events with whether they were reported.
struct SensingObserver {
    devices: u32,
    plan: Plan,
    sensing: Vec<usize>,
    events: Vec<(Tti, bool)>,
}

impl SensingObserver {
    fn sensing_in(&self, ttis: std::ops::Range<usize>) -> f64 {
        let n = ttis.len() as f64;
        self.sensing[ttis].iter().sum::<usize>() as f64 / n
    }

    fn reported_from(&self, first: u64) -> f64 {
        let late = self.events.iter().filter(|(start, _)| start.0 >= first);
        late.clone().filter(|(_, reported)| *reported).count() as f64 / late.count() as f64
    }
}

impl Observer for SensingObserver {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::PlanSent { update, .. } => self.plan = update.plan.clone(),
            Notification::EventEnded(event) => self.events.push((event.start, event.tally.reports > 0)),
            Notification::TtiClosed(k) => {
                let is_on = |j: &u32| self.plan.duty_cycle(DeviceId(*j)).is_on(*k);
                self.sensing.push((0..self.devices).filter(is_on).count());
            }
            Notification::TtisGranted(_)
            | Notification::EventStarted(_)
            | Notification::ReportReceived(_)
            | Notification::ReportLost(_)
            | Notification::DevicesRemoved(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpSent { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::BeliefUpdated { .. }
            | Notification::DeviceStates(_) => {}
        }
    }
}

/// Runs 40 devices under `q-learning` with harvest `rows`, units per TTI.
fn watch(folder: &TestFolder, knowledge: &str, rows: impl Iterator<Item = u32>) -> SensingObserver {
    let rows: Vec<String> = rows.map(|units| units.to_string()).collect();
    let file = folder.write("energy.csv", &format!("e\n{}\n", rows.join("\n")));
    let file = format!("harvest.trace.file={}", file.display());
    let knowledge = format!("bs.battery_knowledge={knowledge}");
    let set = [
        "policy.name=q-learning",
        "devices=40",
        "ttis=12000",
        "harvest.kind=trace",
        "harvest.trace.column=e",
        "harvest.trace.end=stop",
        file.as_str(),
        knowledge.as_str(),
    ];
    let overrides: Vec<Override> = set
        .iter()
        .map(|set| Override::parse(set).expect("an override"))
        .collect();
    let mut watch = SensingObserver {
        devices: 40,
        plan: Plan::from_bits([]),
        sensing: Vec::new(),
        events: Vec::new(),
    };
    let one_by_one = RunOptions {
        lookahead: false,
        ..RunOptions::default()
    };
    start(&load("paper", &overrides).expect("a scenario").scenario, one_by_one).finish(&mut watch);
    assert_eq!(watch.sensing.len(), 12_000);
    watch
}

#[test]
fn devices_without_harvest_are_woken_ever_less_often() {
    let folder = TestFolder::new();
    let ended = watch(&folder, "reported", std::iter::repeat_n(2, 200));
    let thousands: Vec<f64> = (0..12).map(|i| ended.sensing_in(1000 * i..1000 * (i + 1))).collect();
    assert!(thousands[0] > 3.0, "{thousands:?}");
    assert!(thousands[11] < 0.5, "still asked after 12000 TTIs: {thousands:?}");
    let (early, late): (f64, f64) = (thousands[2..7].iter().sum(), thousands[7..].iter().sum());
    assert!(late < 0.5 * early, "{thousands:?}");
}

#[test]
fn devices_that_charge_again_are_woken_again() {
    let folder = TestFolder::new();
    // A night of 600 TTIs, then day to the end.
    let rows = || (0..12_000).map(|k| if (200..800).contains(&k) { 0 } else { 2 });
    let [known, estimated] = ["oracle", "reported"].map(|knowledge| watch(&folder, knowledge, rows()));
    let (most, found) = (known.reported_from(6000), estimated.reported_from(6000));
    assert!(most > 0.5 && found > 0.9 * most, "{found}, with true levels {most}");
}
