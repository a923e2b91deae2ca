//! The dashboard's curves over a run: metrics, batteries and traffic. `feed` updates them, `page/charts.js` draws them.
//! It takes metrics and quantiles by index, and the other values by key.

use reveille_common::ids::Tti;
use reveille_common::units::Energy;
use reveille_view::history::RunHistory;
use reveille_view::traffic::TrafficStats;
use serde::Serialize;

/// Metrics that have a curve. Their order is fixed by `page/charts.js` and a test of `feed`.
pub(super) const CURVE_METRICS: [&str; 6] = [
    "info_p1",
    "misdetection_pct",
    "detection_delay_ttis",
    "energy_sensing_per_device_tti",
    "energy_sleep_per_device_tti",
    "energy_report_per_device_tti",
];
/// Battery quantiles that have a curve, in the order of `page/charts.js`, which names them.
const QUANTILES: [f64; 3] = [0.05, 0.5, 0.95];
/// Most points of a curve; beyond that, every other point is dropped.
const MAX_POINTS: usize = 800;
/// Greatest initial distance of two points, TTIs.
const MAX_INITIAL_SPACING: u64 = 10;

/// A point of every curve.
#[derive(Clone, Serialize)]
pub(super) struct CurvePoint {
    /// The last TTI that the values include.
    pub tti: Tti,
    /// Values of [`CURVE_METRICS`]; `None` before the first event or the end of the warm-up.
    pub metrics: [Option<f64>; CURVE_METRICS.len()],
    /// [`QUANTILES`] of the batteries, units.
    batteries: [Option<f64>; QUANTILES.len()],
    /// Control overhead, bytes per TTI.
    control: f64,
    /// Reports, bytes per TTI.
    uplink: f64,
}

/// All curves of a run so far, with at most [`MAX_POINTS`] points.
pub(super) struct Curves {
    points: Vec<CurvePoint>,
    /// TTIs between two points.
    spacing: u64,
    /// The next point is due once the TTIs before this one are available.
    next_end: Tti,
}

impl Curves {
    /// Creates the empty curves of a run of `ttis`. A short run gets a point for every TTI. A longer one starts with up
    /// to [`MAX_INITIAL_SPACING`] between points, and [`Self::update`] thins it out.
    pub(super) fn new(ttis: u64) -> Self {
        Self {
            points: Vec::new(),
            spacing: (ttis / MAX_POINTS as u64).clamp(1, MAX_INITIAL_SPACING),
            next_end: Tti::ZERO,
        }
    }

    /// Adds a point if the next one is due. Call it only between two grants, with the state of the frames so far.
    pub(super) fn update(&mut self, history: &mut RunHistory, traffic: &TrafficStats) {
        if history.available_ttis().1 < self.next_end {
            return;
        }
        let Some(point) = curve_point(history, traffic) else {
            return;
        };
        let tti = point.tti;
        self.points.push(point);
        // Keeps every other point, the first included, at twice the distance, so that memory stays bounded.
        if self.points.len() > MAX_POINTS {
            let mut is_odd = false;
            self.points.retain(|_| {
                is_odd = !is_odd;
                is_odd
            });
            self.spacing *= 2;
        }
        self.next_end = tti + 1 + self.spacing;
    }

    /// The stored points, and a last point for the frames so far.
    pub(super) fn points(&self, history: &mut RunHistory, traffic: &TrafficStats) -> Vec<CurvePoint> {
        let current = curve_point(history, traffic);
        let mut points = self.points.clone();
        points.pop_if(|last| current.as_ref().is_some_and(|current| current.tti == last.tti));
        points.extend(current);
        points
    }
}

/// Computes a point of every curve from the frames so far; `None` before TTI 0.
fn curve_point(history: &mut RunHistory, traffic: &TrafficStats) -> Option<CurvePoint> {
    let tti = history.reconstruction().mirror().current_tti()?;
    let mut batteries: Vec<Energy> = history.views().iter().map(|view| view.battery).collect();
    batteries.sort_unstable();
    let quantile = |share: f64| {
        let index = (share * batteries.len().saturating_sub(1) as f64).round() as usize;
        batteries.get(index).map(|level| level.units())
    };
    let metrics = history.reconstruction().metrics();
    let value = |name: &str| metrics.value(name).filter(|value| value.is_finite());
    let ttis = traffic.ttis().max(1) as f64;
    Some(CurvePoint {
        tti,
        metrics: CURVE_METRICS.map(value),
        batteries: QUANTILES.map(quantile),
        control: traffic.control().bytes as f64 / ttis,
        uplink: traffic.uplink().bytes as f64 / ttis,
    })
}
