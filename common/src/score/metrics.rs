//! The one definition of every metric, from exact integer totals.

use serde::Serialize;

use crate::scenario::Scenario;
use crate::totals::{PICO_PER_INFORMATION, Totals};
use crate::units::{Energy, MICRO_PER_UNIT};

/// What a metric is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Metric {
    /// Its name: the field of [`Metrics`], the column of tables.
    pub name: &'static str,
    /// Its unit.
    pub unit: &'static str,
    /// Its unit in words, for the axis of a figure.
    pub axis: &'static str,
    /// What it measures.
    pub meaning: &'static str,
    /// Whether its mean may be 0 while its values are not, so that an interval relative to the mean says nothing.
    pub is_difference: bool,
}

/// What the formulas of the metrics are made of.
struct Measured<'t> {
    alpha: f64,
    totals: &'t Totals,
}

impl Measured<'_> {
    fn device_ttis(&self) -> f64 {
        self.totals.devices as f64 * self.totals.ttis as f64
    }

    fn information(&self) -> f64 {
        self.totals.events.information_pico as f64 / PICO_PER_INFORMATION
    }

    fn per_event(&self, sum: f64) -> f64 {
        match self.totals.events.events {
            0 => f64::NAN,
            events => sum / events as f64,
        }
    }

    fn per_device_tti(&self, sum: Energy) -> f64 {
        sum.units() / self.device_ttis()
    }

    fn per_tti(&self, sum: u64) -> f64 {
        sum as f64 / self.totals.ttis as f64
    }
}

/// Declares the metrics. An entry is `name: unit, axis = |measured| formula;`, what it measures in its doc comment.
/// `difference` after the axis sets [`Metric::is_difference`].
macro_rules! metrics {
    ($($(#[doc = $meaning:literal])+
        $name:ident: $unit:literal, $axis:literal $(, $difference:ident)? = |$measured:ident| $formula:expr;)+) => {
        /// The metrics of a run; those per event are NaN where no event was counted.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
        pub struct Metrics {
            $($(#[doc = $meaning])+
            pub $name: f64,)+
            /// Events counted.
            pub events: u64,
        }

        impl Metrics {
            /// Metrics that are numbers with a fraction: all but `events`.
            pub const COUNT: usize = [$(stringify!($name)),+].len();

            /// All metrics in the order of tables, `events` last.
            pub const ALL: [Metric; Self::COUNT + 1] = [
                $(Metric {
                    name: stringify!($name),
                    unit: $unit,
                    axis: $axis,
                    meaning: concat!($($meaning),+).trim_ascii(),
                    is_difference: {
                        const MARK: &[&str] = &[$(stringify!($difference))?];
                        !MARK.is_empty()
                    },
                },)+
                Metric {
                    name: "events",
                    unit: "events",
                    axis: "events",
                    meaning: "Events counted.",
                    is_difference: false,
                },
            ];

            /// The values, in the order of [`Metrics::NAMES`].
            pub const fn values(&self) -> [f64; Self::COUNT] {
                [$(self.$name),+]
            }

            /// The metrics of `totals` where events start with probability `alpha` a TTI.
            pub fn of(alpha: f64, totals: &Totals) -> Self {
                let run = Measured { alpha, totals };
                Self {
                    $($name: (|$measured: &Measured<'_>| $formula)(&run),)+
                    events: totals.events.events,
                }
            }
        }
    };
}

metrics! {
    /// Σ I_i / number of events.
    info_per_event: "information/event", "information per event" = |run| run.per_event(run.information());
    /// Σ I_i / (α · measured TTIs): the objective of P1, Eq. (`P1_I`).
    info_p1: "information/(α·TTI)", "information per α and TTI" =
        |run| run.information() / (run.alpha * run.totals.ttis as f64);
    /// Events without a report at the BS, % of events.
    misdetection_pct: "% of events", "% of events" =
        |run| run.per_event(100.0 * run.totals.events.misdetected as f64);
    /// Energy spent, mean over devices and TTIs.
    energy_per_device_tti: "units", "units per device and TTI" =
        |run| run.per_device_tti(run.totals.energy.spent);
    /// Device-TTIs that ended with B < E_Tx, %.
    low_energy_pct: "% of device-TTIs", "% of devices, B < E_Tx" =
        |run| 100.0 * run.totals.energy.low_ttis as f64 / run.device_ttis();
    /// Battery at the end of a TTI, mean over devices and TTIs.
    mean_battery: "units", "units" =
        |run| run.totals.energy.battery_sum as f64 / MICRO_PER_UNIT as f64 / run.device_ttis();
    /// Devices per event that entered S2 and could not transmit, or were woken farther than d_max from the epicentre.
    wrong_activations_per_event: "devices/event", "devices per event" =
        |run| run.per_event(run.totals.events.wrong_activations as f64);
    /// Energy spent by wrong activations, per event.
    wasted_energy_per_event: "units/event", "units per event" =
        |run| run.per_event(run.totals.events.wasted.units());
    /// Energy harvested, mean over devices and TTIs, overflow included.
    harvested_per_device_tti: "units", "units per device and TTI" =
        |run| run.per_device_tti(run.totals.energy.harvested);
    /// Energy harvested less energy spent, mean over devices and TTIs.
    net_per_device_tti: "units", "units per device and TTI", difference =
        |run| (run.totals.energy.harvested.units() - run.totals.energy.spent.units()) / run.device_ttis();
    /// Energy harvested that did not fit in the battery, mean over devices and TTIs.
    overflow_per_device_tti: "units", "units per device and TTI" =
        |run| run.per_device_tti(run.totals.energy.overflow);
    /// Bytes on the control channel (δ plans, synchronisation, wake-ups; BS to devices) per TTI.
    ctl_bytes_per_tti: "bytes/TTI", "bytes per TTI" = |run| run.per_tti(run.totals.control.bytes);
    /// Messages on the control channel per TTI.
    ctl_msgs_per_tti: "messages/TTI", "messages per TTI" = |run| run.per_tti(run.totals.control.messages);
    /// Wake-ups sent per event.
    wake_ups_per_event: "wake-ups/event", "wake-ups per event" =
        |run| run.per_event(run.totals.events.wake_ups as f64);
}

impl Metrics {
    /// The names of the metrics that are numbers with a fraction, in the order of tables; `events` comes after them.
    pub const NAMES: [&str; Self::COUNT] = {
        let mut names = [""; Self::COUNT];
        let mut at = 0;
        while at < Self::COUNT {
            names[at] = Self::ALL[at].name;
            at += 1;
        }
        names
    };

    /// The metrics of a run of `scenario` that came to `totals`.
    pub fn new(scenario: &Scenario, totals: &Totals) -> Self {
        Self::of(scenario.events.alpha, totals)
    }

    /// What the metric called `name` is.
    pub fn named(name: &str) -> Option<&'static Metric> {
        const ALL: &[Metric] = &Metrics::ALL;
        ALL.iter().find(|metric| metric.name == name)
    }

    /// The label of an axis with the metric called `name`; empty if there is none.
    pub fn axis(name: &str) -> &'static str {
        Self::named(name).map_or("", |metric| metric.axis)
    }

    /// The value of the metric called `name`, `events` included.
    pub fn value(&self, name: &str) -> Option<f64> {
        self.rows().into_iter().find(|row| row.0 == name).map(|row| row.1)
    }

    /// Every metric with its name and unit, in the order of tables.
    pub fn rows(&self) -> [(&'static str, f64, &'static str); Self::COUNT + 1] {
        let values = self.values();
        std::array::from_fn(|at| {
            let value = values.get(at).copied().unwrap_or(self.events as f64);
            (Self::ALL[at].name, value, Self::ALL[at].unit)
        })
    }
}

/// The metrics as a table in Markdown, for the page on results.
pub fn markdown() -> String {
    let row = |metric: Metric| {
        let meaning = metric.meaning.replace('`', "");
        format!("| `{}` | {} | {meaning} |\n", metric.name, metric.unit)
    };
    let rows: String = Metrics::ALL.map(row).concat();
    format!("| metric | unit | meaning |\n|---|---|---|\n{rows}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pages;

    #[test]
    fn the_page_on_results_has_the_table_of_metrics() {
        pages::assert_table("docs/results.md", "metrics", &markdown());
    }

    #[test]
    fn names_follow_the_fields_and_events_come_last() {
        let metrics = Metrics {
            info_p1: 2.0,
            wake_ups_per_event: 5.0,
            events: 7,
            ..Metrics::default()
        };
        let rows = metrics.rows();
        assert_eq!(rows.map(|row| row.0)[..Metrics::COUNT], Metrics::NAMES);
        assert_eq!(rows[1], ("info_p1", 2.0, "information/(α·TTI)"));
        let wake_ups = rows.iter().find(|row| row.0 == "wake_ups_per_event").expect("a metric");
        assert_eq!(*wake_ups, ("wake_ups_per_event", 5.0, "wake-ups/event"));
        assert_eq!(rows[Metrics::COUNT], ("events", 7.0, "events"));
        let differences = Metrics::ALL.iter().filter(|metric| metric.is_difference);
        assert_eq!(
            differences.map(|metric| metric.name).collect::<Vec<_>>(),
            ["net_per_device_tti"]
        );
        assert_eq!(Metrics::named("mean_battery").expect("a metric").unit, "units");
        assert_eq!((Metrics::named("colour"), metrics.value("colour")), (None, None));
        assert_eq!(metrics.value("info_p1"), Some(2.0));
    }
}
