//! A run over the bus that is taken up: what it depends on besides, and how it is brought to where it goes on.

use std::path::Path;
use std::sync::atomic::Ordering;

use anyhow::{bail, ensure};
use reveille_bs::host::{Decisions, Progress};
use reveille_bs::observe::Observer;
use reveille_bs::policy::external::Answered;
use reveille_bs::prepared::Prepared;
use reveille_bs::taken::Taken;
use reveille_common::ids::Tti;
use reveille_common::scenario::Scenario;
use reveille_lab::inputs::Inputs;
use reveille_lab::run::{Options, Run};

use super::run::Interrupted;
use crate::display::note;
use crate::input_log::{self, INPUTS, InputLog};
use crate::marks;

/// TTIs of a replay between two looks for a signal.
const STRIDE: u64 = 10_000;

/// What the run depends on besides, as far as it is known: what is in the folder of one that is taken up, or the
/// decisions that it was given, which are copied there.
pub fn inputs(
    is_resumed: bool,
    kept: &[Answered],
    (folder, scenario): (&Path, &Scenario),
    mut log: InputLog,
) -> anyhow::Result<(Inputs, InputLog)> {
    if is_resumed {
        return Ok((input_log::of_folder(folder, scenario)?, log));
    }
    let given = Inputs {
        outages: Vec::new(),
        decisions: kept.to_vec(),
    };
    log.add_all(&given)?;
    Ok((given, log))
}

/// Brings a run that is taken up to TTI `to`, in memory. Also gives the decisions that were made after that.
pub fn replay(
    prepared: &Prepared,
    inputs: &Inputs,
    to: Tti,
    window: u64,
    progress: &Progress,
    observer: &mut impl Observer,
) -> anyhow::Result<(Taken, Decisions)> {
    note!("replaying the run up to TTI {to}");
    let options = Options {
        lookahead: true,
        window,
    };
    let mut run = Run::new(prepared, options);
    run.expect_all(inputs);
    while run.cycle().next_tti() < to {
        if progress.stop.load(Ordering::Relaxed) {
            bail!(Interrupted);
        }
        let next = run.cycle().next_tti();
        if !run.advance(to.min(next + STRIDE), observer) {
            break;
        }
        progress.tti.store(run.cycle().next_tti().0, Ordering::Relaxed);
    }
    ensure!(
        !run.is_undecided(),
        "{INPUTS} ends with a decision before TTI {}, and {} says that the run had come to TTI {to}: was it changed?",
        run.cycle().next_tti(),
        marks::MARK
    );
    ensure!(!run.awaits_outages() || run.cycle().next_tti() < to, input_log::MISFIT);
    let decisions = Decisions {
        before: run.decisions(),
        kept: run.take_decisions(),
        port: None,
    };
    Ok((run.hand_over(), decisions))
}
