//! Features of a decision request, in `[0, 1]`: one row per device and one global row. A model trained on them in
//! memory can decide on the bus.
//!
//! The features hold only knowledge of the base station. None grows with N, the area or the length of the run. Their
//! order and meaning are part of the policy port and of the Python environments: trained models rely on them. A new or
//! moved feature needs a new `PROTOCOL_VERSION` (`wire.rs`).

use reveille_common::ids::{DeviceId, Tti};

use super::decision::{DecisionContext, DecisionStage};
use super::history::{StaticFeatures, harvest_share};

/// Description of a feature of a device, or of the global row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Feature {
    /// Its name.
    pub name: &'static str,
    /// Meaning, one sentence without its stop.
    pub about: &'static str,
}

const fn feature(name: &'static str, about: &'static str) -> Feature {
    Feature { name, about }
}

/// Features of each device, in this order; all in `[0, 1]`. Stage 0 is [`DecisionStage::Plan`], stage 1
/// [`DecisionStage::Wake`]. The `about` texts are part of the hello message and of the Python package;
/// [`DecisionContext::write_devices`] computes the values in this order.
pub const DEVICE_FEATURES: [Feature; 15] = [
    feature("x", "position along the area's width, as a share of the width"),
    feature("y", "position along the area's height, as a share of the height"),
    feature(
        "battery",
        "B / E_max at the end of the last TTI, as known under `bs.battery_knowledge`",
    ),
    feature(
        "can_report",
        "1 if its known battery level pays for a report in this TTI",
    ),
    feature("sensing", "δ of this TTI at stage 1, of the last TTI at stage 0"),
    feature(
        "may_wake",
        "1 if a wake-up decision may name it: at stage 1, with δ = 0 and not yet woken",
    ),
    feature("woken", "1 if it was woken in this TTI; 0 at stage 0"),
    feature(
        "information",
        "I / Ψ of its report in this TTI; 0 without a report, and at stage 0",
    ),
    feature(
        "nearness",
        "p(d), d the distance to the nearest reporter of this TTI; 0 at stage 0",
    ),
    feature(
        "since_sensing",
        "t / (t + 8), t the TTIs since its last δ = 1; 1 if never",
    ),
    feature(
        "since_report",
        "t / (t + 64), t the TTIs since its last report; 1 if never",
    ),
    feature(
        "stale",
        "1 - 1 / √w, w the mean of a(a + 1)/2 over the places it covers, a the age of a place in TTIs",
    ),
    feature("neighbours", "ln(1 + n) / ln(N), n the other devices within d_max"),
    feature("harvest", "h / (h + E_idle), h the mean harvest in a TTI"),
    feature("harvest_now", "h / (h + E_idle), h the expected harvest in this TTI"),
];

/// Features of the global row, in this order; all in `[0, 1]`. [`DecisionContext::write_globals`] computes the values
/// in this order.
pub const GLOBAL_FEATURES: [Feature; 10] = [
    feature(
        "information",
        "Î / Ψ: the known information about the event of this TTI; 0 at stage 0",
    ),
    feature("i_min", "I_min / Ψ: the information at which `knn` stops"),
    feature("alpha", "α: the probability that an event starts in a TTI"),
    feature("devices", "ln(N) / 10"),
    feature(
        "sensing",
        "share of the devices with δ = 1 in this TTI at stage 1, in the last TTI at stage 0",
    ),
    feature(
        "reports",
        "n / (n + 1), n the number of reports so far in this TTI; 0 at stage 0",
    ),
    feature("woken", "share of the devices woken in this TTI; 0 at stage 0"),
    feature("battery", "mean of the known B / E_max over the devices"),
    feature(
        "since_report",
        "t / (t + 8), t the TTIs since the last report of any device; 1 if never",
    ),
    feature("stale", "1 - 1 / √w, w the mean of a(a + 1)/2 over the whole area"),
];

/// Time after which the feature of a device's last report is 1/2, TTIs. The texts above repeat both times.
const REPORT_HALF_TTIS: f64 = 64.0;
/// Time after which the features of sensing, and of the last report of any device, are 1/2, TTIs.
const HALF_TTIS: f64 = 8.0;

/// Returns the feature of a time: 1/2 after `half_ttis`, and 1 for `None`.
fn bounded_time(ttis: Option<u64>, half_ttis: f64) -> f64 {
    ttis.map_or(1.0, |t| t as f64 / (t as f64 + half_ttis))
}

/// Returns the feature of a [`ReportHistory::staleness`](super::history::ReportHistory::staleness), ≥ 1.
fn bounded_staleness(staleness: f64) -> f64 {
    1.0 - 1.0 / staleness.max(1.0).sqrt()
}

fn flag(is_set: bool) -> f32 {
    f32::from(u8::from(is_set))
}

impl DecisionContext<'_> {
    /// Returns whether δ = 1: in this TTI at [`DecisionStage::Wake`], in the last at [`DecisionStage::Plan`].
    #[inline]
    fn is_sensing(&self, device: DeviceId) -> bool {
        let plan = self.observation.plan;
        match (self.stage, self.observation.now) {
            (DecisionStage::Wake, now) => plan.is_on(device, now),
            (DecisionStage::Plan, Tti(0)) => false,
            (DecisionStage::Plan, Tti(now)) => plan.is_on(device, Tti(now - 1)),
        }
    }

    /// Returns the known B / E_max of `device`.
    #[inline]
    fn battery_share(&self, device: usize) -> f64 {
        (self.observation.batteries[device].units() / self.history.static_features(device).e_max).min(1.0)
    }

    /// Returns the expected harvest of `device` in this TTI, scaled as [`StaticFeatures::harvest`].
    #[inline]
    fn harvest_now(&self, device: usize, constants: &StaticFeatures) -> f32 {
        // A steady harvest is the same in every TTI and was computed once.
        if constants.is_steady {
            return constants.harvest;
        }
        let (known, now) = (self.observation.known, self.observation.now);
        let expected_harvest = known.expected_harvest(DeviceId(device as u32), now, now + 1);
        harvest_share(expected_harvest, known.devices[device].energy.e_idle) as f32
    }

    /// Writes [`DEVICE_FEATURES`] of each device, in the order of ids, into `rows`.
    ///
    /// # Panics
    /// If the length of `rows` is not N times the number of features.
    pub fn write_devices(&self, rows: &mut [f32]) {
        let (observation, history) = (&self.observation, self.history);
        let (n, psi) = (observation.known.n(), observation.known.sensing.psi);
        assert_eq!(rows.len(), n * DEVICE_FEATURES.len(), "a row for each device");
        let is_wake_stage = self.stage == DecisionStage::Wake;
        for (j, row) in rows.chunks_exact_mut(DEVICE_FEATURES.len()).enumerate() {
            let (device, constants) = (DeviceId(j as u32), history.static_features(j));
            let [information, nearness] = if is_wake_stage {
                [history.information(j) / psi, history.nearness(j)].map(|value| value as f32)
            } else {
                [0.0; 2]
            };
            let values: [f32; DEVICE_FEATURES.len()] = [
                constants.relative_position[0],
                constants.relative_position[1],
                self.battery_share(j) as f32,
                flag(observation.can_report(device)),
                flag(self.is_sensing(device)),
                flag(self.may_wake(device)),
                flag(is_wake_stage && self.woken[j]),
                information,
                nearness,
                bounded_time(history.since_sensing(j, observation.now), HALF_TTIS) as f32,
                bounded_time(history.since_report(j, observation.now), REPORT_HALF_TTIS) as f32,
                bounded_staleness(history.staleness(j)) as f32,
                constants.neighbours,
                constants.harvest,
                self.harvest_now(j, constants),
            ];
            row.copy_from_slice(&values);
        }
    }

    /// Writes [`GLOBAL_FEATURES`] into `row`.
    ///
    /// # Panics
    /// If `row` has another length.
    pub fn write_globals(&self, row: &mut [f32]) {
        let (observation, history, known) = (&self.observation, self.history, self.observation.known);
        assert_eq!(row.len(), GLOBAL_FEATURES.len(), "a place for each feature");
        let (n, psi) = (known.n() as f64, known.sensing.psi);
        let devices = || (0..known.n() as u32).map(DeviceId);
        let share = |count: usize| count as f64 / n;
        let (report_count, woken_count) = match self.stage {
            DecisionStage::Plan => (0.0, 0),
            DecisionStage::Wake => (
                self.reports.len() as f64,
                self.woken.iter().filter(|woken| **woken).count(),
            ),
        };
        let values: [f64; GLOBAL_FEATURES.len()] = [
            observation.information / psi,
            history.i_min() / psi,
            known.alpha,
            (libm::log(n) / 10.0).min(1.0),
            share(devices().filter(|j| self.is_sensing(*j)).count()),
            report_count / (report_count + 1.0),
            share(woken_count),
            (0..known.n()).map(|j| self.battery_share(j)).sum::<f64>() / n,
            bounded_time(history.since_any_report(observation.now), HALF_TTIS),
            bounded_staleness(history.area_staleness()),
        ];
        for (feature, value) in row.iter_mut().zip(values) {
            *feature = value as f32;
        }
    }

    /// Writes into `mask`, by device id, 2 if the decision may name the device, or 0 if that would have no effect: the
    /// codes of a Gymnasium mask, on which the Python package relies. See
    /// [`DecisionRequest::action_mask`](super::wire::DecisionRequest::action_mask).
    ///
    /// # Panics
    /// If the length of `mask` is not N.
    pub fn write_mask(&self, mask: &mut [i8]) {
        assert_eq!(mask.len(), self.device_count(), "a place for each device");
        for (j, entry) in (0..).zip(mask) {
            let may_name = match self.stage {
                DecisionStage::Plan => true,
                DecisionStage::Wake => self.may_wake(DeviceId(j)),
            };
            *entry = if may_name { 2 } else { 0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_of_the_policy_port_lists_the_columns() {
        let page = include_str!("../../../../docs/policy-port.md");
        for features in [&DEVICE_FEATURES[..], &GLOBAL_FEATURES] {
            let rows = (0..).zip(features);
            let rows = rows.map(|(index, Feature { name, about })| format!("| {index} | `{name}` | {about} |\n"));
            let table = format!(
                "| index | column | content |\n|---|---|---|\n{}\n",
                rows.collect::<String>()
            );
            assert!(page.contains(&table), "docs/policy-port.md must contain\n{table}");
        }
    }
}
