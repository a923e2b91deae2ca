//! The definitions of all metrics, computed from exact integer totals. A new metric is an entry of `metrics!` below:
//! summaries, tables, figures and `docs/results.md` list [`Metrics::ALL`]. Names are columns of result tables, so it
//! also needs a name in [`Metrics::ADDED_LATER`] a higher `TABLE_VERSION` (`lab/src/table/error.rs`)
//! and a new `FORMAT` of journals (`lab/src/sweep/journal/`). The test
//! `tests/tests/reference.rs` computes every metric a second time, `tests/recompute/recompute.py` most of them. A
//! renamed metric needs an entry in `FORMER_NAMES`.

use serde::Serialize;

use crate::totals::{DeviceTotals, EventTotals, MissCause, PICO_PER_INFORMATION, RadioLosses, Totals};
use crate::units::{Energy, MICRO_PER_UNIT};

/// The subject of a metric, which groups the rows of a table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MetricGroup {
    /// The base station's knowledge of events, and its delay.
    Events,
    /// Energy spent and harvested.
    Energy,
    /// Batteries, and costs that they could not cover.
    Batteries,
    /// Messages and bytes over the air.
    Radio,
}

impl MetricGroup {
    /// All groups, in the order of tables.
    pub const ALL: [Self; 4] = [Self::Events, Self::Energy, Self::Batteries, Self::Radio];

    /// The title in tables.
    pub const fn title(self) -> &'static str {
        match self {
            Self::Events => "events",
            Self::Energy => "energy",
            Self::Batteries => "batteries",
            Self::Radio => "radio",
        }
    }
}

/// The description of a metric.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Metric {
    /// The name: the field of [`Metrics`] and the column of tables.
    pub name: &'static str,
    /// The group to which it belongs.
    pub group: MetricGroup,
    /// Its unit.
    pub unit: &'static str,
    /// The quantity with its unit, for titles and axes of figures; no two metrics share it.
    pub axis: &'static str,
    /// The measured quantity: the doc comment of the entry in `metrics!`, also a row of `docs/results.md`.
    pub meaning: &'static str,
    /// Whether the mean may be 0 while the values are not, so that an interval relative to the mean is meaningless.
    pub is_difference: bool,
}

impl Metric {
    /// Whether it can be computed for a subset of the devices. Information belongs to events, not to devices.
    pub fn is_by_device(&self) -> bool {
        matches!(self.group, MetricGroup::Energy | MetricGroup::Batteries) && self.name != "info_per_energy"
    }
}

struct MetricInputs<'t> {
    alpha: f64,
    totals: &'t Totals,
}

impl MetricInputs<'_> {
    fn device_ttis(&self) -> f64 {
        self.totals.devices as f64 * self.totals.ttis as f64
    }

    fn information(&self) -> f64 {
        self.totals.events.information_pico as f64 / PICO_PER_INFORMATION
    }

    /// Returns `sum` per counted event; NaN without events.
    fn per_event(&self, sum: f64) -> f64 {
        match self.totals.events.events {
            0 => f64::NAN,
            events => sum / events as f64,
        }
    }

    fn missed_pct(&self, cause: MissCause) -> f64 {
        self.per_event(100.0 * self.totals.missed.by_cause(cause) as f64)
    }

    /// Returns `sum` per reported event; NaN without reported events.
    fn per_reported_event(&self, sum: f64) -> f64 {
        let EventTotals {
            events, misdetected, ..
        } = self.totals.events;
        if events == misdetected {
            f64::NAN
        } else {
            sum / (events - misdetected) as f64
        }
    }

    fn per_device_tti(&self, sum: Energy) -> f64 {
        sum.units() / self.device_ttis()
    }

    fn pct_of_device_ttis(&self, ttis: u64) -> f64 {
        100.0 * ttis as f64 / self.device_ttis()
    }

    fn per_tti(&self, sum: u64) -> f64 {
        sum as f64 / self.totals.ttis as f64
    }

    /// Returns Jain's index of the energy spent: 1 if all devices spend the same, 1/N if one spends all.
    fn jain(&self) -> f64 {
        let sum = self.totals.energy.spent.total().micro() as f64;
        sum * sum / (self.totals.devices as f64 * self.totals.spread.spent_squares as f64)
    }
}

/// Declares the metrics, group by group. An entry is `name: unit, axis = |measured| formula;` with its meaning in the
/// doc comment. `difference` after the axis sets [`Metric::is_difference`].
macro_rules! metrics {
    ($($group:ident {
        $($(#[doc = $meaning:literal])+
        $name:ident: $unit:literal, $axis:literal $(, $difference:ident)? = |$measured:ident| $formula:expr;)+
    })+) => {
        /// The metrics of a run. A metric is NaN if its divisor is 0, for example the number of events.
        #[derive(Clone, Copy, Debug, Default, Serialize)]
        pub struct Metrics {
            $($($(#[doc = $meaning])+
            pub $name: f64,)+)+
            /// Number of counted events.
            pub events: u64,
        }

        impl Metrics {
            /// Number of metrics that are fractional numbers: all except `events`.
            pub const COUNT: usize = [$($(stringify!($name)),+),+].len();

            /// All metrics in the order of tables, `events` last.
            pub const ALL: [Metric; Self::COUNT + 1] = [
                $($(Metric {
                    name: stringify!($name),
                    group: MetricGroup::$group,
                    unit: $unit,
                    axis: $axis,
                    meaning: concat!($($meaning),+).trim_ascii(),
                    is_difference: {
                        const FLAGS: &[&str] = &[$(stringify!($difference))?];
                        !FLAGS.is_empty()
                    },
                },)+)+
                Metric {
                    name: "events",
                    group: MetricGroup::Events,
                    unit: "events",
                    axis: "events",
                    meaning: "Events counted.",
                    is_difference: false,
                },
            ];

            /// Returns the values, in the order of [`Metrics::NAMES`].
            pub const fn values(&self) -> [f64; Self::COUNT] {
                [$($(self.$name),+),+]
            }

            /// Computes the metrics of `totals` for events that start with probability `alpha` in a TTI.
            pub fn from_totals(alpha: f64, totals: &Totals) -> Self {
                let run = MetricInputs { alpha, totals };
                Self {
                    $($($name: (|$measured: &MetricInputs<'_>| $formula)(&run),)+)+
                    events: totals.events.events,
                }
            }
        }
    };
}

metrics! {
    Events {
        /// Σ I_i / (α · measured TTIs), the objective of P1, Eq. (`P1_I`), with α the mean start probability over these
        /// TTIs. The headline metric, since an event detected late leaves less time for others.
        info_p1: "information/(α·TTI)", "information per α and TTI (P1)" =
            |run| run.information() / (run.alpha * run.totals.ttis as f64);
        /// Σ I_i / number of events. It ignores delay, so always read it together with the next two metrics.
        info_per_event: "information/event", "information per event" = |run| run.per_event(run.information());
        /// Detection delay: TTIs from an event's start to its first report (0: in the same TTI), mean over the reported
        /// events.
        detection_delay_ttis: "TTIs", "mean detection delay, TTIs" =
            |run| run.per_reported_event(run.totals.events.delay_ttis as f64);
        /// 95th percentile of the detection delay.
        detection_delay_p95_ttis: "TTIs", "detection delay, TTIs, 95th percentile" =
            |run| {
                let EventTotals { events, misdetected, .. } = run.totals.events;
                if events == misdetected { f64::NAN } else { run.totals.delay_p95_ttis as f64 }
            };
        /// Events without a report at the BS, % of events.
        misdetection_pct: "% of events", "missed events, % of events" =
            |run| run.per_event(100.0 * run.totals.events.misdetected as f64);
        /// Events missed because no device is within d_max, % of events.
        missed_out_of_reach_pct: "% of events", "% of events out of reach" =
            |run| run.missed_pct(MissCause::OutOfReach);
        /// Events missed because all devices within d_max had been removed or had failed, % of events.
        missed_removed_pct: "% of events", "% of events near removed devices" =
            |run| run.missed_pct(MissCause::Removed);
        /// Events missed because the probabilistic detection failed for every device within d_max, % of events.
        missed_undetected_pct: "% of events", "% of events not detected" =
            |run| run.missed_pct(MissCause::Undetected);
        /// Events missed because all devices that would have detected them slept by plan, % of events.
        missed_asleep_pct: "% of events", "% of events missed asleep" =
            |run| run.missed_pct(MissCause::Asleep);
        /// Events missed because an operator had failed the devices with δ = 1 that would have detected them, % of
        /// events.
        missed_failed_pct: "% of events", "% of events missed by failed devices" =
            |run| run.missed_pct(MissCause::Failed);
        /// Events missed because no device with δ = 1 could pay for sensing, % of events.
        missed_unpowered_pct: "% of events", "% of events missed without power" =
            |run| run.missed_pct(MissCause::Unpowered);
        /// Events missed because no woken device received its wake-up, % of events. Only an oracle wakes devices before
        /// the first report.
        missed_wake_missed_pct: "% of events", "% of events with missed wake-ups" =
            |run| run.missed_pct(MissCause::WakeMissed);
        /// Events missed because no device that detected them could pay for a report, % of events.
        missed_no_energy_pct: "% of events", "% of events without energy for a report" =
            |run| run.missed_pct(MissCause::NoEnergy);
        /// Events missed because all reports were lost on the radio, % of events.
        missed_lost_pct: "% of events", "% of events with lost reports" = |run| run.missed_pct(MissCause::Lost);
        /// Reports at the BS per event.
        reports_per_event: "reports/event", "reports per event" =
            |run| run.per_event(run.totals.events.reports as f64);
        /// Wake-ups sent per event.
        wake_ups_per_event: "wake-ups/event", "wake-ups per event" =
            |run| run.per_event(run.totals.events.wake_ups as f64);
        /// Devices per event that entered S2 but could not transmit, or were woken farther than d_max from the
        /// epicentre.
        wrong_activations_per_event: "devices/event", "wrong activations per event" =
            |run| run.per_event(run.totals.events.wrong_activations as f64);
        /// Energy spent by wrong activations, per event.
        wasted_energy_per_event: "units/event", "wasted energy, units per event" =
            |run| run.per_event(run.totals.events.wasted_energy.units());
    }
    Energy {
        /// Energy spent, mean over devices and TTIs; the sum of the next three metrics.
        energy_per_device_tti: "units", "energy, units per device and TTI" =
            |run| run.per_device_tti(run.totals.energy.spent.total());
        /// Energy spent in S1, Eq. (4), including energy drained by failed attempts.
        energy_sensing_per_device_tti: "units", "energy in S1, units per device and TTI" =
            |run| run.per_device_tti(run.totals.energy.spent.sensing);
        /// Energy spent in S4, Eq. (4), including energy drained by failed attempts and false wake-ups.
        energy_sleep_per_device_tti: "units", "energy in S4, units per device and TTI" =
            |run| run.per_device_tti(run.totals.energy.spent.sleep);
        /// Energy spent from S2 to S3, Eq. (4), including energy drained by failed attempts.
        energy_report_per_device_tti: "units", "energy in S2 and S3, units per device and TTI" =
            |run| run.per_device_tti(run.totals.energy.spent.report);
        /// Σ I_i / energy spent by all devices; undefined if they spent none.
        info_per_energy: "information/unit", "information per unit of energy" = |run| {
            let spent = run.totals.energy.spent.total().units();
            if spent > 0.0 { run.information() / spent } else { f64::NAN }
        };
        /// Jain's index of the energy spent per device: 1 if all devices spend the same, 1/N if one device spends all.
        fairness_energy: "0 to 1", "Jain's index of the energy spent" = |run| run.jain();
        /// Energy harvested, including overflow, mean over devices and TTIs.
        harvested_per_device_tti: "units", "harvest, units per device and TTI" =
            |run| run.per_device_tti(run.totals.energy.harvested);
        /// Energy harvested minus energy spent, mean over devices and TTIs.
        net_per_device_tti: "units", "net energy, units per device and TTI", difference =
            |run| {
                let spent = run.totals.energy.spent.total().units();
                (run.totals.energy.harvested.units() - spent) / run.device_ttis()
            };
        /// Harvested energy that did not fit in the battery, mean over devices and TTIs.
        overflow_per_device_tti: "units", "overflow, units per device and TTI" =
            |run| run.per_device_tti(run.totals.energy.overflow);
    }
    Batteries {
        /// Battery level at the end of a TTI, mean over devices and TTIs.
        mean_battery: "units", "mean battery level, units" =
            |run| run.totals.energy.battery_sum as f64 / MICRO_PER_UNIT as f64 / run.device_ttis();
        /// Device-TTIs that ended with B < E_Tx, %.
        low_energy_pct: "% of device-TTIs", "% of device-TTIs with B < E_Tx" =
            |run| run.pct_of_device_ttis(run.totals.energy.low_ttis);
        /// TTIs that the worst device ended with B < E_Tx, % of TTIs.
        worst_low_energy_pct: "% of TTIs", "% of TTIs with B < E_Tx, worst device" =
            |run| 100.0 * run.per_tti(run.totals.spread.worst_low_ttis);
        /// Actions δ = 1 that the battery could not pay, % of all δ = 1.
        failed_actions_pct: "% of δ = 1", "% of δ = 1 that failed" = |run| {
            let DeviceTotals { failed_ttis, sensing_ttis, .. } = run.totals.energy;
            100.0 * failed_ttis as f64 / sensing_ttis as f64
        };
        /// Device-TTIs with δ = 0 in which the battery could not pay for the wake-up radio, % of all device-TTIs.
        unpowered_pct: "% of device-TTIs", "% of device-TTIs with an unpowered wake-up radio" =
            |run| run.pct_of_device_ttis(run.totals.energy.unpowered_ttis);
        /// Device-TTIs in which the battery could not pay the cost that δ required, %: sensing for δ = 1, the wake-up
        /// radio for δ = 0.
        no_power_pct: "% of device-TTIs", "% of device-TTIs without power" = |run| {
            let DeviceTotals { failed_ttis, unpowered_ttis, .. } = run.totals.energy;
            run.pct_of_device_ttis(failed_ttis + unpowered_ttis)
        };
    }
    Radio {
        /// Bytes on the control channel (δ plans, synchronisation, wake-ups; BS to devices) per TTI.
        ctl_bytes_per_tti: "bytes/TTI", "bytes of control messages per TTI" =
            |run| run.per_tti(run.totals.control.bytes);
        /// Messages on the control channel per TTI.
        ctl_msgs_per_tti: "messages/TTI", "control messages per TTI" = |run| run.per_tti(run.totals.control.messages);
        /// Encoded bytes of received reports (devices to BS) per TTI.
        uplink_bytes_per_tti: "bytes/TTI", "bytes of reports per TTI" = |run| run.per_tti(run.totals.uplink.bytes);
        /// Reports lost between device and BS, % of reports sent.
        lost_reports_pct: "% of reports", "% of reports that were lost" = |run| {
            let lost = run.totals.losses.lost_reports as f64;
            100.0 * lost / (lost + run.totals.uplink.messages as f64)
        };
        /// Wake-ups that the device did not receive, % of wake-ups sent. The wake-up radio missed the signal or was
        /// unpowered, or the device was not asleep.
        missed_wake_ups_pct: "% of wake-ups", "% of wake-ups not received" = |run| {
            let RadioLosses { sent_wake_ups, missed_wake_ups, .. } = run.totals.losses;
            100.0 * missed_wake_ups as f64 / sent_wake_ups as f64
        };
        /// Wake-ups after which the device woke too late for the event because of `radio.wake_latency`, % of wake-ups
        /// sent.
        late_wake_ups_pct: "% of wake-ups", "% of wake-ups that were too late" = |run| {
            let RadioLosses { sent_wake_ups, late_wake_ups, .. } = run.totals.losses;
            100.0 * late_wake_ups as f64 / sent_wake_ups as f64
        };
        /// TTIs from an event's first report to its last, mean over reported events. The cause is the wake-up latency
        /// of devices woken in order.
        wake_up_span_ttis: "TTIs", "TTIs from the first report to the last" = |run| {
            let EventTotals { events, misdetected, .. } = run.totals.events;
            run.totals.wake_up_span_ttis as f64 / (events - misdetected) as f64
        };
        /// Plans that a device missed, % of plans sent, counted once per device.
        missed_plans_pct: "% of plans", "% of plans that devices missed" = |run| {
            let RadioLosses { sent_plans, missed_plans, .. } = run.totals.losses;
            100.0 * missed_plans as f64 / sent_plans as f64
        };
        /// Device-TTIs with δ = 0 and a false or late wake-up, % of device-TTIs with δ = 0.
        false_wake_ups_pct: "% of δ = 0", "% of δ = 0 with a false or late wake-up" = |run| {
            let DeviceTotals { false_wake_ups, sensing_ttis, .. } = run.totals.energy;
            100.0 * false_wake_ups as f64 / (run.device_ttis() - sensing_ttis as f64)
        };
        /// Device-TTIs of removed devices, whose process was lost under `--on-loss continue`, %. Energy and battery
        /// means cover all N devices: removed devices spend nothing.
        removed_pct: "% of device-TTIs", "% of device-TTIs of removed devices" =
            |run| run.pct_of_device_ttis(run.totals.removed_ttis);
    }
}

/// Compares bits, so that an undefined metric (NaN) equals itself.
impl PartialEq for Metrics {
    fn eq(&self, other: &Self) -> bool {
        let bits = |metrics: &Self| metrics.values().map(f64::to_bits);
        bits(self) == bits(other) && self.events == other.events
    }
}

impl Metrics {
    /// The names of the metrics that are fractional numbers, in the order of tables; `events` comes after them.
    pub const NAMES: [&str; Self::COUNT] = {
        let mut names = [""; Self::COUNT];
        let mut index = 0;
        while index < Self::COUNT {
            names[index] = Self::ALL[index].name;
            index += 1;
        }
        names
    };

    /// Names of metrics in version 0.1, each with the name of today. Options and result tables still accept them.
    const FORMER_NAMES: [(&str, &str); 5] = [
        ("dark_pct", "unpowered_pct"),
        ("gone_pct", "removed_pct"),
        ("unheard_wake_ups_pct", "missed_wake_ups_pct"),
        ("refining_ttis", "wake_up_span_ttis"),
        ("false_wakes_pct", "false_wake_ups_pct"),
    ];

    /// The metrics that result tables of earlier versions do not have, and may lack when read: the causes of missed
    /// events before version 3, `info_per_energy` before version 4, `missed_failed_pct` and `no_power_pct` before
    /// version 5.
    pub const ADDED_LATER: [&str; MissCause::COUNT + 2] = [
        "missed_out_of_reach_pct",
        "missed_removed_pct",
        "missed_undetected_pct",
        "missed_asleep_pct",
        "missed_failed_pct",
        "missed_unpowered_pct",
        "missed_wake_missed_pct",
        "missed_no_energy_pct",
        "missed_lost_pct",
        "info_per_energy",
        "no_power_pct",
    ];

    /// Returns today's name of the metric that once had this name; any other name stays as it is.
    pub fn current_name(name: &str) -> &str {
        let renamed = Self::FORMER_NAMES.iter().find(|(former, _)| *former == name);
        renamed.map_or(name, |(_, current)| current)
    }

    /// Returns the description of the metric `name`, which may be a former name.
    pub fn find(name: &str) -> Option<&'static Metric> {
        const ALL: &[Metric] = &Metrics::ALL;
        let name = Self::current_name(name);
        ALL.iter().find(|metric| metric.name == name)
    }

    /// Returns the axis label of the metric `name`; empty if it does not exist.
    pub fn axis_label(name: &str) -> &'static str {
        Self::find(name).map_or("", |metric| metric.axis)
    }

    /// Returns the value of the metric `name`, which may be `events` but not a former name.
    pub fn value(&self, name: &str) -> Option<f64> {
        self.rows().into_iter().find(|row| row.0 == name).map(|row| row.1)
    }

    /// Returns the name, value and unit of every metric, in the order of tables.
    pub fn rows(&self) -> [(&'static str, f64, &'static str); Self::COUNT + 1] {
        let values = self.values();
        std::array::from_fn(|index| {
            let value = values.get(index).copied().unwrap_or(self.events as f64);
            (Self::ALL[index].name, value, Self::ALL[index].unit)
        })
    }
}

/// Returns the metrics as a Markdown table, for the page on results.
pub fn markdown_table() -> String {
    let row = |metric: Metric| {
        let meaning = metric.meaning.replace('`', "");
        let group = metric.group.title();
        format!("| `{}` | {group} | {} | {meaning} |\n", metric.name, metric.unit)
    };
    let rows: String = Metrics::ALL.map(row).concat();
    format!("| metric | about | unit | meaning |\n|---|---|---|---|\n{rows}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io;

    #[test]
    fn the_results_page_contains_the_table_of_metrics() {
        io::assert_table("docs/results.md", "metrics", &markdown_table());
    }

    #[test]
    fn axis_labels_are_distinct_and_fit_a_figure() {
        for (index, metric) in Metrics::ALL.iter().enumerate() {
            let is_taken = Metrics::ALL[..index].iter().any(|other| other.axis == metric.axis);
            assert!(!is_taken, "{}: {}", metric.name, metric.axis);
            assert!(metric.axis.chars().count() <= 50, "{}: {}", metric.name, metric.axis);
        }
    }

    #[test]
    fn rows_contain_the_fields_of_their_names() {
        let metrics = Metrics {
            info_p1: 2.0,
            mean_battery: 3.0,
            wake_ups_per_event: 5.0,
            events: 7,
            ..Metrics::default()
        };
        let fields = serde_json::to_value(metrics).expect("numbers");
        assert_eq!(fields.as_object().expect("fields").len(), metrics.rows().len());
        for (name, value, _) in metrics.rows() {
            assert_eq!(fields[name].as_f64(), Some(value), "{name}");
            assert_eq!(metrics.value(name), Some(value), "{name}");
        }
        assert_eq!((Metrics::find("colour"), metrics.value("colour")), (None, None));
        for (former, current) in Metrics::FORMER_NAMES {
            assert!(
                Metrics::NAMES.contains(&current) && !Metrics::NAMES.contains(&former),
                "{former}"
            );
            assert_eq!(Metrics::find(former).map(|metric| metric.name), Some(current));
        }
    }
}
