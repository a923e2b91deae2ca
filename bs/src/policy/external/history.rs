//! History of the run for decision requests ([`super::features`]): when each device sensed and reported, and how long
//! each place has been uncovered. Trained models rely on the values. [`super::External`] calls `advance`, then in a TTI
//! with reports `start_event` and `add_report`.

use reveille_common::geometry::{Buckets, Point};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

use crate::beliefs::ages::staleness::Staleness;
use crate::beliefs::ranking::i_min;
use crate::knowledge::{DeviceKnowledge, Knowledge};

/// History of the reports and of the sensing devices.
#[derive(Clone, Debug)]
pub struct ReportHistory {
    place_ages: Staleness,
    /// First TTI that has not ended.
    open_tti: Tti,
    /// Whether a report arrived in [`Self::open_tti`].
    is_event_reported: bool,
    /// By device, the last ended TTI with δ = 1, counted from 1; 0 for none.
    last_sensed: Vec<u64>,
    /// By device, the TTI of its last report, counted from 1; 0 for none.
    last_reported: Vec<u64>,
    /// By device, its constant features.
    static_features: Vec<StaticFeatures>,
    positions: Vec<Point>,
    sensing: Sensing,
    latest_reports: LatestReports,
    i_min: f64,
}

/// Constant features of a device, stored compactly; `features.rs` describes and copies them.
#[derive(Clone, Copy, Debug)]
pub struct StaticFeatures {
    /// Position as shares of the width and height of the area, `[0, 1]`.
    pub relative_position: [f32; 2],
    /// Density ln(1 + n) / ln(N), with n the other devices within d_max, `[0, 1]`.
    pub neighbours: f32,
    /// Share h / (h + E_idle), with h its mean harvest in a TTI, `[0, 1]`.
    pub harvest: f32,
    /// E_max, units.
    pub e_max: f64,
    /// Whether [`Self::harvest`] holds in every TTI.
    pub is_steady: bool,
}

/// The reports of the latest TTI with any, and the distances from their devices, by device.
#[derive(Clone, Debug)]
struct LatestReports {
    /// I_ij of its report, 0 without a report.
    information: Vec<f64>,
    /// Distance to the nearest reporter, m; infinite without a reporter.
    distance: Vec<f64>,
    /// Detection probability p(d) at that distance.
    nearness: Vec<f64>,
}

impl ReportHistory {
    /// Creates the history before TTI 0, for the devices in `known`.
    pub fn new(known: &Knowledge) -> Self {
        let positions = known.positions();
        let loss_probability = known.radio.no_report_probability();
        let buckets = Buckets::new(&positions, known.area, known.sensing.d_max);
        // ln(1) is 0: for a single device `neighbours` below is then 0 and not NaN.
        let ln_n = libm::log(known.n() as f64).max(f64::MIN_POSITIVE);
        let static_features = |(j, device): (usize, &DeviceKnowledge)| {
            let mut others = 0_u32;
            buckets.within(device.position, known.sensing.d_max, |i, _| others += u32::from(i != j));
            let Point { x, y } = device.position;
            StaticFeatures {
                relative_position: [x / known.area.width, y / known.area.height].map(|share| share as f32),
                neighbours: (libm::log(f64::from(1 + others)) / ln_n) as f32,
                harvest: harvest_share(device.mean_harvest, device.energy.e_idle) as f32,
                e_max: device.energy.e_max.units(),
                is_steady: known.day_profiles[usize::from(device.class)].is_none(),
            }
        };
        Self {
            place_ages: Staleness::with_loss(loss_probability, &positions, known.area, &known.sensing),
            open_tti: Tti::ZERO,
            is_event_reported: false,
            last_sensed: vec![0; known.n()],
            last_reported: vec![0; known.n()],
            static_features: known.devices.iter().enumerate().map(static_features).collect(),
            latest_reports: LatestReports {
                information: vec![0.0; known.n()],
                distance: vec![f64::INFINITY; known.n()],
                nearness: vec![0.0; known.n()],
            },
            i_min: i_min(&positions, known.area, &known.sensing),
            positions,
            sensing: known.sensing.clone(),
        }
    }

    /// Ends the open TTIs before `end`, which passed under `plan`. Call it before the plan changes.
    pub fn advance(&mut self, end: Tti, plan: &Plan) {
        while self.open_tti < end {
            for (j, last_sensed) in self.last_sensed.iter_mut().enumerate() {
                if plan.is_on(DeviceId(j as u32), self.open_tti) {
                    self.place_ages.add(j);
                    *last_sensed = self.open_tti.0 + 1;
                }
            }
            // The reports belong to the first of these TTIs, so only that one has a reported event.
            self.place_ages.advance(std::mem::take(&mut self.is_event_reported));
            self.open_tti = self.open_tti + 1;
        }
    }

    /// Replaces the reports by the first ones of the open TTI, at least one. Call [`Self::advance`] to this TTI first.
    pub(crate) fn start_event(&mut self, reports: &[Report]) {
        self.latest_reports.information.fill(0.0);
        self.latest_reports.distance.fill(f64::INFINITY);
        self.latest_reports.nearness.fill(0.0);
        for report in reports {
            self.add_report(report);
        }
    }

    /// Adds another report of the same TTI.
    pub fn add_report(&mut self, report: &Report) {
        let Self {
            positions,
            sensing,
            latest_reports,
            ..
        } = self;
        self.is_event_reported = true;
        self.last_reported[report.device.index()] = report.tti.0 + 1;
        latest_reports.information[report.device.index()] = report.information;
        let reporter = positions[report.device.index()];
        // Updated per report: computing distances for each request took half of an environment's step at N = 250.
        let devices = positions
            .iter()
            .zip(&mut latest_reports.distance)
            .zip(&mut latest_reports.nearness);
        for ((position, nearest_distance), nearness) in devices {
            let distance = position.distance(reporter);
            if distance < *nearest_distance {
                (*nearest_distance, *nearness) = (distance, sensing.p(distance));
            }
        }
    }

    /// Returns I of the report of `device` in the last TTI with reports, `[0, Ψ]`; 0 without a report.
    pub fn information(&self, device: usize) -> f64 {
        self.latest_reports.information[device]
    }

    /// Returns p(d) of the distance from `device` to the nearest reporter of that TTI, `[0, 1]`.
    pub(crate) fn nearness(&self, device: usize) -> f64 {
        self.latest_reports.nearness[device]
    }

    /// Returns the TTIs since `device` last sensed by the plan in an ended TTI, or `None`.
    pub(crate) fn since_sensing(&self, device: usize, now: Tti) -> Option<u64> {
        ttis_since(self.last_sensed[device], now)
    }

    /// Returns the TTIs since the last report of `device`, or `None`.
    pub(crate) fn since_report(&self, device: usize, now: Tti) -> Option<u64> {
        ttis_since(self.last_reported[device], now)
    }

    /// Returns the TTIs since the last report of any device, or `None`.
    pub(crate) fn since_any_report(&self, now: Tti) -> Option<u64> {
        ttis_since(self.last_reported.iter().copied().max().unwrap_or(0), now)
    }

    /// Returns the worth of covering the places of `device`, as a multiple of the worth right after covering them, ≥ 1.
    /// It is the mean of a(a + 1)/2 over the ages a of the places ([`ages`](crate::beliefs::ages)).
    #[inline]
    pub(crate) fn staleness(&self, device: usize) -> f64 {
        self.place_ages.device_staleness(device)
    }

    /// Returns the same ratio for the whole area.
    pub(crate) fn area_staleness(&self) -> f64 {
        self.place_ages.area_staleness()
    }

    /// Returns the constant features of `device`.
    #[inline]
    pub fn static_features(&self, device: usize) -> &StaticFeatures {
        &self.static_features[device]
    }

    /// I_min (Sec. V-A), `[0, Ψ]`.
    pub const fn i_min(&self) -> f64 {
        self.i_min
    }
}

/// Returns h / (h + E_idle) for a harvest h in a TTI.
pub(super) fn harvest_share(harvest: Energy, e_idle: Energy) -> f64 {
    let (harvest, e_idle) = (harvest.units(), e_idle.units());
    if harvest > 0.0 {
        harvest / (harvest + e_idle)
    } else {
        0.0
    }
}

/// Returns the TTIs to `now` from `last`, a TTI counted from 1; `None` for 0.
const fn ttis_since(last: u64, now: Tti) -> Option<u64> {
    match last {
        0 => None,
        last => Some((now.0 + 1).saturating_sub(last)),
    }
}
