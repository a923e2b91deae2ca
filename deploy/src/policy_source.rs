//! The source of external decisions in a run over the bus, as the command line selects it: a recorded input log, a
//! policy process that `reveille` starts, or one that connects to the policy port. Used by `up` and `bs`.

use std::path::Path;
use std::sync::Arc;

use anyhow::ensure;
use reveille_bs::policy::outside;
use reveille_bs::scenario::Scenario;
use reveille_bs::server::{DecisionTimeout, RunProgress};
use reveille_common::bus::Bus;
use reveille_common::secret::Secret;
use reveille_lab::external_inputs::ExternalInputs;

use crate::cli::{DriveArgs, ExternalPolicyArgs, OnUndecidedArg};
use crate::display::note;
use crate::policy_process::PolicyProcess;
use crate::run_registry;

/// The source of external decisions.
pub(crate) struct PolicySource<'a> {
    /// Timeout of decision requests; `None` if the run needs no policy process. `commands::bs` sends policy processes
    /// a farewell only with a value.
    pub decision_timeout: Option<DecisionTimeout>,
    /// The command that starts the policy process; `None` if it is started by hand, or not needed.
    command: Option<&'a str>,
}

/// Selects the source of decisions in a run of `scenario`: the policy itself, the `recorded_inputs` of an earlier run,
/// or the policy port.
///
/// # Errors
/// If the options do not apply here, or the recorded inputs cannot be replayed on the bus.
pub(crate) fn select_policy_source<'a>(
    scenario: &Scenario,
    recorded_inputs: Option<&ExternalInputs>,
    drive: &'a DriveArgs,
) -> anyhow::Result<PolicySource<'a>> {
    let ExternalPolicyArgs {
        policy_command,
        decision_timeout,
        on_undecided,
    } = &drive.external_policy;
    // Recorded inputs hold all decisions, so no policy process is asked.
    let needs_policy_process = outside::is_external(&scenario.policy) && recorded_inputs.is_none();
    let has_timeout_options = decision_timeout.is_some() || *on_undecided != OnUndecidedArg::End;
    ensure!(
        needs_policy_process || (policy_command.is_none() && !has_timeout_options),
        "--policy-command, --decision-timeout and --on-undecided need a policy process; add --policy external"
    );
    ensure!(
        recorded_inputs.is_none_or(|inputs| inputs.removals.is_empty()),
        "the input log removes devices, which cannot be repeated on the bus; replay it with `reveille run`"
    );
    Ok(PolicySource {
        decision_timeout: needs_policy_process.then(|| (&drive.external_policy).into()),
        command: policy_command.as_deref(),
    })
}

impl PolicySource<'_> {
    /// Starts the policy command, if any, for the run on `bus` with this `key`, and with the folder of certificates if
    /// the bus is encrypted. Otherwise prints the address of
    /// the policy port, if a policy process is needed and the run is not `is_quiet`.
    ///
    /// # Errors
    /// If it cannot be started.
    pub(crate) fn start(
        &self,
        (bus, tls): (&Bus, Option<&Path>),
        key: Option<Secret>,
        progress: &Arc<RunProgress>,
        is_quiet: bool,
    ) -> anyhow::Result<Option<PolicyProcess>> {
        if let Some(command) = self.command {
            return PolicyProcess::start(command, (bus, tls), key, progress).map(Some);
        }
        if self.decision_timeout.is_some() && !is_quiet {
            let (port, endpoint) = (
                bus.key_exprs().policy_port(),
                run_registry::reachable_endpoint(bus.endpoint()),
            );
            note!(
                "waiting for a policy process at {port} of {endpoint}; start one that connects there, or let this \
                 command start it with --policy-command COMMAND (see docs/external-policies.md)"
            );
        }
        Ok(None)
    }
}
