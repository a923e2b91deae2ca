//! Actions of operators on a running run: checks and stores each one, and hands it to the run loop before the TTI in
//! which it takes effect is granted. `subscriptions` passes the requests; docs/actions.md describes them.

use std::sync::Arc;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{ActRequest, Change, DeviceRange, OperatorAction};
use reveille_common::secret::Secret;

use super::failover::ReplaySource;
use super::state::{ServerState, SharedState};
use crate::actions::check_change;
use crate::scenario::Scenario;

/// Accepts the actions of operators.
pub(super) struct ActionHandler {
    pub(super) shared: Arc<SharedState>,
    pub(super) scenario: Scenario,
    /// The run's key, which operators must show; `None` if any client may act.
    pub(super) run_key: Option<Secret>,
    /// Stores the actions; `None` if the run stores no external inputs, so that it accepts no action.
    pub(super) replay: Option<Arc<dyn ReplaySource>>,
}

impl ActionHandler {
    /// Accepts `request`, sent with the key `shown`. Returns the TTI in which it takes effect. Either all changes of a
    /// request are accepted or none.
    ///
    /// # Errors
    /// The reason for the operator: a wrong key, an impossible change, a granted TTI, a removed device, or a failure to
    /// store the actions, which also ends the run.
    pub(super) fn accept(&self, mut request: ActRequest, shown: Option<Secret>) -> Result<Tti, String> {
        if self.run_key.is_some_and(|key| shown != Some(key)) {
            return Err("an action needs the run's key; use the key of the process that started the run".to_owned());
        }
        let replay = self.replay.as_ref();
        let replay = replay.ok_or("this run stores no external inputs, so it takes no actions")?;
        let devices = self.scenario.run.devices;
        for change in &request.changes {
            check_change(&change.with_all_resolved(devices), &self.scenario)?;
        }
        // Held to the end, so that the TTI from `action_tti` is not granted before the actions are pending.
        let mut state = self.shared.lock_between_grants();
        let changes = request.changes.into_iter();
        request.changes = changes
            .flat_map(|change| state.with_present_devices(change, devices))
            .collect();
        let tti = state.action_tti(request.at)?;
        state.check_devices_not_removed(&request)?;
        let actions: Vec<_> = request
            .changes
            .into_iter()
            .map(|change| OperatorAction { tti, change })
            .collect();
        // Stored first: an action that took effect and was not stored would make the run impossible to replay.
        if let Err(error) = replay.record_actions(&actions) {
            // Part of the actions can be in the log, so the run must not continue without them.
            state.failure = Some(error.clone());
            return Err(error);
        }
        state.pending_actions.extend(actions);
        Ok(tti)
    }
}

impl ServerState {
    /// Returns the TTI of an action that an operator wants `at` a TTI, by default as soon as possible.
    fn action_tti(&self, at: Option<Tti>) -> Result<Tti, String> {
        let (next, run_end) = (self.next_tti, self.clock.end());
        if next >= run_end {
            return Err("the last TTI of the run is granted already, so an action has no effect".to_owned());
        }
        let tti = at.unwrap_or(next);
        if (next..run_end).contains(&tti) {
            Ok(tti)
        } else {
            let last = run_end.0 - 1;
            Err(format!(
                "TTI {tti}: must be from {next}, the next TTI, to {last}, the last TTI of the run"
            ))
        }
    }

    /// Returns `change` alone, or, if it concerns all `devices` of the run, a change for each range of devices that are
    /// not removed.
    fn with_present_devices(&self, change: Change, devices: u32) -> Vec<Change> {
        if change.devices() != Some(DeviceRange::ALL) {
            return vec![change];
        }
        let range_ends = self.removed_devices.iter().copied().chain([DeviceId(devices)]);
        let mut first = DeviceId(0);
        let ranges = range_ends.filter_map(|range_end| {
            let range = DeviceRange {
                first,
                count: range_end.0 - first.0,
            };
            first = DeviceId(range_end.0 + 1);
            (range.count > 0).then(|| change.with_devices(range))
        });
        ranges.collect()
    }

    fn check_devices_not_removed(&self, request: &ActRequest) -> Result<(), String> {
        let ranges = request.changes.iter().filter_map(Change::devices);
        for range in ranges {
            if let Some(device) = self.removed_devices.range(range.first..).next()
                && range.contains(*device)
            {
                return Err(format!(
                    "device {device} was removed from the run with its process; use devices that are still in the run"
                ));
            }
        }
        Ok(())
    }
}
