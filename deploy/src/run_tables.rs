//! The rows of the tables in a run folder: events, windows of TTIs, devices.
//!
//! `run_folder` writes them. The columns and their order are a file format without a version, documented in
//! `docs/results.md`; `compare`, `inspect misses`, `run_reader` and `tests/recompute/` read columns by name. Each row
//! has its cells in the order of its columns, of which the compiler checks only the number, and for windows not even
//! that. Energies of events and devices are in units, exact to the micro-unit, with six decimals.

use reveille_bs::scenario::Scenario;
use reveille_common::event::EventRecord;
use reveille_common::geometry::Buckets;
use reveille_common::score::{DeviceRecord, EventActivity, Metrics, WindowRecord};
use reveille_common::totals::{PICO_PER_INFORMATION, Totals};

/// The columns of `events.csv`.
pub(crate) const EVENT_COLUMNS: [&str; 15] = [
    "event",
    "start_tti",
    "last_tti",
    "x_m",
    "y_m",
    "counted",
    "delay_ttis",
    "reports",
    "wake_ups",
    "information",
    "wrong_activations",
    "wasted_units",
    "miss_cause",
    "nearest_device",
    "nearest_m",
];

/// The columns of `devices.csv`.
pub(crate) const DEVICE_COLUMNS: [&str; 20] = [
    "device",
    "x_m",
    "y_m",
    "class",
    "sensing_units",
    "sleep_units",
    "report_units",
    "harvested_units",
    "overflow_units",
    "reports",
    "wake_ups",
    "wake_ups_received",
    "wrong_activations",
    "sensing_ttis",
    "failed_ttis",
    "low_ttis",
    "unpowered_ttis",
    "longest_outage_ttis",
    "start_battery",
    "final_battery",
];

/// Metrics over all devices in each window of `windows.csv`.
const WINDOW_METRICS: [&str; 8] = [
    "mean_battery",
    "low_energy_pct",
    "energy_per_device_tti",
    "energy_sensing_per_device_tti",
    "energy_sleep_per_device_tti",
    "energy_report_per_device_tti",
    "harvested_per_device_tti",
    "overflow_per_device_tti",
];

/// Sums over the events of a window; [`window_row`] has them in this order.
const WINDOW_EVENTS: [&str; 6] = [
    "events",
    "misdetected",
    "delay_ttis",
    "information",
    "wake_ups",
    "wrong_activations",
];

/// The row of an event in a deployment with these device positions.
pub(crate) fn event_row(record: &EventRecord, positions: &Buckets) -> [String; EVENT_COLUMNS.len()] {
    let tally = record.tally;
    let nearest = positions.nearest(record.epicentre, 1);
    let (nearest_m, nearest_device) = nearest.first().map_or_else(Default::default, |(squared_m2, device)| {
        (squared_m2.sqrt().to_string(), device.to_string())
    });
    [
        record.event.0.to_string(),
        record.start.to_string(),
        record.last.to_string(),
        record.epicentre.x.to_string(),
        record.epicentre.y.to_string(),
        u8::from(record.counted).to_string(),
        record.delay().map_or_else(String::new, |delay| delay.to_string()),
        tally.reports.to_string(),
        tally.wake_ups.to_string(),
        format_information(u128::from(tally.information_pico)),
        tally.wrong_activations.to_string(),
        tally.wasted_energy.decimal_units(),
        record
            .miss_cause
            .map_or_else(String::new, |cause| cause.name().to_owned()),
        nearest_device,
        nearest_m,
    ]
}

/// The row of a device, over the measured TTIs.
pub(crate) fn device_row(scenario: &Scenario, record: &DeviceRecord) -> [String; DEVICE_COLUMNS.len()] {
    let (measured, spent) = (record.ledger.measured, record.ledger.measured.spent);
    let EventActivity {
        reports,
        wake_ups,
        received_wake_ups,
        wrong_activations,
    } = record.activity;
    let class = scenario.classes.get(usize::from(record.class));
    [
        record.device.to_string(),
        record.position.x.to_string(),
        record.position.y.to_string(),
        class.map_or_else(String::new, |class| class.name.clone()),
        spent.sensing.decimal_units(),
        spent.sleep.decimal_units(),
        spent.report.decimal_units(),
        measured.harvested.decimal_units(),
        measured.overflow.decimal_units(),
        reports.to_string(),
        wake_ups.to_string(),
        received_wake_ups.to_string(),
        wrong_activations.to_string(),
        measured.sensing_ttis.to_string(),
        measured.failed_ttis.to_string(),
        measured.low_ttis.to_string(),
        measured.unpowered_ttis.to_string(),
        record.ledger.longest_outage.to_string(),
        measured.initial.decimal_units(),
        measured.battery.decimal_units(),
    ]
}

/// The columns of `windows.csv`.
pub(crate) fn window_columns() -> impl Iterator<Item = &'static str> {
    ["first_tti", "end_tti"]
        .into_iter()
        .chain(WINDOW_METRICS)
        .chain(WINDOW_EVENTS)
}

/// The row of a window of TTIs with `devices` devices, removed ones included.
pub(crate) fn window_row(devices: u32, record: &WindowRecord) -> impl Iterator<Item = String> {
    let event_sums = record.events;
    let totals = Totals {
        devices: u64::from(devices),
        ttis: record.end - record.first,
        energy: record.energy,
        ..Totals::default()
    };
    // Without α: no metric of a window needs it.
    let metrics = Metrics::from_totals(f64::NAN, &totals);
    let times = [record.first, record.end].map(|tti| tti.to_string());
    let means = WINDOW_METRICS.map(|name| metrics.value(name).unwrap_or(f64::NAN).to_string());
    let events = [
        event_sums.events.to_string(),
        event_sums.misdetected.to_string(),
        event_sums.delay_ttis.to_string(),
        format_information(event_sums.information_pico),
        event_sums.wake_ups.to_string(),
        event_sums.wrong_activations.to_string(),
    ];
    times.into_iter().chain(means).chain(events)
}

/// Formats a sum of information, in parts of 1 / [`PICO_PER_INFORMATION`], as a plain number.
fn format_information(pico: u128) -> String {
    (pico as f64 / PICO_PER_INFORMATION).to_string()
}
