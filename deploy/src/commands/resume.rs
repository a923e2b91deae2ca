//! Start or resume of a run over the bus: its external inputs and its replay up to the resume TTI. A resumed run must
//! have the digest and tables of an undisturbed one (`tests/program/takeover.rs`).

use std::path::Path;
use std::sync::atomic::Ordering;

use anyhow::ensure;
use reveille_bs::cycle::PreparedRun;
use reveille_bs::observer::Observer;
use reveille_bs::policy::outside;
use reveille_bs::server::RunProgress;
use reveille_bs::session::Session;
use reveille_common::ids::Tti;
use reveille_common::message::HostCheckpoint;
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::resume_mark::ResumeMark;
use reveille_lab::run::{Run, RunOptions};

use super::run::advance;
use crate::display::note;
use crate::exit::Interrupted;
use crate::input_log::{self, INPUT_LOG_FILE, InputLog};
use crate::resume_mark;

/// The start of a run, or the point at which it resumes.
pub(super) struct ResumePlan {
    /// The known external inputs. A new run gets them from another run or a script, a resumed run from its log. Inputs
    /// after the resume TTI stay queued.
    pub inputs: ExternalInputs,
    /// The log for later inputs; it holds `inputs` already.
    pub log: InputLog,
    /// The resume mark that the replay must reproduce. The mark writer, an observer of the replay, compares it.
    pub mark: Option<ResumeMark>,
    /// Window length of the resumed run, TTIs; `None` for a new run, or without a mark.
    pub window: Option<u64>,
    /// The TTI up to which the run is replayed in memory; `None` for a new run.
    pub resume_tti: Option<Tti>,
}

impl ResumePlan {
    /// Creates the plan of a new run with these `inputs`, recorded in another run or scripted, and logs them.
    ///
    /// # Errors
    /// If they cannot be written.
    pub(super) fn new(inputs: &ExternalInputs, mut log: InputLog) -> anyhow::Result<Self> {
        log.add_all(inputs)?;
        Ok(Self {
            inputs: inputs.clone(),
            log,
            mark: None,
            window: None,
            resume_tti: None,
        })
    }

    /// Creates the plan to resume the `prepared` run in this `folder`.
    ///
    /// # Errors
    /// If the folder cannot be read or written or does not match the run, or `progress` asks the run to stop.
    pub(super) fn from_folder(
        folder: &Path,
        prepared: &PreparedRun,
        mut log: InputLog,
        progress: &RunProgress,
    ) -> anyhow::Result<Self> {
        let scenario = &prepared.scenario;
        let mut mark = resume_mark::read(folder, scenario)?;
        let mut inputs = input_log::read_folder(folder, scenario)?;
        let window = mark.as_ref().map(|mark| mark.window);
        // The last removal, since the log is in order of TTIs. It can be later than the mark; the run then reached at
        // least the TTI after it.
        let after_last_removal = inputs.removals.last().map(|removal| removal.tti + 1);
        let mut resume_tti = mark.as_ref().map(|mark| Tti(mark.tti)).max(after_last_removal);
        if let Some(known_end) = resume_tti
            && outside::is_external(&scenario.policy)
            && let Some(tti) = first_undecided(prepared, &inputs, known_end, progress)?
        {
            // The run was killed in a TTI with lost devices, or a power cut took the last decisions.
            note!("{INPUT_LOG_FILE} ends at TTI {tti}; resuming from there");
            inputs = inputs.before(tti);
            log.replace(&inputs)?;
            // From here on the run may decide differently, and then never reproduces a later mark.
            mark = mark.filter(|mark| Tti(mark.tti) <= tti);
            resume_tti = Some(tti);
        }
        Ok(Self {
            inputs,
            log,
            mark,
            window,
            resume_tti,
        })
    }
}

/// Finds the first TTI before `end` for which `inputs` lack a decision, if any.
fn first_undecided(
    prepared: &PreparedRun,
    inputs: &ExternalInputs,
    end: Tti,
    progress: &RunProgress,
) -> anyhow::Result<Option<Tti>> {
    // A trial without observers: `replay` shows them the run afterwards.
    let mut run = Run::new(prepared, RunOptions::default());
    run.schedule_inputs(inputs);
    advance_to(&mut run, end, progress, &mut ())?;
    Ok(run.missing_decision())
}

/// Advances `run` to TTI `to`. Returns false if it ends earlier, because a decision is missing or `observer` ends it.
///
/// # Errors
/// If `progress` asks the run to stop.
fn advance_to(run: &mut Run, to: Tti, progress: &RunProgress, observer: &mut impl Observer) -> anyhow::Result<bool> {
    let is_stop_requested = || progress.is_stop_requested();
    let has_reached = advance(run, to, observer, |next| {
        progress.next_tti.store(next.0, Ordering::Relaxed);
        !is_stop_requested()
    });
    ensure!(has_reached || !is_stop_requested(), Interrupted::DURING_REPLAY);
    Ok(has_reached)
}

/// Replays a run up to TTI `to` in memory, with the `window` of its first part. Returns it with its devices; later
/// decisions and actions stay queued. If `observer` ends the replay, the run returned has diverged from its mark, and
/// must not continue: `ResumeMarkWriter::check` returns the error.
///
/// # Errors
/// If `progress` asks the run to stop, or a logged removal did not take effect.
pub(super) fn replay(
    prepared: &PreparedRun,
    inputs: &ExternalInputs,
    to: Tti,
    window: u64,
    progress: &RunProgress,
    observer: &mut impl Observer,
) -> anyhow::Result<(Session, HostCheckpoint)> {
    note!("replaying the run up to TTI {to}");
    let options = RunOptions {
        lookahead: true,
        window,
    };
    let mut run = Run::new(prepared, options);
    run.schedule_inputs(inputs);
    let has_reached = advance_to(&mut run, to, progress, observer)?;
    // `to` lies after the last logged removal, so all of them must have taken effect.
    let has_removed_all = run.input_queue().removal_count() == 0;
    ensure!(has_removed_all || !has_reached, input_log::MISMATCH);
    Ok(run.into_resumed())
}
