//! Robustness to an imperfect radio: information, energy and missed events against the failure rate of one radio
//! function, while all others work. `reveille figures robustness` draws it. This module makes the runs; it reads no
//! tables. The names of [`IMPAIRMENTS`] are fields of `radio` in scenarios, values of `--only` and cells of the CSV.
//! Its columns are a file format. A new field of [`RadioSettings`] is not drawn without an entry there.

use std::fmt::Write as _;

use rayon::prelude::*;
use reveille_bs::scenario::Scenario;
use reveille_common::radio::{InterferenceBursts, RadioSettings};
use reveille_common::score::Metrics;
use reveille_lab::preparation::RunPreparer;
use reveille_lab::run::{Run, RunOptions};
use reveille_lab::stats::Estimate;

use super::chart::{Chart, ChartPoint, Interval, Series};
use super::chart_grid::{ChartGrid, ChartRow};
use super::scale::Scale;
use super::study::{half_width_cell, possible_values, runs_in_words};
use super::style::Style;

/// Name in commands and files.
pub const NAME: &str = "robustness";
/// Metrics of the figures, with their names in titles.
pub const METRICS: [(&str, &str); 3] = [
    ("info_p1", "information"),
    ("energy_per_device_tti", "energy"),
    ("misdetection_pct", "missed events"),
];
/// Mean length of an interference burst, TTIs: the default of `radio.bursts.burst_ttis`.
const BURST_TTIS: f64 = 10.0;

/// A kind of radio failure.
#[derive(Clone, Copy, Debug)]
pub struct Impairment {
    /// Name in commands and in the CSV, equal to its field in `radio`.
    pub name: &'static str,
    /// Description for titles.
    pub title: &'static str,
    /// Axis label of the levels.
    pub x_label: &'static str,
    /// Failure rates or magnitudes; the first is 0, and all others are above it.
    pub levels: &'static [f64],
    /// Radio settings for a level above 0. They are not validated: bursts need 1 TTI of quiet or more.
    radio_settings: fn(f64) -> RadioSettings,
}

const FAILURE_RATES: &[f64] = &[0.0, 0.1, 0.2, 0.3, 0.5];

/// All impairments.
pub static IMPAIRMENTS: [Impairment; 6] = [
    Impairment {
        name: "wake_miss",
        title: "Missed wake-ups",
        x_label: "probability that a wake-up is missed",
        levels: FAILURE_RATES,
        radio_settings: |wake_miss| RadioSettings {
            wake_miss,
            ..RadioSettings::default()
        },
    },
    Impairment {
        name: "false_wake_up",
        title: "False wake-ups",
        x_label: "probability of a false wake-up, per TTI asleep",
        levels: &[0.0, 0.01, 0.02, 0.05, 0.1],
        radio_settings: |false_wake_up| RadioSettings {
            false_wake_up,
            ..RadioSettings::default()
        },
    },
    Impairment {
        name: "uplink_loss",
        title: "Lost reports",
        x_label: "probability that a report is lost",
        levels: FAILURE_RATES,
        radio_settings: |uplink_loss| RadioSettings {
            uplink_loss,
            ..RadioSettings::default()
        },
    },
    Impairment {
        name: "plan_loss",
        title: "Missed plans",
        x_label: "probability that a device misses a plan",
        levels: FAILURE_RATES,
        radio_settings: |plan_loss| RadioSettings {
            plan_loss,
            ..RadioSettings::default()
        },
    },
    Impairment {
        name: "wake_latency",
        title: "Wake-up latency",
        x_label: "TTIs from a wake-up until the device is awake",
        levels: &[0.0, 1.0, 2.0, 3.0, 4.0],
        radio_settings: |ttis| RadioSettings {
            wake_latency: ttis as u64,
            ..RadioSettings::default()
        },
    },
    Impairment {
        name: "interference",
        title: "Bursts of interference",
        x_label: "share of time without any reception",
        levels: FAILURE_RATES,
        radio_settings: |share| RadioSettings {
            bursts: Some(InterferenceBursts {
                burst_ttis: BURST_TTIS,
                quiet_ttis: BURST_TTIS * (1.0 - share) / share,
                loss: 1.0,
            }),
            ..RadioSettings::default()
        },
    },
];

/// Results of the runs of one policy at one level. Level 0 of every impairment has the same runs.
#[derive(Clone, Debug)]
pub struct RobustnessPoint {
    /// Policy name.
    pub policy: String,
    /// Kind of failure.
    pub impairment: &'static Impairment,
    /// Failure level.
    pub level: f64,
    /// Metrics of the runs, in seed order.
    pub run_metrics: Vec<Metrics>,
}

impl RobustnessPoint {
    /// Returns the mean of `metric` over the runs, with its interval; `None` if no run has a value.
    pub fn estimate(&self, metric: &str) -> Option<Estimate> {
        Estimate::from_values(self.run_metrics.iter().filter_map(|run| run.value(metric)))
    }
}

/// Runs `scenarios`, one for each policy, with all levels of each of `impairments`, on all cores. Each cell has `seeds`
/// runs with consecutive seeds from the scenario's own. The scenarios' radio settings are ignored.
///
/// # Panics
/// If `seeds` is 0.
pub fn measure(scenarios: &[Scenario], impairments: &[&'static Impairment], seeds: u64) -> Vec<RobustnessPoint> {
    let preparer = RunPreparer::default();
    let mut cells: Vec<(&Scenario, RadioSettings)> = scenarios
        .iter()
        .map(|scenario| (scenario, RadioSettings::default()))
        .collect();
    for Impairment {
        levels,
        radio_settings: settings_at,
        ..
    } in impairments
    {
        // Level 0 comes first and is the perfect radio, which all impairments share.
        for &level in levels.iter().skip(1) {
            cells.extend(scenarios.iter().map(|scenario| (scenario, settings_at(level))));
        }
    }
    let runs = cells.iter().flat_map(|cell| (0..seeds).map(move |i| (cell, i)));
    let runs: Vec<_> = runs.collect();
    let metrics_of_run = |((scenario, radio), i): &(&(&Scenario, RadioSettings), u64)| {
        // The same seeds for every level, so that levels differ only in the radio.
        let mut scenario = scenario.with_seed(scenario.run.seed.wrapping_add(*i));
        scenario.radio = *radio;
        Run::new(&preparer.prepare(&scenario), RunOptions::default())
            .finish(&mut ())
            .metrics
    };
    let metrics: Vec<Metrics> = runs.par_iter().map(metrics_of_run).collect();
    // The chunks follow the order of `cells` above.
    let mut by_cell = metrics.chunks(seeds as usize);
    let at_level_zero: Vec<&[Metrics]> = by_cell.by_ref().take(scenarios.len()).collect();
    let mut points = Vec::new();
    for &impairment in impairments {
        for &level in impairment.levels {
            for (index, scenario) in scenarios.iter().enumerate() {
                let runs = if level > 0.0 {
                    by_cell.next()
                } else {
                    Some(at_level_zero[index])
                };
                points.push(RobustnessPoint {
                    policy: scenario.policy.name().to_owned(),
                    impairment,
                    level,
                    run_metrics: runs.unwrap_or_default().to_vec(),
                });
            }
        }
    }
    points
}

/// Draws all metrics of [`METRICS`] against the levels of `impairments`, a row each, from `points` of runs that differ
/// from `scenario` in policy, seed and radio only. Misdetections have a square-root axis: the policies differ by more
/// than a factor of ten, and 0 is a frequent value.
pub fn grid(points: &[RobustnessPoint], impairments: &[&Impairment], scenario: &Scenario) -> ChartGrid {
    let row = |impairment: &&Impairment| ChartRow {
        title: impairment.title.to_owned(),
        x_label: impairment.x_label.to_owned(),
        charts: METRICS.map(|metric| chart(points, impairment, metric)).to_vec(),
    };
    let run_counts = points.iter().map(|point| point.run_metrics.len());
    let runs = runs_in_words((run_counts.clone().min().unwrap_or(0), run_counts.max().unwrap_or(0)));
    // An oracle relies on its wake-ups only, and other policies also on scheduled sensing.
    let misses_wake_ups = impairments.iter().any(|impairment| impairment.name == "wake_miss");
    let oracle_limit = if misses_wake_ups && points.iter().any(|point| point.policy == "genie") {
        " genie is an upper bound only if its wake-ups arrive: with missed wake-ups, another policy can be better."
    } else {
        ""
    };
    let mut grid = ChartGrid {
        title: format!("Robustness to an imperfect radio, N = {}", scenario.run.devices),
        columns: METRICS
            .map(|(metric, _)| Metrics::axis_label(metric).to_owned())
            .to_vec(),
        rows: impairments.iter().map(row).collect(),
        caption: format!(
            "Preset {}; {runs} of {} TTIs per point, mean with its 95 % interval as band. Plans are resent every {} \
             TTIs; there is no impairment except the one along x. All rows of a column have the same y axis; that of % \
             of events is a square-root axis.{oracle_limit}",
            scenario.run.preset, scenario.run.ttis, scenario.bs.sync_interval
        ),
    };
    grid.share_y_axes(|column, ends| match METRICS[column].0 {
        "misdetection_pct" => Scale::square_root(ends),
        _ => Scale::linear(ends, true),
    });
    grid
}

/// Draws a metric of [`METRICS`] against the level of `impairment`.
fn chart(points: &[RobustnessPoint], impairment: &Impairment, (metric, metric_name): (&str, &str)) -> Chart {
    let Impairment {
        name, title, levels, ..
    } = *impairment;
    let of_impairment: Vec<&RobustnessPoint> = points.iter().filter(|point| point.impairment.name == name).collect();
    let mut policies: Vec<&str> = Vec::new();
    for point in &of_impairment {
        if !policies.contains(&point.policy.as_str()) {
            policies.push(&point.policy);
        }
    }
    let series: Vec<Series> = policies
        .into_iter()
        .map(|policy| policy_series(&of_impairment, policy, metric))
        .collect();
    let chart_points = || series.iter().flat_map(|line| &line.points);
    let interval_ends = |point: &ChartPoint| {
        let half_width = finite_or_zero(point.y_half_width);
        possible_values(metric, [point.y - half_width, point.y + half_width])
    };
    let largest_level = levels.iter().copied().fold(0.0, f64::max);
    let (low, high) = chart_points()
        .flat_map(interval_ends)
        .fold((0.0_f64, 0.0_f64), |(low, high), y| (low.min(y), high.max(y)));
    Chart {
        title: format!("{title}: {metric_name}"),
        x_label: String::new(),
        y_label: String::new(),
        x: Scale::Linear {
            from: -0.04 * largest_level,
            to: 1.04 * largest_level,
        },
        // Only the ends count: `ChartGrid::share_y_axes` makes the axis that all rows share from them.
        y: Scale::Linear { from: low, to: high },
        marks: Vec::new(),
        spans: Vec::new(),
        notes: Vec::new(),
        has_zero_at_border: false,
        caption: String::new(),
        series,
    }
}

/// Returns the line of `policy` among `points` of one impairment.
fn policy_series(points: &[&RobustnessPoint], policy: &str, metric: &str) -> Series {
    let chart_point = |point: &&RobustnessPoint| {
        let Estimate { mean, half_width, .. } = point.estimate(metric)?;
        Some(ChartPoint {
            x: point.level,
            y: mean,
            y_half_width: half_width,
            x_half_width: f64::NAN,
        })
    };
    Series {
        name: policy.to_owned(),
        style: Style::of_policy(policy),
        is_joined: true,
        has_markers: true,
        interval: Interval::LightBand,
        points: points
            .iter()
            .filter(|point| point.policy == policy)
            .filter_map(chart_point)
            .collect(),
    }
}

const fn finite_or_zero(half_width: f64) -> f64 {
    if half_width.is_finite() { half_width } else { 0.0 }
}

/// Formats all metrics of all `points` as CSV.
pub fn csv(points: &[RobustnessPoint]) -> String {
    let mut out = "impairment,level,policy,metric,mean,half_width_95,runs\n".to_owned();
    for point in points {
        for metric in Metrics::NAMES {
            if let Some(Estimate {
                mean, half_width, runs, ..
            }) = point.estimate(metric)
            {
                let (name, half_width) = (point.impairment.name, half_width_cell(half_width));
                let _ = writeln!(
                    out,
                    "{name},{},{},{metric},{mean},{half_width},{runs}",
                    point.level, point.policy
                );
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    #[test]
    fn each_policy_has_a_point_at_each_level_and_impairments_have_an_effect() {
        let scenario_of = |policy: &str| {
            let set = [
                format!("policy.name={policy}"),
                "devices=12".to_owned(),
                "ttis=400".to_owned(),
                "bs.sync_interval=20".to_owned(),
            ];
            let set = set.map(|field| Override::parse(&field).expect("an override"));
            load("paper", &set).expect("a scenario").scenario
        };
        let scenarios = [scenario_of("random"), scenario_of("genie")];
        let impairments: Vec<&Impairment> = IMPAIRMENTS.iter().collect();
        let points = measure(&scenarios, &impairments, 2);
        let levels: usize = IMPAIRMENTS.iter().map(|impairment| impairment.levels.len()).sum();
        assert_eq!(points.len(), 2 * levels);
        let perfect: Vec<&RobustnessPoint> = points.iter().filter(|point| point.level <= 0.0).collect();
        // Without an impairment, the runs of a policy are the same for all impairments. The first two points are of
        // `random` and the genie.
        for point in &perfect {
            assert_eq!(
                point.run_metrics,
                perfect[usize::from(point.policy == "genie")].run_metrics
            );
        }
        // In the order of `IMPAIRMENTS`: the last level raises its metric, a percentage, by more than 2 points. The
        // limit only tells an effect from none.
        let raised_metrics = [
            "missed_wake_ups_pct",
            "false_wake_ups_pct",
            "lost_reports_pct",
            "missed_plans_pct",
            "late_wake_ups_pct",
            "misdetection_pct",
        ];
        for (impairment, metric) in impairments.into_iter().zip(raised_metrics) {
            let of_genie = points
                .iter()
                .filter(|point| point.impairment.name == impairment.name && point.policy == "genie");
            let values: Vec<f64> = of_genie
                .filter_map(|point| Some(point.estimate(metric)?.mean))
                .collect();
            let levels = impairment.levels.len();
            assert!(
                values.len() == levels && values[levels - 1] > values[0] + 2.0,
                "{metric}: {values:?}"
            );
        }
        let all: Vec<&Impairment> = IMPAIRMENTS.iter().collect();
        let grid = grid(&points, &all, &scenarios[0]);
        assert_eq!((grid.rows.len(), grid.columns.len()), (6, 3));
        for (row, impairment) in grid.rows.iter().zip(&all) {
            for (chart, shared) in row.charts.iter().zip(&grid.rows[0].charts) {
                assert_eq!(chart.series.len(), 2);
                assert!(
                    chart
                        .series
                        .iter()
                        .all(|line| line.points.len() == impairment.levels.len())
                );
                assert_eq!(chart.y, shared.y, "one axis for each column");
                let (low, high) = chart.y.ends();
                let points = chart.series.iter().flat_map(|line| &line.points);
                assert!(
                    points.into_iter().all(|point| low <= point.y && point.y <= high),
                    "{:?}",
                    chart.y
                );
            }
        }
        assert!(grid.caption.contains("2 runs of 400 TTIs"), "{}", grid.caption);
        let names_limit = |grid: &ChartGrid| grid.caption.contains("genie is an upper bound only if");
        let without_genie: Vec<_> = points.iter().filter(|point| point.policy != "genie").cloned().collect();
        assert!(names_limit(&grid) && !names_limit(&super::grid(&without_genie, &all, &scenarios[0])));
        let scene = grid.scene();
        for item in &scene.items {
            let [left, top, right, bottom] = item.bounds();
            assert!(
                left >= 0.0 && top >= 0.0 && right <= scene.width && bottom <= scene.height,
                "{item:?} leaves the page"
            );
        }
        assert_eq!(
            csv(&points).lines().next(),
            Some("impairment,level,policy,metric,mean,half_width_95,runs")
        );
    }
}
