//! What an imperfect radio costs: information, energy and missed events of policies against how often one thing fails,
//! while all others work.

use std::fmt::Write as _;

use rayon::prelude::*;
use reveille_common::radio::{Bursts, Radio};
use reveille_common::scenario::Scenario;
use reveille_common::score::Metrics;
use reveille_lab::preparation::Workshop;
use reveille_lab::run::{Options, Run};
use reveille_lab::stats::Estimate;

use super::chart::{Chart, Interval, Sample, Series};
use super::scale::Scale;
use super::study::{csv_half, runs_in_words};
use super::style::Style;

/// Its name in commands and files.
pub const NAME: &str = "robustness";
/// What is drawn, and how titles call it.
pub const METRICS: [(&str, &str); 3] = [
    ("info_p1", "information"),
    ("energy_per_device_tti", "energy"),
    ("misdetection_pct", "missed events"),
];
/// The mean length of a burst of interference, TTIs.
const BURST: f64 = 10.0;

/// Something that fails.
#[derive(Clone, Copy, Debug)]
pub struct Impairment {
    /// Its name in files: that of its field in `radio`.
    pub name: &'static str,
    /// What it is, for a title.
    pub title: &'static str,
    /// What its levels are, for an axis.
    pub axis: &'static str,
    /// How often it fails, or by how much; never comes first.
    pub levels: &'static [f64],
    /// The radio in which it does, at a level above 0.
    radio: fn(f64) -> Radio,
}

const LEVELS: &[f64] = &[0.0, 0.1, 0.2, 0.3, 0.5];

/// All of them.
pub static IMPAIRMENTS: [Impairment; 6] = [
    Impairment {
        name: "wake_miss",
        title: "Wake-ups that are missed",
        axis: "probability that a wake-up is missed",
        levels: LEVELS,
        radio: |wake_miss| Radio {
            wake_miss,
            ..Radio::default()
        },
    },
    Impairment {
        name: "false_wake",
        title: "Wake-ups for nothing",
        axis: "probability of a wake-up for nothing, per TTI asleep",
        levels: &[0.0, 0.01, 0.02, 0.05, 0.1],
        radio: |false_wake| Radio {
            false_wake,
            ..Radio::default()
        },
    },
    Impairment {
        name: "uplink_loss",
        title: "Reports that are lost",
        axis: "probability that a report is lost",
        levels: LEVELS,
        radio: |uplink_loss| Radio {
            uplink_loss,
            ..Radio::default()
        },
    },
    Impairment {
        name: "plan_loss",
        title: "Plans that are missed",
        axis: "probability that a device misses a plan",
        levels: LEVELS,
        radio: |plan_loss| Radio {
            plan_loss,
            ..Radio::default()
        },
    },
    Impairment {
        name: "wake_latency",
        title: "Devices that take time to wake",
        axis: "TTIs from a wake-up until the device is awake",
        levels: &[0.0, 1.0, 2.0, 3.0, 4.0],
        radio: |ttis| Radio {
            wake_latency: ttis as u64,
            ..Radio::default()
        },
    },
    Impairment {
        name: "interference",
        title: "Bursts of interference",
        axis: "share of the time in which nothing gets through",
        levels: LEVELS,
        radio: |share| Radio {
            bursts: Some(Bursts {
                burst_ttis: BURST,
                quiet_ttis: BURST * (1.0 - share) / share,
                loss: 1.0,
            }),
            ..Radio::default()
        },
    },
];

/// What runs of one policy at one level came to.
#[derive(Clone, Debug)]
pub struct Point {
    /// The policy.
    pub policy: String,
    /// What fails.
    pub impairment: &'static Impairment,
    /// How often it fails.
    pub level: f64,
    /// The metrics of its runs, in the order of seeds.
    pub runs: Vec<Metrics>,
}

impl Point {
    /// The mean of `metric` over its runs, with its interval; `None` where no run has a value.
    pub fn reading(&self, metric: &str) -> Option<Estimate> {
        Estimate::of(self.runs.iter().filter_map(|run| run.value(metric)))
    }
}

/// What `scenarios`, one for each policy, come to with each of `impairments` at all levels, in runs with `seeds` seeds
/// from their own on, on all cores. What they say of the radio is left out.
pub fn measure(scenarios: &[Scenario], impairments: &[&'static Impairment], seeds: u64) -> Vec<Point> {
    let workshop = Workshop::default();
    let mut cells: Vec<(&Scenario, Radio)> = scenarios.iter().map(|scenario| (scenario, Radio::default())).collect();
    for Impairment { levels, radio, .. } in impairments {
        for &level in levels.iter().skip(1) {
            cells.extend(scenarios.iter().map(|scenario| (scenario, radio(level))));
        }
    }
    let runs = cells.iter().flat_map(|cell| (0..seeds).map(move |i| (cell, i)));
    let runs: Vec<_> = runs.collect();
    let play = |((scenario, radio), i): &(&(&Scenario, Radio), u64)| {
        let scenario = Scenario {
            seed: scenario.seed.wrapping_add(*i),
            radio: *radio,
            ..(*scenario).clone()
        };
        Run::new(&workshop.prepare(&scenario), Options::default())
            .finish(&mut ())
            .metrics
    };
    let metrics: Vec<Metrics> = runs.par_iter().map(play).collect();
    let mut by_cell = metrics.chunks(seeds as usize);
    let perfect: Vec<&[Metrics]> = by_cell.by_ref().take(scenarios.len()).collect();
    let mut points = Vec::new();
    for &impairment in impairments {
        for &level in impairment.levels {
            for (at, scenario) in scenarios.iter().enumerate() {
                let runs = if level > 0.0 { by_cell.next() } else { Some(perfect[at]) };
                points.push(Point {
                    policy: scenario.policy.name().to_owned(),
                    impairment,
                    level,
                    runs: runs.unwrap_or_default().to_vec(),
                });
            }
        }
    }
    points
}

/// The chart of a metric of [`METRICS`] against how often something fails, from `points` of runs of `scenario`.
pub fn chart(points: &[Point], impairment: &Impairment, (metric, word): (&str, &str), scenario: &Scenario) -> Chart {
    let Impairment {
        name,
        title,
        axis,
        levels,
        ..
    } = *impairment;
    let own: Vec<&Point> = points.iter().filter(|point| point.impairment.name == name).collect();
    let mut policies: Vec<&str> = Vec::new();
    for point in &own {
        if !policies.contains(&point.policy.as_str()) {
            policies.push(&point.policy);
        }
    }
    let series: Vec<Series> = policies
        .into_iter()
        .map(|policy| series(&own, policy, metric))
        .collect();
    let samples = || series.iter().flat_map(|line| &line.samples);
    let reach = |s: &Sample| [(s.y - finite(s.half)).max(0.0), s.y + finite(s.half)];
    let most = levels.iter().copied().fold(0.0, f64::max);
    let seeds = own.iter().map(|point| point.runs.len());
    let caption = format!(
        "Preset {}, N = {}; {} of {} TTIs a point, mean with its 95 % interval as band and bar. Plans are sent \
         again every {} TTIs; all that is not along x works.",
        scenario.preset,
        scenario.devices,
        runs_in_words((seeds.clone().min().unwrap_or(0), seeds.max().unwrap_or(0))),
        scenario.ttis,
        scenario.bs.sync_interval
    );
    Chart {
        title: format!("{title}: {word}"),
        x_label: axis.to_owned(),
        y_label: Metrics::axis(metric).to_owned(),
        x: Scale::Linear {
            from: -0.04 * most,
            to: 1.04 * most,
        },
        y: Scale::linear(samples().flat_map(reach), true),
        marks: Vec::new(),
        spans: Vec::new(),
        notes: Vec::new(),
        zero_below: false,
        caption,
        series,
    }
}

fn series(points: &[&Point], policy: &str, metric: &str) -> Series {
    let sample = |point: &&Point| {
        let Estimate { mean, half_width, .. } = point.reading(metric)?;
        Some(Sample {
            x: point.level,
            y: mean,
            half: half_width,
            across: f64::NAN,
        })
    };
    Series {
        name: policy.to_owned(),
        style: Style::of_policy(policy),
        joined: true,
        marked: true,
        interval: Interval::Bars,
        samples: points
            .iter()
            .filter(|point| point.policy == policy)
            .filter_map(sample)
            .collect(),
    }
}

const fn finite(half: f64) -> f64 {
    if half.is_finite() { half } else { 0.0 }
}

/// All metrics of all `points` as CSV.
pub fn csv(points: &[Point]) -> String {
    let mut out = "impairment,level,policy,metric,mean,half_width_95,runs\n".to_owned();
    for point in points {
        for metric in Metrics::NAMES {
            if let Some(Estimate {
                mean, half_width, runs, ..
            }) = point.reading(metric)
            {
                let (name, half) = (point.impairment.name, csv_half(half_width));
                let _ = writeln!(
                    out,
                    "{name},{},{},{metric},{mean},{half},{runs}",
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
    fn every_policy_has_a_point_at_every_level_of_everything() {
        let of = |policy: &str| {
            let set = [
                format!("policy.name={policy}"),
                "devices=12".to_owned(),
                "ttis=400".to_owned(),
                "bs.sync_interval=20".to_owned(),
            ];
            let set = set.map(|field| Override::parse(&field).expect("an override"));
            load("paper", &set).expect("a scenario")
        };
        let scenarios = [of("random"), of("genie")];
        let all: Vec<&Impairment> = IMPAIRMENTS.iter().collect();
        let points = measure(&scenarios, &all, 2);
        let levels: usize = IMPAIRMENTS.iter().map(|impairment| impairment.levels.len()).sum();
        assert_eq!(points.len(), 2 * levels);
        let perfect: Vec<&Point> = points.iter().filter(|point| point.level <= 0.0).collect();
        for point in &perfect {
            assert_eq!(point.runs, perfect[usize::from(point.policy == "genie")].runs);
        }
        // The most of each, against none: what it is known by.
        let shown = [
            "unheard_wake_ups_pct",
            "false_wakes_pct",
            "lost_reports_pct",
            "missed_plans_pct",
            "late_wake_ups_pct",
            "misdetection_pct",
        ];
        for (impairment, metric) in all.into_iter().zip(shown) {
            let own = points
                .iter()
                .filter(|point| point.impairment.name == impairment.name && point.policy == "genie");
            let values: Vec<f64> = own.filter_map(|point| Some(point.reading(metric)?.mean)).collect();
            let levels = impairment.levels.len();
            assert!(
                values.len() == levels && values[levels - 1] > values[0] + 2.0,
                "{metric}: {values:?}"
            );
            for drawn in METRICS {
                let chart = chart(&points, impairment, drawn, &scenarios[0]);
                assert_eq!(chart.series.len(), 2);
                assert!(chart.series.iter().all(|line| line.samples.len() == levels));
                assert!(
                    chart.scene().height > 100.0 && chart.caption.contains("2 runs of 400 TTIs"),
                    "{}",
                    chart.caption
                );
            }
        }
        assert_eq!(
            csv(&points).lines().next(),
            Some("impairment,level,policy,metric,mean,half_width_95,runs")
        );
    }
}
