//! The actions of a run and its missed events: the devices that actions failed, and the phases between actions.

use std::collections::BTreeMap;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, OperatorAction};
use reveille_common::totals::MissCause;

use super::{MissedEvent, Misses, count_causes};

/// Most phases of a run. With more times of actions, one phase covers all TTIs between the first and the last action.
const MAX_PHASES: usize = 4;

/// The failures of a device by actions, in the measured TTIs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActionFailure {
    /// First TTI of the first failure; the first measured TTI if the device failed before it.
    pub first: Tti,
    /// Number of TTIs in which the device had failed.
    pub ttis: u64,
    /// Whether the device was still failed at the end.
    pub is_failed_at_end: bool,
}

/// The measured TTIs between two actions, before the first or after the last one.
#[derive(Clone, Debug, PartialEq)]
pub struct Phase {
    /// First TTI.
    pub first: Tti,
    /// TTI after the last.
    pub end: Tti,
    /// Counted events that started in these TTIs.
    pub events: u64,
    /// The missed ones.
    pub missed: u64,
    /// The most frequent cause of them with its number of events, as in [`Misses::causes`]; `None` without missed
    /// events.
    pub main_cause: Option<(Option<MissCause>, u64)>,
    /// The largest number of devices that had failed at the same time.
    pub failed_devices: u64,
}

impl Phase {
    /// Share of the events that were missed, %; NaN without events.
    pub fn missed_pct(&self) -> f64 {
        100.0 * self.missed as f64 / self.events as f64
    }
}

impl Misses {
    /// Returns the devices that actions failed in the measured TTIs.
    pub fn action_failures(&self) -> BTreeMap<DeviceId, ActionFailure> {
        let (first, end) = (self.scenario.warm_up_end(), self.end);
        let mut failures: BTreeMap<DeviceId, ActionFailure> = BTreeMap::new();
        for (device, from, to) in self.failure_spans() {
            let (from, to) = (from.max(first), to.unwrap_or(end).min(end));
            if from >= to {
                continue;
            }
            let failure = failures.entry(device).or_insert(ActionFailure {
                first: from,
                ttis: 0,
                is_failed_at_end: false,
            });
            failure.first = failure.first.min(from);
            failure.ttis += to - from;
            failure.is_failed_at_end |= to == end;
        }
        failures
    }

    /// Returns the failures by actions in the whole run: the device, its first failed TTI, and the TTI of its revival.
    fn failure_spans(&self) -> Vec<(DeviceId, Tti, Option<Tti>)> {
        let (mut spans, mut failed_since) = (Vec::new(), BTreeMap::new());
        for OperatorAction { tti, change } in self.sorted_actions() {
            match change {
                // A failed device that fails again stays failed.
                Change::Fail(devices) => devices.devices().for_each(|device| {
                    failed_since.entry(device).or_insert(tti);
                }),
                Change::Revive(devices) => spans.extend(
                    devices
                        .devices()
                        .filter_map(|device| Some((device, failed_since.remove(&device)?, Some(tti)))),
                ),
                Change::AddEnergy(..) | Change::Set(..) => {}
            }
        }
        spans.extend(failed_since.into_iter().map(|(device, from)| (device, from, None)));
        spans
    }

    /// Returns the missed events with the cause `failed` in place of `removed` if an action had failed the nearest
    /// device. The two causes differ only in the duration of the failure.
    pub(super) fn missed_by_failures(&self) -> Vec<MissedEvent> {
        let spans = self.failure_spans();
        let is_failed = |event: &MissedEvent| {
            let is_span = |(device, from, to): &(DeviceId, Tti, Option<Tti>)| {
                *device == event.nearest && (*from..to.unwrap_or(Tti::NEVER)).contains(&event.start)
            };
            spans.iter().any(is_span)
        };
        let mut missed = self.missed.clone();
        for event in &mut missed {
            if event.cause == Some(MissCause::Removed) && is_failed(event) {
                event.cause = Some(MissCause::Failed);
            }
        }
        missed
    }

    /// The actions in the order in which they take effect.
    fn sorted_actions(&self) -> Vec<OperatorAction> {
        let mut actions = self.actions.clone();
        actions.sort_by_key(|action| action.tti);
        actions
    }

    /// Divides the measured TTIs at the actions; empty without an action before their end. Actions in the warm-up
    /// count as actions in the first measured TTI.
    pub fn phases(&self) -> Vec<Phase> {
        let (first, end) = (self.scenario.warm_up_end(), self.end);
        let times = self.sorted_actions().into_iter().map(|action| action.tti.max(first));
        let mut times: Vec<Tti> = times.filter(|tti| *tti < end).collect();
        times.dedup();
        if times.is_empty() || first >= end {
            return Vec::new();
        }
        if times.len() >= MAX_PHASES {
            times = vec![times[0], times[times.len() - 1]];
        }
        let mut bounds = vec![first];
        bounds.extend(times.into_iter().filter(|tti| *tti > first));
        bounds.push(end);
        let spans = self.failure_spans();
        bounds
            .windows(2)
            .map(|pair| self.phase((pair[0], pair[1]), &spans))
            .collect()
    }

    fn phase(&self, (first, end): (Tti, Tti), spans: &[(DeviceId, Tti, Option<Tti>)]) -> Phase {
        let is_here = |tti: Tti| (first..end).contains(&tti);
        let missed: Vec<_> = self.missed.iter().filter(|event| is_here(event.start)).collect();
        // The number of failed devices is largest at the start of the phase or of a failure in it.
        let spans: Vec<(Tti, Tti)> = spans
            .iter()
            .map(|(_, from, to)| (*from, to.unwrap_or(Tti::NEVER)))
            .filter(|(from, to)| *from < end && *to > first)
            .collect();
        let mut changes: BTreeMap<Tti, i64> = BTreeMap::new();
        for (from, to) in spans {
            *changes.entry(from.max(first)).or_default() += 1;
            *changes.entry(to).or_default() -= 1;
        }
        let failed = changes.into_values().scan(0, |failed, change| {
            *failed += change;
            Some(*failed)
        });
        Phase {
            first,
            end,
            events: self.counted_starts.iter().filter(|start| is_here(**start)).count() as u64,
            missed: missed.len() as u64,
            main_cause: count_causes(missed).first().copied(),
            failed_devices: failed.max().unwrap_or(0).cast_unsigned(),
        }
    }
}
