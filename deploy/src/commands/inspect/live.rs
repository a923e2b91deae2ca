//! A live run, observed through the tap of its bus, for `inspect` and the dashboard. The run never waits for this
//! process: frames that it cannot take are dropped and counted. Tests wait for the note `connected to run`, which comes
//! only after the tap is declared, so that no later frame is missed, and after the handlers of signals are installed.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use anyhow::anyhow;
use reveille_common::bus::{Bus, DeclarationGuard, Role};
use reveille_common::ids::Tti;
use reveille_common::message::{
    ClockCommand, ClockStatus, DescribeRequest, Frame, InputLogPart, InputLogRequest, Message, MessageKind, Query,
};
use reveille_view::recording::ScenarioBundle;
use tokio::sync::watch;

use super::catch_up::CatchUp;
use super::frame_stream::{BsPresence, FrameStream};
use crate::cli::TargetArgs;
use crate::display::{count_noun, note};
use crate::exit::Interrupted;
use crate::run_registry;
use crate::signals::{ForcedExit, SignalMode, Signals};

/// Longest wait for the connection and for each reply.
const QUERY_TIMEOUT: Duration = Duration::from_secs(5);
/// Roles of programs that only observe, the preferred one first.
pub(crate) const OBSERVERS: [Role; 2] = [Role::Observer, Role::Operator];
/// Batches of frames that can wait in the queue.
const MAX_QUEUED_BATCHES: usize = 4_096;
/// Pause between two queries of a base station that has just returned.
const QUERY_PAUSE: Duration = Duration::from_millis(200);
/// Longest wait for a base station that has left the bus before the end of its run, unless the caller sets another.
const RETURN_TIMEOUT: Duration = Duration::from_secs(10);

/// An observed run.
pub(crate) struct Live {
    bus: Bus,
    /// The run's name.
    pub run_name: String,
    /// Number of devices N.
    pub devices: u32,
    /// The clock's status when the base station was last reached.
    status: ClockStatus,
    frames: FrameStream,
    /// Longest wait for a base station that has left the bus before the end of its run.
    return_timeout: Duration,
    /// Called with false when the base station has left the bus before the end of its run, and with true on its return.
    on_reachability: Box<dyn Fn(bool) + Send>,
    signals: Signals,
    /// The thread of [`Self::force_exit_after_signal`].
    forced_exit: Option<ForcedExit>,
    /// The TTI before which [`Self::follow`] has passed on everything; set when it returns without an error.
    reached: Tti,
    _declared: [DeclarationGuard; 2],
}

impl Live {
    /// Connects to the run that `target` selects, over TLS with the certificate of the first of `roles` that it finds.
    ///
    /// # Errors
    /// If there is no such run, the bus fails, or the handlers of signals cannot be installed.
    pub(crate) async fn connect(target: &TargetArgs, roles: &[Role]) -> anyhow::Result<Self> {
        let address = run_registry::find(target)?;
        let bus = address.connect(roles, QUERY_TIMEOUT).await?;
        if !bus
            .list_runs(QUERY_TIMEOUT)
            .await?
            .contains(&bus.key_exprs().run().to_string())
        {
            return Err(bus.no_run_error().await.into());
        }
        let Some(status) = bus.query(&ClockCommand::Status, QUERY_TIMEOUT).await? else {
            return Err(bus.no_run_error().await.into());
        };
        let (batch_sender, batches) = tokio::sync::mpsc::channel(MAX_QUEUED_BATCHES);
        let (presence_sender, bs_presence) = watch::channel(BsPresence::default());
        let presence_sender = Arc::new(presence_sender);
        let presence_reader = Arc::clone(&presence_sender);
        let watch = bus.watch_alive(bus.key_exprs().bs_liveliness(), move |_, is_present| {
            presence_sender.send_modify(|presence| {
                presence.is_present = is_present;
                presence.losses += u64::from(!is_present);
            });
        })?;
        let tap = bus.observe(move |batch| {
            // The callback must not block zenoh's thread; a batch without room shows as a gap in the frame numbers.
            let losses = presence_reader.borrow().losses;
            let _no_room = batch_sender.try_send((losses, batch)).is_err();
        })?;
        Ok(Self {
            run_name: bus.key_exprs().run().to_string(),
            devices: status.devices,
            status,
            bus,
            frames: FrameStream::new(batches, bs_presence),
            return_timeout: RETURN_TIMEOUT,
            on_reachability: Box::new(|_| {}),
            signals: Signals::install(SignalMode::HasNoResults)?,
            forced_exit: None,
            reached: Tti::ZERO,
            _declared: [watch, tap],
        })
    }

    /// The bus session.
    pub(crate) fn bus(&self) -> Bus {
        self.bus.clone()
    }

    /// Waits without limit for a base station that has left the bus before the end of its run, and calls
    /// `on_reachability` with false when it leaves and with true when it is back.
    pub(crate) fn wait_for_lost_bs(&mut self, on_reachability: impl Fn(bool) + Send + 'static) {
        (self.return_timeout, self.on_reachability) = (Duration::MAX, Box::new(on_reachability));
    }

    /// The signals that end the observation.
    pub(crate) fn signals(&self) -> Signals {
        self.signals.clone()
    }

    /// Ends the program soon after a signal, until this is closed: output without a reader may block.
    ///
    /// # Errors
    /// If the thread cannot be started.
    pub(crate) fn force_exit_after_signal(&mut self) -> io::Result<()> {
        self.forced_exit = Some(
            self.signals
                .force_exit_after_signal(|| Interrupted::WITHOUT_RESULTS.to_string())?,
        );
        Ok(())
    }

    /// Queries the base station, until a signal comes.
    async fn query_bs<Q: Query<Address = ()>>(&self, query: &Q) -> anyhow::Result<Option<Q::Reply>> {
        let reply = self
            .signals
            .unless_interrupted(self.bus.query(query, QUERY_TIMEOUT))
            .await;
        Ok(reply.ok_or(Interrupted::WITHOUT_RESULTS)??)
    }

    /// Whether the base station has left the bus.
    pub(crate) const fn has_ended(&self) -> bool {
        self.frames.is_bs_lost
    }

    /// The number of frames dropped because this reader was too slow.
    pub(crate) const fn dropped_frames(&self) -> u64 {
        self.frames.dropped_frames
    }

    /// Prints the position of the run, since a paused run may send nothing else for long.
    pub(crate) fn report_position(&self) {
        note!("connected to run {}: {}", self.run_name, self.status);
    }

    /// The scenario of the run.
    ///
    /// # Errors
    /// If the run has ended, or a signal comes.
    pub(crate) async fn bundle(&self) -> anyhow::Result<ScenarioBundle> {
        match self.query_bs(&DescribeRequest).await? {
            Some(description) => Ok(description.into()),
            None => Err(self.bus.no_run_error().await.into()),
        }
    }

    /// Receives the next frames and the number of frames dropped before them. Returns `None` once the base station has
    /// left the bus or a signal came.
    pub(crate) async fn next(&mut self) -> Option<(Vec<Frame>, u64)> {
        tokio::select! {
            biased;
            () = self.signals.wait_for_first() => None,
            frames = self.frames.next() => frames,
        }
    }

    /// After [`Self::next`] has returned `None`: waits for the return of a base station that left the bus before the
    /// end of its run, such as one that was disconnected, paused or resumed by a new process. Returns false if the run
    /// has ended, a signal came, or the base station has not returned in time. Frames sent in between are lost.
    ///
    /// # Errors
    /// If the bus fails, or the base station that returns has another run.
    async fn wait_for_return(&mut self) -> anyhow::Result<bool> {
        if self.signals.has_arrived() || self.frames.is_run_over {
            return Ok(false);
        }
        let limit = if self.return_timeout == Duration::MAX {
            String::new()
        } else {
            format!(" up to {} s", self.return_timeout.as_secs())
        };
        (self.on_reachability)(false);
        note!(
            "the base station of run {} has left the bus; waiting{limit} for its return",
            self.run_name
        );
        let signals = self.signals.clone();
        let returned = tokio::time::timeout(self.return_timeout, self.query_returned_bs());
        let Some(Ok(returned)) = signals.unless_interrupted(returned).await else {
            return Ok(false);
        };
        let Some(status) = returned? else {
            return Ok(false);
        };
        anyhow::ensure!(
            status.run_id == self.status.run_id,
            "another run called {} answers now; start again to observe it",
            self.run_name
        );
        (self.on_reachability)(true);
        let dropped = match self.frames.take_unreported_drops() {
            0 => String::new(),
            dropped => format!("; {} dropped before (reader too slow)", count_noun(dropped, "message")),
        };
        note!("the base station is back: {status}{dropped}");
        self.status = status;
        self.frames.resume();
        Ok(true)
    }

    /// Waits until the base station is on the bus again and answers, and returns its status; `None` if a late message
    /// ends the run.
    async fn query_returned_bs(&mut self) -> anyhow::Result<Option<ClockStatus>> {
        while self.frames.wait_for_bs().await? {
            let status = self.bus.query(&ClockCommand::Status, QUERY_TIMEOUT).await?;
            if status.is_some() {
                return Ok(status);
            }
            // A query without a route to the base station ends immediately.
            tokio::time::sleep(QUERY_PAUSE).await;
        }
        Ok(None)
    }

    /// Checks that a run did not end before its last TTI. Call it after [`Self::follow`], which counts the TTIs.
    ///
    /// # Errors
    /// If it did.
    pub(crate) fn check_ran_to_end(&self) -> anyhow::Result<()> {
        let (reached, ttis) = (self.reached, self.status.ttis);
        anyhow::ensure!(
            !self.frames.is_bs_lost || reached.0 >= ttis,
            "the run was interrupted or failed before TTI {reached} of {ttis}"
        );
        Ok(())
    }

    /// Creates the catch-up of the run that `bundle` describes, up to this connection.
    ///
    /// # Errors
    /// If the scenario of `bundle` is invalid, the run has ended, or a signal comes.
    pub(crate) async fn start_catch_up(&self, bundle: &ScenarioBundle) -> anyhow::Result<CatchUp> {
        let signals = self.signals.clone();
        let mut catch_up = CatchUp::new(bundle.load()?, move || signals.has_arrived());
        if self.fetch_new_inputs(&mut catch_up).await? {
            Ok(catch_up)
        } else {
            Err(self.bus.no_run_error().await.into())
        }
    }

    /// Passes the frames of the run to `on_frame`, from TTI 0 on; frames of `catch_up` lack the emulation plane. Stops
    /// when the run ends, a signal comes, or `on_frame` returns false. The first dropped messages are reported
    /// immediately, later ones only if the base station leaves the bus and returns; `dropped_frames` counts all. The
    /// messages in between are caught up too.
    ///
    /// # Errors
    /// If the external inputs of the run cannot be read.
    pub(crate) async fn follow(
        &mut self,
        mut catch_up: CatchUp,
        mut on_frame: impl FnMut(Frame) -> bool,
    ) -> anyhow::Result<()> {
        let mut reached = Tti::ZERO;
        let mut on_frame = |frame: Frame| {
            if frame.kind == MessageKind::World
                && let Ok(Message::World(world)) = frame.message()
            {
                reached = world.last + 1;
            }
            on_frame(frame)
        };
        let (mut wants_more, mut has_warned, mut is_running, mut must_replay) = (true, false, true, true);
        while wants_more {
            if std::mem::take(&mut must_replay) {
                // The replay can take long; `block_in_place` keeps other tasks going, such as the dashboard's.
                tokio::task::block_in_place(|| {
                    catch_up.replay_closed_ttis(&self.status, |frame| wants_more &= on_frame(frame))
                })?;
                continue;
            }
            let Some((frames, dropped_before)) = self.next().await else {
                if !self.wait_for_return().await? {
                    break;
                }
                catch_up.restart();
                match self.fetch_new_inputs(&mut catch_up).await {
                    Err(error) if error.is::<Interrupted>() => break,
                    still_running => is_running = still_running?,
                }
                must_replay = is_running;
                continue;
            };
            if dropped_before > 0 {
                catch_up.note_gap();
            }
            // The kinds before which `CatchUp::push` needs the log. No others: the tap also copies the query below,
            // which must not trigger the next one.
            let may_trigger_replay =
                |frame: &Frame| matches!(frame.kind, MessageKind::Plan | MessageKind::World | MessageKind::Clock);
            if !catch_up.is_over() && frames.iter().any(may_trigger_replay) {
                is_running = match self.fetch_new_inputs(&mut catch_up).await {
                    Err(error) if error.is::<Interrupted>() => break,
                    still_running => still_running?,
                };
            }
            tokio::task::block_in_place(|| {
                let mut frames = frames.into_iter();
                frames.try_for_each(|frame| catch_up.push(frame, |frame| wants_more &= on_frame(frame)))
            })
            .map_err(|error| {
                if is_running {
                    return error;
                }
                anyhow!("the run ended before this observer had caught up; use `up --record` to record from TTI 0")
            })?;
            if self.dropped_frames() > 0 && !has_warned {
                let dropped = count_noun(self.frames.take_unreported_drops(), "message");
                let tti = catch_up.replayed_until();
                note!("{dropped} after TTI {tti} dropped (reader too slow)");
                has_warned = true;
            }
        }
        self.reached = reached;
        Ok(())
    }

    /// Fetches the new lines of the input log from the base station and passes them to `catch_up`. Returns false if the
    /// run has ended.
    ///
    /// # Errors
    /// If the log cannot be read, or a signal comes.
    async fn fetch_new_inputs(&self, catch_up: &mut CatchUp) -> anyhow::Result<bool> {
        loop {
            let from = catch_up.bytes_read();
            let Some(part) = self.query_bs(&InputLogRequest { from }).await? else {
                return Ok(false);
            };
            let has_grown = tokio::task::block_in_place(|| catch_up.read_input_log(&part.bytes))?;
            // A part shorter than the limit ends the log. Inputs added meanwhile are read at the next grant.
            if !has_grown || (part.bytes.len() as u64) < InputLogPart::MAX_BYTES {
                return Ok(true);
            }
        }
    }

    /// Closes the connection.
    pub(crate) async fn close(self) {
        // All output is written; closing the session may take longer than the grace.
        drop(self.forced_exit);
        self.bus.close().await;
    }
}
