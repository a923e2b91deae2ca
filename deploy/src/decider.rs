//! Who decides for a run from outside, as the command line says.

use std::sync::Arc;

use anyhow::ensure;
use reveille_bs::host::{Decisions, Progress};
use reveille_bs::policy::outside;
use reveille_common::bus::Bus;
use reveille_common::scenario::Scenario;
use reveille_common::secret::Secret;
use reveille_lab::inputs::Inputs;

use crate::cli::{DriveArgs, OnUndecidedArg, OutsideArgs};
use crate::display::note;
use crate::local;
use crate::policy_process::PolicyProcess;

/// Who decides for a run from outside.
pub struct Deciding<'a> {
    /// What was decided, and how somebody is asked.
    pub decisions: Decisions,
    /// What is started to decide.
    command: Option<&'a str>,
}

/// Who decides in a run of `scenario`: nobody outside, what was `given` of an earlier run, or who answers at the policy
/// port.
///
/// # Errors
/// The options mean nothing here, or what was given cannot be gone through on the bus.
pub fn deciding<'a>(scenario: &Scenario, given: Option<Inputs>, drive: &'a DriveArgs) -> anyhow::Result<Deciding<'a>> {
    let OutsideArgs {
        policy_command,
        decision_timeout,
        on_undecided,
    } = &drive.outside;
    let is_asked = outside::is_external(&scenario.policy) && given.is_none();
    let is_tuned = decision_timeout.is_some() || *on_undecided != OnUndecidedArg::End;
    ensure!(
        is_asked || (policy_command.is_none() && !is_tuned),
        "--policy-command, --decision-timeout and --on-undecided are for a run whose policy asks another program: add \
         --policy external"
    );
    let Inputs { outages, decisions } = given.unwrap_or_default();
    ensure!(
        outages.is_empty(),
        "the log names devices that were lost, which does not happen again on the bus; replay it with `reveille run`"
    );
    Ok(Deciding {
        decisions: Decisions {
            kept: decisions,
            before: 0,
            port: is_asked.then(|| (&drive.outside).into()),
        },
        command: policy_command.as_deref(),
    })
}

impl Deciding<'_> {
    /// Starts the command that decides for the run on `bus` that has this `key`, if there is one; else says where it is
    /// to be decided, if it is and the run `is_quiet` not.
    ///
    /// # Errors
    /// It cannot be started.
    pub fn start(
        &self,
        bus: &Bus,
        key: Option<Secret>,
        progress: &Arc<Progress>,
        is_quiet: bool,
    ) -> anyhow::Result<Option<PolicyProcess>> {
        if let Some(command) = self.command {
            return PolicyProcess::start(command, bus, key, progress).map(Some);
        }
        if self.decisions.port.is_some() && !is_quiet {
            let (port, endpoint) = (bus.keys().policy(), local::reachable(bus.endpoint()));
            note!("asking for decisions at {port} of {endpoint}");
        }
        Ok(None)
    }
}
