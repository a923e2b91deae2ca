//! A run over the bus that is taken up: what it depends on besides, and how it is brought to where it goes on.

use std::path::Path;
use std::sync::atomic::Ordering;

use anyhow::{bail, ensure};
use reveille_bs::host::{Decisions, Progress};
use reveille_bs::observe::Observer;
use reveille_bs::policy::external::Answered;
use reveille_bs::policy::outside;
use reveille_bs::prepared::Prepared;
use reveille_bs::taken::Taken;
use reveille_common::ids::Tti;
use reveille_lab::inputs::Inputs;
use reveille_lab::mark::Mark;
use reveille_lab::run::{Options, Run};

use super::run::Interrupted;
use crate::display::note;
use crate::input_log::{self, INPUTS, InputLog};
use crate::marks;

/// TTIs of a replay between two looks for a signal.
const STRIDE: u64 = 10_000;

/// Where a run is taken up.
pub struct Beginning {
    /// What it depends on besides, as far as that came before.
    pub inputs: Inputs,
    /// Where more of it is kept.
    pub log: InputLog,
    /// The mark that it comes by.
    pub mark: Option<Mark>,
    /// The TTI to which it is brought in memory; nothing for one that begins.
    pub from: Option<Tti>,
}

impl Beginning {
    /// Of a run that begins, with the decisions `kept` of another, which are copied into its log.
    ///
    /// # Errors
    /// They cannot be written.
    pub fn new(kept: &[Answered], mut log: InputLog) -> anyhow::Result<Self> {
        let inputs = Inputs {
            outages: Vec::new(),
            decisions: kept.to_vec(),
        };
        log.add_all(&inputs)?;
        Ok(Self {
            inputs,
            log,
            mark: None,
            from: None,
        })
    }

    /// Of the run that is `prepared` in this `folder`.
    ///
    /// # Errors
    /// What is in the folder cannot be read, or is of no use.
    pub fn of_folder(folder: &Path, prepared: &Prepared, mut log: InputLog) -> anyhow::Result<Self> {
        let scenario = &prepared.scenario;
        let mut mark = marks::read(folder, scenario)?;
        let mut inputs = input_log::of_folder(folder, scenario)?;
        // What a mark knows nothing of, the run may have gone on from.
        let known = inputs.outages.last().map(|outage| outage.tti + 1);
        let mut from = mark.as_ref().map(|mark| Tti(mark.tti)).max(known);
        if let Some(to) = from
            && outside::is_external(&scenario.policy)
            && let Some(tti) = undecided(prepared, &inputs, to)
        {
            // It was killed over a TTI in which devices were lost, or the last decisions are lost with a power cut.
            note!("{INPUTS} has no more than the decisions before TTI {tti}: the run is taken up there");
            inputs = inputs.before(tti);
            log.replace(&inputs)?;
            mark = mark.filter(|mark| Tti(mark.tti) <= tti);
            from = Some(tti);
        }
        Ok(Self {
            inputs,
            log,
            mark,
            from,
        })
    }
}

/// The TTI before `to` that was not decided to its end, if there is one.
fn undecided(prepared: &Prepared, inputs: &Inputs, to: Tti) -> Option<Tti> {
    let mut run = Run::new(prepared, Options::default());
    run.expect_all(inputs);
    run.advance(to, &mut ());
    run.undecided()
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
    ensure!(!run.awaits_outages() || run.cycle().next_tti() < to, input_log::MISFIT);
    let kept = run.take_decisions();
    let decisions = Decisions {
        before: (inputs.decisions.len() - kept.len()) as u64,
        kept,
        port: None,
    };
    Ok((run.hand_over(), decisions))
}
