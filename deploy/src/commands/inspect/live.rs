//! A live run, observed through the tap of its bus.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use anyhow::anyhow;
use reveille_common::bus::{Bus, DeclarationGuard};
use reveille_common::ids::Tti;
use reveille_common::message::{
    ClockCommand, ClockStatus, DescribeRequest, Frame, LogPart, Message, MessageKind, Query, ReadLog, TapBatch,
};
use reveille_view::recording::Bundle;
use tokio::sync::Notify;
use tokio::sync::mpsc::Receiver;

use super::catch_up::CatchUp;
use crate::cli::TargetArgs;
use crate::display::note;
use crate::exit::Interrupted;
use crate::run_registry;
use crate::signals::{Insistence, Manner, Signals};

const PATIENCE: Duration = Duration::from_secs(5);
/// Batches of frames that can wait in the queue.
const QUEUE: usize = 4_096;
/// Longest wait for each of the last frames of an ended run.
const LAST: Duration = Duration::from_millis(300);

/// An observed run.
pub(crate) struct Live {
    bus: Bus,
    /// The run's name.
    pub run: String,
    /// Number of devices N.
    pub devices: u32,
    /// The clock's status at the connection.
    status: ClockStatus,
    batches: Receiver<TapBatch>,
    ended: Arc<Notify>,
    is_over: bool,
    signals: Signals,
    insistence: Option<Insistence>,
    /// The TTI before which [`Self::follow`] has passed on everything.
    reached: Tti,
    /// The number of the next frame, once one has arrived.
    expected: Option<u64>,
    /// Frames dropped because this reader was too slow.
    pub left_out: u64,
    _declared: [DeclarationGuard; 2],
}

impl Live {
    /// Connects to the run that `target` selects.
    ///
    /// # Errors
    /// If there is no such run.
    pub(crate) async fn connect(target: &TargetArgs) -> anyhow::Result<Self> {
        let found = run_registry::find(target)?;
        let bus = Bus::connect(&found.endpoint, found.run, PATIENCE)
            .await?
            .with_key(found.key);
        if !bus.list_runs(PATIENCE).await?.contains(&bus.keys().run().to_string()) {
            return Err(bus.no_run_error().await.into());
        }
        let Some(status) = bus.query(&ClockCommand::Status, PATIENCE).await? else {
            return Err(bus.no_run_error().await.into());
        };
        let (send, batches) = tokio::sync::mpsc::channel(QUEUE);
        let ended = Arc::new(Notify::new());
        let bell = Arc::clone(&ended);
        let watch = bus.watch_alive(bus.keys().bs_alive(), move |_, alive| {
            if !alive {
                // `notify_one` keeps a permit: the token can disappear before anything waits for the bell.
                bell.notify_one();
            }
        })?;
        let tap = bus.observe(move |batch| {
            // The callback must not block zenoh's thread; a batch without room shows as a gap in the frame numbers.
            let _no_room = send.try_send(batch).is_err();
        })?;
        Ok(Self {
            run: bus.keys().run().to_string(),
            devices: status.devices,
            status,
            bus,
            batches,
            ended,
            is_over: false,
            signals: Signals::install(Manner::Leaves)?,
            insistence: None,
            reached: Tti::ZERO,
            expected: None,
            left_out: 0,
            _declared: [watch, tap],
        })
    }

    /// The bus session.
    pub(crate) fn bus(&self) -> Bus {
        self.bus.clone()
    }

    /// The signals that end the observation.
    pub(crate) fn signals(&self) -> Signals {
        self.signals.clone()
    }

    /// Ends the program soon after a signal, until this is closed: output without a reader may block.
    ///
    /// # Errors
    /// If the thread cannot be started.
    pub(crate) fn insist(&mut self) -> io::Result<()> {
        self.insistence = Some(self.signals.insist(|| Interrupted::BARE.to_string())?);
        Ok(())
    }

    /// Queries the base station, until a signal comes.
    async fn ask<Q: Query<Address = ()>>(&self, question: &Q) -> anyhow::Result<Option<Q::Reply>> {
        let reply = self.signals.or(self.bus.query(question, PATIENCE)).await;
        Ok(reply.ok_or(Interrupted::BARE)??)
    }

    /// Whether the run has ended.
    pub(crate) const fn has_ended(&self) -> bool {
        self.is_over
    }

    /// Prints the position of the run, since a paused run may send nothing else for long.
    pub(crate) fn report_position(&self) {
        note!("connected to run {}: {}", self.run, self.status);
    }

    /// The scenario of the run.
    ///
    /// # Errors
    /// If the run has ended, or a signal comes.
    pub(crate) async fn bundle(&self) -> anyhow::Result<Bundle> {
        match self.ask(&DescribeRequest).await? {
            Some(description) => Ok(description.into()),
            None => Err(self.bus.no_run_error().await.into()),
        }
    }

    /// Receives the next frames and the number of frames dropped before them. Returns `None` once the run has ended or
    /// a signal came.
    pub(crate) async fn next(&mut self) -> Option<(Vec<Frame>, u64)> {
        if !self.is_over {
            tokio::select! {
                // In this order: a signal ends the wait, and batches that have arrived come before the end of the run.
                biased;
                () = self.signals.first() => return None,
                batch = self.batches.recv() => return batch.map(|batch| self.take(batch)),
                () = self.ended.notified() => self.is_over = true,
            }
        }
        // The end of the run becomes visible before its last batches arrive.
        let last = tokio::time::timeout(LAST, self.batches.recv());
        let last = self.signals.or(last).await?.ok().flatten();
        last.map(|batch| self.take(batch))
    }

    /// Checks that a followed run did not end before its last TTI.
    ///
    /// # Errors
    /// If it did.
    pub(crate) fn report_early_end(&self) -> anyhow::Result<()> {
        let (reached, ttis) = (self.reached, self.status.ttis);
        anyhow::ensure!(
            !self.is_over || reached.0 >= ttis,
            "the run was interrupted or failed before TTI {reached} of {ttis}"
        );
        Ok(())
    }

    /// Creates the catch-up of the run that `bundle` describes, up to this connection.
    ///
    /// # Errors
    /// If the scenario of `bundle` is invalid, the run has ended, or a signal comes.
    pub(crate) async fn past(&self, bundle: &Bundle) -> anyhow::Result<CatchUp> {
        let signals = self.signals.clone();
        let mut past = CatchUp::new(bundle.load()?, move || signals.have_come());
        if self.learn(&mut past).await? {
            Ok(past)
        } else {
            Err(self.bus.no_run_error().await.into())
        }
    }

    /// Passes every frame of the run to `take`, from TTI 0 on; frames of its `past` come without the emulation plane.
    /// Stops when the run ends, a signal comes, or `take` returns false. Dropped messages are counted and reported
    /// once.
    ///
    /// # Errors
    /// If the external inputs of the run cannot be read.
    pub(crate) async fn follow(
        &mut self,
        mut past: CatchUp,
        mut take: impl FnMut(Frame) -> bool,
    ) -> anyhow::Result<()> {
        let mut reached = Tti::ZERO;
        let mut take = |frame: Frame| {
            if frame.kind == MessageKind::World
                && let Ok(Message::World(world)) = frame.message()
            {
                reached = world.last + 1;
            }
            take(frame)
        };
        let (mut goes_on, mut is_told, mut is_there) = (true, false, true);
        // The replay can take long; `block_in_place` keeps other tasks going, such as the dashboard's.
        tokio::task::block_in_place(|| past.catch_up(&self.status, |frame| goes_on &= take(frame)))?;
        while goes_on && let Some((frames, _)) = self.next().await {
            // The tap also copies the query below: frames of other kinds must not trigger the next query.
            let is_due =
                |frame: &Frame| matches!(frame.kind, MessageKind::Plan | MessageKind::World | MessageKind::Clock);
            if !past.is_over() && frames.iter().any(is_due) {
                is_there = match self.learn(&mut past).await {
                    Err(error) if error.is::<Interrupted>() => break,
                    learned => learned?,
                };
            }
            tokio::task::block_in_place(|| {
                let mut frames = frames.into_iter();
                frames.try_for_each(|frame| past.push(frame, |frame| goes_on &= take(frame)))
            })
            .map_err(|error| {
                if is_there {
                    return error;
                }
                anyhow!("the run ended before this observer had caught up; use `up --record` to record from TTI 0")
            })?;
            if self.left_out > 0 && !is_told {
                let (left_out, tti) = (self.left_out, past.replayed_until());
                note!("{left_out} messages after TTI {tti} were dropped (reader too slow)");
                is_told = true;
            }
        }
        self.reached = reached;
        Ok(())
    }

    /// Passes new lines of the input log to `past`. Returns false if the run has ended.
    ///
    /// # Errors
    /// If the log cannot be read, or a signal comes.
    async fn learn(&self, past: &mut CatchUp) -> anyhow::Result<bool> {
        loop {
            let from = past.read();
            let Some(part) = self.ask(&ReadLog { from }).await? else {
                return Ok(false);
            };
            let is_more = tokio::task::block_in_place(|| past.read_input_log(&part.bytes))?;
            // A part shorter than the limit ends the log. Inputs added meanwhile are read at the next grant.
            if !is_more || (part.bytes.len() as u64) < LogPart::LONGEST {
                return Ok(true);
            }
        }
    }

    fn take(&mut self, batch: TapBatch) -> (Vec<Frame>, u64) {
        // Saturating: a batch whose numbers go back must not wrap the count.
        let missing = batch.first.saturating_sub(self.expected.unwrap_or(batch.first));
        self.left_out += missing;
        self.expected = Some(batch.first.saturating_add(batch.frames.len() as u64));
        (batch.frames, missing)
    }

    /// Closes the connection.
    pub(crate) async fn close(self) {
        // All output is written; closing the session may take longer than the grace.
        drop(self.insistence);
        self.bus.close().await;
    }
}
