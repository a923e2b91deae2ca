//! One file for each subcommand.

pub mod analyse;
pub mod bs;
pub mod clock;
pub mod device;
pub mod figures;
pub mod inspect;
pub mod merge;
pub mod report;
pub mod run;
pub mod scenario;
pub mod sweep;
pub mod train;
#[cfg(feature = "tune")]
pub mod tune;
pub mod up;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use reveille_common::scenario::{Override, PolicyConfig, Scenario, load};
use reveille_lab::sweep::{SweepError, table_in};

use crate::cli::{OutputArgs, ScenarioArgs};
use crate::display;
use crate::results::Summary;

/// The scenario that the command line means.
pub fn resolve(args: &ScenarioArgs) -> anyhow::Result<Scenario> {
    let mut overrides = args
        .set
        .iter()
        .map(|text| Override::parse(text))
        .collect::<Result<Vec<_>, _>>()?;
    let flags = [
        ("--devices", "devices", &args.devices),
        ("--policy", "policy.name", &args.policy),
        ("--ttis", "ttis", &args.ttis),
        ("--seed", "seed", &args.seed),
    ];
    for (flag, field, value) in flags {
        if let Some(value) = value {
            overrides.push(Override::flag(flag, field, value)?);
        }
    }
    if args.learn {
        overrides.push(Override::flag("--learn", "policy.q-learning.learn", "true")?);
    }
    let scenario = load(&args.scenario, &overrides)?;
    match &scenario.policy {
        PolicyConfig::QLearning(settings) if !settings.foreign.is_empty() => {
            warn_of_setting(&settings.foreign.join("; "));
        }
        PolicyConfig::Knn(_) | PolicyConfig::Adjusted(_) | PolicyConfig::Random | PolicyConfig::Genie if args.learn => {
            anyhow::bail!(
                "--learn: the policy {} does not learn; add --policy q-learning",
                scenario.policy.name()
            );
        }
        PolicyConfig::QLearning(_)
        | PolicyConfig::Knn(_)
        | PolicyConfig::Adjusted(_)
        | PolicyConfig::Random
        | PolicyConfig::Genie => {}
    }
    Ok(scenario)
}

/// Says that tables were learned on another setting: in what it `differs`.
fn warn_of_setting(differs: &str) {
    tracing::warn!(
        "the tables of q-learning were learned on another setting ({differs}); for tables of its own: reveille train q-learning \
         --out FILE, with the same --scenario and --set"
    );
}

/// TTIs in a window of the per-window series.
pub fn window(args: &OutputArgs, scenario: &Scenario) -> u64 {
    args.window.unwrap_or_else(|| scenario.ttis.div_ceil(100))
}

/// Prints the summary as asked, and gives the exit code.
pub fn conclude(args: &OutputArgs, summary: &Summary<'_>, folder: &std::path::Path) -> anyhow::Result<ExitCode> {
    if args.json {
        display::out(&summary.to_json()?)?;
    } else if args.quiet {
        display::out(&format!("digest {}\n", summary.digest))?;
    } else {
        display::out(&display::table(summary))?;
        display::out(&format!("results in {}\n", folder.display()))?;
    }
    Ok(if summary.status == "complete" {
        ExitCode::SUCCESS
    } else {
        ExitCode::from(crate::INTERRUPTED)
    })
}

/// The table that `given` names: that of the sweep in it if it is a folder.
pub fn table_of(given: &Path) -> Result<PathBuf, SweepError> {
    if given.is_dir() {
        table_in(given)
    } else {
        Ok(given.to_owned())
    }
}

/// Whether both paths lead to one file or folder.
pub fn is_same(a: &Path, b: &Path) -> bool {
    match (a.canonicalize(), b.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        (Err(_), _) | (_, Err(_)) => false,
    }
}
