//! The paper's Figs. 13 and 14: harvest and net energy against λ for E_B of 1, 5 and 10 units.
//!
//! As in the paper, consumption stays fixed while λ varies; it is read from the tables, as in Fig. 8. Lines are the
//! closed form λτ·exp(-λτ)·E_B of Eq. (5). Points are harvests of simulated devices, in Fig. 14 less consumption.
//! [`NAMES`] are values of `--only` and parts of file names, listed in docs/figures-and-report.md. The columns of both
//! CSV files are a file format. `reveille report` recognises the titles by their first words, `Harvest` and `Net`.

use std::fmt::Write as _;

use reveille_bs::policy::registry;
use reveille_bs::scenario::{Loaded, load_with_files};
use reveille_common::declare::NoFiles;
use reveille_common::digits::{decimals_for, format_significant};
use reveille_common::units::Energy;

use super::chart::{Chart, ChartPoint, Interval, Series, StatedMark, StatedValue};
use super::results::RunCondition;
use super::scale::Scale;
use super::study::{figure_title, half_width_cell};
use super::style::Style;
use crate::analysis::AnalysisError;
use crate::analysis::harvest::{self, HarvestPoint, HarvestStudy, LambdaReading, STATED_THRESHOLDS, measure};
use reveille_lab::stats::Estimate;

/// Names of the two figures.
pub const NAMES: [&str; 2] = ["harvest", "net"];
/// E_B of the figures, units. Each E_B in [`STATED_THRESHOLDS`] must be one of them.
const E_B_UNITS: [f64; 3] = [1.0, 5.0, 10.0];
/// λ at which harvests are measured.
const LAMBDAS: [f64; 9] = [0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0];
/// Ends of the λ axis. Eq. (5) is largest at λτ = 1.
const LAMBDA_RANGE: (f64, f64) = (0.01, 1.0);
/// Number of points of a closed form's line.
const CURVE_STEPS: u32 = 80;
/// N of Fig. 14.
const NET_N: u32 = 100;
/// Policies of Fig. 14: the ones with the highest and lowest consumption in the paper.
const NET_POLICIES: [&str; 2] = ["adjusted", "random"];
/// Range of the y axis of Fig. 14, units per device and TTI; lines end where they leave it.
const NET_RANGE: (f64, f64) = (-0.4, 1.0);
/// Devices, TTIs and runs of the measured harvests; the captions state them.
const MEASUREMENT_SIZE: (u32, u64, u64) = (20, 2000, 8);

/// Measures harvests of simulated devices for the λ and E_B of the figures, with all other settings as in `preset`.
/// Empty if no preset of this name loads without files.
///
/// # Errors
/// The measurement fails, which does not happen for a preset.
pub fn measure_harvests(preset: &str) -> Result<Vec<HarvestPoint>, AnalysisError> {
    let (devices, ttis, seeds) = MEASUREMENT_SIZE;
    let Ok(Loaded { mut scenario, .. }) = load_with_files(preset, &[], &NoFiles) else {
        return Ok(Vec::new());
    };
    scenario.run.devices = devices;
    scenario.run.ttis = ttis;
    measure(&HarvestStudy {
        scenario,
        readings: vec![LambdaReading::Eq5],
        lambdas: LAMBDAS.to_vec(),
        e_b: E_B_UNITS.into_iter().filter_map(Energy::from_units).collect(),
        seeds,
    })
}

/// Returns the policies with the least and the most consumption in `condition` with `n` devices, units per device and
/// TTI, in this order. Upper bounds such as the genie do not count, since they cannot be built. `None` with fewer than
/// two policies.
pub fn extreme_consumptions(condition: &RunCondition, n: u32) -> Option<[(String, Estimate); 2]> {
    let policies = condition
        .policies()
        .into_iter()
        .filter(|policy| registry::named(policy).is_none_or(|policy| !policy.is_bound));
    let spent = policies.filter_map(|policy| {
        let estimate = condition.estimate(policy, n, "energy_per_device_tti")?;
        Some((policy.to_owned(), estimate))
    });
    let mut spent: Vec<(String, Estimate)> = spent.collect();
    spent.sort_by(|a, b| a.1.mean.total_cmp(&b.1.mean));
    match &spent[..] {
        [least, .., most] => Some([least.clone(), most.clone()]),
        [] | [_] => None,
    }
}

fn curve_lambdas() -> impl Iterator<Item = f64> {
    let (from, to) = LAMBDA_RANGE;
    (0..=CURVE_STEPS).map(move |i| from * libm::pow(to / from, f64::from(i) / f64::from(CURVE_STEPS)))
}

/// Computes the mean harvest by Eq. (5), units per TTI, for τ = 1 as in the paper's figures.
fn mean_harvest(e_b: f64, lambda: f64) -> f64 {
    e_b * LambdaReading::Eq5.probability(lambda, 1.0)
}

fn lambda_scale() -> Scale {
    Scale::Log {
        from: LAMBDA_RANGE.0,
        to: LAMBDA_RANGE.1,
    }
}

/// Returns the style of each of [`E_B_UNITS`], for its line, points and marks.
fn e_b_styles() -> [Style; E_B_UNITS.len()] {
    [Style::from_palette(0), Style::from_palette(3), Style::from_palette(4)]
}

/// Draws Fig. 13 with `points` of [`measure_harvests`], and consumption bands for N = 10 and 250 if `condition` has
/// them.
pub fn harvest_chart(condition: &RunCondition, points: &[HarvestPoint]) -> Chart {
    let (devices, ttis, seeds) = MEASUREMENT_SIZE;
    let mut series = Vec::new();
    let mut bands = String::new();
    for (n, style) in [(10, Style::from_palette(1)), (250, Style::from_palette(2))] {
        let Some([(least_policy, least), (most_policy, most)]) = extreme_consumptions(condition, n) else {
            continue;
        };
        // A band is a line with a half-width, so it is drawn around its middle.
        let half_width = 0.5 * (most.mean - least.mean);
        let ends = [LAMBDA_RANGE.0, LAMBDA_RANGE.1].map(|x| ChartPoint {
            x,
            y: least.mean + half_width,
            y_half_width: half_width,
            x_half_width: f64::NAN,
        });
        series.push(Series {
            name: format!("spent, N = {n}"),
            style,
            is_joined: true,
            has_markers: false,
            interval: Interval::BandEdges,
            points: ends.to_vec(),
        });
        let [least_text, most_text] = [least, most].map(|spent| format_significant(spent.mean, 3));
        let _ = write!(
            bands,
            " Spent at N = {n}: {least_text} ({least_policy}) to {most_text} ({most_policy})."
        );
    }
    for (e_b, style) in E_B_UNITS.into_iter().zip(e_b_styles()) {
        let line = curve_lambdas().map(|x| ChartPoint {
            x,
            y: mean_harvest(e_b, x),
            y_half_width: f64::NAN,
            x_half_width: f64::NAN,
        });
        series.push(curve_series(format!("E_B = {e_b}"), style, line.collect()));
        let measured = points.iter().filter(|p| (p.e_b - e_b).abs() < 1e-9);
        series.push(measured_series(style, measured.map(harvest_point).collect()));
    }
    // The paper states these for its own settings, which only an unchanged preset matches.
    let stated = STATED_THRESHOLDS
        .iter()
        .filter(|s| s.devices != NET_N && condition.is_unchanged_preset());
    let marks: Vec<StatedMark> = stated.flat_map(stated_marks).collect();
    let marks_caption = if marks.is_empty() {
        ""
    } else {
        "Hollow marks on the lines: the λ above which harvest exceeds consumption according to the paper, N = 10 and \
         250. "
    };
    Chart {
        title: figure_title("Harvest against λ", "Fig. 13 of the paper", condition),
        x_label: "energy arrival rate λ, per TTI".to_owned(),
        y_label: "harvest, units per device and TTI".to_owned(),
        x: lambda_scale(),
        y: Scale::Log { from: 0.01, to: 10.0 },
        caption: format!(
            "Lines: closed form λ·exp(−λ)·E_B, Eq. (5). Points: {seeds} runs with N = {devices} and {ttis} TTIs, made \
             for this figure under preset {} (not from the table), with 95 % intervals; harvest does not depend on N. \
             {marks_caption}Bands, from the table: {}.{bands}",
            condition.preset,
            condition.label()
        ),
        series,
        marks,
        spans: Vec::new(),
        notes: Vec::new(),
        has_zero_at_border: false,
    }
}

/// Draws Fig. 14: harvest less the consumption of `random` and `adjusted` with 100 devices, in closed form and with
/// `points` of [`measure_harvests`]. `None` if `condition` lacks those policies.
pub fn net_chart(condition: &RunCondition, points: &[HarvestPoint]) -> Option<Chart> {
    let (devices, ttis, seeds) = MEASUREMENT_SIZE;
    let consumption_of = |policy| condition.estimate(policy, NET_N, "energy_per_device_tti");
    let mut series = Vec::new();
    let mut consumptions = Vec::new();
    for policy in NET_POLICIES {
        let consumption = consumption_of(policy)?;
        let (spent, half_width) = (consumption.mean, consumption.half_width);
        consumptions.push(if half_width.is_nan() {
            format!("{policy} spends {}", format_significant(spent, 3))
        } else {
            let decimals = decimals_for(half_width, 2);
            format!("{policy} spends {spent:.decimals$} ± {half_width:.decimals$}")
        });
        for (e_b, style) in E_B_UNITS.into_iter().zip(e_b_styles()) {
            let net = curve_lambdas().map(|x| ChartPoint {
                x,
                y: mean_harvest(e_b, x) - spent,
                y_half_width: half_width,
                x_half_width: f64::NAN,
            });
            let style = Style {
                dashes: Style::of_policy(policy).dashes,
                ..style
            };
            let within_range = net.filter(|s| (NET_RANGE.0..=NET_RANGE.1).contains(&s.y));
            series.push(curve_series(
                format!("{policy}, E_B = {e_b}"),
                style,
                within_range.collect(),
            ));
            let measured = points.iter().filter(|p| (p.e_b - e_b).abs() < 1e-9);
            let net = measured.map(|p| net_point(p, &consumption));
            series.push(measured_series(
                style,
                net.filter(|s| (NET_RANGE.0..=NET_RANGE.1).contains(&s.y)).collect(),
            ));
        }
    }
    let stated = STATED_THRESHOLDS
        .iter()
        .filter(|s| s.devices == NET_N && condition.is_unchanged_preset());
    let marks = stated.flat_map(stated_marks).map(|mark| StatedMark {
        stated: StatedValue::Value(0.0),
        ..mark
    });
    let marks: Vec<StatedMark> = marks.collect();
    let marks_caption = if marks.is_empty() {
        ""
    } else {
        " Hollow marks at zero: the λ at which it becomes positive according to the paper."
    };
    Some(Chart {
        title: figure_title("Net energy against λ", "Fig. 14 of the paper", condition),
        x_label: "energy arrival rate λ, per TTI".to_owned(),
        y_label: "net energy, units per device and TTI".to_owned(),
        x: lambda_scale(),
        y: Scale::Linear {
            from: NET_RANGE.0,
            to: NET_RANGE.1,
        },
        marks,
        spans: Vec::new(),
        notes: Vec::new(),
        has_zero_at_border: false,
        caption: format!(
            "Lines: closed form λ·exp(−λ)·E_B, Eq. (5), less the consumption of the policy with {NET_N} devices, \
             preset {}: {}; bands are their 95 % intervals. Points: measured harvest less the same consumption, \
             {seeds} runs with N = {devices} and {ttis} TTIs, made for this figure.{marks_caption}",
            condition.label(),
            consumptions.join(", ")
        ),
        series,
    })
}

/// Returns marks at the λ of a statement, on the line of its E_B.
fn stated_marks(stated: &harvest::StatedThreshold) -> impl Iterator<Item = StatedMark> {
    let index = E_B_UNITS
        .iter()
        .position(|e| (e - stated.e_b).abs() < 1e-9)
        .unwrap_or(0);
    let (style, e_b) = (e_b_styles()[index], stated.e_b);
    stated.ends().map(move |end| StatedMark {
        x: end.lambda,
        x_offset: 0.0,
        stated: StatedValue::Value(mean_harvest(e_b, end.lambda)),
        style,
    })
}

fn curve_series(name: String, style: Style, points: Vec<ChartPoint>) -> Series {
    Series {
        name,
        style,
        is_joined: true,
        has_markers: false,
        interval: Interval::Band,
        points,
    }
}

/// Creates measured points without an entry in the legend.
fn measured_series(style: Style, points: Vec<ChartPoint>) -> Series {
    Series {
        name: String::new(),
        style,
        is_joined: false,
        has_markers: true,
        interval: Interval::Bars,
        points,
    }
}

fn harvest_point(point: &HarvestPoint) -> ChartPoint {
    ChartPoint {
        x: point.lambda,
        y: point.harvested.mean,
        y_half_width: point.harvested.half_width,
        x_half_width: f64::NAN,
    }
}

/// Returns the harvest of `point` less `consumption`. The two come from different runs, so their variances add up. The
/// result has no interval if either comes from a single run.
fn net_point(point: &HarvestPoint, consumption: &Estimate) -> ChartPoint {
    ChartPoint {
        x: point.lambda,
        y: point.harvested.mean - consumption.mean,
        y_half_width: libm::hypot(point.harvested.half_width, consumption.half_width),
        x_half_width: f64::NAN,
    }
}

/// Formats the data of Fig. 13 as CSV.
pub fn harvest_csv(points: &[HarvestPoint]) -> String {
    let mut out = String::from("lambda,e_b,closed_form,harvested,half_width_95,runs\n");
    for p in points {
        let HarvestPoint {
            lambda,
            e_b,
            closed_form,
            harvested,
            ..
        } = p;
        let (mean, half, runs) = (harvested.mean, harvested.half_width, harvested.runs);
        let _ = writeln!(out, "{lambda},{e_b},{closed_form},{mean},{half},{runs}");
    }
    out
}

/// Formats the data of Fig. 14 as CSV: the lines, and the points with their half-widths. In `chart`, of [`net_chart`],
/// the measured points follow their line.
pub fn net_csv(chart: &Chart) -> String {
    let mut out = String::from("line,kind,lambda,net,half_width_95\n");
    let mut line_name = "";
    for series in &chart.series {
        let kind = if series.is_joined { "closed form" } else { "measured" };
        if series.is_joined {
            line_name = &series.name;
        }
        for ChartPoint { x, y, y_half_width, .. } in &series.points {
            // Quoted, since the names of lines contain commas.
            let _ = writeln!(out, "\"{line_name}\",{kind},{x},{y},{}", half_width_cell(*y_half_width));
        }
    }
    out
}
